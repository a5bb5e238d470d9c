import numpy as np
import pytest

from turbnet.atmosphere.covariance import radial_covariance, zernike_covariance, zernike_covariance_matrix
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Constant, Tabulated
from turbnet.errors import ParameterError

SCENE = OpticalPath(0.2034, 7000.0, Tabulated((0.0, 7000.0), (3e-15, 1e-15)), 525e-9)


def test_swapping_the_modes_reverses_the_separation():
    dx, dy = 0.21, -0.13
    forward = zernike_covariance_matrix(SCENE, range(2, 12), dx, dy)
    backward = zernike_covariance_matrix(SCENE, range(2, 12), -dx, -dy)
    np.testing.assert_allclose(forward, backward.T, rtol=0, atol=1e-12)


def test_covariance_of_many_points_is_positive_definite():
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 1.5, (12, 2))
    lag = points[:, None] - points[None]
    blocks = zernike_covariance_matrix(SCENE, range(2, 12), lag[..., 0], lag[..., 1])
    full = blocks.transpose(0, 2, 1, 3).reshape(120, 120)
    np.testing.assert_allclose(full, full.T, atol=1e-12)
    assert np.linalg.eigvalsh(full).min() > 0


def test_turning_the_scene_by_a_right_angle_swaps_the_tilts():
    along = zernike_covariance(SCENE, 2, 2, np.array([0.3, 0.0]), np.array([0.0, 0.3]))
    across = zernike_covariance(SCENE, 3, 3, np.array([0.3, 0.0]), np.array([0.0, 0.3]))
    np.testing.assert_allclose(along, across[::-1], rtol=1e-9)
    assert along[0] < across[0]  # longitudinal tilts part sooner than transverse ones


def test_shape_follows_the_separations():
    grid_x, grid_y = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 3))
    assert zernike_covariance(SCENE, 2, 4, grid_x, grid_y).shape == (3, 5)
    assert zernike_covariance_matrix(SCENE, [2, 3, 4], grid_x, grid_y).shape == (3, 5, 3, 3)


@pytest.mark.parametrize(("n", "n2", "mu"), [(1, 1, 0), (1, 1, 2), (2, 2, 0), (1, 3, 2), (7, 7, 14), (10, 10, 0)])
def test_radial_integral_agrees_with_brute_force(n, n2, mu):
    # One long panelled rule in x = t^3 without taper, at separations between the knots of the spline.
    from scipy.special import jv

    x_gauss, w_gauss = np.polynomial.legendre.leggauss(20)
    panels, t_max = 4000, 900.0 ** (1 / 3)
    t = (np.arange(panels)[:, None] + 0.5 * (x_gauss + 1)) * t_max / panels
    x, weight = t**3, 0.5 * w_gauss * t_max / panels * 3 * t**2
    integrand = weight * x ** (-8 / 3) * 4 * np.sqrt((n + 1) * (n2 + 1)) * jv(n + 1, x) * jv(n2 + 1, x) / x**2
    scale = np.abs(integrand).sum()
    for s in (0.0, 0.313, 1.07, 1.98, 2.31, 7.7, 31.3):
        expected = (integrand * jv(mu, x * s)).sum()
        assert radial_covariance(n, n2, mu, np.array(s)) == pytest.approx(expected, abs=1e-5 * scale)


def test_far_apart_the_tilts_follow_their_power_law():
    values = radial_covariance(1, 1, 0, np.array([5e3, 1e4, 2e4, 8e4]))
    np.testing.assert_allclose(values[1:] / values[:-1], [2 ** (-1 / 3), 2 ** (-1 / 3), 4 ** (-1 / 3)], rtol=1e-5)


def test_still_air_has_no_covariance():
    still = OpticalPath(0.2, 1000.0, Constant(0.0))
    assert zernike_covariance(still, 2, 2, 0.0) == 0


def test_indices_outside_the_range_are_refused():
    with pytest.raises(ParameterError, match="radial order n = 0"):
        zernike_covariance(SCENE, 1, 2, 0.0)
    with pytest.raises(ParameterError, match="radial order n' = 21"):
        zernike_covariance(SCENE, 2, 232, 0.0)
