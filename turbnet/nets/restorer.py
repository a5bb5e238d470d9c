"""The multi-frame restorer: tilt removal, the TCJA transformer, the still scene once a clip, and every frame's own part."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from torch import Tensor, nn

from turbnet.nets.scene import LuckyFusion, OwnFrame, SceneNet
from turbnet.nets.tcja import TCJATransformer
from turbnet.nets.tilt import Registered, TiltNet


class Restored(NamedTuple):
    """What the stages of a restorer found.

    Attributes:
        frames: restored frames (B, T, C, H, W).
        scene: the still scene (B, 1, C, H, W).
        gate: where a frame is not the still scene, (B, T, 1, H, W), 0 to 1.
        registered: what tilt removal made of the clip.
    """

    frames: Tensor
    scene: Tensor
    gate: Tensor
    registered: Registered


class Restorer(nn.Module):
    """Registers a clip and restores every frame of it: out = scene + gate (own - scene).

    Args:
        tilt: arguments of `TiltNet`.
        tcja: arguments of `TCJATransformer`.
        scene: `widths` and `depths` of `SceneNet`.
        fusions: pictures of the lucky fusion.
    """

    def __init__(
        self,
        tilt: Mapping[str, Any] | None = None,
        tcja: Mapping[str, Any] | None = None,
        scene: Mapping[str, Any] | None = None,
        fusions: int = 3,
    ) -> None:
        super().__init__()
        self.tilt = TiltNet(**(tilt or {}))
        self.tcja = TCJATransformer(**(tcja or {}))
        width, patch = self.tcja.width, self.tcja.patch
        self.fusion = LuckyFusion(width, patch, fusions)
        self.scene = SceneNet(3 * fusions, width, **(scene or {}))
        self.own = OwnFrame(width, patch)
        self.size_multiple = math.lcm(self.tilt.size_multiple, patch, self.scene.size_multiple)

    def stages(self, frames_BTCHW: Tensor) -> Restored:
        """Restored frames and what led to them."""
        registered = self.tilt(frames_BTCHW)
        confidence = registered.confidence
        gathered, features = self.tcja(registered.reference, registered.frames, confidence)
        fused = self.fusion(registered.frames, features, confidence)
        scene = self.scene(fused, gathered)[:, None]
        own, gate = self.own(registered.frames, features)
        return Restored(scene + gate * (own - scene), scene, gate, registered)

    def forward(self, frames_BTCHW: Tensor) -> Tensor:
        """Restored frames (B, T, C, H, W), sRGB-encoded in [0, 1] like the input; H and W multiples of `size_multiple`."""
        return self.stages(frames_BTCHW).frames
