import numpy as np
import pytest

from turbnet.atmosphere.approximations import chanan_integral, chanan_tilts, mid_path_covariance, noll_mixing
from turbnet.atmosphere.covariance import zernike_covariance, zernike_covariance_matrix
from turbnet.atmosphere.noll import noll_matrix
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Constant, Tabulated
from turbnet.errors import ParameterError

SCENE = OpticalPath(0.2034, 7000.0, Constant(1e-15), 525e-9)


def test_chanan_constants():
    assert chanan_integral(0, np.array(0.0)) == pytest.approx(0.05788, rel=1e-3)
    assert chanan_integral(0, np.array(0.0)) == pytest.approx(0.05766, rel=5e-3)  # as printed
    assert chanan_integral(2, np.array(0.0)) == pytest.approx(0.0, abs=1e-9)


def test_chanan_integrals_agree_with_their_definition():
    from scipy.special import jv

    gauss, weight = np.polynomial.legendre.leggauss(16)
    t_max, panels = 300.0 ** (1 / 3), 2000
    t = (np.arange(panels)[:, None] + 0.5 * (gauss + 1)) * t_max / panels
    zeta, step = t**3, 0.5 * weight * t_max / panels * 3 * t**2
    for order in (0, 2):
        for s in (0.2, 1.0, 3.0):
            expected = np.sum(step * zeta ** (-14 / 3) * jv(order, 2 * s * zeta) * jv(2, zeta) ** 2)
            assert chanan_integral(order, np.array(s)) == pytest.approx(expected, rel=1e-4)


def test_chanan_is_the_mid_path_for_tilts():
    dx, dy = np.array([0.0, 0.1, 0.3]), np.array([0.0, 0.2, -0.1])
    tilts = chanan_tilts(SCENE, dx, dy)
    for row, i in enumerate((2, 3)):
        for column, j in enumerate((2, 3)):
            expected = mid_path_covariance(SCENE, i, j, dx, dy)
            np.testing.assert_allclose(tilts[:, row, column], expected, rtol=2e-3, atol=1e-6)


def test_mid_path_is_sixteen_percent_low_on_a_uniform_path():
    share = mid_path_covariance(SCENE, 2, 2, 0.0) / zernike_covariance(SCENE, 2, 2, 0.0)
    assert share == pytest.approx(2 ** (-5 / 3) / (3 / 8), rel=1e-3)


def test_mid_path_cannot_tell_ramps_apart():
    near = OpticalPath(0.2, 5000.0, Tabulated((0, 5000), (2e-15, 0)))
    far = OpticalPath(0.2, 5000.0, Tabulated((0, 5000), (0, 2e-15)))
    assert mid_path_covariance(near, 2, 2, 0.1) == pytest.approx(mid_path_covariance(far, 2, 2, 0.1))
    assert zernike_covariance(near, 2, 2, 0.1) > 1.5 * zernike_covariance(far, 2, 2, 0.1)


def test_noll_mixing_is_right_at_one_point_and_misses_cross_terms_between_points():
    modes = range(2, 12)
    np.testing.assert_allclose(
        noll_mixing(SCENE, modes, 0.0), noll_matrix(modes) * SCENE.d_over_r0 ** (5 / 3), atol=1e-9
    )
    apart = 32 * SCENE.pixel
    mixed, exact = noll_mixing(SCENE, modes, apart), zernike_covariance_matrix(SCENE, modes, apart)
    assert mixed[0, 2] == 0
    assert exact[0, 2] == pytest.approx(0.198, abs=5e-4)
    assert mixed[0, 6] / exact[0, 6] > 2  # (2, 8)


def test_only_two_integrals_exist():
    with pytest.raises(ParameterError, match="order of the integral = 3"):
        chanan_integral(3, np.array(0.0))
