from dataclasses import replace

import numpy as np
import pytest
import skimage.data
import torch

from turbnet.atmosphere.covariance import zernike_covariance
from turbnet.atmosphere.noll import noll_covariance, noll_matrix
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Constant
from turbnet.atmosphere.screens import PhaseScreen
from turbnet.errors import InputError, ParameterError
from turbnet.optics.psf import psf
from turbnet.optics.pupil import circular, pupil_grid
from turbnet.simulate.draw import TILT_PIXELS
from turbnet.simulate.field import ZernikeField
from turbnet.simulate.psf_basis import tilt_free_psf
from turbnet.simulate.sensor import Sensor
from turbnet.simulate.simple import DirectToImage, GaussianDraw, WarpBlur
from turbnet.simulate.tilt import sample, upsample
from turbnet.simulate.width import equivalent_sigma, short_exposure_sigma, width_statistics

PATH = OpticalPath.from_d_over_r0(3.0)
STILL = OpticalPath(0.2, 7000.0, Constant(0.0))
MODELS = [WarpBlur, DirectToImage]


@pytest.fixture(scope="module")
def scene() -> torch.Tensor:
    return torch.from_numpy(skimage.data.astronaut()[:65, 180:251].copy()).float().permute(2, 0, 1)[None, None] / 255


@pytest.fixture(scope="module", params=MODELS)
def model(request):
    return request.param(PATH, 65, 71)


def test_every_output_has_the_shape_it_says(model, scene):
    out = model(scene, model.draw([1, 2], 3))
    for clip in (out.frames, out.blur_only, out.tilt_only):
        assert clip.shape == (2, 3, 3, 65, 71)
    assert out.tilt.shape == (2, 3, 2, 65, 71)
    assert out.draw.sigma.shape[2] == 1


@pytest.mark.parametrize("kind", MODELS)
def test_zero_turbulence_returns_the_scene(kind, scene):
    still = kind(STILL, 65, 71)
    out = still(scene, still.draw([0], 3))
    for clip in (out.frames, out.blur_only, out.tilt_only):
        torch.testing.assert_close(clip, scene.expand(1, 3, 3, 65, 71), rtol=0, atol=1e-6)
    assert not out.tilt.any()


def test_a_still_clip_in_a_batch_stays_as_it_is(model, scene):
    out = model(scene, model.draw([0, 0], d_over_r0=torch.tensor([0.0, 3.0])))
    torch.testing.assert_close(out.frames[:1], scene, rtol=0, atol=1e-4)
    assert float((out.frames[1:] - scene).abs().mean()) > 0.01


def test_a_uniform_scene_stays_uniform_to_its_very_edge(model):
    out = model(torch.full((1, 1, 3, 65, 71), 0.5), model.draw([0, 1], 2))
    for clip in (out.frames, out.blur_only, out.tilt_only):
        torch.testing.assert_close(clip, torch.full_like(clip, 0.5), rtol=0, atol=1e-5)


@pytest.mark.parametrize("wind", [None, torch.tensor((3.0, -1.0))])
def test_a_seed_gives_the_same_atmosphere_alone_in_a_batch_and_piece_by_piece(model, wind):
    whole = model.draw([5, 9], 4, wind)
    for name in ("tilt", "sigma"):
        full = getattr(whole, name)
        assert torch.equal(getattr(model.draw([9], 4, wind), name)[0], full[1])
        pieces = [getattr(model.draw([9], 2, wind, start=start), name)[0] for start in (0, 2)]
        assert torch.equal(torch.cat(pieces), full[1])
    assert not torch.equal(whole.tilt[0], whole.tilt[1])
    assert not torch.equal(whole.tilt[0, 0], whole.tilt[0, 1])


def test_sampling_at_the_moved_points_undoes_the_tilt(model, scene):
    out = model(scene, model.draw([4, 5, 6]))
    frames, truth, tilt = (x.flatten(0, 1) for x in (out.frames, out.blur_only, out.tilt))
    inner = (..., slice(8, -8), slice(8, -8))

    def distance(clip):
        return float((clip - truth)[inner].square().mean())

    assert distance(sample(frames, tilt)) < 0.05 * distance(frames)
    assert distance(sample(frames, -tilt)) > distance(frames)


def test_each_point_moves_first_and_then_spreads_by_its_own_width():
    """Points far from each other, one a channel, against their Gaussians drawn by hand; indexed by where light lands, the
    widths would be others."""
    model = DirectToImage(PATH, 65, 65, stride=1)
    side = 65 + 2 * model.margin
    y, x = torch.meshgrid(torch.arange(side).float(), torch.arange(side).float(), indexing="ij")
    tilt = torch.stack((4 + 1.5 * torch.sin(y / 9), 3 * torch.cos(x / 11)))[None]
    sigma = (2.0 + 1.0 * torch.sin(x / 4))[None, None]
    points = [(30, 30), (33, 48), (52, 41), (60, 60), (47, 27)]
    image = torch.zeros(1, len(points), side, side)
    for channel, (row, column) in enumerate(points):
        image[0, channel, row, column] = 1
    out = model._scatter(image, tilt, sigma)[0]
    misplaced = []
    for channel, (row, column) in enumerate(points):
        to_x, to_y = column + tilt[0, 0, row, column], row + tilt[0, 1, row, column]

        def gaussian(width, to_x=to_x, to_y=to_y):
            return torch.exp(-((x - to_x) ** 2 + (y - to_y) ** 2) / (2 * width**2)) / (2 * np.pi * width**2)

        expected = gaussian(sigma[0, 0, row, column])
        assert float((out[channel] - expected).abs().max() / expected.max()) < 0.03
        there = gaussian(sigma[0, 0, int(to_y.round()), int(to_x.round())])
        misplaced.append(float((there - expected).abs().max() / expected.max()))
    assert max(misplaced) > 0.5


@pytest.mark.parametrize("kind", MODELS)
def test_gradients_in_scene_tilt_and_sigma(kind):
    small = kind(OpticalPath.from_d_over_r0(0.5), 5, 4)
    draw = small.draw([3])
    tilt, sigma = draw.tilt.double().requires_grad_(), (1.02 * draw.sigma.double()).requires_grad_()
    scene = torch.rand(1, 1, 1, 5, 4, dtype=torch.float64, requires_grad=True)

    def frames(scene, tilt, sigma):
        return small(scene, replace(draw, tilt=tilt, sigma=sigma)).frames

    assert torch.autograd.gradcheck(frames, (scene, tilt, sigma), atol=1e-5, fast_mode=True)


@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize("size", [(1, 1), (3, 3), (1, 40), (17, 5)])
def test_any_size(kind, size):
    model = kind(OpticalPath.from_d_over_r0(2.0), *size)
    out = model(torch.rand(1, 1, 3, *size), model.draw([0], 2))
    assert out.frames.shape == (1, 2, 3, *size)
    assert torch.isfinite(out.frames).all()


def test_the_sensor_sees_the_frames(scene):
    plain, noisy = (WarpBlur(PATH, 65, 71, sensor=sensor) for sensor in (None, Sensor(read_noise=0.05)))
    draw = plain.draw([0])
    first, second = noisy(scene, draw, 1), noisy(scene, draw, 2)
    assert not torch.equal(first.frames, second.frames)
    torch.testing.assert_close(first.tilt_only, plain(scene, draw).tilt_only)


def test_wrong_size_bad_pixels_and_strengths_out_of_range_are_refused(model, scene):
    draw = model.draw([0])
    with pytest.raises(InputError, match="expects"):
        model(scene[..., :-1], draw)
    with pytest.raises(InputError, match="NaN"):
        model(scene * float("nan"), draw)
    for strength in (-1.0, 3.5, float("nan")):
        with pytest.raises(ParameterError, match="D/r0"):
            model.draw([0], d_over_r0=torch.tensor([strength]))


@pytest.mark.parametrize("kind", MODELS)
def test_bad_geometry_is_refused(kind):
    for name in ("height", "width", "stride"):
        with pytest.raises(ParameterError, match=name):
            kind(**{"path": PATH, "height": 16, "width": 16, name: 0})
    with pytest.raises(ParameterError, match="D/r0"):
        kind(OpticalPath.from_d_over_r0(11.0), 16, 16)


class TestWarpBlur:
    @pytest.mark.parametrize("strength", [1.0, 3.0])
    def test_tilt_has_the_variance_and_the_relative_motion_of_theory(self, strength):
        """Spatial means over 200 frames; the spread of the frames' means gives the tolerance."""
        path = OpticalPath.from_d_over_r0(strength)
        model, frames = WarpBlur(path, 129, 129, stride=2), 200
        tilt = model.draw([0], frames).tilt[0].double()
        variance = TILT_PIXELS**2 * noll_covariance(2, 2) * strength ** (5 / 3)
        square = tilt.square().mean((1, 2, 3))
        assert abs(square.mean() - variance) < 4 * square.std() / frames**0.5
        assert square.std() / frames**0.5 < 0.05 * variance

        # One aperture apart, to the nearest step of the grid: rows and columns, both components.
        step = round(path.aperture / path.pixel / 2)
        moved = torch.stack(
            [
                0.5 * ((tilt[..., step:] - tilt[..., :-step]).square().mean((1, 2, 3))),
                0.5 * ((tilt[..., step:, :] - tilt[..., :-step, :]).square().mean((1, 2, 3))),
            ]
        ).mean(0)
        there = sum(float(zernike_covariance(path, j, j, 2 * step * path.pixel)) for j in (2, 3)) / 2
        expected = variance - TILT_PIXELS**2 * there
        assert abs(moved.mean() - expected) < 4 * moved.std() / frames**0.5
        assert moved.std() / frames**0.5 < 0.05 * expected

    def test_components_are_independent_and_correlated_like_a_gaussian(self):
        model, frames = WarpBlur(PATH, 129, 129, correlation=12.0, tilt_std=1.0), 80
        x, y = model.draw([1], frames).tilt[0].double().unbind(1)
        for first, second, expected in (
            (x, y, 0.0),
            (x[..., 4:], x[..., :-4], np.exp(-(16**2) / (4 * 12**2))),
            (y[:, 6:], y[:, :-6], np.exp(-(24**2) / (4 * 12**2))),
        ):
            mean = (first * second).mean((1, 2))
            assert abs(mean.mean() - expected) < 4 * mean.std() / frames**0.5

    @pytest.mark.parametrize("strength", [1.0, 3.0])
    def test_width_is_that_of_the_mean_short_exposure(self, strength):
        """Drawn phase screens, all modes, fitted tilt removed; eight groups of 60 give the error."""
        points = 32
        screens = PhaseScreen((points, points), 1 / points, 1 / strength, dtype=torch.float64)
        phase = screens.draw(480, torch.Generator().manual_seed(0))
        x, y = pupil_grid(points)
        pupil = torch.as_tensor(circular(points))
        inside = pupil.numpy() > 0
        basis = torch.as_tensor(np.stack([np.ones_like(x), x, y])[:, inside])
        inner = phase[:, inside]
        flat = torch.zeros_like(phase)
        flat[:, inside] = inner - inner @ torch.linalg.pinv(basis) @ basis
        mean = psf(flat, pupil, 63).unflatten(0, (8, 60)).mean(1)
        groups = equivalent_sigma(mean)
        # 63 pixels hold all but 1 % of the light, which makes the rest look that much sharper.
        whole = equivalent_sigma(mean.mean(0, keepdim=True))
        error = float(groups.std()) / 8**0.5
        assert abs(float(whole) - short_exposure_sigma(strength)) < 4 * error + 0.015 * short_exposure_sigma(strength)
        assert error < 0.03 * short_exposure_sigma(strength)
        assert WarpBlur(OpticalPath.from_d_over_r0(strength), 9, 9).sigma == short_exposure_sigma(strength)

    def test_weaker_air_moves_and_blurs_less(self):
        model = WarpBlur(PATH, 33, 33)
        draw = model.draw([1, 1], d_over_r0=torch.tensor([1.0, 3.0]))
        torch.testing.assert_close(draw.tilt[0] * 3 ** (5 / 6), draw.tilt[1])
        np.testing.assert_allclose(draw.sigma[:, 0, 0, 0, 0], [short_exposure_sigma(s) for s in (1.0, 3.0)], rtol=1e-6)

    def test_wind_carries_the_pattern_along(self):
        """Air half way moves twice as far in the scene: one grid step a frame here, to the right and up."""
        model = WarpBlur(PATH, 65, 65)
        speed = 4 * PATH.pixel * 30 / 2
        first, second = model.draw([0], 2, torch.tensor((speed, -speed))).tilt[0]
        torch.testing.assert_close(second[:, :-1, 1:], first[:, 1:, :-1], atol=1e-4, rtol=0)

    @pytest.mark.parametrize("bad", [{"tilt_std": -1.0}, {"correlation": -1.0}, {"sigma": -1.0}])
    def test_bad_parameters_are_refused(self, bad):
        with pytest.raises(ParameterError, match=next(iter(bad))):
            WarpBlur(PATH, 16, 16, **bad)


class TestDirectToImage:
    def test_tilts_are_those_of_the_exact_field(self):
        model = DirectToImage(PATH, 40, 24)
        tilts = ZernikeField(PATH, 40, 24, model.margin, modes=3).draw([7], 2).tilt
        torch.testing.assert_close(model.draw([7], 2).tilt, tilts)

    @pytest.mark.parametrize("strength", [1.0, 2.2, 3.0, 4.5])
    def test_widths_have_the_mean_and_the_spread_of_tilt_free_psfs(self, strength):
        """One point of 1500 independent frames against 4000 Kolmogorov PSFs of another seed."""
        model, frames = DirectToImage(OpticalPath.from_d_over_r0(strength), 65, 65), 1500
        sigma = torch.cat([model.draw([seed], frames // 10).sigma[0, :, 0] for seed in range(10)])
        drawn = sigma[:, sigma.shape[1] // 2, sigma.shape[2] // 2].double()
        factor = torch.from_numpy(np.linalg.cholesky(noll_matrix(range(4, 37)))).float()
        noise = torch.randn(4000, 33, generator=torch.Generator().manual_seed(99))
        widths = equivalent_sigma(tilt_free_psf(noise @ factor.T * strength ** (5 / 6))).double()

        def spread_error(x):
            kurtosis = float((x - x.mean()).pow(4).mean() / x.var() ** 2)
            return float(x.std()) * ((kurtosis - 1) / (4 * len(x))) ** 0.5

        mean_error = float(drawn.var() / len(drawn) + widths.var() / len(widths)) ** 0.5
        assert abs(float(drawn.mean() - widths.mean())) < 4 * mean_error
        error = np.hypot(spread_error(drawn), spread_error(widths))
        assert abs(float(drawn.std() - widths.std())) < 4 * error
        assert error < 0.06 * float(widths.std())

    def test_widths_change_over_the_distance_of_defocus_and_not_of_tilt(self):
        """rho_sigma(r) = sum of squared correlations of a_4..a_6 (and crosswise) over the sum at r = 0."""
        model, frames = DirectToImage(PATH, 129, 129), 150
        sigma = model.draw([0], frames).sigma[0, :, 0].double()
        mean, spread = width_statistics(3.0)
        deviation = sigma - mean
        for step in (2, 6):
            lag = 4 * step * PATH.pixel
            pairs = [(i, j) for i in (4, 5, 6) for j in (4, 5, 6)]
            squares = sum(float(zernike_covariance(PATH, i, j, lag)) ** 2 for i, j in pairs)
            expected = squares / (3 * (noll_covariance(4, 4) * 3 ** (5 / 3)) ** 2)
            measured = (deviation[..., step:] * deviation[..., :-step]).mean((1, 2)) / spread**2
            error = measured.std() / frames**0.5
            assert abs(measured.mean() - expected) < 4 * error + 0.02
            assert error < 0.1

    def test_interpolated_gaussians_are_gaussians(self):
        """A point in a field of one width, between nodes, against the sampled Gaussian."""
        model = DirectToImage(PATH, 33, 33, stride=1)
        side = 33 + 2 * model.margin
        image = torch.zeros(1, 1, side, side)
        image[..., side // 2, side // 2] = 1
        x = torch.arange(side).float() - side // 2
        for width in (1.0, 1.4, 2.3, 3.7):
            field = torch.full((1, 1, side, side), width)
            out = model._scatter(image, torch.zeros(1, 2, side, side), field)[0, 0]
            line = torch.exp(-x.square() / (2 * width**2)) / (2 * np.pi) ** 0.5 / width
            expected = line[:, None] * line
            assert float((out - expected).abs().max() / expected.max()) < 0.015
            assert float(out.sum()) == pytest.approx(1.0, abs=1e-4)


def test_a_draw_is_a_value_that_can_be_applied_to_any_picture(model, scene):
    draw = model.draw([2])
    assert isinstance(draw, GaussianDraw)
    one, two = (model(picture, draw) for picture in (scene, 1 - scene))
    torch.testing.assert_close(one.frames + two.frames, torch.ones_like(one.frames), atol=1e-4, rtol=0)
    torch.testing.assert_close(
        one.tilt, upsample(draw.tilt[0], 4, 999, 999)[None, ..., model.margin :, model.margin :][..., :65, :71]
    )
