"""Stress of the methods without learning, on pictures with nothing to register, nothing to sharpen, or one pixel."""

from collections.abc import Iterator
from functools import partial
from itertools import product

import numpy as np

from turbnet.bench.stress_cell import Cell, Check, close, finite, within
from turbnet.bench.stress_content import BROKEN, CONTENTS, clip
from turbnet.classical.methods import METHODS
from turbnet.deploy.method import ClassicalMethod
from turbnet.deploy.restore import restore_array

_FLAT = 1e-5  # of full scale: rounding of a few iterations in float32


def cells(quick: bool) -> Iterator[Cell]:
    """Methods, contents, sizes, lengths; linear pictures of high dynamic range."""
    contents = ("texture", "constant", "black", "checkerboard", "Inf") if quick else CONTENTS
    sizes = ((1, 1), (5, 24)) if quick else ((1, 1), (1, 17), (5, 24), (40, 33))
    for method, content, (height, width), frames in product(METHODS, contents, sizes, (1, 3)):
        name = f"{method}, {content}, {height} x {width}, {frames} frames"
        yield Cell(
            "classical", name, partial(_restore, method, content, height, width, frames), content in (*BROKEN, "HDR")
        )
    for method in METHODS:
        yield Cell("classical", f"{method}, linear up to 1e6", partial(_linear, method))
        yield Cell("classical", f"{method}, one core and two", partial(_cores, method))


def _frames(content: str, height: int, width: int, frames: int) -> np.ndarray:
    return clip(content, height, width, frames)[0].float().movedim(1, -1).numpy()


def _restore(method: str, content: str, height: int, width: int, frames: int) -> Iterator[Check]:
    seen = _frames(content, height, width, frames)
    restored = restore_array(seen, ClassicalMethod(method, 1))
    yield finite("frames", restored)
    yield within("frames", restored, 0.0, 1.0)
    if content in ("constant", "black", "saturated"):
        yield close("change of a flat clip", restored + 1, seen + 1, _FLAT)


def _linear(method: str) -> Iterator[Check]:
    frames = _frames("HDR", 24, 24, 3)
    yield finite("frames", METHODS[method](frames, 1, lambda share: None))


def _cores(method: str) -> Iterator[Check]:
    frames = _frames("texture", 24, 24, 3)
    one, two = (METHODS[method](frames, cores, lambda share: None) for cores in (1, 2))
    yield close("difference of one core and two", two, one, 1e-5)
