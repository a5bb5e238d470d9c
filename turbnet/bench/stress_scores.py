"""Stress of losses and metrics."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import torch
from torch import Tensor

from turbnet.bench.stress_cell import Cell, Check, close, finite, not_hidden, within
from turbnet.bench.stress_content import BROKEN, CONTENTS, clip
from turbnet.media.colour import to_linear, to_srgb
from turbnet.metrics.calibration import ause, calibration_error, rank_correlation
from turbnet.metrics.fidelity import ms_ssim, psnr, ssim
from turbnet.metrics.registration import estimate_displacements, estimate_shift
from turbnet.metrics.sharpness import noise_level, sharpness
from turbnet.metrics.stability import jitter
from turbnet.tasks import losses

EIGHT_MEGAPIXELS = (2304, 3456)
LOSSES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "charbonnier": losses.charbonnier,
    "psnr": losses.psnr,
    "frequency": losses.frequency_loss,
    "moving": lambda a, b: losses.charbonnier(a, b, weight=losses.moving_weights(b, 6.0)),
}
SCORES: dict[str, Callable[[Any, Any], Any]] = {"PSNR": psnr, "SSIM": ssim, "MS-SSIM": ms_ssim}


def cells(quick: bool) -> Iterator[Cell]:
    """Losses and metrics, contents, sizes, precisions; PSNR of eight megapixels."""
    for (name, loss), content, (height, width) in product(LOSSES.items(), CONTENTS, ((1, 1), (31, 18))):
        yield Cell(
            "scores", f"loss {name}, {content}, {height} x {width}", partial(_loss, loss, content, height, width)
        )
    for (name, score), content, side in product(SCORES.items(), CONTENTS, (1, 31) if quick else (1, 31, 176)):
        title = f"{name}, {content}, {side} x {side}"
        yield Cell("scores", title, partial(_score, name, score, content, side), content in BROKEN)
    for (name, score), dtype in product(SCORES.items(), (torch.float64, torch.bfloat16, torch.float16, torch.uint8)):
        side = 176 if name == "MS-SSIM" else 31
        scored = partial(_score_of, score, dtype, side)
        yield Cell("scores", f"{name}, {str(dtype)[6:]}", scored, must_refuse=dtype is torch.uint8)
    for content, side in product(CONTENTS, (1, 31)):
        for work in (_still, _motion, _colour, _calibration):
            yield Cell("scores", f"{work.__name__[1:]}, {content}, {side} x {side}", partial(work, content, side))
    if not quick:
        yield Cell("scores", "PSNR, 2304 x 3456", _large_psnr)


def _pair(content: str, height: int, width: int) -> tuple[Tensor, Tensor]:
    """A clip and its mirror image, float64 (1, T, C, H, W)."""
    frames = clip(content, height, width, 2)
    return frames, frames.flip(-1).contiguous()


def _loss(loss: Callable[[Tensor, Tensor], Tensor], content: str, height: int, width: int) -> Iterator[Check]:
    first, second = (x.float() for x in _pair(content, height, width))
    value = loss(first, second)
    if content in BROKEN:
        yield not_hidden("loss", value)
        return
    yield finite("loss", value, loss(first, first))
    for other in (first, second):  # at equality, too, where roots have their kink
        leaf = first.clone().requires_grad_()
        (slope,) = torch.autograd.grad(loss(leaf, other), leaf)
        yield finite("gradients", slope)
        if loss is not losses.psnr:
            yield within("sum of the gradient's magnitudes", slope.abs().sum(), 0.0, 6.0 * math.sqrt(first.numel()))


def _score(name: str, score: Callable[[Any, Any], Any], content: str, side: int) -> Iterator[Check]:
    first, second = (x[0].movedim(1, -1).float() for x in _pair(content, side, side))
    value = score(first, second)
    if name != "PSNR":
        yield within("score", value, -1.0, 1.0, 1e-4)
        yield close("score of equals", score(first, first), torch.ones(2), 1e-4)
    else:
        yield Check("NaN scores", float(torch.isnan(value).sum()))
    exact = score(first.double(), second.double())
    usual = torch.isfinite(exact)
    yield close("difference from float64", value[usual], exact[usual], 1e-3)
    other = score(second, first)
    yield close("difference with the two exchanged", other[usual], value[usual], 1e-3)


def _score_of(score: Callable[[Any, Any], Any], dtype: torch.dtype, side: int) -> Iterator[Check]:
    first, second = (x[0].movedim(1, -1).to(dtype) for x in _pair("texture", side, side))
    second = (0.8 * first + 0.2 * second).to(dtype)
    yield close("difference from float64", score(first, second), score(first.double(), second.double()), 1e-2)


def _still(content: str, side: int) -> Iterator[Check]:
    frame = clip(content, side, side)[0, 0].movedim(0, -1).numpy()
    yield finite("sharpness and noise", sharpness(frame), noise_level(frame))


def _motion(content: str, side: int) -> Iterator[Check]:
    first, second = (x[0, 0].movedim(0, -1).numpy() for x in _pair(content, side, side))
    found = estimate_displacements(first, second)
    yield within("displacements of windows with texture", np.nan_to_num(found), -0.25 * side, 0.25 * side)
    yield finite("shift", *estimate_shift(first, second))
    yield finite("jitter", jitter([first, second], (first + second) / 2))


def _colour(content: str, side: int) -> Iterator[Check]:
    frame = clip(content, side, side)
    if content in BROKEN:
        yield not_hidden("linear", to_linear(frame))
        yield not_hidden("encoded", to_srgb(frame))
        return
    leaf = frame.float().requires_grad_()
    there = to_srgb(to_linear(leaf))
    yield close("there and back", there, frame, 1e-5)
    yield finite("gradients", *torch.autograd.grad(there.sum(), leaf))


def _calibration(content: str, side: int) -> Iterator[Check]:
    error, scale = (x[0, 0].numpy() for x in _pair(content, side, side))
    yield finite(
        "calibration", calibration_error(error, scale + 1e-3), ause(error, scale), rank_correlation(error, scale)
    )


def _large_psnr() -> Iterator[Check]:
    first = torch.zeros(*EIGHT_MEGAPIXELS, 1)
    yield Check("PSNR of a grey level of difference", float(psnr(first, first + 1 / 255)), 48.13, 0.01, "dB")
