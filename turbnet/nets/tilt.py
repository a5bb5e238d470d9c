"""Tilt removal: a multiscale network that registers the frames of a clip to their common, untilted geometry.

Turbulence moves the scene point u of frame t to u + t(u). The network estimates t coarse to fine (1/8, 1/4, 1/2 of the
resolution) and undoes it by sampling each frame at x + t(x). At every level the reference is the temporal mean of the
frames as registered so far, so it sharpens from level to level. A level takes the closed-form Lucas-Kanade step towards
the reference and adds a learned correction; untrained, the network is a plain multiscale Lucas-Kanade registration.
Nothing depends on the number of frames.

After the tilt-removal stage of TMT (Zhang et al., IEEE TCI 2024), which supervises three scales with blur-only frames;
here the reference is explicit, the first guess is computed and not learned, and the frame count is free.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbnet.nets.blocks import warp, zero_start
from turbnet.nets.lucas_kanade import lucas_kanade

SCALES = (8, 4, 2)
"""Fractions of the resolution at which the tilt is estimated, coarse to fine."""


class Registered(NamedTuple):
    """What tilt removal returns.

    Attributes:
        frames: registered frames (B, T, C, H, W).
        tilts: estimates of the tilt map at 1/8, 1/4 and 1/2 of the resolution, each (B, T, 2, H/s, W/s), in full-resolution
            pixels.
    """

    frames: Tensor
    tilts: list[Tensor]


class _Level(nn.Module):
    """Corrects the tilt at one scale from the frame as registered so far, the reference and the tilt itself."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.log_prior = nn.Parameter(torch.tensor(-7.0))
        self.layers = nn.Sequential(
            nn.Conv2d(2 * channels + 4, width, 3, padding=1, padding_mode="replicate"),
            nn.GELU(),
            nn.Conv2d(width, width, 3, padding=1, padding_mode="replicate"),
            nn.GELU(),
            nn.Conv2d(width, width, 3, padding=1, padding_mode="replicate"),
            nn.GELU(),
        )
        self.correction = nn.Conv2d(width, 2, 3, padding=1, padding_mode="replicate")
        zero_start(self.correction)

    def forward(self, registered_NCHW: Tensor, reference_NCHW: Tensor, tilt_N2HW: Tensor) -> Tensor:
        step = lucas_kanade(registered_NCHW, reference_NCHW, self.log_prior.clamp(-12.0, 0.0).exp())
        step = step.to(registered_NCHW.dtype)
        return step + self.correction(self.layers(torch.cat((registered_NCHW, reference_NCHW, tilt_N2HW, step), dim=1)))


class TiltNet(nn.Module):
    """Estimates and removes the tilt of every frame.

    Args:
        widths: channels of the levels, coarse to fine.
        channels: of the frames.
    """

    size_multiple = 8

    def __init__(self, widths: Sequence[int] = (32, 24, 16), channels: int = 3) -> None:
        super().__init__()
        self.levels = nn.ModuleList(_Level(channels, width) for width in widths)

    def forward(self, frames_BTCHW: Tensor) -> Registered:
        batch, count, channels, height, width = frames_BTCHW.shape
        frames = frames_BTCHW.flatten(0, 1)
        tilt = frames.new_zeros((batch * count, 2, height // SCALES[0], width // SCALES[0]))
        tilts: list[Tensor] = []
        for scale, level in zip(SCALES, self.levels, strict=True):
            small = F.avg_pool2d(frames, scale)
            if tilts:
                tilt = F.interpolate(tilt, scale_factor=2.0, mode="bilinear", align_corners=False)
            registered = warp(small, tilt / scale)
            clip = registered.unflatten(0, (batch, count))
            reference = clip.mean(dim=1, keepdim=True).expand(clip.shape).flatten(0, 1)
            # Levels work in their own pixels, where a tilt is of order one.
            tilt = tilt + scale * level(registered, reference, tilt / scale).to(tilt.dtype)
            tilts.append(tilt)
        fine = F.interpolate(tilt, scale_factor=float(SCALES[-1]), mode="bilinear", align_corners=False)
        out = warp(frames, fine)
        return Registered(out.unflatten(0, (batch, count)), [t.unflatten(0, (batch, count)) for t in tilts])
