"""DnCNN, to compare with: a chain of 3 x 3 convolutions that predicts what is wrong (Zhang et al., IEEE TIP 2017)."""

from itertools import pairwise

from torch import Tensor, nn

from turbnet.errors import check_range
from turbnet.nets.blocks import conv3x3, each_frame, zero_start


class DnCNN(nn.Module):
    """Every frame by itself at full resolution, a receptive field of 2 `depth` + 1 pixels; without batch normalisation.

    Args:
        width: channels.
        depth: convolutions, at least 2.

    Raises:
        ParameterError: a value out of range.
    """

    size_multiple = 1

    def __init__(self, width: int = 32, depth: int = 10) -> None:
        super().__init__()
        check_range("width", width, 1, 4096)
        check_range("depth", depth, 2, 100)
        widths = [3, *[width] * (depth - 1)]
        layers = [layer for a, b in pairwise(widths) for layer in (conv3x3(a, b), nn.ReLU())]
        last = conv3x3(width, 3)
        zero_start(last)
        self.layers = nn.Sequential(*layers, last)

    def forward(self, frames_BTCHW: Tensor) -> Tensor:
        """Restored frames (B, T, C, H, W)."""
        return frames_BTCHW + each_frame(self.layers, frames_BTCHW)
