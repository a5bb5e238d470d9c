r"""A network spared what a scene does not need, tile by tile and window by window.

**Nothing dances.** Displacements of RMS sigma in each axis vary a pixel by sigma^2 |grad I|^2 in time, noise varies all
alike. From the pixels of the strongest and of the weakest gradients,

.. math::
    \sigma^2 = \frac{\mathrm{med}\, v_{strong} - \mathrm{med}\, v_{weak}}{\mathrm{med}\, |\nabla I|^2_{strong}}

with v the variance over time; medians, so that what moves of itself does not count. Below a tenth of a pixel, D/r0 = 0.08,
there is nothing to restore and the frames pass as they are.

**A frame by itself** does not dance. If a network of uncertainty maps is there, it says what change to expect; where it
expects less than 1.5 levels of 255 (but for one pixel in 200), the frame passes as it is.

**Nothing has changed.** A still background is restored in two windows, and their mean, which dances less than either, stands
for all that follow. A block of 16 x 16 pixels shows it where its means are, all through a window, what they were when it was
first restored, as far as they fluctuate; what passes before it does not wipe it out, what comes to stay does. The network
sees rectangles around the blocks that do not show it or have not been restored often enough, with 32 pixels around them;
what changes fades into the background over 16. Cameras change their exposure with what stands before them
(`turbnet.deploy.exposure`): the means of blocks are compared without it, and the background is shown as each frame was
exposed.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from turbnet.deploy.exposure import LAST_BIT, exposures

STILL = 0.1
"""RMS displacement, pixels, below which air does not matter."""

ENOUGH = 2
"""Windows of which a still background is the mean."""

_LOOKED_AT = 12  # frames of a window, equally spaced, that tell the dance
_BLOCK = 16
_AROUND = 32  # pixels of context around what has changed
_FADING = 8  # the outermost of them show nothing
_CALL = 32**2  # pixels that would take as long as a rectangle of its own takes beside its pixels
_CHANGE = 0.010  # of a block's mean, full scale 1
_SLOPES = 2.0  # how much steeper a picture is than its mean over time
_FLUCTUATION = 3.5  # standard errors
_CHANCE = 0.05  # by which two medians of the same variance may differ
_EXPECTED, _RARE = 1.5 / 255, 0.995


@dataclass
class Skipped:
    """Tiles of windows, or parts of one: `clean` passed as they were, `still` given what was restored before, `restored`."""

    clean: float = 0.0
    still: float = 0.0
    restored: float = 0.0

    @property
    def saved(self) -> float:
        """Share of the tiles that the network did not see."""
        total = self.clean + self.still + self.restored
        return (self.clean + self.still) / total if total else 0.0


@dataclass(frozen=True)
class _Kept:
    """What was restored, by block: its mean and fluctuation then, whether it stood still, in how many windows; the picture.

    And the least dance of all windows, pixels: what passes by adds to it.
    """

    means: np.ndarray
    spread: np.ndarray
    steady: np.ndarray
    windows: np.ndarray
    picture: np.ndarray  # (C, H, W)
    dance: float


class Skipping:
    """A network that takes whole windows, given the tiles of one window after the other, always in the same order.

    Args:
        network: (1, T, C, h, w) -> (1, T, C, h, w).
        tiles: of a frame.
        skipped: counts what was spared.
        multiple: sides the network accepts are multiples of this, pixels.
        maps: (1, T, C, h, w) -> (1, T, 3, h, w), scales of tilt and blur and the change to expect; None: frames by
            themselves are all restored.
    """

    def __init__(
        self,
        network: Callable[[np.ndarray], np.ndarray],
        tiles: int,
        skipped: Skipped,
        multiple: int = 8,
        maps: Callable[[np.ndarray], np.ndarray] | None = None,
    ) -> None:
        self._network, self.skipped, self._multiple, self._maps = network, skipped, multiple, maps
        self._kept: list[_Kept | None] = [None] * tiles
        self._turn = 0

    def __call__(self, frames_BTCHW: np.ndarray) -> np.ndarray:
        """The next tile's frames restored."""
        turn, self._turn = self._turn, (self._turn + 1) % len(self._kept)
        frames = frames_BTCHW[0]
        if len(frames) == 1:
            if self._maps is not None and np.quantile(self._maps(frames_BTCHW)[:, :, 2], _RARE) < _EXPECTED:
                self.skipped.clean += 1
                return frames_BTCHW
            self.skipped.restored += 1
            return self._network(frames_BTCHW)
        grey = frames.mean(1)
        means = block_means(grey)
        few = np.unique(np.linspace(0, len(frames) - 1, _LOOKED_AT).round().astype(int))
        moved = dance(exposures(np.median(means[few], axis=0), means[few]).taken_out(grey[few]))
        if moved < STILL:
            self._kept[turn] = None
            self.skipped.clean += 1
            return frames_BTCHW
        kept, sides = self._kept[turn], frames.shape[2:]
        moved = min(moved, kept.dance) if kept else moved
        if np.isinf(moved):  # nobody can say what of it stands still
            self.skipped.restored += 1
            return self._network(frames_BTCHW)
        exposure = exposures(kept.means if kept else np.median(means, axis=0), means)
        means = exposure.taken_out(means)
        spread = _fluctuation(means)
        # Only what stands still all the time stands for what comes; air moves the slopes of a picture as far as it dances.
        slopes = block_means(np.hypot(*np.gradient(grey.mean(0)))[None])[0]
        calm = spread < _CHANGE + _SLOPES * moved * np.minimum(slopes, 1 / _BLOCK)
        steady = calm & _same(means.mean(0), np.inf, spread, means)
        known, windows = np.zeros_like(calm), np.zeros(calm.shape)
        boxes = [(slice(0, sides[0]), slice(0, sides[1]))]
        if kept is not None:
            known = calm & kept.steady & _same(kept.means, len(means), np.minimum(kept.spread, spread), means)
            windows = np.where(known, kept.windows, 0)
            boxes = around(windows < ENOUGH, sides, self._multiple)
        share = sum((down.stop - down.start) * (across.stop - across.start) for down, across in boxes)
        share = float(min(share / (sides[0] * sides[1]), 1.0))
        self.skipped.restored += share
        self.skipped.still += 1 - share
        if kept is None or share == 1:
            fresh = self._network(frames_BTCHW)
        else:
            fresh = np.zeros_like(frames_BTCHW)
            for box in boxes:
                seen = self._network(np.ascontiguousarray(frames_BTCHW[..., *box]))
                (down, from_top), (across, from_left) = (
                    _shown(part, side) for part, side in zip(box, sides, strict=True)
                )
                fresh[..., down, across] = seen[..., from_top, from_left]
        mean = exposure.mean(fresh[0])
        if kept is None:
            self._kept[turn] = _Kept(means.mean(0), spread, steady, windows + 1, mean, moved)
            return fresh
        # What passes by does not wipe out the background that it hides; what has come to stay does.
        passing = ~known & ~steady & kept.steady
        replaced = ~known & ~passing
        gains = np.where(known & (windows < ENOUGH), 1 / (windows + 1), 0)
        counts = np.maximum(_at_pixels((replaced | _neighbours(replaced)) & ~passing, sides), _at_pixels(gains, sides))
        picture = kept.picture + counts * (mean - kept.picture)
        self._kept[turn] = _Kept(
            np.where(replaced, means.mean(0), kept.means),
            np.where(replaced, spread, kept.spread),
            np.where(replaced, steady, kept.steady),
            np.where(passing, kept.windows, np.minimum(windows + 1, ENOUGH)),
            picture,
            moved,
        )
        changes = _at_pixels(~known | _neighbours(~known), sides)
        background = exposure.shown(picture)
        fresh[0] -= background
        fresh[0] *= changes
        fresh[0] += background
        return fresh


def around(changed_hw: np.ndarray, sides: tuple[int, int], multiple: int) -> list[tuple[slice, slice]]:
    """Rectangles around the blocks that have changed and what surrounds them, as large as a network takes them.

    One around all of them is cut in two, and those again, while that leaves fewer pixels. They may overlap.
    """
    ends = [np.array([*_starts(side)[1:], side]) for side in sides]

    def rectangle(blocks_N2: np.ndarray) -> tuple[slice, slice]:
        first, last = blocks_N2.min(0), blocks_N2.max(0)
        down, across = (
            _multiple(max(f * _BLOCK - _AROUND, 0), min(end[k] + _AROUND, side), side, multiple)
            for f, k, end, side in zip(first, last, ends, sides, strict=True)
        )
        return down, across

    def cut(blocks_N2: np.ndarray) -> list[tuple[slice, slice]]:
        whole, parts = rectangle(blocks_N2), None
        least = _cost(whole)
        for places in blocks_N2.T:
            for place in np.unique(places)[1:]:
                halves = blocks_N2[places < place], blocks_N2[places >= place]
                cost = sum(_cost(rectangle(half)) for half in halves)
                if cost < least:
                    least, parts = cost, halves
        return [whole] if parts is None else [*cut(parts[0]), *cut(parts[1])]

    blocks = np.argwhere(changed_hw)
    return cut(blocks) if len(blocks) else []


def _cost(box: tuple[slice, slice]) -> int:
    down, across = box
    return (down.stop - down.start) * (across.stop - across.start) + _CALL


def _shown(part: slice, side: int) -> tuple[slice, slice]:
    """Where a part of an axis shows something, in the frame and in the part.

    Not at its outermost pixels, which see too little around them, unless the frame ends there.
    """
    first, end = _FADING * (part.start > 0), part.stop - part.start - _FADING * (part.stop < side)
    return slice(part.start + first, part.start + end), slice(first, end)


def _multiple(first: int, end: int, side: int, multiple: int) -> slice:
    """The smallest part of an axis that holds this one and that a network takes: four units at least."""
    first = first // multiple * multiple
    length = min(max(-(-(end - first) // multiple), 4) * multiple, side)
    first = min(first, side - length)
    return slice(first, first + length)


def _at_pixels(blocks_hw: np.ndarray, sides: tuple[int, int]) -> np.ndarray:
    """Values of blocks at pixels (H, W), float32: the mean of what lies within 8 pixels, so that no border shows."""
    values = blocks_hw.astype(np.float64)
    for axis, side in enumerate(sides):
        starts = _starts(side)
        values = np.repeat(values, np.diff([*starts, side]), axis=axis)
        reach = _BLOCK // 2
        padding = [(0, 0), (0, 0)]
        padding[axis] = (reach + 1, reach)
        sums = np.pad(values, padding, mode="edge").cumsum(axis)
        ahead = np.arange(side)
        values = (sums.take(ahead + 2 * reach + 1, axis) - sums.take(ahead, axis)) / (2 * reach + 1)
    return values.astype(np.float32)


def dance(frames_THW: np.ndarray) -> float:
    """RMS displacement of what stands still, in each axis, pixels; 0 where no frame differs from the others.

    Infinite in place of next to nothing where weak gradients vary so much, by noise or by what moves of itself, that nothing
    can be told.

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
    if np.quantile(variance, 0.999) < LAST_BIT**2 / 4:  # a mean of four pixels
        return 0.0
    down, across = np.gradient(halved.mean(0))
    steepness = (down**2 + across**2) / 4  # of a pixel, not of two
    weak, strong = np.quantile(steepness, (0.5, 0.9))
    if strong <= 0:
        return np.inf
    noise, slope = np.median(variance[steepness <= weak]), np.median(steepness[steepness >= strong])
    moved = float(np.sqrt(max(np.median(variance[steepness >= strong]) - noise, 0.0) / slope))
    return np.inf if moved < STILL and noise * _CHANCE > STILL**2 * slope else moved


def _starts(side: int) -> list[int]:
    """Where blocks begin along an axis; the last one takes what is left."""
    return list(range(0, max(side - _BLOCK, 0) + 1, _BLOCK))


def _fluctuation(means_Thw: np.ndarray) -> np.ndarray:
    """Standard deviation over time (h, w), from the median difference of successive frames: few are large as things pass."""
    deviation: np.ndarray = np.median(np.abs(np.diff(means_Thw, axis=0)), axis=0) / 0.954
    return deviation


def block_means(pictures_NHW: np.ndarray) -> np.ndarray:
    """Means of the blocks of every picture, (N, h, w) float64; the last one of an axis takes what is left."""
    sums, count = pictures_NHW.astype(np.float64), np.ones(())
    for axis in (1, 2):
        starts = _starts(pictures_NHW.shape[axis])
        sums = np.add.reduceat(sums, starts, axis=axis)
        count = np.multiply.outer(count, np.diff([*starts, pictures_NHW.shape[axis]]))
    return sums / count


def _same(expected_hw: np.ndarray, behind: float, spread_hw: np.ndarray, means_Thw: np.ndarray) -> np.ndarray:
    """Where a window, each third of it and every four frames show what is expected, so that nothing passes through: (h, w).

    Of so many comparisons some fail by chance: a block that departs by less than twice what is allowed must have a neighbour
    that departs as well.

    Args:
        behind: frames that what is expected was the mean of; infinite where it is the mean of these frames themselves.
    """
    departure = np.zeros(expected_hw.shape)
    count = len(means_Thw)
    for part in (
        part for pieces in {1, min(3, count), max(count // 4, 1)} for part in np.array_split(means_Thw, pieces)
    ):
        allowed = _CHANGE + _FLUCTUATION * spread_hw * np.sqrt(1 / len(part) + 1 / behind)
        departure = np.maximum(departure, np.abs(part.mean(0) - expected_hw) / allowed)
    departs = departure > 1
    return ~(departs & (_neighbours(departs) | (departure > 2)))


def _neighbours(blocks_hw: np.ndarray) -> np.ndarray:
    """Where one of the eight blocks around is true."""
    height, width = blocks_hw.shape
    padded = np.pad(blocks_hw, 1)
    places = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    found: np.ndarray = np.any([padded[i : i + height, j : j + width] for i, j in places], axis=0)
    return found
