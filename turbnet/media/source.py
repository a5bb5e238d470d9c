"""What every reader gives: a header, a pass over frames (H, W, 3) in [0, 1], and pixels of any kind made such frames."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from turbnet.errors import InputError
from turbnet.media.sound import Sound

Frame = NDArray[np.float32]
TimedFrame = tuple[Fraction | None, Frame]

DEFAULT_FPS = 25.0

# Filtering overshoots white by a little; twice white means that another scale was used.
BRIGHTEST = 2.0


@dataclass(frozen=True)
class ClipInfo:
    """What a clip's header says.

    Args:
        frames: how many; None: not declared.
        height, width: pixels.
        fps: frames per second, on average.
        grey: stored in one channel.
        tick: seconds, of which the frames' times are multiples; None: they carry no times.
    """

    frames: int | None
    height: int
    width: int
    fps: float
    grey: bool
    tick: Fraction | None = None


@dataclass(frozen=True)
class Source:
    """A clip's header, a function that starts a pass over its frames and one that opens its sound, None if it has none."""

    info: ClipInfo
    frames: Callable[[], Iterator[TimedFrame]]
    sound: Callable[[], AbstractContextManager[Sound | None]] = nullcontext


def as_frame(pixels: NDArray[Any], path: Path) -> Frame:
    """Integers scaled by their largest value, floats as they are; one channel repeated, alpha laid over black."""
    if pixels.dtype == np.bool_:
        pixels = pixels.astype(np.float32)
    elif pixels.dtype.kind == "u":
        pixels = pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
    elif pixels.dtype.kind != "f":
        raise InputError(f"cannot read {path}: pixels of type {pixels.dtype} have no known white level")
    elif not np.isfinite(pixels).all():
        raise InputError(f"{path} holds NaN or infinite pixels")
    elif np.abs(pixels).max() > BRIGHTEST:
        raise InputError(f"{path} holds values up to {np.abs(pixels).max():g}; scale floating-point pixels to 0 to 1")
    pixels = pixels.astype(np.float32, copy=False)
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    if pixels.shape[-1] in (2, 4):
        pixels = pixels[..., :-1] * pixels[..., -1:]
    if pixels.shape[-1] == 1:
        pixels = np.repeat(pixels, 3, axis=-1)
    if pixels.ndim != 3 or pixels.shape[-1] != 3:
        raise InputError(f"cannot read {path}: {pixels.shape[-1]} channels are neither grey nor RGB")
    return np.ascontiguousarray(pixels)
