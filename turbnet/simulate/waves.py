"""The plane waves that stand for a Kolmogorov spectrum on a periodic grid and below it.

A square FFT grid with spacing dK holds every object-plane frequency but the lowest, where the power-law spectrum has most
of its energy. The block of bins -1..1 (the zero among them) is therefore taken out and cut into 9 x 9 cells a third as
wide, whose inner 3 x 3 block is cut again, and so on. Each wave carries the energy of its whole cell, weighted by K^2 as
a tilt sees it: cell means of K^(-11/3+2), not midpoints. Represented covariances then lie within about 1 % of the exact
ones up to half the period; three-by-three subharmonics of midpoint weights leave 5 %.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_LEVELS = 4
_HALF = 4  # cells -4..4: nine across
_INNER = 1  # bins -1..1 are handed down to the next level


@dataclass(frozen=True)
class LowWaves:
    """Waves below the grid, one of each pair +-K, in units of dK: positions `x`, `y` and weight relative to a grid bin."""

    x: Array
    y: Array
    weight: Array


def cell_weight(x: Array, y: Array, width: float = 1.0, samples: int = 33) -> Array:
    """Mean of |K|^(-11/3+2) over square cells centred at (x, y), divided by its value at the centre."""
    t = width * ((np.arange(samples) + 0.5) / samples - 0.5)
    k2 = (x[:, None, None] + t[:, None]) ** 2 + (y[:, None, None] + t) ** 2
    return np.mean(k2 ** (-5 / 6), axis=(1, 2)) / (x**2 + y**2) ** (-5 / 6)


@lru_cache
def low_waves() -> LowWaves:
    """The waves of every level below the grid."""
    n = np.arange(-_HALF, _HALF + 1)
    a, b = (v.ravel().astype(float) for v in np.meshgrid(n, n))
    one_of_pair = (b > 0) | ((b == 0) & (a > 0))
    xs, ys, weights = [], [], []
    for level in range(1, _LEVELS + 1):
        inner = _INNER if level < _LEVELS else 0
        keep = one_of_pair & (np.maximum(np.abs(a), np.abs(b)) > inner)
        width = 3.0**-level
        xs.append(a[keep] * width)
        ys.append(b[keep] * width)
        weights.append(cell_weight(a[keep], b[keep]) * width**2)
    return LowWaves(np.concatenate(xs), np.concatenate(ys), np.concatenate(weights))


def grid_weight(size: int) -> Array:
    """Weight of each bin of a (size, size//2+1) half-plane FFT grid; zero for the block handed to `low_waves`."""
    y, x = np.meshgrid(np.fft.fftfreq(size, 1 / size), np.arange(size // 2 + 1), indexing="ij")
    weight = np.ones_like(x, dtype=np.float64)
    reach = np.maximum(np.abs(x), np.abs(y))
    near = (reach > _INNER) & (reach <= 8)
    weight[near] = cell_weight(x[near], y[near])
    weight[reach <= _INNER] = 0.0
    return weight
