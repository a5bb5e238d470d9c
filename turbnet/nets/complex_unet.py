r"""A complex-valued U-Net, to compare with: amplitude and phase of features in place of real features.

A complex convolution is a real one of twice the channels whose weights are tied,

.. math::
    (W_r + i W_i) * (x_r + i x_i) = (W_r * x_r - W_i * x_i) + i\, (W_i * x_r + W_r * x_i)

so it has half the parameters at the same cost. After N. Anantrasirichai, Pattern Recognition Letters 171, 69 (2023), who
restores what registration has made of a clip; rectified part by part, normalised by magnitude.

Complex maps of C channels are real ones of 2C: all real parts, then all imaginary ones.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbnet.nets.blocks import conv3x3, each_frame, zero_start
from turbnet.nets.scene import UBody


class ComplexConv2d(nn.Module):
    """A convolution of complex maps, (N, 2 inner, H, W) to (N, 2 outer, H, W).

    Args:
        inner, outer: complex channels.
        size: of the kernel, pixels.
        stride: pixels; with a stride nothing is added around the picture, without one its border goes on.
    """

    def __init__(self, inner: int, outer: int, size: int = 3, stride: int = 1) -> None:
        super().__init__()
        self.stride, self.reach = stride, size // 2 if stride == 1 else 0
        # Two parts of half the variance make a complex number of the variance of a real weight.
        bound = (2 * inner * size**2) ** -0.5
        self.real, self.imaginary = (
            nn.Parameter(torch.empty(outer, inner, size, size).uniform_(-bound, bound)) for _ in range(2)
        )
        self.bias = nn.Parameter(torch.zeros(2 * outer))

    def forward(self, x_NCHW: Tensor) -> Tensor:
        weight = torch.cat((torch.cat((self.real, -self.imaginary), 1), torch.cat((self.imaginary, self.real), 1)))
        padded = F.pad(x_NCHW, (self.reach,) * 4, mode="replicate") if self.reach else x_NCHW
        return F.conv2d(padded, weight, self.bias, stride=self.stride)


class MagnitudeNorm(nn.Module):
    """Complex maps over the RMS magnitude of the channels at each pixel, in float32 at least; no phase is turned."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))

    def forward(self, x_NCHW: Tensor) -> Tensor:
        x = x_NCHW if x_NCHW.dtype == torch.float64 else x_NCHW.float()
        power = 2 * x.square().mean(1, keepdim=True)
        scaled = x * torch.rsqrt(power + 1e-5) * self.weight.repeat(2)[:, None, None]
        return scaled.to(x_NCHW.dtype)


class ComplexBlock(nn.Module):
    """Normalise, two complex convolutions, add."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = MagnitudeNorm(channels)
        self.first, self.second = ComplexConv2d(channels, channels), ComplexConv2d(channels, channels)

    def forward(self, x_NCHW: Tensor) -> Tensor:
        return x_NCHW + self.second(F.relu(self.first(self.norm(x_NCHW))))


class ComplexUNet(UBody):
    """Each frame the real part, the clip's temporal mean the imaginary part of what a complex U-Net corrects.

    Args:
        widths: complex channels at half, a quarter and an eighth of the resolution.
        depths: residual blocks at each scale, on the way down; on the way up as many but at the coarsest.
    """

    def __init__(self, widths: Sequence[int] = (8, 16, 24), depths: Sequence[int] = (1, 1, 2)) -> None:
        nn.Module.__init__(self)
        pairs = list(zip(widths, widths[1:], strict=False))
        self.embed = ComplexConv2d(12, widths[0])
        self.down = nn.ModuleList(ComplexConv2d(a, b, 2, stride=2) for a, b in pairs)
        self.know = None
        self.encode = nn.ModuleList(_blocks(w, d) for w, d in zip(widths, depths, strict=True))
        self.up = nn.ModuleList(ComplexConv2d(b, 4 * a, 1) for a, b in pairs)
        self.decode = nn.ModuleList(_blocks(w, d) for w, d in zip(widths[:-1], depths, strict=False))
        self.correct = conv3x3(2 * widths[0], 12)
        zero_start(self.correct)

    def forward(self, frames_BTCHW: Tensor) -> Tensor:  # type: ignore[override]
        """Restored frames (B, T, C, H, W), sRGB-encoded in [0, 1] like the input; H and W multiples of `size_multiple`."""
        mean = frames_BTCHW.mean(1, keepdim=True).expand_as(frames_BTCHW)
        return frames_BTCHW + each_frame(super().forward, torch.cat((frames_BTCHW, mean), dim=2))


def _blocks(channels: int, depth: int) -> nn.Sequential:
    return nn.Sequential(*(ComplexBlock(channels) for _ in range(depth)))
