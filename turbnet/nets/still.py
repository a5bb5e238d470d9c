"""A single frame restored: a U-Net that knows inverse filters and, if it is given them, uncertainty maps."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from turbnet.nets.blocks import each_frame
from turbnet.nets.inverse import InverseFilters
from turbnet.nets.scene import SceneNet
from turbnet.nets.uncertainty import LEAST, MOST, Uncertainty, UncertaintyNet


class StillRestored(NamedTuple):
    """Restored frames (B, T, C, H, W), and what was expected of each; None without maps."""

    frames: Tensor
    uncertainty: Uncertainty | None


class StillRestorer(nn.Module):
    """Restores every frame by itself.

    Args:
        widths, depths: of its U-Net, see `turbnet.nets.scene.UBody`.
        inverse: arguments of `InverseFilters`.
        maps: arguments of `UncertaintyNet`, whose maps the U-Net sees beside the frame; None: it sees the frame alone.
    """

    def __init__(
        self,
        widths: Sequence[int] = (24, 48, 80),
        depths: Sequence[int] = (1, 2, 3),
        inverse: Mapping[str, Any] | None = None,
        maps: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.inverse = InverseFilters(**(inverse or {}))
        self.maps = None if maps is None else UncertaintyNet(**maps)
        filters, seen = len(self.inverse.weight), 0 if maps is None else 2 + 2 * 3
        self.net = SceneNet(3 + seen + 3 * filters, widths=widths, depths=depths, blends=filters)
        self.size_multiple = self.net.size_multiple

    def stages(self, frames_BTCHW: Tensor) -> StillRestored:
        """Restored frames and the maps that helped."""
        expected = None if self.maps is None else self.maps(frames_BTCHW)
        parts = [frames_BTCHW]
        if expected is not None:
            # Logarithms in 0 to 1, so that small errors count, and what is expected to change.
            parts.append(((expected.log_scale - LEAST) / (MOST - LEAST)).to(frames_BTCHW.dtype))
            parts.append(expected.change.flatten(2, 3).to(frames_BTCHW.dtype))
        parts.append(each_frame(lambda x: self.inverse(x).flatten(1, 2), frames_BTCHW))
        return StillRestored(each_frame(self.net, torch.cat(parts, dim=2)), expected)

    def forward(self, frames_BTCHW: Tensor) -> Tensor:
        """Restored frames (B, T, C, H, W), sRGB-encoded in [0, 1] like the input; H and W multiples of `size_multiple`."""
        return self.stages(frames_BTCHW).frames
