"""Losses on clips (B, T, C, H, W)."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from turbnet.nets.blocks import warp
from turbnet.nets.tilt import SCALES


def charbonnier(a: Tensor, b: Tensor, epsilon: float = 1e-3) -> Tensor:
    """Mean of sqrt((a-b)^2 + epsilon^2): absolute error, smooth at zero."""
    return torch.sqrt((a.float() - b.float()).square() + epsilon**2).mean()


def psnr(a: Tensor, b: Tensor) -> Tensor:
    """Mean over clips of the peak signal-to-noise ratio, dB, full scale 1; values are cut to [0, 1]."""
    error = (a.float().clamp(0, 1) - b.float()).square().flatten(1).mean(1)
    return (-10 * torch.log10(error.clamp(min=1e-12))).mean()


def registration_loss(frames: Tensor, blur_only: Tensor, tilts: Sequence[Tensor]) -> Tensor:
    """Charbonnier distance of the registered frames to the blur-only frames at 1/4, 1/2 and full resolution.

    Each scale is registered with the tilt estimated at half its resolution.
    """
    flat, truth = frames.flatten(0, 1), blur_only.flatten(0, 1)
    loss = frames.new_zeros(())
    for coarse, tilt in zip(SCALES, tilts, strict=True):
        scale = coarse // 2
        fine = F.interpolate(tilt.flatten(0, 1), scale_factor=2.0, mode="bilinear", align_corners=False)
        small = F.avg_pool2d(flat, scale) if scale > 1 else flat
        wanted = F.avg_pool2d(truth, scale) if scale > 1 else truth
        loss = loss + charbonnier(warp(small, fine / scale), wanted)
    return loss / len(SCALES)


def tilt_loss(tilts: Sequence[Tensor], tilt_map: Tensor) -> Tensor:
    """Charbonnier distance of the estimated tilts to the true tilt map at each scale, pixels."""
    truth = tilt_map.flatten(0, 1)
    parts = [
        charbonnier(tilt.flatten(0, 1), F.avg_pool2d(truth, scale), epsilon=0.1)
        for scale, tilt in zip(SCALES, tilts, strict=True)
    ]
    return torch.stack(parts).mean()
