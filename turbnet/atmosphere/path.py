r"""A path of turbulent air between a scene and an aperture, and the few lengths that sum it up.

z runs from the aperture (z = 0) to the scene (z = L); k = 2 pi / lambda. Kolmogorov turbulence:

.. math::
    r_0 = \left[0.423\,k^2 \int_0^L C_n^2(z)\, w(z)\, dz\right]^{-3/5}, \qquad
    \theta_0 = \left[2.914\,k^2 \int_0^L C_n^2(z)\, z^{5/3}\, dz\right]^{-3/5}

with w = 1 for a plane wave and w = ((L-z)/L)^{5/3} for a spherical wave. Source: Fried, JOSA 56, 1372 (1966); the
exponent 5/3 of the spherical weight is missing in some printed texts. Rytov variances and coherence time: L. C. Andrews
and R. L. Phillips, Laser Beam Propagation through Random Media (2005), chapters 8 and 12.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from turbnet.atmosphere.profiles import Array, Constant, Profile
from turbnet.errors import check_range

WEAK, STRONG = 0.3, 5.0
"""Plane-wave Rytov variances that part weak, moderate and strong fluctuation, by the usual convention."""


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

    def quadrature(self) -> tuple[Array, Array]:
        """Points z (m) and weights Cn2(z) dz (m^(1/3)) for integrals over the path, 8 Gauss points on each panel.

        Panels narrow towards both ends, where the weights have their zeros and a slanted path its ground layer, and end
        at every knot the profile names.
        """
        edges = 0.5 * self.distance * (1 - np.cos(np.linspace(0.0, np.pi, 257)))
        knots = [z for z in getattr(self.profile, "knots", ()) if 0 < z < self.distance]
        edges = np.unique(np.concatenate([edges, knots]))
        x, w = np.polynomial.legendre.leggauss(8)
        half = 0.5 * np.diff(edges)[:, None]
        z = edges[:-1, None] + half * (x + 1)
        return z.ravel(), (half * w * self.profile(z)).ravel()

    def _moment(self, toward_scene: bool, power: float) -> float:
        """int Cn2(z) s^power dz, with s = z/L towards the scene or (L-z)/L towards the aperture."""
        z, cn2_dz = self.quadrature()
        s = z / self.distance if toward_scene else 1 - z / self.distance
        return float(np.sum(cn2_dz * s**power))

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

    @cached_property
    def rytov_plane(self) -> float:
        """Rytov variance of a plane wave, 2.25 k^(7/6) int Cn2 z^(5/6) dz; 1.23 k^(7/6) Cn2 L^(11/6) if constant."""
        z, cn2_dz = self.quadrature()
        return float(2.25 * self.wavenumber ** (7 / 6) * np.sum(cn2_dz * z ** (5 / 6)))

    @cached_property
    def rytov_spherical(self) -> float:
        """Rytov variance of a spherical wave from the scene, 2.25 k^(7/6) int Cn2 [z (L-z) / L]^(5/6) dz."""
        z, cn2_dz = self.quadrature()
        return float(2.25 * self.wavenumber ** (7 / 6) * np.sum(cn2_dz * (z * (1 - z / self.distance)) ** (5 / 6)))

    @property
    def fresnel_number(self) -> float:
        """D^2 / (lambda L): far above 1 the aperture is in the near field of the turbulence, far below in its far."""
        return self.aperture**2 / (self.wavelength * self.distance)

    def coherence_time(self, wind: Callable[[Array], Array] | float) -> float:
        """tau0 = [2.914 k^2 int Cn2(z) v(z)^(5/3) dz]^(-3/5), s: in it the phase changes by 1 rad^2; 0.134/tau0 is
        Greenwood's frequency.

        Args:
            wind: speed across the path, m/s, one value or a function of z (m).

        Raises:
            ParameterError: a speed outside 0 to 200 m/s.
        """
        z, cn2_dz = self.quadrature()
        speed = np.broadcast_to(np.asarray(wind(z) if callable(wind) else wind, dtype=np.float64), z.shape)
        check_range("slowest wind", float(speed.min()), 0.0, 200.0, "m/s")
        check_range("fastest wind", float(speed.max()), 0.0, 200.0, "m/s")
        integral = float(np.sum(cn2_dz * speed ** (5 / 3)))
        return float("inf") if integral == 0 else float((2.914 * self.wavenumber**2 * integral) ** (-3 / 5))

    def validity(self) -> str:
        """One sentence on how far a phase-only model of this path can be trusted."""
        field = "near" if self.fresnel_number >= 1 else "far"
        rytov = self.rytov_plane
        if rytov < WEAK:
            verdict = "weak fluctuation: a phase-only model holds"
        elif rytov < STRONG:
            verdict = "moderate fluctuation: a phase-only model holds for the phase and misses the scintillation"
        else:
            verdict = f"strong fluctuation (above {STRONG:g}): outside the validity of a phase-only model"
        return f"Rytov variance {rytov:.2g}, {verdict}; {field} field (Fresnel number {self.fresnel_number:.2g})"


def _fried(wavenumber: float, integral: float) -> float:
    return float("inf") if integral == 0 else float((0.423 * wavenumber**2 * integral) ** (-3 / 5))
