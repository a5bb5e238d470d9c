"""Restoration in three lines of Python.

import turbnet

clear = turbnet.Restorer()(frames)
"""

from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from turbnet.deploy.restore import (
    TILE,
    Restoration,
    ready,
    restore_clip,
    restore_frames,
    tiling_of,
    views_of,
    window_of,
)
from turbnet.deploy.session import Model
from turbnet.deploy.weights import DEFAULT, find_model
from turbnet.errors import InputError


class Restorer:
    """A released network, or one of yours, for frames in memory and for files; one may serve several threads.

    Args:
        model: name of a released network, or an ONNX file of `turbnet export`.
        threads: processor threads of one call; None: all cores.
        window: frames restored together; None: as the network's card recommends.
        tile: greatest side of a tile, pixels.
        views: of every window, 1 to 8: restored so many times, turned and mirrored, and averaged.

    Raises:
        InputError: there is no such model, it is damaged, a value out of range.
    """

    def __init__(
        self,
        model: str | Path = DEFAULT,
        threads: int | None = None,
        window: int | None = None,
        tile: int = TILE,
        views: int = 1,
    ) -> None:
        self.model = Model.load(find_model(model), threads)
        self.window, self.tiling = window_of(self.model, window), tiling_of(self.model, tile)
        self.views = views_of(self.model, views)

    def __call__(self, frames_THWC: NDArray[Any]) -> NDArray[Any]:
        """Restore a clip (T, H, W, 3) or a still (H, W, 3), RGB, sRGB-encoded; the same shape and dtype come back.

        Args:
            frames_THWC: uint8 or uint16 of full scale, or floating point in [0, 1].

        Raises:
            InputError: another shape or dtype, no frames, values that are not finite or far outside [0, 1].
        """
        clip = np.asarray(frames_THWC)
        if clip.ndim == 3:
            return self(clip[None])[0]
        if clip.ndim != 4 or clip.shape[-1] != 3 or 0 in clip.shape:
            raise InputError(f"frames of shape {clip.shape}: give (T, H, W, 3) or (H, W, 3), RGB")
        return np.stack(list(self.stream(clip)))

    def stream(self, frames: Iterable[NDArray[Any]]) -> Iterator[NDArray[Any]]:
        """Restore frames (H, W, 3) of one size as they come, one for each; memory holds a few windows. As `__call__`."""
        dtype: np.dtype[Any] | None = None

        def floats() -> Iterator[NDArray[np.float32]]:
            nonlocal dtype
            for frame in frames:
                dtype = frame.dtype
                yield frame.astype(np.float32) / _full_scale(dtype)

        source = floats()
        first = next(source, None)
        if first is None:
            return
        network = ready(self.model, self.tiling.count(*first.shape[:2]), views=self.views)
        for restored in restore_frames(chain([first], source), network, self.tiling, self.window):
            assert dtype is not None
            full = _full_scale(dtype)
            yield restored.astype(dtype) if full == 1 else (restored * full + 0.5).astype(dtype)

    def restore(
        self, source: str | Path, destination: str | Path, passes: int = 1, skip: bool = False, resume: bool = False
    ) -> Restoration:
        """A clip from file to file, as `turbnet restore`; what was done comes back. Arguments: see `restore_clip`."""
        return restore_clip(
            source,
            destination,
            self.model,
            tile=self.tiling.tile,
            window=self.window,
            passes=passes,
            views=self.views,
            skip=skip,
            resume=resume,
        )


def _full_scale(dtype: np.dtype[Any]) -> float:
    if dtype in (np.uint8, np.uint16):
        return float(np.iinfo(dtype).max)
    if np.issubdtype(dtype, np.floating):
        return 1.0
    raise InputError(f"frames of dtype {dtype}: give uint8, uint16 or floating point")
