"""Stress of the released networks as they are used: `restore_array` and `turbnet.Restorer` over onnxruntime.

Here NaN, Inf and values far above 1 must be refused, and a flat picture must stay about flat: learned weights owe no more
than that.
"""

from collections.abc import Iterator
from functools import lru_cache, partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from turbnet.bench.stress_cell import Cell, Check, close, finite, within
from turbnet.bench.stress_content import BROKEN, CONTENTS, clip
from turbnet.deploy.restore import restore_array
from turbnet.deploy.restorer import Restorer
from turbnet.deploy.session import Model
from turbnet.deploy.weights import released_models

_FLAT = 0.02  # of full scale: learned, measured 0.008
_DTYPES = (np.uint8, np.uint16, np.float16, np.float32, np.float64)


def cells(quick: bool) -> Iterator[Cell]:
    """Networks, contents, sizes, lengths, types of number, threads."""
    sizes = ((1, 1), (33, 47)) if quick else ((1, 1), (1, 17), (33, 47), (350, 9))
    for name in released_models():
        for content, (height, width), frames in product(CONTENTS, sizes, (1, 3)):
            title = f"{name}, {content}, {height} x {width}, {frames} frames"
            yield Cell(
                "models", title, partial(_restore, name, content, height, width, frames), content in (*BROKEN, "HDR")
            )
        for dtype in _DTYPES:
            yield Cell("models", f"{name}, {np.dtype(dtype)}", partial(_typed, name, dtype))
        yield Cell("models", f"{name}, int32", partial(_typed, name, np.int32), must_refuse=True)
        yield Cell("models", f"{name}, one thread and two", partial(_threads, name))
        for frames in (40,) if quick else (40, 500):
            yield Cell("models", f"{name}, {frames} frames", partial(_long, name, frames))


@lru_cache
def _model(name: str, threads: int = 1) -> Model:
    return Model.load(released_models()[name], threads)


def _frames(content: str, height: int, width: int, frames: int) -> NDArray[np.float32]:
    return np.asarray(clip(content, height, width, frames)[0].float().movedim(1, -1).numpy())


def _restore(name: str, content: str, height: int, width: int, frames: int) -> Iterator[Check]:
    seen = _frames(content, height, width, frames)
    restored = restore_array(seen, _model(name))
    yield finite("frames", restored)
    yield within("frames", restored, 0.0, 1.0)
    if content in ("constant", "black", "saturated"):
        yield close("change of a flat clip", restored + 1, seen + 1, _FLAT / float(seen.max() + 1))


def _typed(name: str, dtype: type) -> Iterator[Check]:
    restorer = Restorer(name, threads=1)
    frames = _frames("texture", 33, 47, 2)
    full = np.iinfo(dtype).max if np.issubdtype(dtype, np.integer) else 1
    given: NDArray[Any] = (frames * full).astype(dtype)
    restored = restorer(given)
    yield Check("whether the type is kept", float(restored.dtype == given.dtype), 1.0)
    exact = restore_array(given.astype(np.float32) / np.float32(full), _model(name))
    last = 0.5 / full if full > 1 else float(np.finfo(dtype).eps)
    yield close("difference from float32", restored.astype(np.float64) / full, exact, max(1.01 * last, 1e-5) * 1.5)


def _threads(name: str) -> Iterator[Check]:
    frames = _frames("texture", 64, 64, 4)
    one, two = (restore_array(frames, _model(name, threads)) for threads in (1, 2))
    yield close("difference of one thread and two", two, one, 1e-5)


def _long(name: str, frames: int) -> Iterator[Check]:
    restored = restore_array(_frames("texture", 16, 16, frames), _model(name))
    yield finite("frames", restored)
    yield Check("frames", len(restored), frames)
