"""The Zernike-space covariance by quadrature of the spectrum, beside an integrator that never leaves real space."""

import numpy as np
import pytest

from turbnet.atmosphere.covariance import drift_covariance, zernike_covariance, zernike_covariance_matrix
from turbnet.atmosphere.noll import noll_matrix
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Constant, Tabulated
from turbnet.optics.zernike import zernike

DISTANCE = 7000.0
PROFILES = {
    "constant": Constant(1e-15),
    "ramp towards the camera": Tabulated((0.0, DISTANCE), (2e-15, 0.0)),
    "ramp towards the target": Tabulated((0.0, DISTANCE), (0.0, 2e-15)),
}
PAIRS = [(2, 2), (3, 3), (4, 4), (2, 4), (2, 8), (4, 11), (2, 3), (3, 4), (5, 6), (7, 12)]
PIXELS = [0, 8, 32, 128, 512]

# Separation along x in Nyquist pixels; 525 nm, 7 km, 0.2034 m, constant Cn2 = 1e-15; rad^2, half the last digit given.
TABLE = {
    (2, 2): ([5.026, 4.687, 3.813, 2.637, 1.694], 5e-4),
    (3, 3): ([5.026, 4.879, 4.371, 3.409, 2.377], 5e-4),
    (4, 4): ([0.2599, 0.1955, 0.0977, 0.0314, 0.0084], 5e-5),
    (2, 4): ([0.0, 0.1602, 0.1980, 0.1219, 0.0485], 5e-5),
    (2, 8): ([-0.1586, -0.1103, -0.0418, -0.0073, -0.0008], 5e-5),
    (4, 11): ([-0.0434, -0.0285, -0.0115, -0.0032, -0.0008], 5e-5),
}


def path(profile=PROFILES["constant"]) -> OpticalPath:
    return OpticalPath(0.2034, DISTANCE, profile, 525e-9)


@pytest.mark.parametrize("pair", TABLE)
def test_published_table(pair):
    scene = path()
    values, rounding = TABLE[pair]
    measured = zernike_covariance(scene, *pair, np.array(PIXELS) * scene.pixel)
    np.testing.assert_allclose(measured, values, rtol=5e-4, atol=rounding)


def test_published_values_at_thirty_degrees():
    scene = path()
    dx, dy = 32 * scene.pixel * np.cos(np.pi / 6), 32 * scene.pixel * np.sin(np.pi / 6)
    for (i, j), value in {(2, 3): -0.2413, (3, 4): 0.0990, (5, 6): 0.0144}.items():
        assert zernike_covariance(scene, i, j, dx, dy) == pytest.approx(value, abs=5e-5)


def disk(radii: int, angles: int, turn: float):
    x, w = np.polynomial.legendre.leggauss(radii)
    rho, theta = (
        np.repeat(np.sqrt((x + 1) / 2), angles),
        np.tile(2 * np.pi * (np.arange(angles) + turn) / angles, radii),
    )
    return rho, theta, np.repeat(w / (2 * angles), angles)


def direct_covariance(scene: OpticalPath, dx: float, dy: float, lever=lambda s: s) -> np.ndarray:
    """-1/2 of the double disk average of Z_i(rho) Z_j(rho') D(rho, rho'), D the phase structure function.

    D = 2.914 k^2 int Cn2 |R c (rho - rho') + lever (dx, dy)|^(5/3) dz, with lever = z/L for two points. No
    spectrum, no Bessel function and no slow convergence at low wavenumbers: Zernikes above piston have zero mean, so
    only differences of phase matter.
    """
    rho, theta, weight = disk(12, 24, 0.0)
    rho2, theta2, weight2 = disk(13, 24, 0.5)
    radius = scene.aperture / 2
    lag_x = radius * ((rho * np.cos(theta))[:, None] - rho2 * np.cos(theta2))
    lag_y = radius * ((rho * np.sin(theta))[:, None] - rho2 * np.sin(theta2))
    structure = np.zeros_like(lag_x)
    for z, cn2_dz in zip(*scene.layers(128), strict=True):
        s = z / scene.distance
        structure += cn2_dz * (((1 - s) * lag_x + lever(s) * dx) ** 2 + ((1 - s) * lag_y + lever(s) * dy) ** 2) ** (
            5 / 6
        )
    structure *= 2.914 * scene.wavenumber**2
    return np.array(
        [-0.5 * (zernike(i, rho, theta) * weight) @ structure @ (zernike(j, rho2, theta2) * weight2) for i, j in PAIRS]
    )


def scales(scene):
    """sqrt(E[a_i^2] E[a_j^2]) of each pair: what a covariance is small or large against."""
    variance = np.diag(noll_matrix(range(2, 13))) * scene.d_over_r0 ** (5 / 3)
    return np.array([np.sqrt(variance[i - 2] * variance[j - 2]) for i, j in PAIRS])


@pytest.mark.parametrize("name", PROFILES)
@pytest.mark.parametrize("pixels", PIXELS)
def test_agrees_with_an_integrator_in_real_space(name, pixels):
    scene = path(PROFILES[name])
    dx, dy = pixels * scene.pixel * np.cos(0.5), pixels * scene.pixel * np.sin(0.5)
    measured = [float(zernike_covariance(scene, i, j, dx, dy)) for i, j in PAIRS]
    np.testing.assert_allclose(measured, direct_covariance(scene, dx, dy), rtol=2e-3, atol=2e-4 * scales(scene).min())


@pytest.mark.parametrize("name", PROFILES)
@pytest.mark.parametrize("moved", [0.02, 0.1, 0.5])
def test_moving_air_agrees_with_an_integrator_in_real_space(name, moved):
    scene = path(PROFILES[name])
    dx, dy = moved * np.cos(0.5), moved * np.sin(0.5)
    measured = np.array([float(drift_covariance(scene, i, j, dx, dy)) for i, j in PAIRS])
    error = measured - direct_covariance(scene, dx, dy, lever=lambda s: -1.0)
    assert np.all(np.abs(error) < 2e-4 * scales(scene))


def test_ramps_differ_although_their_total_is_the_same():
    near, far = (path(PROFILES[name]) for name in ("ramp towards the camera", "ramp towards the target"))
    assert near.r0_plane == pytest.approx(far.r0_plane)
    assert zernike_covariance(near, 2, 2, 0.0) > 2 * zernike_covariance(far, 2, 2, 0.0)


def test_one_point_gives_the_noll_covariance():
    scene, modes = path(), range(2, 37)
    expected = noll_matrix(modes) * scene.d_over_r0 ** (5 / 3)
    np.testing.assert_allclose(zernike_covariance_matrix(scene, modes, 0.0), expected, rtol=1e-3, atol=1e-7)
