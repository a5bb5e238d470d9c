from dataclasses import replace

import pytest
import skimage.data
import torch

from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Constant
from turbnet.errors import InputError, ParameterError
from turbnet.simulate.psf_basis import tilt_free_psf
from turbnet.simulate.sensor import Sensor
from turbnet.simulate.simulator import Simulator


@pytest.fixture(scope="module")
def scene() -> torch.Tensor:
    return torch.from_numpy(skimage.data.astronaut()[:65, 180:251].copy()).float().permute(2, 0, 1)[None, None] / 255


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator(OpticalPath.from_d_over_r0(3.0), 65, 71, modes=15, components=6)


def test_zero_turbulence_returns_the_scene(scene):
    still = Simulator(OpticalPath(0.2, 7000.0, Constant(0.0)), 65, 71)
    out = still(scene, still.draw([0], 3))
    torch.testing.assert_close(out.frames, scene.expand(1, 3, 3, 65, 71), rtol=0, atol=1e-6)
    assert not out.tilt.any()


def test_every_output_has_the_shape_it_says(simulator, scene):
    out = simulator(scene, simulator.draw([1, 2], 3))
    for clip in (out.frames, out.blur_only, out.tilt_only):
        assert clip.shape == (2, 3, 3, 65, 71)
    assert out.tilt.shape == (2, 3, 2, 65, 71)


def test_same_draw_same_frames_and_another_draw_others(simulator, scene):
    first, again, other = (simulator(scene, simulator.draw([seed])).frames for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_stronger_air_does_more_harm(scene):
    damage = []
    for strength in (0.5, 1.5, 3.0, 6.0):
        # One margin: the same atmosphere at every strength.
        simulator = Simulator(OpticalPath.from_d_over_r0(strength), 65, 71, modes=15, components=6, margin=32)
        frames = simulator(scene, simulator.draw([0, 1, 2])).frames
        damage.append(float((frames - scene).square().mean()))
    assert damage == sorted(damage)


def test_blur_only_is_what_registration_can_reach(simulator, scene):
    """Sampling the frames at x + tilt(x) brings them close to the blur-only frames, and back does not."""
    from turbnet.simulate.tilt import sample

    out = simulator(scene, simulator.draw([4, 5, 6]))
    frames, truth, tilt = (x.flatten(0, 1) for x in (out.frames, out.blur_only, out.tilt))
    inner = (..., slice(8, -8), slice(8, -8))

    def distance(clip):
        return float((clip - truth)[inner].square().mean())

    assert distance(sample(frames, tilt)) < 0.05 * distance(frames)
    assert distance(sample(frames, -tilt)) > distance(frames)


def test_differentiable_in_the_scene_and_in_the_draw(simulator, scene):
    draw = simulator.draw([0])
    coefficients = draw.coefficients.clone().requires_grad_()
    picture = scene.clone().requires_grad_()
    out = simulator(picture, replace(draw, coefficients=coefficients))
    out.frames.square().mean().backward()
    for gradient in (picture.grad, coefficients.grad):
        assert torch.isfinite(gradient).all()
        assert gradient.abs().sum() > 0


def test_a_uniform_scene_stays_uniform_to_its_very_edge(simulator):
    out = simulator(torch.full((1, 1, 3, 65, 71), 0.5), simulator.draw([0, 1], 2))
    for clip in (out.frames, out.blur_only, out.tilt_only):
        torch.testing.assert_close(clip, torch.full_like(clip, 0.5), rtol=0, atol=1e-5)


def test_points_keep_their_energy_when_asked():
    simulator = Simulator(OpticalPath.from_d_over_r0(3.0), 65, 65, modes=15, components=6, uniform=False)
    scene = torch.zeros(1, 1, 1, 65, 65)
    scene[..., 32, 32] = 1
    frames = simulator(scene, simulator.draw(range(4))).frames
    torch.testing.assert_close(frames.sum((2, 3, 4)), torch.ones(4, 1), rtol=0.05, atol=0)


@pytest.mark.parametrize("size", [(1, 1), (3, 3), (1, 40), (17, 5)])
def test_any_size(size):
    simulator = Simulator(OpticalPath.from_d_over_r0(2.0), *size, modes=10, components=3)
    out = simulator(torch.rand(1, 1, 3, *size), simulator.draw([0], 2))
    assert out.frames.shape == (1, 2, 3, *size)
    assert torch.isfinite(out.frames).all()


def test_wrong_size_and_bad_pixels_are_refused(simulator, scene):
    draw = simulator.draw([0])
    with pytest.raises(InputError, match="expects"):
        simulator(scene[..., :-1], draw)
    bad = scene.clone()
    bad[0, 0, 0, 3, 3] = float("nan")
    with pytest.raises(InputError, match="NaN"):
        simulator(bad, draw)


def psnr(one: torch.Tensor, other: torch.Tensor) -> float:
    return float(-10 * torch.log10((one - other).square().mean()))


PATH = OpticalPath.from_d_over_r0(2.0)


def test_three_equal_wavelengths_are_one(scene):
    grey, colour = (
        Simulator(PATH, 65, 71, modes=15, components=8, wavelengths=w) for w in (None, (525e-9, 525e-9, 525e-9))
    )
    draw = grey.draw([0], 2)
    torch.testing.assert_close(colour(scene, draw).frames, grey(scene, draw).frames, rtol=0, atol=2e-6)
    assert colour.plan().wavelengths == 3


@pytest.mark.parametrize(("strength", "bluer_is_worse"), [(1.0, False), (5.0, True)])
def test_bluer_light_suffers_more_from_air_and_less_from_diffraction(scene, strength, bluer_is_worse):
    """Phase goes with 1 / lambda, the diffraction pattern's width with lambda; tilts in pixels are the same."""
    path, colours = OpticalPath.from_d_over_r0(strength), (650e-9, 450e-9)
    simulator = Simulator(path, 65, 71, components=30, wavelengths=colours)
    grey = scene[:, :, 1:2].expand(-1, -1, 2, -1, -1)
    out = simulator(grey, simulator.draw(range(6)))
    harm = (out.blur_only - grey).square().mean((0, 1, 3, 4)).tolist()
    assert (harm[1] > harm[0]) is bluer_is_worse
    torch.testing.assert_close(out.tilt_only[:, :, 0], out.tilt_only[:, :, 1], rtol=0, atol=1e-5)


def test_a_wavelength_is_that_of_a_path_of_its_own():
    """One channel of 450 nm: PSFs with the phase 525 / 450 times as large, pixels 525 / 450 Nyquist pixels."""
    phase = 525 / 450
    simulator = Simulator(PATH, 64, 64, modes=36, components=60, wavelengths=(450e-9,), exact=True, uniform=False)
    draw = simulator.draw([5])
    point = torch.zeros(1, 1, 1, 64, 64)
    point[..., 32, 32] = 1
    seen = simulator(point, draw).blur_only[0, 0, 0, 32 - 12 : 33 + 12, 32 - 12 : 33 + 12]
    at = (32 + draw.margin) // draw.stride
    whole = tilt_free_psf(phase * draw.high[0, 0, :, at, at][None], phase)[0]
    half = whole.shape[-1] // 2
    expected = whole[half - 12 : half + 13, half - 12 : half + 13]
    assert float((seen - expected).norm() / expected.norm()) < 0.05


def test_wavelengths_are_one_a_channel(scene):
    simulator = Simulator(PATH, 65, 71, modes=10, components=3, wavelengths=(525e-9, 525e-9))
    with pytest.raises(InputError, match="2 wavelengths"):
        simulator(scene, simulator.draw([0]))


def test_an_exposure_is_the_mean_of_its_moments(scene):
    """Of a moving scene in moving air, the shutter open for half the frame."""
    wind, moving = torch.tensor((4.0, 1.0)), torch.cat((scene, scene.flip(-1)), 1)
    simulator = Simulator(PATH, 65, 71, modes=15, components=6, sensor=Sensor(exposures=4), margin=24)
    out = simulator(moving, simulator.draw([1], 2, wind, shutter=0.5))
    short = Simulator(PATH, 65, 71, modes=15, components=6, margin=24)
    for frame in range(2):
        moments = [
            short(moving[:, frame : frame + 1], short.draw([1], 1, wind, start=frame + 0.5 * part / 4))
            for part in range(4)
        ]
        for name in ("frames", "tilt_only", "blur_only", "tilt", "blur_strength"):
            mean = torch.stack([getattr(moment, name)[:, 0] for moment in moments]).mean(0)
            torch.testing.assert_close(getattr(out, name)[:, frame], mean, rtol=0, atol=1e-5)
    assert psnr(out.frames[:, 0], moments[0].frames[:, 0]) < 50


@pytest.mark.parametrize(("size", "scale"), [((64, 64), 0.5), ((66, 70), 0.5), ((65, 50), 2)])
def test_the_same_air_at_another_scale(size, scale):
    """As many pixels as the lens resolves, or half as many: the picture is that of the other, reduced."""
    height, width = size
    picture = torch.from_numpy(skimage.data.astronaut()[: 2 * height, 150 : 150 + 2 * width].copy())
    fine = picture.float().permute(2, 0, 1)[None] / 255
    fine = torch.nn.functional.avg_pool2d(fine, 3, 1, 1)
    simulator = Simulator(OpticalPath.from_d_over_r0(3.0), height, width, outer_scale=10.0)
    draw = simulator.draw([0])
    other = simulator.at_scale(scale)
    scaled = draw.at_scale(scale)
    torch.testing.assert_close(scaled.tilt, draw.tilt * scale)
    assert other.margin == simulator.margin * scale
    # Its own draws are of the same air.
    torch.testing.assert_close(other.draw([0]).coefficients, draw.coefficients, rtol=1e-3, atol=1e-3)
    if scale == 0.5:
        scene = fine[..., :height, :width]
        large, small = simulator(scene[None], draw), other(half(scene)[None], scaled)
    else:
        scene = fine[..., : 2 * height, : 2 * width]
        large, small = other(scene[None], scaled), simulator(half(scene)[None], draw)
    inner = (..., slice(4, -4), slice(4, -4))
    reduced, blurred = half(large.frames[0])[inner], large.blur_only_at(2)[0][inner]
    assert psnr(reduced, small.frames[0][inner]) > 40
    assert psnr(blurred, small.blur_only[0][inner]) > 40
    assert psnr(reduced, half(scene)[inner]) < 30


def half(clip: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.avg_pool2d(clip, 2)


def test_another_scale_keeps_what_was_given():
    given = {"modes": 15, "components": 7, "exact": True, "outer_scale": 3.0, "boiling": 0.2, "layers": 5}
    other = Simulator(PATH, 64, 64, margin=20, tolerance=40.0, **given).at_scale(0.5)
    plan = other.plan()
    assert (plan.modes, plan.components, plan.network, plan.tolerance) == (15, 7, False, 40.0)
    assert (other.margin, other.stride, other.q) == (10, 2, 2.0)
    assert other.field.boiling == 0.2
    assert len(other.field._layer_scale) == 5


@pytest.mark.parametrize("scale", [0.3, 1 / 8, 0.0])
def test_a_scale_of_no_whole_pixels_is_refused(simulator, scale):
    with pytest.raises(ParameterError, match="whole"):
        simulator.at_scale(scale)


def test_blur_only_reduced_is_the_mean_of_its_pixels(simulator, scene):
    out = simulator(scene, simulator.draw([0], 2))
    small = out.blur_only_at(2)
    assert small.shape == (1, 2, 3, 32, 35)
    torch.testing.assert_close(small[0, 1, 2, 5, 7], out.blur_only[0, 1, 2, 10:12, 14:16].mean())


def test_a_draw_of_another_grid_is_refused(simulator, scene):
    draw = simulator.draw([0])
    cut = draw.coefficients[..., :-1]
    for other in (replace(draw, stride=2), replace(draw, margin=8), replace(draw, coefficients=cut)):
        with pytest.raises(InputError, match="another grid|was made for"):
            simulator(scene, other)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_draw_that_is_not_a_number_is_refused(simulator, scene, value):
    draw = simulator.draw([0])
    coefficients = draw.coefficients.clone()
    coefficients[0, 0, 4, 2, 3] = value
    with pytest.raises(InputError, match="draw"):
        simulator(scene, replace(draw, coefficients=coefficients))


@pytest.mark.parametrize("shape", [(1, 3), (3, 1)])
def test_scenes_of_other_clips_or_frames_than_the_draw_are_refused(simulator, scene, shape):
    with pytest.raises(InputError, match="clips of"):
        simulator(scene.expand(*shape, 3, 65, 71), simulator.draw([0, 1], 2))


def test_double_precision():
    simulator = Simulator(PATH, 24, 20, modes=10, dtype=torch.float64)
    assert simulator.plan().network
    out = simulator(torch.rand(1, 1, 1, 24, 20, dtype=torch.float64), simulator.draw([0]))
    assert out.frames.dtype == torch.float64


def test_the_plan_of_a_scene_names_what_the_scene_lets_out(simulator, scene):
    flat = torch.full((3, 65, 71), 0.2)
    flat[:, 30:33, 5:8] = 0.9
    told = str(simulator.plan(flat))
    assert "channels are the same" in told
    assert "flat" in told
    assert "channels are the same" not in str(simulator.plan(scene[0, 0]))
    assert simulator.plan(tolerance=20.0).tolerance == 20.0


def test_one_thread_or_two_give_the_same_clip(scene):
    """Bit by bit."""
    simulator, wind, drawn, frames = Simulator(PATH, 65, 71), torch.tensor((2.0, 1.0)), [], []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            drawn.append(simulator.draw([0, 1], 2, wind))
            frames.append(simulator(scene, drawn[-1]).frames)
    finally:
        torch.set_num_threads(1)
    assert torch.equal(drawn[0].coefficients, drawn[1].coefficients)
    assert torch.equal(*frames)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.uint8])
def test_a_scene_of_coarse_numbers_is_refused(simulator, scene, dtype):
    with pytest.raises(InputError, match="float32"):
        simulator((scene * 255).to(dtype), simulator.draw([0]))


def test_air_in_which_light_comes_from_everywhere_is_refused():
    """D/r0 = 4000 would take a margin of thousands of pixels, and all the memory there is."""
    with pytest.raises(ParameterError, match="D/r0"):
        Simulator(OpticalPath(0.2034, 7000.0, Constant(1e-10)), 8, 8)
