r"""Zernike polynomials in Noll's order, on the unit disk.

.. math::
    Z_j(\rho, \theta) = \sqrt{n+1}\, R_n^m(\rho)\, \{1 \;|\; \sqrt2 \cos m\theta \;|\; \sqrt2 \sin m\theta\}

with the first form for m = 0, cosine for even j, sine for odd j. Unit mean square over the disk. Fourier transform:

.. math::
    Q_j(k) = \frac1\pi \int_{disk} Z_j(\rho) e^{i k \cdot \rho} d^2\rho
           = \sqrt{n+1}\, \frac{2 J_{n+1}(k)}{k} (-1)^{(n-m)/2} i^m
             \{1 | \sqrt2 \cos m\theta_k | \sqrt2 \sin m\theta_k\}

so that a plane wave e^{i k.rho} has the coefficient Q_j(k). Source: R. J. Noll, JOSA 66, 207 (1976).
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import jv

from turbnet.errors import check_range

Array = NDArray[np.float64]


def noll_to_nm(j: int) -> tuple[int, int]:
    """Radial order n and azimuthal order m >= 0 of the Noll index j >= 1."""
    check_range("Noll index j", j, 1, 10**9)
    n = int((np.sqrt(8 * j - 7) - 1) // 2)
    position = j - n * (n + 1) // 2 - 1  # 0 .. n within the order
    m = 2 * ((position + 1) // 2) if n % 2 == 0 else 2 * (position // 2) + 1
    return n, m


def jacobi(k: int, alpha: float, beta: float, x: Array) -> Array:
    """Jacobi polynomial P_k^(alpha, beta)(x), 0 for k < 0, by its three-term recursion.

    Stable on [-1, 1] at any order, where the sum over factorials loses all digits beyond n = 40.
    """
    x = np.asarray(x, dtype=np.float64)
    if k < 0:
        return np.zeros_like(x)
    previous, current = np.zeros_like(x), np.ones_like(x)
    for i in range(k):
        if i == 0:
            previous, current = current, 0.5 * ((alpha + beta + 2) * x + alpha - beta)
            continue
        s = 2 * i + alpha + beta
        a = 2 * (i + 1) * (i + alpha + beta + 1) * s
        b = (s + 1) * (s * (s + 2) * x + alpha**2 - beta**2)
        c = 2 * (i + alpha) * (i + beta) * (s + 2)
        previous, current = current, (b * current - c * previous) / a
    return current


def radial(n: int, m: int, rho: Array) -> Array:
    """Radial polynomial R_n^m(rho) = rho^m P_k^(0,m)(2 rho^2 - 1), k = (n-m)/2, for 0 <= m <= n with n - m even.

    R_n^m(1) = 1.
    """
    rho = np.asarray(rho, dtype=np.float64)
    return rho**m * jacobi((n - m) // 2, 0, m, 2 * rho**2 - 1)


def angular(j: int, theta: Array) -> Array:
    """Angular factor of Z_j with its normalisation: 1, sqrt(2) cos(m theta) or sqrt(2) sin(m theta)."""
    _, m = noll_to_nm(j)
    if m == 0:
        return np.ones_like(np.asarray(theta, dtype=np.float64))
    return np.sqrt(2.0) * (np.cos(m * theta) if j % 2 == 0 else np.sin(m * theta))


def zernike(j: int, rho: Array, theta: Array) -> Array:
    """Z_j at polar points of the unit disk; the polynomial is continued, not cut, beyond rho = 1."""
    n, m = noll_to_nm(j)
    return np.sqrt(n + 1.0) * radial(n, m, rho) * angular(j, theta)


def zernike_gradient(j: int, rho: Array, theta: Array) -> tuple[Array, Array]:
    r"""(dZ_j/dx, dZ_j/dy) at polar points of the unit disk, x = rho cos(theta), y = rho sin(theta).

    .. math::
        \nabla Z = N\,[P'(s)\,\nabla s\; h_m + P(s)\,\nabla h_m], \qquad s = 2\rho^2 - 1, \quad
        P' = \tfrac{k+m+1}{2} P_{k-1}^{(1,m+1)}

    with the harmonic polynomial h_m = Re or Im (x + iy)^m, so nothing is divided by rho and the centre is no exception.
    """
    rho, theta = np.asarray(rho, dtype=np.float64), np.asarray(theta, dtype=np.float64)
    n, m = noll_to_nm(j)
    k, s = (n - m) // 2, 2 * rho**2 - 1
    norm = np.sqrt(n + 1.0)
    slope = 4 * norm * rho * 0.5 * (k + m + 1) * jacobi(k - 1, 1, m + 1, s)  # N P'(s) |grad s|
    along = slope * rho**m * angular(j, theta)
    grad_x, grad_y = along * np.cos(theta), along * np.sin(theta)
    if m == 0:
        return grad_x, grad_y
    value = np.sqrt(2.0) * norm * m * rho ** (m - 1) * jacobi(k, 0, m, s)
    cosine, sine = np.cos((m - 1) * theta), np.sin((m - 1) * theta)
    if j % 2 == 0:
        return grad_x + value * cosine, grad_y - value * sine
    return grad_x + value * sine, grad_y + value * cosine


def zernike_basis(modes: list[int] | range, rho: Array, theta: Array) -> Array:
    """Z_j for each j of `modes`, stacked on a new first axis."""
    return np.stack([zernike(j, rho, theta) for j in modes])


def fourier_radial(n: int, k: Array) -> Array:
    """sqrt(n+1) 2 J_{n+1}(k) / k, the radial part of Q_j for every mode of radial order n; its limit at k = 0."""
    k = np.asarray(k, dtype=np.float64)
    safe = np.where(k == 0, 1.0, k)
    return np.sqrt(n + 1.0) * np.where(k == 0, 1.0 if n == 0 else 0.0, 2 * jv(n + 1, safe) / safe)


def fourier_phase(j: int) -> complex:
    """(-1)^((n-m)/2) i^m, the constant factor of Q_j."""
    n, m = noll_to_nm(j)
    return complex((-1) ** ((n - m) // 2) * 1j**m)


def zernike_fourier(j: int, k: Array, theta: Array) -> NDArray[np.complexfloating]:
    """Q_j at angular spatial frequency k (radians per aperture radius) and direction theta."""
    n, _ = noll_to_nm(j)
    return np.asarray(fourier_phase(j) * fourier_radial(n, k) * angular(j, theta))
