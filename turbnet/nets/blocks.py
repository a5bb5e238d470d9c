"""Parts shared by the networks. Clips are (B, T, C, H, W); convolutions see their frames as one batch."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def each_frame(module: Callable[[Tensor], Tensor], clip_BTCHW: Tensor) -> Tensor:
    """Apply an image module to every frame of a clip."""
    batch, frames = clip_BTCHW.shape[:2]
    out = module(clip_BTCHW.flatten(0, 1))
    return out.unflatten(0, (batch, frames))


def zero_start(layer: nn.Conv2d, bias: float = 0.0) -> None:
    """Let a layer's output start as the constant `bias`: the network around it starts as its closed form."""
    nn.init.zeros_(layer.weight)
    if layer.bias is not None:
        nn.init.constant_(layer.bias, bias)


def conv3x3(inner: int, outer: int) -> nn.Conv2d:
    """A 3 x 3 convolution for which the border goes on outside the picture."""
    return nn.Conv2d(inner, outer, 3, padding=1, padding_mode="replicate")


class ChannelNorm(nn.Module):
    """Layer normalisation over the channels of each pixel, computed in float32 whatever the input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x_NCHW: Tensor) -> Tensor:
        channels_last = x_NCHW.permute(0, 2, 3, 1).float()
        normal = F.layer_norm(channels_last, self.weight.shape, self.weight.float(), self.bias.float(), 1e-5)
        return normal.to(x_NCHW.dtype).permute(0, 3, 1, 2)


class ResidualBlock(nn.Module):
    """Normalise, two 3 x 3 convolutions, add. Dense convolutions: depthwise ones need fewer sums and take a CPU longer."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = ChannelNorm(channels)
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x_NCHW: Tensor) -> Tensor:
        return x_NCHW + self.second(F.relu(self.first(self.norm(x_NCHW))))


def warp(image_NCHW: Tensor, flow_N2HW: Tensor) -> Tensor:
    """image(x + flow(x)), flow in pixels, x then y, bilinear; the border goes on outside the picture."""
    height, width = image_NCHW.shape[-2:]
    x = torch.arange(width, device=flow_N2HW.device, dtype=torch.float32)
    y = torch.arange(height, device=flow_N2HW.device, dtype=torch.float32)[:, None]
    flow = flow_N2HW.float()
    # Torch's backward pass writes outside its memory where a place is NaN; forward it takes it for the border.
    flow = flow.masked_fill(flow.isnan(), 0.0)
    grid = torch.stack(
        ((x + flow[:, 0] + 0.5) * (2 / width) - 1, (y + flow[:, 1] + 0.5) * (2 / height) - 1),
        dim=-1,
    )
    out = F.grid_sample(image_NCHW.float(), grid, mode="bilinear", padding_mode="border", align_corners=False)
    return out.to(image_NCHW.dtype)
