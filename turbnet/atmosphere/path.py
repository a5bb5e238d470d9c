r"""A path of turbulent air between a scene and an aperture, and the few lengths that sum it up.

z runs from the aperture (z = 0) to the scene (z = L); k = 2 pi / lambda. Kolmogorov turbulence:

.. math::
    r_0 = \left[0.423\,k^2 \int_0^L C_n^2(z)\, w(z)\, dz\right]^{-3/5}, \qquad
    \theta_0 = \left[2.914\,k^2 \int_0^L C_n^2(z)\, z^{5/3}\, dz\right]^{-3/5}

with w = 1 for a plane wave and w = ((L-z)/L)^{5/3} for a spherical wave. Source: Fried, JOSA 56, 1372 (1966); the
exponent 5/3 of the spherical weight is missing in some printed texts.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from turbnet.atmosphere.profiles import Array, Constant, Profile
from turbnet.errors import check_range


@dataclass(frozen=True)
class OpticalPath:
    """An aperture that looks through `distance` metres of air.

    Args:
        aperture: diameter D of the entrance pupil, m.
        distance: from the aperture to the scene, L, m.
        profile: Cn2 along the path, m^(-2/3); see `turbnet.atmosphere.profiles`.
        wavelength: lambda, m.

    Raises:
        ParameterError: a value outside its physical range, such as a wavelength given in nanometres.
    """

    aperture: float
    distance: float
    profile: Profile
    wavelength: float = 525e-9

    def __post_init__(self) -> None:
        check_range("aperture", self.aperture, 1e-3, 50.0, "m")
        check_range("distance", self.distance, 1.0, 1e6, "m")
        check_range("wavelength", self.wavelength, 1e-7, 2e-5, "m")

    @classmethod
    def from_d_over_r0(
        cls, d_over_r0: float, aperture: float = 0.2034, distance: float = 7000.0, wavelength: float = 525e-9
    ) -> "OpticalPath":
        """A constant-Cn2 path with the given ratio D/r0 of aperture to (spherical-wave) Fried parameter.

        For those who have no camera data. The default geometry decides how fast the turbulence changes across the
        scene (here a pixel is 9.03 mm in the scene and the aperture 22.5 pixels wide).
        """
        check_range("D/r0", d_over_r0, 0.0, 100.0)
        unit = cls(aperture, distance, Constant(1e-16), wavelength)
        return cls(aperture, distance, Constant(1e-16 * (d_over_r0 / unit.d_over_r0) ** (5 / 3)), wavelength)

    @property
    def wavenumber(self) -> float:
        """k = 2 pi / lambda, rad/m."""
        return 2 * np.pi / self.wavelength

    @property
    def pixel(self) -> float:
        """Nyquist pixel in the scene, lambda L / (2 D), m."""
        return self.wavelength * self.distance / (2 * self.aperture)

    def layers(self, count: int) -> tuple[Array, Array]:
        """Gauss-Legendre points z_l (m) and Cn2 weights Cn2(z_l) dz_l (m^(1/3)) that integrate over the path."""
        x, w = np.polynomial.legendre.leggauss(count)
        z = 0.5 * self.distance * (x + 1)
        return z, 0.5 * self.distance * w * self.profile(z)

    def _moment(self, toward_scene: bool, power: float) -> float:
        """int Cn2(z) s^power dz, with s = z/L towards the scene or (L-z)/L towards the aperture."""
        # Composite rule: profiles have kinks where they are tabulated.
        edges = np.linspace(0.0, self.distance, 257)
        x, w = np.polynomial.legendre.leggauss(8)
        half = 0.5 * np.diff(edges)[:, None]
        z = edges[:-1, None] + half * (x + 1)
        s = z / self.distance if toward_scene else 1 - z / self.distance
        return float(np.sum(half * w * self.profile(z) * s**power))

    @cached_property
    def r0(self) -> float:
        """Fried parameter of a spherical wave from the scene, m; infinite in still air."""
        return _fried(self.wavenumber, self._moment(False, 5 / 3))

    @cached_property
    def r0_plane(self) -> float:
        """Fried parameter of a plane wave, m; infinite in still air."""
        return _fried(self.wavenumber, self._moment(False, 0.0))

    @property
    def d_over_r0(self) -> float:
        """D/r0, spherical wave: the strength of the turbulence in the image."""
        return self.aperture / self.r0

    @cached_property
    def theta0(self) -> float:
        """Isoplanatic angle, rad; infinite in still air."""
        integral = self._moment(True, 5 / 3) * self.distance ** (5 / 3)
        return float("inf") if integral == 0 else float((2.914 * self.wavenumber**2 * integral) ** (-3 / 5))

    @property
    def theta0_pixels(self) -> float:
        """Isoplanatic angle in Nyquist pixels."""
        return self.theta0 * self.distance / self.pixel


def _fried(wavenumber: float, integral: float) -> float:
    return float("inf") if integral == 0 else float((0.423 * wavenumber**2 * integral) ** (-3 / 5))
