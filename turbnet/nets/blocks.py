"""Parts shared by the networks. Clips are (B, T, C, H, W); convolutions see their frames as one batch."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def each_frame(module: nn.Module, clip_BTCHW: Tensor) -> Tensor:
    """Apply an image module to every frame of a clip."""
    batch, frames = clip_BTCHW.shape[:2]
    out = module(clip_BTCHW.flatten(0, 1))
    return out.unflatten(0, (batch, frames))


def zero_start(layer: nn.Conv2d, bias: float = 0.0) -> None:
    """Let a layer's output start as the constant `bias`: the network around it starts as its closed form."""
    nn.init.zeros_(layer.weight)
    if layer.bias is not None:
        nn.init.constant_(layer.bias, bias)


class ChannelNorm(nn.Module):
    """Layer normalisation over the channels of each pixel, computed in float32 whatever the input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, x_NCHW: Tensor) -> Tensor:
        x = x_NCHW.float()
        mean = x.mean(dim=1, keepdim=True)
        variance = (x - mean).square().mean(dim=1, keepdim=True)
        x = (x - mean) * torch.rsqrt(variance + 1e-5)
        return (x * self.weight[:, None, None] + self.bias[:, None, None]).to(x_NCHW.dtype)


class GatedConv(nn.Module):
    """Feed-forward part: expand, mix over 3 x 3 pixels within each channel, gate one half by the other, contract."""

    def __init__(self, channels: int, expansion: float = 2.0) -> None:
        super().__init__()
        hidden = int(channels * expansion)
        self.expand = nn.Conv2d(channels, 2 * hidden, 1)
        self.mix = nn.Conv2d(2 * hidden, 2 * hidden, 3, padding=1, groups=2 * hidden)
        self.contract = nn.Conv2d(hidden, channels, 1)

    def forward(self, x_NCHW: Tensor) -> Tensor:
        a, b = self.mix(self.expand(x_NCHW)).chunk(2, dim=1)
        return self.contract(F.gelu(a) * b)


def warp(image_NCHW: Tensor, flow_N2HW: Tensor) -> Tensor:
    """image(x + flow(x)), flow in pixels, x then y, bilinear; the border goes on outside the picture."""
    height, width = image_NCHW.shape[-2:]
    x = torch.arange(width, device=flow_N2HW.device, dtype=torch.float32)
    y = torch.arange(height, device=flow_N2HW.device, dtype=torch.float32)[:, None]
    flow = flow_N2HW.float()
    grid = torch.stack(
        ((x + flow[:, 0] + 0.5) * (2 / width) - 1, (y + flow[:, 1] + 0.5) * (2 / height) - 1),
        dim=-1,
    )
    out = F.grid_sample(image_NCHW.float(), grid, mode="bilinear", padding_mode="border", align_corners=False)
    return out.to(image_NCHW.dtype)
