r"""Structure functions: the mean-square difference between two points a distance r apart.

.. math::
    D_n(r) = 8\pi \int \kappa^2\, \Phi_n(\kappa) \left[1 - \frac{\sin\kappa r}{\kappa r}\right] d\kappa
           = C_n^2\, r^{2/3}, \qquad
    D_\phi(r) = 4\pi \int \kappa\, F_\phi(\kappa)\, [1 - J_0(\kappa r)]\, d\kappa = 6.88\, (r/r_0)^{5/3}

the closed forms for Kolmogorov turbulence, the integrals for any outer and inner scale. Source: V. I. Tatarskii, Wave
Propagation in a Turbulent Medium (1961).
"""

from collections.abc import Callable

import numpy as np
from scipy.special import j0

from turbnet.atmosphere.profiles import CN2_MAX, Array
from turbnet.atmosphere.spectra import phase_spectrum, refractive_spectrum
from turbnet.errors import check_range


def refractive_structure(r: Array, cn2: float, outer_scale: float = np.inf, inner_scale: float = 0.0) -> Array:
    """D_n(r), dimensionless, at the distances r >= 0 (m); arguments as in `spectra.refractive_spectrum`."""
    check_range("Cn2", cn2, 0.0, CN2_MAX, "m^(-2/3)")
    r = np.asarray(r, dtype=np.float64)
    if np.isinf(outer_scale) and inner_scale == 0:
        return cn2 * r ** (2 / 3)

    def density(kappa: Array) -> Array:
        return 8 * np.pi * kappa**2 * refractive_spectrum(kappa, cn2, outer_scale, inner_scale)

    return _integrate(density, _one_minus_sinc, r)


def phase_structure(r: Array, r0: float, outer_scale: float = np.inf, inner_scale: float = 0.0) -> Array:
    """D_phi(r), rad^2, at the distances r >= 0 (m) for the Fried parameter r0 (m); scales in m."""
    check_range("r0", r0, 1e-6, np.inf, "m")
    r = np.asarray(r, dtype=np.float64)
    if np.isinf(outer_scale) and inner_scale == 0:
        return 6.88 * (r / r0) ** (5 / 3)

    def density(kappa: Array) -> Array:
        return 4 * np.pi * kappa * phase_spectrum(kappa, r0, outer_scale, inner_scale)

    return _integrate(density, _one_minus_j0, r)


def _integrate(density: Callable[[Array], Array], kernel: Callable[[Array], Array], r: Array) -> Array:
    """int density(kappa) kernel(kappa r) dkappa, with a kernel that grows like the square and ends oscillating about 1.

    Panels are equal in log(kappa r) below 1 and beyond 200, where the oscillation no longer counts and the kernel is 1;
    between, they are shorter than a period.
    """
    gauss, weight = np.polynomial.legendre.leggauss(16)

    def panels(edges: Array) -> tuple[Array, Array]:
        half = 0.5 * np.diff(edges)[:, None]
        return (edges[:-1, None] + half * (gauss + 1)).ravel(), (half * weight).ravel()

    low, low_step = panels(np.linspace(np.log(1e-18), 0.0, 60))
    middle, middle_step = panels(np.linspace(1.0, 200.0, 60))
    high, high_step = panels(np.linspace(np.log(200.0), np.log(200.0) + 20, 40))
    u = np.concatenate([np.exp(low), middle, np.exp(high)])
    step = np.concatenate([np.exp(low) * low_step, middle_step, np.exp(high) * high_step])
    step *= np.where(u < 200, kernel(u), 1.0)
    return np.array([step @ density(u / x) / x if x > 0 else 0.0 for x in r.ravel()]).reshape(r.shape)


def _one_minus_j0(u: Array) -> Array:
    return np.where(u < 1e-2, u**2 / 4 * (1 - u**2 / 16), 1 - j0(u))


def _one_minus_sinc(u: Array) -> Array:
    return np.where(u < 1e-2, u**2 / 6 * (1 - u**2 / 20), 1 - np.sinc(u / np.pi))
