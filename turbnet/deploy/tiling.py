"""Pictures of any size through a network of bounded memory: padding, overlapping tiles, smooth blending.

A picture is padded by reflection to a multiple of what the network asks for, then cut into equal tiles that overlap.
Along each axis a tile's weight rises and falls as a raised cosine,

    w(k) = sin^2(pi/2 (k + 1/2) / n),   k = 0 ... n - 1 over an overlap of n pixels,

whose mirror image is 1 - w, so neighbours' weights sum to one. A tile's weight is the product over both axes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np

from turbnet.errors import check_range


def raised_cosine(n: int) -> np.ndarray:
    """The rising weights over an overlap of `n` samples, (n,) float64; `raised_cosine(n)[::-1] == 1 - itself`."""
    return np.sin(np.pi / 2 * (np.arange(n) + 0.5) / n) ** 2


def packed(picture: np.ndarray) -> np.ndarray:
    """A float32 picture as uint8, a quarter of the memory, where nothing is lost: it came from eight bits. Else itself."""
    levels = np.rint(picture.clip(0, 1) * np.float32(255)).astype(np.uint8)
    return levels if np.array_equal(_unpacked(levels), picture) else picture


def _unpacked(picture: np.ndarray) -> np.ndarray:
    return picture / np.float32(255) if picture.dtype == np.uint8 else picture


@dataclass(frozen=True)
class Axis:
    """Tiles along one axis: equal `length`, at `starts`, with `weights` (tiles, length) that sum to one everywhere."""

    length: int
    starts: list[int]
    weights: np.ndarray

    @classmethod
    def cover(cls, size: int, tile: int, overlap: int, multiple: int) -> "Axis":
        """Cover `size` (a multiple of `multiple`) with the fewest tiles no longer than `tile`.

        The tiles are then made as short as that number allows, so little is computed twice.
        """
        tile = min(tile // multiple * multiple, size)
        count = 1 if tile == size else ceil((size - overlap) / (tile - overlap))
        length = ceil((size + (count - 1) * overlap) / count / multiple) * multiple
        starts = [round(k * (size - length) / max(count - 1, 1)) for k in range(count)]

        weights = np.ones((count, length))
        for k in range(count - 1):
            ramp = raised_cosine(starts[k] + length - starts[k + 1])
            weights[k + 1, : len(ramp)] *= ramp
            weights[k, length - len(ramp) :] *= ramp[::-1]
        # Only where rounding makes three tiles meet is the sum not one already.
        total = np.zeros(size)
        for start, weight in zip(starts, weights, strict=True):
            total[start : start + length] += weight
        weights /= np.stack([total[start : start + length] for start in starts])
        return cls(length, starts, weights)


@dataclass(frozen=True)
class Tiling:
    """How pictures are cut for a network.

    Args:
        tile: greatest side of a tile, pixels, 32 to 8192 and at least 4 `multiple`.
        overlap: least overlap of neighbours, pixels, 0 to tile/2.
        multiple: sides the network accepts are multiples of this, pixels.

    Raises:
        ParameterError: a value is out of its range.
    """

    tile: int
    overlap: int
    multiple: int

    def __post_init__(self) -> None:
        check_range("tile", self.tile, max(32, 4 * self.multiple), 8192, "pixels")
        check_range("overlap", self.overlap, 0, self.tile // 2 - self.multiple, "pixels")

    def axes(self, height: int, width: int) -> tuple[Axis, Axis]:
        """Tiles down and across a picture, in pixels of the padded picture."""
        rows, columns = (
            Axis.cover(self._padded(side), self.tile, self.overlap, self.multiple) for side in (height, width)
        )
        return rows, columns

    def count(self, height: int, width: int) -> int:
        """Number of tiles of a picture."""
        rows, columns = self.axes(height, width)
        return len(rows.starts) * len(columns.starts)

    def apply(
        self, network: Callable[[np.ndarray], np.ndarray], frames: Sequence[np.ndarray] | np.ndarray
    ) -> list[np.ndarray]:
        """Pass frames of any size through `network`, (1, T, C, h, w) -> (1, T, C', h, w), tile by tile.

        Args:
            frames: (C, H, W) each, or all in one array, float32 or as `packed` makes of it; H and W at least 1. A window of
                many frames is large: it is never copied as a whole.

        Returns:
            float32 (C', H, W) for each frame, in memory of its own, which so can be freed frame by frame.
        """
        height, width = frames[0].shape[-2:]
        padding = [(0, self._padded(side) - side) for side in (height, width)]
        padded = list(frames)
        if padding != [(0, 0), (0, 0)]:  # np.pad would copy
            padded = [np.pad(frame, [(0, 0), *padding], mode="reflect") for frame in frames]
        rows, columns = self.axes(height, width)

        blended: list[np.ndarray] = []
        for top, weight_H in zip(rows.starts, rows.weights, strict=True):
            for left, weight_W in zip(columns.starts, columns.weights, strict=True):
                place = np.s_[..., top : top + rows.length, left : left + columns.length]
                (restored_TCHW,) = network(np.stack([_unpacked(frame[place]) for frame in padded])[None])
                if not blended:
                    shape = (restored_TCHW.shape[1], *padded[0].shape[-2:])
                    blended = [np.zeros(shape, np.float32) for _ in padded]
                weight = np.outer(weight_H, weight_W).astype(np.float32)
                for whole, part in zip(blended, restored_TCHW, strict=True):
                    whole[place] += part * weight
        return [whole[:, :height, :width] for whole in blended]

    def _padded(self, side: int) -> int:
        """Next multiple, at least four of them, so that a network's coarsest scale still has neighbours to look at."""
        return max(ceil(side / self.multiple), 4) * self.multiple
