r"""Spectra of the refractive index and of the phase it leaves on light.

.. math::
    \Phi_n(\kappa) = 0.033\,C_n^2\,(\kappa^2 + \kappa_0^2)^{-11/6}\, e^{-\kappa^2/\kappa_m^2}, \qquad
    \kappa_0 = 2\pi/L_0, \quad \kappa_m = 5.92/l_0

is von Kármán's, with Kolmogorov's 0.033 Cn2 kappa^(-11/3) as its limit L0 -> inf, l0 -> 0. A slab of thickness dz has
the phase spectrum F = 2 pi k^2 dz Phi_n, in terms of the Fried parameter 0.490 r0^(-5/3) kappa^(-11/3). kappa is an
angular wavenumber, rad/m; B(r) = int F e^{i kappa.r} d^2 kappa. Source: L. C. Andrews and R. L. Phillips, Laser Beam
Propagation through Random Media (2005), chapter 3.
"""

import numpy as np

from turbnet.atmosphere.profiles import CN2_MAX, Array
from turbnet.errors import check_range


def refractive_spectrum(kappa: Array, cn2: float, outer_scale: float = np.inf, inner_scale: float = 0.0) -> Array:
    """Phi_n, m^3, at the angular wavenumbers kappa > 0 (rad/m).

    Args:
        kappa: any shape, rad/m.
        cn2: structure parameter, m^(-2/3).
        outer_scale: L0, m; infinite for Kolmogorov turbulence.
        inner_scale: l0, m; 0 for Kolmogorov turbulence.

    Raises:
        ParameterError: a value out of range.
    """
    check_range("Cn2", cn2, 0.0, CN2_MAX, "m^(-2/3)")
    return 0.033 * cn2 * _shape(kappa, outer_scale, inner_scale)


def phase_spectrum(kappa: Array, r0: float, outer_scale: float = np.inf, inner_scale: float = 0.0) -> Array:
    """F_phi, rad^2 m^2, at the angular wavenumbers kappa > 0 (rad/m), for the Fried parameter r0 (m)."""
    check_range("r0", r0, 1e-6, np.inf, "m")
    return 0.490 * r0 ** (-5 / 3) * _shape(kappa, outer_scale, inner_scale)


def _shape(kappa: Array, outer_scale: float, inner_scale: float) -> Array:
    check_range("outer scale", outer_scale, 1e-3, np.inf, "m")
    check_range("inner scale", inner_scale, 0.0, 1.0, "m")
    kappa = np.asarray(kappa, dtype=np.float64)
    decay = np.exp(-((kappa * inner_scale / 5.92) ** 2))
    return (kappa**2 + (2 * np.pi / outer_scale) ** 2) ** (-11 / 6) * decay
