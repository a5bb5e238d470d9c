import numpy as np
import pytest
import torch

from turbnet.atmosphere.noll import noll_covariance, noll_matrix
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Constant, Tabulated
from turbnet.errors import ParameterError
from turbnet.simulate.field import ZernikeField

SCENE = OpticalPath(0.2034, 7000.0, Constant(1e-15), 525e-9)
SEPARATIONS = (0, 8, 32, 128, 512)  # Nyquist pixels along x
EXACT = {  # quadrature of the Zernike-space covariance for SCENE, rad^2
    (2, 2): (5.026, 4.687, 3.813, 2.637, 1.694),
    (3, 3): (5.026, 4.879, 4.371, 3.409, 2.377),
    (4, 4): (0.2599, 0.1955, 0.0977, 0.0314, 0.0084),
    (2, 4): (0.0, 0.1602, 0.1980, 0.1219, 0.0485),
    (2, 8): (-0.1586, -0.1103, -0.0418, -0.0073, -0.0008),
    (4, 11): (-0.0434, -0.0285, -0.0115, -0.0032, -0.0008),
}


@pytest.fixture(scope="module")
def field() -> ZernikeField:
    return ZernikeField(SCENE, 513, 513, modes=11)


@pytest.mark.parametrize("pair", EXACT)
def test_covariance_over_the_whole_picture(field, pair):
    scale = np.sqrt(noll_covariance(pair[0], pair[0]) * noll_covariance(pair[1], pair[1])) * SCENE.d_over_r0 ** (5 / 3)
    error = (field.covariance(*pair, SEPARATIONS) - EXACT[pair]) / scale
    assert np.abs(error).max() < 0.02, error


def test_draws_have_the_covariance_that_the_waves_hold(field):
    """Spatial means over 60 draws; the spread of the draws' means gives the tolerance."""
    pairs, draws = [(2, 2), (4, 4), (2, 4), (2, 8), (11, 11)], 60
    lag = 8  # pixels: two grid steps; the second point lies at larger x, so u - u' = -8
    measured = {pair: [] for pair in pairs}
    for seed in range(draws):
        a = field.draw([seed]).coefficients[0, 0].double()
        for i, j in pairs:
            measured[i, j].append(float((a[i - 2][:, : -lag // 4] * a[j - 2][:, lag // 4 :]).mean()))
    for (i, j), values in measured.items():
        expected = field.covariance(i, j, [-lag])[0]
        error = np.std(values) / np.sqrt(draws)
        assert abs(np.mean(values) - expected) < 4 * error, (i, j)
        assert error < 0.25 * np.sqrt(noll_covariance(i, i) * noll_covariance(j, j)) * SCENE.d_over_r0 ** (5 / 3)


@pytest.mark.parametrize(
    "profile",
    [Constant(1e-15), Tabulated((0, 7000), (2e-15, 0)), Tabulated((0, 7000), (0, 2e-15))],
    ids=["constant", "towards the camera", "towards the scene"],
)
def test_single_point_variances_on_any_path(profile):
    path = OpticalPath(0.2034, 7000.0, profile, 525e-9)
    field = ZernikeField(path, 64, 64, modes=6, stride=2)
    expected = np.diag(noll_matrix(range(2, 7))) * path.d_over_r0 ** (5 / 3)
    held = [field.covariance(j, j, [0])[0] for j in range(2, 7)]
    np.testing.assert_allclose(held, expected, rtol=0.02)


def test_opposite_edges_are_not_tied_together(field):
    """Unpadded periodic sampling correlates opposite edges at 0.996; theory says 0.34 to 0.47 of the variance here."""
    held = field.covariance(2, 2, [512])[0] / field.covariance(2, 2, [0])[0]
    assert held == pytest.approx(1.694 / 5.026, abs=0.02)


def test_a_seed_gives_the_same_atmosphere_alone_in_a_batch_and_piece_by_piece():
    field = ZernikeField(SCENE, 40, 24, modes=8)
    wind = torch.tensor((3.0, -1.0))
    for motion in (None, wind):
        whole = field.draw([5, 9], 4, motion).coefficients
        torch.testing.assert_close(field.draw([9], 4, motion).coefficients[0], whole[1], rtol=0, atol=0)
        pieces = [field.draw([9], 2, motion, start=start).coefficients[0] for start in (0, 2)]
        torch.testing.assert_close(torch.cat(pieces), whole[1], rtol=0, atol=0)
        assert not torch.equal(whole[0], whole[1])
        assert not torch.equal(whole[0, 0], whole[0, 1])


def test_strength_scales_the_same_atmosphere():
    field = ZernikeField(SCENE, 32, 32, modes=6)
    one, two = field.draw([1, 1], d_over_r0=torch.tensor([1.0, 2.0])).coefficients
    torch.testing.assert_close(two, one * 2 ** (5 / 6))


def test_frozen_flow_shifts_a_single_layer():
    """Air close to the scene that travels one grid step moves the pattern of blur by one grid step."""
    path = OpticalPath(0.2034, 7000.0, Tabulated((0, 6900, 6901, 7000), (0, 0, 1e-12, 1e-12)), 525e-9)
    field = ZernikeField(path, 128, 128, modes=6, stride=4, layers=64)
    step = 4 * path.pixel
    high = field.draw([0], 2, torch.tensor((step * 30.0, 0.0)), frame_rate=30.0).high[0]
    moved, still = high[1][:, :, 1:], high[0][:, :, :-1]
    assert float((moved - still).square().mean() / high.square().mean()) < 0.02


def test_centred_draw_has_no_mean_tilt_and_the_same_blur():
    draw = ZernikeField(SCENE, 32, 32, modes=6).draw([3], 3)
    centred = draw.centred()
    assert float(centred.tilt.mean((1, 3, 4)).abs().max()) < 1e-5
    torch.testing.assert_close(centred.high, draw.high)


def test_still_air_has_no_coefficients():
    field = ZernikeField(OpticalPath(0.2, 1000.0, Constant(0.0)), 16, 16)
    assert not field.draw([0], 2).coefficients.any()


@pytest.mark.parametrize("strength", [-1.0, float("nan"), float("inf")])
def test_bad_strength_is_refused(strength):
    with pytest.raises(ParameterError, match="D/r0"):
        ZernikeField(SCENE, 16, 16, modes=4).draw([0], d_over_r0=torch.tensor([strength]))


def test_still_air_cannot_be_scaled_up():
    field = ZernikeField(OpticalPath(0.2, 1000.0, Constant(0.0)), 16, 16, modes=4)
    with pytest.raises(ParameterError, match="still air"):
        field.draw([0], d_over_r0=torch.tensor([2.0]))


@pytest.mark.parametrize("bad", [{"height": 0}, {"modes": 2}, {"stride": 0}, {"layers": 0}])
def test_bad_geometry_is_refused(bad):
    with pytest.raises(ParameterError, match=next(iter(bad))):
        ZernikeField(**{"path": SCENE, "height": 16, "width": 16, **bad})
