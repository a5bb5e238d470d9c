"""The plane waves that stand for a power-law spectrum on a periodic grid and below it.

An FFT grid with the steps dK holds every object-plane frequency but the lowest, where the spectrum has most of its
energy. The block of bins -1..1 (the zero among them) is therefore taken out and cut into 9 x 9 cells a third as wide,
whose inner 3 x 3 block is cut again, and so on. Each wave carries the energy of its whole cell, weighted by K^2 as a tilt
sees it: cell means of (K^2 + K_0^2)^(-11/6) K^2, not midpoints. Represented covariances then lie within about 1 % of the
exact ones up to half the period; three-by-three subharmonics of midpoint weights leave 5 %.

Every wave stands for its cell: frozen flow moves it with a frequency drawn from there, so that single points see the
continuous spectrum go by and no pattern comes back after a period of the grid.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_LEVELS = 6
_HALF = 4  # cells -4..4: nine across
_INNER = 1  # bins -1..1 are handed down to the next level
_NEAR = 8  # bins beyond this carry what their midpoint says


@dataclass(frozen=True)
class Waves:
    """Plane waves and the cells of frequencies they stand for.

    Attributes:
        x, y: frequencies in the scene, rad/m.
        width: of each cell, as a fraction of the grid's steps.
        step: of the grid, dK along x and y, rad/m.
    """

    x: Array
    y: Array
    width: Array
    step: tuple[float, float]

    @property
    def area(self) -> Array:
        """Of the cells, (rad/m)^2."""
        return self.width**2 * self.step[0] * self.step[1]

    def weight(self, k0: float = 0.0) -> Array:
        """Energy of each cell over that of its area at the wave itself.

        Args:
            k0: frequency of the outer scale, rad/m in the scene; 0 for Kolmogorov.
        """
        weight = np.ones_like(self.x)
        reach = np.maximum(np.abs(self.x) / self.step[0], np.abs(self.y) / self.step[1]) / self.width
        near = (reach > 0) & (reach < _NEAR + 0.5)
        step = (self.width[near] * self.step[0], self.width[near] * self.step[1])
        weight[near] = cell_weight(self.x[near], self.y[near], step, k0)
        weight[reach == 0] = 0.0
        return weight


def cell_weight(x: Array, y: Array, step: tuple[Array, Array], k0: float = 0.0, samples: int = 33) -> Array:
    """Mean of (K^2 + k0^2)^(-11/6) K^2 over cells `step` wide centred at (x, y), divided by its value there."""
    t = (np.arange(samples) + 0.5) / samples - 0.5
    k2 = (x[:, None, None] + step[0][:, None, None] * t) ** 2 + (
        y[:, None, None] + step[1][:, None, None] * t[:, None]
    ) ** 2
    centre = x**2 + y**2
    return np.mean((k2 + k0**2) ** (-11 / 6) * k2, axis=(1, 2)) / ((centre + k0**2) ** (-11 / 6) * centre)


def low_waves(step: tuple[float, float]) -> Waves:
    """The waves of every level below a grid, one of each pair +-K."""
    n = np.arange(-_HALF, _HALF + 1)
    a, b = (v.ravel().astype(float) for v in np.meshgrid(n, n))
    one_of_pair = (b > 0) | ((b == 0) & (a > 0))
    xs, ys, widths = [], [], []
    for level in range(1, _LEVELS + 1):
        inner = _INNER if level < _LEVELS else 0
        keep = one_of_pair & (np.maximum(np.abs(a), np.abs(b)) > inner)
        width = 3.0**-level
        xs.append(a[keep] * width * step[0])
        ys.append(b[keep] * width * step[1])
        widths.append(np.full(keep.sum(), width))
    return Waves(np.concatenate(xs), np.concatenate(ys), np.concatenate(widths), step)


def grid_waves(shape: tuple[int, int], step: tuple[float, float], half: bool = False) -> Waves:
    """The bins of a half-plane FFT grid of `shape` = (rows, columns) samples, (rows, columns // 2 + 1).

    With `half` only the rows of ky >= 0, (rows // 2 + 1, columns // 2 + 1).
    """
    rows = np.arange(shape[0] // 2 + 1.0) if half else np.fft.fftfreq(shape[0], 1 / shape[0])
    y, x = np.meshgrid(rows, np.arange(shape[1] // 2 + 1.0), indexing="ij")
    return Waves(x * step[0], y * step[1], np.ones_like(x), step)


def held(waves: Waves) -> NDArray[np.bool_]:
    """Which bins the grid keeps: all but the block handed to `low_waves`."""
    return np.maximum(np.abs(waves.x) / waves.step[0], np.abs(waves.y) / waves.step[1]) > _INNER + 0.5
