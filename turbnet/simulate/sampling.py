r"""How a split-step propagation is sampled, when that is fine enough, and what it costs.

The wave runs on N x N samples whose spacing changes linearly from the scene to the aperture,

.. math::
    \delta(z) = \delta_0 + (\delta_L - \delta_0)\, z/L, \qquad
    \delta_0 = \frac{sD}{N}, \qquad \delta_L = \frac{\lambda L}{sD}

In the aperture the grid is s diameters wide; in the scene its spacing lets a band-limited point source light just that
width. In coordinates x / m(z), m = delta(z) / delta_0, with the curvature of the grid's own cone taken off, the wave
obeys the plain Fresnel equation over the reduced distance

.. math:: \tau_{ab} = (z_a - z_b) / (m_a m_b), \qquad \lambda\, \tau_{L0} = N \delta_0^2

whose last equality is critical sampling of the whole way, for any geometry; each step stays below it. Source: D. G.
Voelz, Computational Fourier Optics (2011), ch. 5; J. D. Schmidt, Numerical Simulation of Optical Wave Propagation
(2010), ch. 8-9; J. M. Martin and S. M. Flatté, Appl. Opt. 27, 2111 (1988) for the strength of one screen.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len

from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Array
from turbnet.atmosphere.slabs import Slabs, slabs
from turbnet.errors import ParameterError, check_range

SAMPLES_PER_R0 = 3
"""Samples a Fried parameter must span: the phase between neighbours then stays near 1 rad rms."""
ROOM = 0.65
"""Share of a grid's width that the light which matters fills."""
FRESNEL_ZONES, SPREADS = 6.0, 4.0
"""How far from the aperture, in sqrt(lambda z) and in lambda z / r0, light at z can still reach it."""
SLAB_RYTOV = 0.1
"""Largest Rytov variance of one slab: within it the air must change the phase only."""


@dataclass(frozen=True)
class Sampling:
    """The grid of a split-step propagation.

    Args:
        path: what the light crosses.
        grid: N, samples along a side, in all planes; N / extent must be whole, and even if N is even.
        extent: s, width of the grid in the aperture, in diameters, at least 4.
        screens: phase screens, equally thick slabs, at least 10.

    Raises:
        ParameterError: a sampling constraint is violated; says which, why it matters and what to change.
    """

    path: OpticalPath
    grid: int = 256
    extent: float = 4.0
    screens: int = 10

    def __post_init__(self) -> None:
        check_range("grid", self.grid, 32, 16384, "samples")
        check_range("extent", self.extent, 4.0, 64.0, "aperture diameters (less lets light wrap around)")
        check_range("screens", self.screens, 10, 200)
        across = self.grid / self.extent
        if across != int(across) or (self.grid - int(across)) % 2:
            raise ParameterError(
                f"grid = {self.grid} samples over extent = {self.extent:g} diameters puts {across:g} samples across "
                "the aperture; they must be whole, and even if the grid is even"
            )
        self._check_turbulence()

    def _check_turbulence(self) -> None:
        path, finest = self.path, float(np.min(self.slabs.r0))
        coarse = SAMPLES_PER_R0 * self.spacing_aperture / path.r0
        if coarse > 1:
            raise ParameterError(
                f"spacing in the aperture = {self.spacing_aperture:.3g} m is too coarse for r0 = {path.r0:.3g} m, "
                f"which must span {SAMPLES_PER_R0} samples; use grid >= {int(np.ceil(self.grid * coarse))}"
            )
        coarse = SAMPLES_PER_R0 * float(np.max(self.spacing / self.slabs.r0))
        if coarse > 1:
            raise ParameterError(
                f"a screen of r0 = {finest:.3g} m is sampled too coarsely: {SAMPLES_PER_R0} samples must span it; use "
                f"more screens, or grid and extent >= {coarse:.3g} times as large"
            )
        spread = 2 * path.wavelength * path.distance / path.r0
        if spread > (self.extent - 1) * path.aperture:
            raise ParameterError(
                f"light scattered by r0 = {path.r0:.3g} m spreads {spread:.3g} m in the aperture's plane and would "
                f"wrap around the grid into the aperture; use extent >= {np.ceil(1 + spread / path.aperture):g}"
            )
        rytov = float(self.slab_rytov.max())
        if rytov > SLAB_RYTOV:
            enough = int(np.ceil(self.screens * (rytov / SLAB_RYTOV) ** (6 / 11)))
            raise ParameterError(
                f"screens = {self.screens} leaves a slab with a Rytov variance of {rytov:.2g}, above {SLAB_RYTOV}: too "
                f"strong to act as a thin screen; use screens >= {enough}"
            )

    @cached_property
    def slabs(self) -> Slabs:
        """The screens' places and strengths, in the order of the light."""
        return slabs(self.path, self.screens)

    @property
    def slab_rytov(self) -> Array:
        """Plane-wave Rytov variance of each slab, 1.23 k^(7/6) I dz^(5/6)."""
        cut = self.slabs
        return np.asarray(1.23 * self.path.wavenumber ** (7 / 6) * cut.cn2_dz * cut.thickness ** (5 / 6))

    @property
    def spacing_aperture(self) -> float:
        """delta_0, m."""
        return self.extent * self.path.aperture / self.grid

    @property
    def spacing_scene(self) -> float:
        """delta_L, m."""
        return self.path.wavelength * self.path.distance / (self.extent * self.path.aperture)

    @property
    def across(self) -> int:
        """Samples across the aperture."""
        return round(self.grid / self.extent)

    def spacing_at(self, z: Array | float) -> Array:
        """delta(z), m."""
        share = np.asarray(z) / self.path.distance
        return np.asarray(self.spacing_aperture + (self.spacing_scene - self.spacing_aperture) * share)

    @property
    def spacing(self) -> Array:
        """delta at the screens, m."""
        return self.spacing_at(self.slabs.z)

    @property
    def reduced_distances(self) -> Array:
        """tau of each of the screens + 1 steps: scene to first screen, ..., last screen to aperture, m."""
        z = np.concatenate([[self.path.distance], self.slabs.z, [0.0]])
        scale = self.spacing_at(z) / self.spacing_aperture
        return -np.diff(z) / (scale[:-1] * scale[1:])

    @property
    def chirps(self) -> Array:
        """lambda tau / delta_0^2 of each step; its transfer function is exp(-i pi chirp f^2), f in cycles a sample."""
        return self.path.wavelength * self.reduced_distances / self.spacing_aperture**2

    @property
    def lit(self) -> Array:
        """Share of the N samples' width that the cone of light fills at each screen."""
        return (1 - self.slabs.z / self.path.distance) * self.spacing_aperture / self.spacing

    @cached_property
    def grids(self) -> NDArray[np.intp]:
        """Samples along a side from each screen on, (screens,): the middle of the N that matters, with room around.

        Near the scene the light is narrow; near the aperture only what lies within FRESNEL_ZONES and SPREADS of it can
        still reach it.
        """
        path, z = self.path, np.append(self.slabs.z, 0.0)
        away = np.sqrt(path.wavelength * z / (1 - z / path.distance)) * FRESNEL_ZONES
        away += path.wavelength * z / path.r0 * SPREADS
        reach = np.minimum((path.aperture + 2 * away) / (self.extent * path.aperture), 1.0)
        width = np.append(self.lit, 1.0) * reach * self.grid / ROOM
        fast = [n for n in range(64, self.grid, 32) if (self.grid - n) % 2 == 0 and next_fast_len(n, real=True) == n]
        needed = np.maximum(width[:-1], width[1:])
        return np.array([next((n for n in fast if n >= max(need, self.across)), self.grid) for need in needed])


@dataclass(frozen=True)
class Cost:
    """What a run takes: points x screens x grid^2.

    Attributes:
        points: of the run.
        grids: samples along a side at each screen.
        screen_samples: samples of all screens together.
        bytes_per_real: 4 or 8.
    """

    points: int
    grids: tuple[int, ...]
    screen_samples: int
    bytes_per_real: int

    @property
    def transforms(self) -> int:
        """Two-dimensional FFTs."""
        return 2 * self.points * len(self.grids)

    @property
    def operations(self) -> float:
        """Floating-point operations of the FFTs, 5 N^2 log2 N^2 each."""
        return 2 * self.points * sum(10 * n**2 * float(np.log2(n)) for n in self.grids)

    @property
    def memory(self) -> int:
        """Bytes of the screens: phase and transmission."""
        return 3 * self.screen_samples * self.bytes_per_real

    def __str__(self) -> str:
        return (
            f"{self.points} points x {len(self.grids)} screens x {self.grids[0]}^2 .. {self.grids[-1]}^2 samples: "
            f"{self.transforms} FFTs, {self.operations / 1e9:.3g} GFLOP, {self.memory / 1e6:.3g} MB of screens"
        )
