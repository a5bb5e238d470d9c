r"""A network spared what a scene does not need, tile by tile and window by window.

**Nothing dances.** Displacements of RMS sigma in each axis vary a pixel by sigma^2 |grad I|^2 in time, noise varies all
alike. From the pixels of the strongest and of the weakest gradients,

.. math::
    \sigma^2 = \frac{\mathrm{med}\, v_{strong} - \mathrm{med}\, v_{weak}}{\mathrm{med}\, |\nabla I|^2_{strong}}

with v the variance over time; medians, so that what moves of itself does not count. Below a tenth of a pixel, D/r0 = 0.08,
there is nothing to restore and the frames pass as they are.

**Nothing has changed.** A still background is restored once. If the means over blocks of 16 x 16 pixels are, all through a
window, what they were in the one before, as far as they fluctuate, what was restored then stands for the whole window.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

STILL = 0.1
"""RMS displacement, pixels, below which air does not matter."""

_LOOKED_AT = 12  # frames of a window, equally spaced
_BLOCK = 16
_CHANGE = 0.012  # of a block's mean, full scale 1: three steps of eight bits
_FLUCTUATION = 5.0  # standard errors
_QUIET = 0.75 / 255  # RMS: the last bit of eight


@dataclass
class Skipped:
    """Tiles of windows: `clean` passed as they were, `still` given what was restored before, `restored` went through."""

    clean: int = 0
    still: int = 0
    restored: int = 0

    @property
    def saved(self) -> float:
        """Share of the tiles that the network did not see."""
        total = self.clean + self.still + self.restored
        return (self.clean + self.still) / total if total else 0.0


@dataclass(frozen=True)
class _Kept:
    means: np.ndarray
    spread: np.ndarray
    picture: np.ndarray


class Skipping:
    """A network that takes whole windows, given the tiles of one window after the other, always in the same order.

    Args:
        network: (1, T, C, h, w) -> (1, T, C, h, w).
        tiles: of a frame.
        skipped: counts what was spared.
    """

    def __init__(self, network: Callable[[np.ndarray], np.ndarray], tiles: int, skipped: Skipped) -> None:
        self._network, self.skipped = network, skipped
        self._kept: list[_Kept | None] = [None] * tiles
        self._turn = 0

    def __call__(self, frames_BTCHW: np.ndarray) -> np.ndarray:
        """The next tile's frames restored."""
        turn, self._turn = self._turn, (self._turn + 1) % len(self._kept)
        frames = frames_BTCHW[0]
        if len(frames) > 1:
            looked = frames[np.unique(np.linspace(0, len(frames) - 1, _LOOKED_AT).round().astype(int))].mean(1)
            if dance(looked) < STILL:
                self._kept[turn] = None
                self.skipped.clean += 1
                return frames_BTCHW
            means, spread = _blocks(looked)
            kept = self._kept[turn]
            if kept is not None and _same(kept.means, np.minimum(kept.spread, spread), means):
                self.skipped.still += 1
                return np.repeat(kept.picture[:, None], len(frames), axis=1)
        restored = self._network(frames_BTCHW)
        self.skipped.restored += 1
        if len(frames) > 1:
            # Only what stood still all the time stands for what comes.
            steady = _same(means.mean(0), spread, means)
            self._kept[turn] = _Kept(means.mean(0), spread, restored.mean(1)) if steady else None
        return restored


def dance(frames_THW: np.ndarray) -> float:
    """RMS displacement of what stands still, in each axis, pixels; 0 where no frame differs from the others.

    Args:
        frames_THW: grey, two frames or more.
    """
    height, width = (side // 2 * 2 for side in frames_THW.shape[1:])
    halved = frames_THW[:, :height, :width]
    halved = (halved[:, ::2] + halved[:, 1::2]) / 2
    halved = (halved[:, :, ::2] + halved[:, :, 1::2]) / 2
    if min(halved.shape[1:]) < 4:
        return np.inf
    variance = halved.var(0, ddof=1)
    if np.quantile(variance, 0.999) < _QUIET**2 / 4:  # a mean of four pixels
        return 0.0
    down, across = np.gradient(halved.mean(0))
    steepness = (down**2 + across**2) / 4  # of a pixel, not of two
    weak, strong = np.quantile(steepness, (0.5, 0.9))
    if strong <= 0:
        return np.inf
    moved = np.median(variance[steepness >= strong]) - np.median(variance[steepness <= weak])
    return float(np.sqrt(max(moved, 0.0) / np.median(steepness[steepness >= strong])))


def _blocks(frames_THW: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means of blocks of every frame, (T, h, w), and how much they fluctuate, (h, w).

    The standard deviation, from the median difference of successive frames: what comes and goes makes a few of them large.
    """
    frames, height, width = frames_THW.shape
    size = min(_BLOCK, height, width)
    rows, columns = height // size, width // size
    cut = frames_THW[:, : rows * size, : columns * size].reshape(frames, rows, size, columns, size)
    means = cut.mean((2, 4))
    return means, np.median(np.abs(np.diff(means, axis=0)), axis=0) / 0.954


def _same(expected: np.ndarray, spread: np.ndarray, means: np.ndarray) -> bool:
    """Whether a window, and its first and its last third, show what is expected, so that nothing passes through."""
    third = max(len(means) // 3, 1)
    for part in (means, means[:third], means[-third:]):
        allowed = _CHANGE + _FLUCTUATION * spread / np.sqrt(len(part))
        if (np.abs(part.mean(0) - expected) > allowed).any():
            return False
    return True
