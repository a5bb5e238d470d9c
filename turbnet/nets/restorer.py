"""The multi-frame restorer: tilt removal, then the TCJA transformer."""

import math
from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from turbnet.nets.tcja import TCJATransformer
from turbnet.nets.tilt import Registered, TiltNet


class Restorer(nn.Module):
    """Registers a clip and restores every frame of it.

    Args:
        tilt: arguments of `TiltNet`.
        tcja: arguments of `TCJATransformer`.
    """

    def __init__(self, tilt: Mapping[str, Any] | None = None, tcja: Mapping[str, Any] | None = None) -> None:
        super().__init__()
        self.tilt = TiltNet(**(tilt or {}))
        self.tcja = TCJATransformer(**(tcja or {}))
        self.size_multiple = math.lcm(self.tilt.size_multiple, self.tcja.size_multiple)

    def stages(self, frames_BTCHW: Tensor) -> tuple[Tensor, Registered]:
        """Restored frames, and what tilt removal made of the clip."""
        registered = self.tilt(frames_BTCHW)
        return self.tcja(registered.frames), registered

    def forward(self, frames_BTCHW: Tensor) -> Tensor:
        """Restored frames (B, T, C, H, W), sRGB-encoded in [0, 1] like the input; H and W multiples of `size_multiple`."""
        return self.stages(frames_BTCHW)[0]
