r"""Tilt removal: a multiscale network that registers the frames of a clip to their common, untilted geometry.

Turbulence moves the scene point u of frame t to u + t(u). The network estimates t coarse to fine (1/8, 1/4, 1/2 of the
resolution) and undoes it by sampling each frame at x + t(x). A level takes the closed-form Lucas-Kanade step towards a
reference, lets a gate decide how much of it counts (what moves of itself is not to be held still), and adds a learned
correction. It also says how sure it is, as the scale b of a Laplace distribution of the tilt's error:

.. math::
    p(t) \propto \frac{1}{b} e^{-|t - \hat t| / b}, \qquad b = b_0 e^{-z}, \qquad c = \frac{1}{1 + b / b_0} = \sigma(z)

The reference is the mean of the frames as registered so far, each weighted by its confidence c: what passes through the
scene weighs little in it, and it sharpens from level to level. Nothing depends on the number of frames, and a reference
made of earlier frames can take part in it.

Registration to a mean of the frames themselves leaves open where that mean lies, and level by level it would wander. Nobody
can know the tilt that all frames share, so after every level the mean tilt of the clip, by confidence, is taken out:

.. math::
    \sum_t c_t(x)\, t_t(x) = 0

and the frames are registered to the mean geometry of the clip, as those seen earlier were to theirs.

What moves of itself and what the air moves look alike in one frame; over a few frames they do not, for the air moves to and
fro. So a level also sees the drift: the mean of the frames t - 2 .. t + 2, less the reference. It is small where only the
air moves.

After the tilt-removal stage of TMT (Zhang et al., IEEE TCI 2024), which supervises three scales with blur-only frames;
here the reference is explicit, the first guess is computed and not learned, and the frame count is free.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbnet.nets.blocks import conv3x3, warp, zero_start
from turbnet.nets.lucas_kanade import lucas_kanade

SCALES = (8, 4, 2)
"""Fractions of the resolution at which the tilt is estimated, coarse to fine."""

ERROR_AT_HALF = 0.5
"""b_0: the expected error of a tilt, pixels, at which confidence is one half."""

_LARGEST_LOGIT = 4.0

_REACH = 2
"""Frames on either side over which the drift is seen."""

RECENT = 2 * _REACH + 1
"""Frames of that mean."""


class Registered(NamedTuple):
    """What tilt removal returns.

    Attributes:
        frames: registered frames (B, T, C, H, W).
        tilts: estimates of the tilt map at 1/8, 1/4 and 1/2 of the resolution, each (B, T, 2, H/s, W/s), in full-resolution
            pixels.
        logits: z of the confidence at the same scales, each (B, T, 1, H/s, W/s).
        reference: mean of the registered frames by confidence, (B, 1, C, H, W).
        neighbours: mean of each registered frame and its neighbours in time at half the resolution, (B, T, C, H/2, W/2).
        drift: those less the reference.
    """

    frames: Tensor
    tilts: list[Tensor]
    logits: list[Tensor]
    reference: Tensor
    neighbours: Tensor
    drift: Tensor

    @property
    def confidence(self) -> Tensor:
        """c at full resolution, (B, T, 1, H, W)."""
        return torch.sigmoid(_enlarged(self.logits[-1].flatten(0, 1), SCALES[-1])).unflatten(0, self.frames.shape[:2])


class _Level(nn.Module):
    """Corrects the tilt at one scale from the frame as registered so far, the reference and the tilt itself."""

    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.log_prior = nn.Parameter(torch.tensor(-7.0))
        self.layers = nn.Sequential(
            conv3x3(3 * channels + 5, width),
            nn.ReLU(),
            conv3x3(width, width),
            nn.ReLU(),
            conv3x3(width, width),
            nn.ReLU(),
        )
        self.correction = conv3x3(width, 2)
        self.correction.bias = None  # it would be a tilt that all frames share, which is taken out
        self.gate = conv3x3(width, 1)
        self.certainty = conv3x3(width, 1)
        zero_start(self.correction)
        zero_start(self.gate, bias=3.0)  # nearly all of the closed-form step
        zero_start(self.certainty)

    def forward(
        self,
        registered_NCHW: Tensor,
        reference_NCHW: Tensor,
        tilt_N2HW: Tensor,
        logit_N1HW: Tensor,
        drift_NCHW: Tensor,
    ) -> tuple[Tensor, Tensor]:
        step = lucas_kanade(registered_NCHW, reference_NCHW, self.log_prior.clamp(-12.0, 0.0).exp())
        step = step.to(registered_NCHW.dtype)
        seen = torch.cat((registered_NCHW, reference_NCHW, tilt_N2HW, step, logit_N1HW, drift_NCHW), dim=1)
        features = self.layers(seen)
        moved = torch.sigmoid(self.gate(features)) * step + self.correction(features)
        return moved, logit_N1HW + self.certainty(features)


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

    def forward(
        self, frames_BTCHW: Tensor, past_BCHW: Tensor | None = None, recent_BCHW: Tensor | None = None
    ) -> Registered:
        """The frames registered to each other and to what came before.

        Args:
            past_BCHW: the reference of earlier frames and the sum of their confidence, (B, C + 1, H, W).
            recent_BCHW: the mean of the last few of them at half the resolution, and how many, (B, C + 1, H/2, W/2).
        """
        batch, count, _, height, width = frames_BTCHW.shape
        frames = frames_BTCHW.flatten(0, 1)
        coarse = (height // SCALES[0], width // SCALES[0])
        tilt, logit = frames.new_zeros((batch * count, 2, *coarse)), frames.new_zeros((batch * count, 1, *coarse))
        tilts: list[Tensor] = []
        logits: list[Tensor] = []
        for scale, level in zip(SCALES, self.levels, strict=True):
            small = F.avg_pool2d(frames, scale)
            if tilts:
                tilt, logit = _enlarged(tilt, 2), _enlarged(logit, 2)
            registered = warp(small, tilt / scale)
            reference = weighted_mean(
                registered.unflatten(0, (batch, count)),
                logit.unflatten(0, (batch, count)),
                None if past_BCHW is None else F.avg_pool2d(past_BCHW, scale),
            )
            everywhere = reference.expand(batch, count, *reference.shape[2:])
            recent = None if recent_BCHW is None else F.avg_pool2d(recent_BCHW, scale // 2)
            drift = neighbours(registered.unflatten(0, (batch, count)), recent) - everywhere
            # Levels work in their own pixels, where a tilt is of order one.
            moved, logit = level(registered, everywhere.flatten(0, 1), tilt / scale, logit, drift.flatten(0, 1))
            tilt = tilt + scale * moved.to(tilt.dtype)
            logit = logit.to(tilt.dtype).clamp(-_LARGEST_LOGIT, _LARGEST_LOGIT)
            tilt, logit = (x.unflatten(0, (batch, count)) for x in (tilt, logit))
            still = None if past_BCHW is None else F.avg_pool2d(past_BCHW[:, -1:], scale)
            tilt, logit = mean_free(tilt, logit, still).flatten(0, 1), logit.flatten(0, 1)
            tilts.append(tilt)
            logits.append(logit)
        out = warp(frames, _enlarged(tilt, SCALES[-1])).unflatten(0, (batch, count))
        reference = weighted_mean(out, _enlarged(logit, SCALES[-1]).unflatten(0, (batch, count)), past_BCHW)
        tilts, logits = ([x.unflatten(0, (batch, count)) for x in xs] for xs in (tilts, logits))
        half = neighbours(F.avg_pool2d(out.flatten(0, 1), 2).unflatten(0, (batch, count)), recent_BCHW)
        drift = half - F.avg_pool2d(reference[:, 0], 2)[:, None]
        return Registered(out, tilts, logits, reference, half, drift)


def neighbours(frames_BTCHW: Tensor, recent_BCHW: Tensor | None = None) -> Tensor:
    """Each frame's mean with its two neighbours on either side, as far as the clip goes, the same shape.

    Args:
        recent_BCHW: mean of the last frames of the past, and how many, (B, C + 1, H, W): stands in for those missing.
    """
    count = frames_BTCHW.shape[1]
    sides = (0, 0, 0, 0, 0, 0, _REACH, _REACH)
    padded, there = F.pad(frames_BTCHW, sides), F.pad(torch.ones_like(frames_BTCHW[:, :, :1]), sides)
    total = sum(padded[:, shift : shift + count] for shift in range(1, RECENT)) + padded[:, :count]
    number = sum(there[:, shift : shift + count] for shift in range(1, RECENT)) + there[:, :count]
    if recent_BCHW is not None:
        mean, earlier = recent_BCHW[:, None, :-1], recent_BCHW[:, None, -1:]
        missing = torch.minimum(RECENT - number, earlier)
        total, number = total + missing * mean, number + missing
    return total / number


def weighted_mean(frames_BTCHW: Tensor, logits_BT1HW: Tensor, past_BCHW: Tensor | None = None) -> Tensor:
    """Mean over time by confidence, (B, 1, C, H, W); of a past (a mean and its weight, (B, C + 1, H, W)) as well."""
    weights = torch.sigmoid(logits_BT1HW.float())
    total, weight = (frames_BTCHW * weights).sum(1, keepdim=True), weights.sum(1, keepdim=True)
    if past_BCHW is not None:
        mean, earlier = past_BCHW[:, None, :-1], past_BCHW[:, None, -1:]
        total, weight = total + earlier * mean, weight + earlier
    return (total / weight).to(frames_BTCHW.dtype)


def mean_free(tilts_BT2HW: Tensor, logits_BT1HW: Tensor, past_B1HW: Tensor | None = None) -> Tensor:
    """Tilts less their mean over time by confidence.

    Args:
        past_B1HW: sum of the confidence of earlier frames, whose tilts had mean zero.
    """
    past_B3HW = None if past_B1HW is None else F.pad(past_B1HW, (0, 0, 0, 0, 2, 0))
    return tilts_BT2HW - weighted_mean(tilts_BT2HW, logits_BT1HW, past_B3HW)


def _enlarged(x_NCHW: Tensor, factor: int) -> Tensor:
    return F.interpolate(x_NCHW, scale_factor=float(factor), mode="bilinear", align_corners=False)
