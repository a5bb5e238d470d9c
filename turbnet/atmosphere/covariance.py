r"""Exact covariance of the Zernike coefficients seen from two points of the scene.

The light of the scene point u reaches the pupil point R rho through the layer z at R rho c + u z/L, c = (L-z)/L. With
Kolmogorov turbulence, spherical waves and any Cn2(z):

.. math::
    E[a_i(u)\,a_j(u')] = \int_0^L dz \int d^2\kappa\; 2\pi k^2\, 0.033\, C_n^2(z)\, \kappa^{-11/3}\,
        Q_i(\kappa c)\, Q_j^*(\kappa c)\, e^{i\kappa\cdot(u-u') z/L}

The angle integrates to Bessel functions of the orders |m_i ± m_j|, and scaling kappa by the radius R c leaves one
universal function of the separation s in radii for each radial pair,

.. math::
    G_{nn'\mu}(s) = \int_0^\infty x^{-8/3} f_n(x) f_{n'}(x) J_\mu(x s)\, dx, \qquad f_n = \sqrt{n+1}\,2J_{n+1}(x)/x,

so that a covariance is one integral over the path of G at s = |u-u'| z / (R (L-z)). Source: N. Takato and I. Yamaguchi,
JOSA A 12, 958 (1995), for one layer; S. H. Chan and N. Chimitt (2023) for the path.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline
from scipy.special import jv

from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Array
from turbnet.errors import check_range
from turbnet.optics.zernike import fourier_phase, fourier_radial, noll_to_nm

# Limits of the radial quadrature. Beyond x = X_MAX the integrand, of order x^(-17/3), is negligible for n <= 20; beyond
# x s = PHASE_MAX a flat-topped taper ends the oscillation of J_mu without touching its sum. S_MAX is where G follows
# its power law.
X_MAX, PHASE_MAX, S_MAX = 400.0, 200.0, 1e4
ORDER_MAX = 20


def radial_covariance(n: int, n2: int, mu: int, s: Array) -> Array:
    """G_nn'mu(s), the covariance integral of one layer at the separation s >= 0 in radii.

    Accurate to 1e-8 of the value at s = 0 for tilts, 1e-6 for n = 7, 2e-4 for n = 20.

    Raises:
        ParameterError: a radial order outside 1 .. 20 in either place.
    """
    check_range("radial order n", n, 1, ORDER_MAX)
    check_range("radial order n'", n2, 1, ORDER_MAX)
    s = np.asarray(s, dtype=np.float64)
    spline = _radial_spline(*sorted((n, n2)), mu)
    return spline(np.arcsinh(np.minimum(s, S_MAX))) * (S_MAX / np.maximum(s, S_MAX)) ** (n + n2 - 5 / 3)


def zernike_covariance(
    path: OpticalPath,
    i: int,
    j: int,
    dx: Array | float,
    dy: Array | float = 0.0,
    layers: tuple[Array, Array] | None = None,
) -> Array:
    """E[a_i(u) a_j(u')], rad^2, in the shape of dx and dy.

    Args:
        path: aperture, distance, profile, wavelength.
        i, j: Noll indices, 2 .. 231.
        dx, dy: u - u' in the scene, m; arrays broadcast against each other.
        layers: points z (m) and weights Cn2 dz (m^(1/3)) of a layered atmosphere, such as `path.layers(16)`; by default
            the path's own quadrature, exact for its profile.

    Raises:
        ParameterError: a Noll index outside its range.
    """
    z, _ = layers = path.quadrature() if layers is None else layers
    return _covariance(path, i, j, dx, dy, z / path.distance, layers)


def drift_covariance(path: OpticalPath, i: int, j: int, dx: Array | float, dy: Array | float = 0.0) -> Array:
    """E[a_i(t) a_j(t')], rad^2, of one scene point while the wind moves all air on the path, frozen, by (dx, dy).

    Args:
        path: aperture, distance, profile, wavelength.
        i, j: Noll indices, 2 .. 231.
        dx, dy: wind velocity times (t - t'), m; arrays broadcast against each other.
    """
    z, _ = layers = path.quadrature()
    return _covariance(path, i, j, dx, dy, np.full_like(z, -1.0), layers)


def zernike_covariance_matrix(
    path: OpticalPath, modes: list[int] | range, dx: Array | float, dy: Array | float = 0.0
) -> Array:
    """E[a_i(u) a_j(u')] for all pairs of `modes`: (..., modes, modes), arguments as in `zernike_covariance`.

    Not symmetric for one separation: swapping i and j is the same as reversing u - u'.
    """
    rows = [np.stack([zernike_covariance(path, i, j, dx, dy) for j in modes], axis=-1) for i in modes]
    return np.stack(rows, axis=-2)


def angular_terms(i: int, j: int) -> list[tuple[int, float, float]]:
    r"""(mu, amplitude, shift) of (1/2pi) int Theta_i Theta_j^* e^{i x s cos(theta - psi)} dtheta.

    Theta is the angular part of Q with its constant factor; the integral is the sum of the terms
    amplitude cos(mu psi - shift) J_mu(x s), all real.
    """
    (_, m), (_, m2) = noll_to_nm(i), noll_to_nm(j)
    norm = 0.5 * np.sqrt((2.0 if m else 1.0) * (2.0 if m2 else 1.0))
    # A sine is a cosine a quarter turn later: cos(A - a) cos(B - b) = [cos(A+B - (a+b)) + cos(A-B - (a-b))] / 2.
    shift, shift2 = (np.pi / 2 if order and index % 2 else 0.0 for index, order in ((i, m), (j, m2)))
    phase = fourier_phase(i) * fourier_phase(j).conjugate()
    terms = []
    for mu, total_shift in ((m + m2, shift + shift2), (m - m2, shift - shift2)):
        if mu < 0:
            mu, total_shift = -mu, -total_shift
        terms.append((mu, norm * float((phase * 1j**mu).real), total_shift))
    return terms


def _covariance(
    path: OpticalPath,
    i: int,
    j: int,
    dx: Array | float,
    dy: Array | float,
    lever: Array,
    layers: tuple[Array, Array],
) -> Array:
    """Sum over layers, where the two footprints are lever * (dx, dy) apart; `lever` has one sign throughout."""
    dx, dy = np.broadcast_arrays(np.asarray(dx, dtype=np.float64), np.asarray(dy, dtype=np.float64))
    z, cn2_dz = layers
    shrink, radius = 1 - z / path.distance, path.aperture / 2
    layer_weight = cn2_dz * shrink ** (5 / 3)
    ratio = np.abs(lever) / (radius * shrink)
    sign = -1.0 if lever.sum() < 0 else 1.0
    direction = np.arctan2(sign * dy, sign * dx)
    distance, inverse = np.unique(np.hypot(dx, dy), return_inverse=True)
    scale = 4 * np.pi**2 * path.wavenumber**2 * 0.033 * radius ** (5 / 3)
    (n, _), (n2, _) = noll_to_nm(i), noll_to_nm(j)
    total = np.zeros(dx.shape)
    for mu, amplitude, shift in angular_terms(i, j):
        by_distance = np.array([layer_weight @ radial_covariance(n, n2, mu, d * ratio) for d in distance])
        total += scale * amplitude * np.cos(mu * direction - shift) * by_distance[inverse].reshape(dx.shape)
    return total


@lru_cache(maxsize=512)
def _radial_spline(n: int, n2: int, mu: int) -> BSpline:
    v, starts, x, _, weight = _nodes()
    values = np.add.reduceat(weight * _pupil_table(n) * _pupil_table(n2) * _bessel_table(mu), starts)
    return make_interp_spline(v, values, k=5)


@lru_cache(maxsize=1)
def _nodes() -> tuple[Array, NDArray[np.intp], Array, Array, Array]:
    """Separations v = asinh(s); where each one's nodes start; nodes x, phases x s and weights x^(-8/3) dx, end to end.

    x = t^3 makes the integrand smooth at 0, where that of the tilts, x^(-2/3), converges only like x^(1/3).
    """
    v = np.linspace(0.0, np.arcsinh(S_MAX), 400)
    gauss, gauss_weight = np.polynomial.legendre.leggauss(16)
    nodes, phases, weights = [], [], []
    for s in np.sinh(v):
        x_max = min(X_MAX, PHASE_MAX / max(s, 1e-9))
        panels = int(np.ceil((2 + s) * x_max / 4))
        t_max = x_max ** (1 / 3)
        t = (np.arange(panels)[:, None] + 0.5 * (gauss + 1)) * t_max / panels
        x = t.ravel() ** 3
        step = np.broadcast_to(0.5 * gauss_weight * t_max / panels, t.shape).ravel()
        taper = np.exp(-36 * (x / x_max) ** 8) if x_max < X_MAX else 1.0
        nodes.append(x)
        phases.append(x * s)
        weights.append(x ** (-8 / 3) * 3 * t.ravel() ** 2 * step * taper)
    starts = np.cumsum([0] + [len(x) for x in nodes[:-1]])
    return v, starts, np.concatenate(nodes), np.concatenate(phases), np.concatenate(weights)


@lru_cache(maxsize=ORDER_MAX)
def _pupil_table(n: int) -> Array:
    return fourier_radial(n, _nodes()[2])


@lru_cache(maxsize=2 * ORDER_MAX + 1)
def _bessel_table(mu: int) -> Array:
    return jv(mu, _nodes()[3])
