import numpy as np
import pytest

from turbnet.optics.zernike import noll_to_nm, zernike_basis, zernike_fourier


def disk_quadrature(radial_points: int = 60, angles: int = 128):
    """Gauss-Legendre in rho^2, equal steps in theta: exact for polynomials of moderate order."""
    x, w = np.polynomial.legendre.leggauss(radial_points)
    rho = np.sqrt((x + 1) / 2)[:, None] * np.ones(angles)
    theta = np.ones((radial_points, 1)) * 2 * np.pi * np.arange(angles) / angles
    return rho, theta, np.repeat(w[:, None] / (2 * angles), angles, axis=1)


def test_noll_order_starts_as_in_the_paper():
    orders = [noll_to_nm(j) for j in range(1, 12)]
    assert orders == [(0, 0), (1, 1), (1, 1), (2, 0), (2, 2), (2, 2), (3, 1), (3, 1), (3, 3), (3, 3), (4, 0)]


def test_polynomials_are_orthonormal():
    rho, theta, weight = disk_quadrature()
    basis = zernike_basis(range(1, 67), rho, theta)
    gram = np.einsum("iab,jab,ab->ij", basis, basis, weight)
    np.testing.assert_allclose(gram, np.eye(66), atol=1e-10)


@pytest.mark.parametrize("j", [1, 2, 3, 4, 5, 6, 11, 14, 22, 35])
def test_fourier_transform_agrees_with_quadrature(j):
    rho, theta, weight = disk_quadrature()
    polynomial = zernike_basis([j], rho, theta)[0]
    for k, direction in [(0.0, 0.0), (0.7, 0.3), (3.0, -2.0), (11.0, 1.1)]:
        wave = np.exp(1j * k * rho * np.cos(theta - direction))
        expected = np.sum(polynomial * wave * weight)
        assert zernike_fourier(j, np.array(k), np.array(direction)) == pytest.approx(expected, abs=1e-9)
