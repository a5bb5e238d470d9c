import pytest
import skimage.data
import torch

from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Constant
from turbnet.errors import InputError
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
    from dataclasses import replace

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
