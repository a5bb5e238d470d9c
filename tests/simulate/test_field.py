import itertools

import numpy as np
import pytest
import torch
from scipy.integrate import simpson
from scipy.special import jv

from turbnet.atmosphere.covariance import drift_covariance, zernike_covariance
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


def von_karman_tilt(outer_scale: float, mode: int = 2, x: float = 0.0) -> float:
    """E[a(u) a(u')] of the tilt a_2 or a_3 for SCENE, u - u' = (x, 0) m, by Simpson's rule; rad^2.

    The angle integrates to 2 pi [J_0 -+ J_2]; nothing of it is shared with the field's own layers, cells or tables.
    """
    k0, radius, sign = 2 * np.pi / outer_scale, SCENE.aperture / 2, -1.0 if mode == 2 else 1.0

    def of_layer(z: float) -> float:
        shrink, lever = (1 - z / SCENE.distance) * radius, x * z / SCENE.distance
        log_kappa = np.linspace(np.log(1e-5 / radius), np.log(60 / shrink), 20001)
        kappa = np.exp(log_kappa)
        pupil = np.sqrt(2) * 2 * jv(2, kappa * shrink) / (kappa * shrink)
        angle = jv(0, kappa * lever) + sign * jv(2, kappa * lever)
        return simpson(kappa**2 * (kappa**2 + k0**2) ** (-11 / 6) * pupil**2 * 2 * np.pi * angle, x=log_kappa)

    z, cn2_dz = SCENE.layers(24)
    layers = sum(weight * of_layer(distance) for distance, weight in zip(z, cn2_dz, strict=True))
    return float(2 * np.pi * SCENE.wavenumber**2 * 0.033 * layers)


@pytest.mark.parametrize("outer_scale", [1.0, 10.0])
def test_outer_scale_against_quadrature_of_the_spectrum(outer_scale):
    """At one point and, where the field has no common tilt to make up for anything, between two."""
    field = ZernikeField(SCENE, 257, 257, modes=4, outer_scale=outer_scale)
    kolmogorov = noll_covariance(2, 2) * SCENE.d_over_r0 ** (5 / 3)
    for mode, lag in ((2, 0), (3, 0), (2, 32), (3, 32), (2, 128)):
        exact = von_karman_tilt(outer_scale, mode, lag * SCENE.pixel)
        assert field.covariance(mode, mode, [lag])[0] == pytest.approx(exact, abs=0.02 * kolmogorov), (mode, lag)


def test_a_larger_outer_scale_comes_closer_to_kolmogorov():
    kolmogorov = ZernikeField(SCENE, 64, 64, modes=3).covariance(2, 2, [0])[0]
    held = [
        ZernikeField(SCENE, 64, 64, modes=3, outer_scale=scale).covariance(2, 2, [0])[0] / kolmogorov
        for scale in (1.0, 10.0, 100.0, 1e6)
    ]
    assert held == sorted(held)
    assert held[0] < 0.5
    # Far below 2 pi / L0 in kappa, what the outer scale takes falls as L0^(-1/3).
    assert held[2] == pytest.approx(von_karman_tilt(100.0) / kolmogorov, abs=0.02)
    assert held[3] == pytest.approx(1.0, abs=0.02)


def test_draws_have_the_variance_of_the_outer_scale():
    """400 draws of one point; the variance of a sample variance is 2 / (N - 1)."""
    field, draws = ZernikeField(SCENE, 8, 8, modes=3, outer_scale=1.0, layers=6), 400
    tilts = field.draw(range(draws)).coefficients[:, 0, :, 0, 0].double()
    exact = von_karman_tilt(1.0)
    for measured in tilts.square().mean(0):
        assert float(measured) / exact == pytest.approx(1.0, abs=4 * np.sqrt(2 / draws))


@pytest.fixture(scope="module")
def boiling() -> torch.Tensor:
    """a_2..a_4 of one point, (300, time, mode), every quarter of a boiling time of 0.1 s, in air that stands."""
    field = ZernikeField(SCENE, 8, 8, modes=4, boiling=0.1, layers=6)
    draw = field.draw(range(300), 10, torch.zeros(2), frame_rate=40.0)
    held = torch.tensor([field.covariance(j, j, [0])[0] for j in (2, 3, 4)])
    return draw.coefficients[..., 0, 0].double() / held.sqrt()


def test_boiling_air_has_the_same_variance_at_every_moment(boiling):
    variance = boiling.square().mean(0)
    assert float((variance - 1).abs().max()) < 4.5 * np.sqrt(2 / len(boiling))  # of 30 values


def test_boiling_air_is_other_air_after_two_boiling_times(boiling):
    correlation = (boiling[:, :1] * boiling).mean(0)
    error = 1 / np.sqrt(len(boiling))
    assert float(correlation[8:].abs().max()) < 4 * error
    # Within the first boiling time it is cos(pi t / 2) of what it was; then, nothing of it is left.
    expected = torch.cos(torch.pi / 2 * torch.arange(5) / 4).double()
    assert float((correlation[:5] - expected[:, None]).abs().max()) < 4.5 * np.sqrt(2) * error


def test_a_boiling_clip_in_pieces_is_the_clip_in_one():
    field = ZernikeField(SCENE, 24, 40, modes=6, boiling=0.07)
    wind = torch.tensor((2.0, 1.0))
    whole = field.draw([3], 6, wind, exposures=2, shutter=0.5).coefficients
    pieces = [field.draw([3], 2, wind, exposures=2, shutter=0.5, start=n).coefficients for n in (0, 2, 4)]
    torch.testing.assert_close(torch.cat(pieces, 1), whole, rtol=0, atol=0)


@pytest.mark.parametrize(
    "profile", [Constant(1e-15), Tabulated((0, 7000), (2e-15, 0))], ids=["constant", "towards the camera"]
)
@pytest.mark.parametrize("mode", [2, 3, 4])
def test_frozen_flow_holds_the_autocorrelation_of_the_theory(profile, mode):
    path = OpticalPath(0.2034, 7000.0, profile, 525e-9)
    variance = noll_covariance(mode, mode) * path.d_over_r0 ** (5 / 3)
    flow = ZernikeField(path, 64, 64, modes=4)
    for way in (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0):
        held = flow.covariance(mode, mode, 0.0, travel=(way, 0.0))
        assert abs(float(held - drift_covariance(path, mode, mode, way))) < 0.05 * variance, way


def test_drawn_flow_is_that_of_the_theory_at_every_lag():
    """The defocus of points over two metres of wind: a period of the grid, 1 m z / L of a layer, cannot hide."""
    draws, step, count = 40, 0.05, 41
    flow = ZernikeField(SCENE, 64, 64, modes=4)
    draw = flow.draw(range(draws), count, torch.tensor((step * 30.0, 0.0)), frame_rate=30.0)
    defocus = draw.coefficients[:, :, 2, ::8, ::8].double()
    variance = noll_covariance(4, 4) * SCENE.d_over_r0 ** (5 / 3)
    for lag in range(1, count):
        products = (defocus[:, lag:] * defocus[:, :-lag]).mean((1, 2, 3)) / variance
        theory = float(drift_covariance(SCENE, 4, 4, lag * step)) / variance
        spread = float(products.std()) / np.sqrt(draws)
        assert abs(float(products.mean()) - theory) < 4.5 * spread, lag


def test_a_layer_does_not_come_back_after_a_period_of_the_grid(monkeypatch):
    """It would, were every wave to move with the frequency of its bin."""
    flow = ZernikeField(SCENE, 128, 128, modes=4)
    layer = 6
    way = 2 * np.pi / flow._step[0] * float(SCENE.layers(16)[0][layer]) / SCENE.distance
    assert way > 2 * SCENE.aperture
    seeds, strength = range(20), torch.zeros(20, 16)
    strength[:, layer] = 1

    def change() -> float:
        """2 for one atmosphere and another, 0 for the same."""
        defocus = flow.draw(seeds, 2, torch.tensor((way * 30.0, 0.0)), cn2=strength).coefficients[:, :, 2]
        return float(2 * (defocus[:, 0] - defocus[:, 1]).square().sum() / defocus.square().sum())

    assert change() > 1.0
    monkeypatch.setattr(flow, "_cells", lambda seed: (0 * flow._grid_k, 0 * flow._low_k))
    assert change() < 0.5  # the waves below the grid do not come back in any case


def test_gradients_in_wind_strength_and_cn2():
    field = ZernikeField(SCENE, 9, 5, modes=5, stride=4, layers=3, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    wind = (0.1 * torch.randn(2, 3, 2, generator=generator, dtype=torch.float64)).requires_grad_()
    strength = torch.tensor([1.0, 2.5], dtype=torch.float64, requires_grad=True)
    cn2 = (0.5 + torch.rand(2, 3, generator=generator, dtype=torch.float64)).requires_grad_()

    def drawn(w, d, c):
        return field.draw([1, 2], 2, w, 30.0, d, cn2=c, start=1).coefficients

    assert drawn(wind, strength, cn2).dtype == torch.float64
    assert torch.autograd.gradcheck(drawn, (wind, strength, cn2), fast_mode=True)


def test_double_precision_draws_the_same_covariance():
    single, double = (ZernikeField(SCENE, 40, 40, modes=6, dtype=dtype) for dtype in (torch.float32, torch.float64))
    for pair in ((2, 2), (4, 4), (2, 4)):
        np.testing.assert_allclose(
            single.covariance(*pair, [0, 16]), double.covariance(*pair, [0, 16]), rtol=1e-4, atol=1e-5
        )


@pytest.mark.parametrize("size", [(40, 160), (160, 40)])
def test_a_rectangular_picture_holds_the_covariance_of_a_square_one(size):
    field = ZernikeField(SCENE, *size, modes=4)
    across, down = (np.array([0, 8, n // 2, n]) for n in reversed(size))
    for i, j in ((2, 2), (3, 3), (4, 4), (2, 4), (3, 4)):
        scale = np.sqrt(noll_covariance(i, i) * noll_covariance(j, j)) * SCENE.d_over_r0 ** (5 / 3)
        for x, y in ((across, 0 * across), (0 * down, down), (across, down)):
            theory = zernike_covariance(SCENE, i, j, x * SCENE.pixel, y * SCENE.pixel)
            assert np.abs(field.covariance(i, j, x, y) - theory).max() < 0.02 * scale, (i, j)


def test_larger_pixels_are_farther_apart():
    """A pixel of q = 2 spans two of Nyquist's."""
    coarse, fine = ZernikeField(SCENE, 64, 64, modes=4, q=2.0, stride=2), ZernikeField(SCENE, 128, 128, modes=4)
    for mode in (2, 4):
        np.testing.assert_allclose(
            coarse.covariance(mode, mode, [0, 8, 32]), fine.covariance(mode, mode, [0, 16, 64]), rtol=0.02
        )


def test_moments_of_an_exposure_are_where_the_shutter_is_open():
    field = ZernikeField(SCENE, 24, 24, modes=6, boiling=0.5)
    wind = torch.tensor((1.0, 3.0))
    drawn = field.draw([4], 2, wind, exposures=4, shutter=0.5, start=3).coefficients
    assert drawn.shape[1] == 8
    for moment in range(8):
        time = 3 + moment // 4 + 0.5 * (moment % 4) / 4
        alone = field.draw([4], 1, wind, start=time).coefficients
        torch.testing.assert_close(drawn[:, moment : moment + 1], alone, rtol=0, atol=0)


def test_moments_without_wind_are_independent_and_still_air_has_as_many():
    field = ZernikeField(SCENE, 24, 24, modes=6)
    drawn = field.draw([4], 2, exposures=3).coefficients[0]
    assert all(not torch.equal(a, b) for a, b in itertools.combinations(drawn, 2))
    torch.testing.assert_close(field.draw([4], 1, exposures=3, start=1).coefficients[0], drawn[3:], rtol=0, atol=0)
    still = ZernikeField(OpticalPath(0.2, 1000.0, Constant(0.0)), 24, 24, modes=6)
    drawn = still.draw([4], 2, torch.ones(2), exposures=3).coefficients
    assert drawn.shape[:3] == (1, 6, 5)
    assert not drawn.any()


def test_cn2_of_the_layers_adds_up():
    """All layers twice as strong: the same atmosphere, sqrt(2) times; one layer alone has its own variance."""
    field, layers = ZernikeField(SCENE, 16, 16, modes=5, layers=4), 4
    one = field.draw([7]).coefficients
    torch.testing.assert_close(field.draw([7], cn2=torch.full((1, layers), 2.0)).coefficients, one * 2**0.5)
    alone = [field.draw([7], cn2=torch.eye(layers)[n : n + 1]).coefficients for n in range(layers)]
    torch.testing.assert_close(sum(alone), one, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("bad", [{"outer_scale": 0.0}, {"boiling": 0.0}, {"q": 0.0}])
def test_bad_air_is_refused(bad):
    with pytest.raises(ParameterError, match=next(iter(bad)).replace("_", " ")):
        ZernikeField(SCENE, 16, 16, modes=4, **bad)


@pytest.mark.parametrize("bad", [{"frames": 0}, {"exposures": 0}, {"shutter": 1.5}])
def test_bad_clips_are_refused(bad):
    with pytest.raises(ParameterError, match=next(iter(bad))):
        ZernikeField(SCENE, 16, 16, modes=4).draw([0], **bad)
    with pytest.raises(ParameterError, match="clips"):
        ZernikeField(SCENE, 16, 16, modes=4).draw([])
