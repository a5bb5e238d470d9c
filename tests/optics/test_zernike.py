import numpy as np
import pytest

from turbnet.errors import ParameterError
from turbnet.optics.zernike import noll_to_nm, radial, zernike, zernike_basis, zernike_fourier, zernike_gradient


def disk_quadrature(radial_points: int = 60, angles: int = 128):
    """Gauss-Legendre in rho^2, equal steps in theta: exact for polynomials of moderate order."""
    x, w = np.polynomial.legendre.leggauss(radial_points)
    rho = np.sqrt((x + 1) / 2)[:, None] * np.ones(angles)
    theta = np.ones((radial_points, 1)) * 2 * np.pi * np.arange(angles) / angles
    return rho, theta, np.repeat(w[:, None] / (2 * angles), angles, axis=1)


def test_noll_order_starts_as_in_the_paper():
    orders = [noll_to_nm(j) for j in range(1, 12)]
    assert orders == [(0, 0), (1, 1), (1, 1), (2, 0), (2, 2), (2, 2), (3, 1), (3, 1), (3, 3), (3, 3), (4, 0)]


def test_every_order_holds_each_azimuthal_order_once_or_twice():
    indices = range(1, 5152)  # radial orders 0 .. 100
    orders = [noll_to_nm(j) for j in indices]
    assert [n for n, _ in orders] == [n for n in range(101) for _ in range(n + 1)]
    cosines = [(n, m) for j, (n, m) in zip(indices, orders, strict=True) if m and j % 2 == 0]
    sines = [(n, m) for j, (n, m) in zip(indices, orders, strict=True) if m and j % 2]
    assert len(set(cosines)) == len(cosines) == len(sines)
    assert set(cosines) == set(sines)


@pytest.mark.parametrize("j", [0, -3])
def test_noll_index_below_one_is_refused(j):
    with pytest.raises(ParameterError, match=f"Noll index j = {j}"):
        noll_to_nm(j)


def test_polynomials_are_orthonormal():
    rho, theta, weight = disk_quadrature()
    basis = zernike_basis(range(1, 67), rho, theta)
    gram = np.einsum("iab,jab,ab->ij", basis, basis, weight)
    np.testing.assert_allclose(gram, np.eye(66), atol=1e-10)


def test_radial_polynomials_are_orthonormal_up_to_order_100():
    x, weight = np.polynomial.legendre.leggauss(110)
    rho = np.sqrt((x + 1) / 2)
    for m in range(101):
        radials = np.stack([np.sqrt(n + 1) * radial(n, m, rho) for n in range(m, 101, 2)])
        np.testing.assert_allclose(radials @ (radials * weight / 2).T, np.eye(len(radials)), atol=1e-10)


@pytest.mark.parametrize("j", [1, 2, 3, 4, 5, 6, 11, 14, 22, 35])
def test_fourier_transform_agrees_with_quadrature(j):
    rho, theta, weight = disk_quadrature()
    polynomial = zernike_basis([j], rho, theta)[0]
    for k, direction in [(0.0, 0.0), (0.7, 0.3), (3.0, -2.0), (11.0, 1.1)]:
        wave = np.exp(1j * k * rho * np.cos(theta - direction))
        expected = np.sum(polynomial * wave * weight)
        assert zernike_fourier(j, np.array(k), np.array(direction)) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("j", [1000, 5051, 5100, 5151])  # up to n = 100, with m = 10, 0, 50, 100
@pytest.mark.parametrize("k", [0.5, 60.0, 103.0])
def test_fourier_transform_of_high_orders_agrees_with_quadrature(j, k):
    rho, theta, weight = disk_quadrature(120, 360)
    expected = np.sum(zernike(j, rho, theta) * np.exp(1j * k * rho * np.cos(theta - 0.3)) * weight)
    assert zernike_fourier(j, np.array(k), np.array(0.3)) == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize("j", [1, 2, 3, 4, 5, 8, 10, 11, 37, 100, 5000])
def test_gradient_agrees_with_finite_differences(j):
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.7, 0.7, (2, 50))
    x[0] = y[0] = 0.0  # the centre, where polar derivatives divide by zero

    def value(x, y):
        return zernike(j, np.hypot(x, y), np.arctan2(y, x))

    step = 1e-6
    grad_x, grad_y = zernike_gradient(j, np.hypot(x, y), np.arctan2(y, x))
    scale = 1 + np.abs(grad_x).max()
    np.testing.assert_allclose(grad_x, (value(x + step, y) - value(x - step, y)) / (2 * step), atol=1e-7 * scale)
    np.testing.assert_allclose(grad_y, (value(x, y + step) - value(x, y - step)) / (2 * step), atol=1e-7 * scale)
