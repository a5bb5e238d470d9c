"""A plain U-Net, to compare with: every frame by itself, the clip's temporal mean beside it."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from turbnet.nets.blocks import each_frame
from turbnet.nets.scene import SceneNet


class UNet(nn.Module):
    """Neither registration nor attention: what convolutions alone make of a frame and the mean of the clip.

    Args:
        widths: channels at half, a quarter and an eighth of the resolution.
        depths: residual blocks at each scale.
    """

    def __init__(self, widths: Sequence[int] = (16, 32, 48), depths: Sequence[int] = (1, 1, 2)) -> None:
        super().__init__()
        self.net = SceneNet(2 * 3, widths=widths, depths=depths)
        self.size_multiple = self.net.size_multiple

    def forward(self, frames_BTCHW: Tensor) -> Tensor:
        """Restored frames (B, T, C, H, W), sRGB-encoded in [0, 1] like the input; H and W multiples of `size_multiple`."""
        mean = frames_BTCHW.mean(1, keepdim=True).expand_as(frames_BTCHW)
        return each_frame(self.net, torch.cat((frames_BTCHW, mean), dim=2))
