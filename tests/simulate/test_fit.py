import runpy
from pathlib import Path

import numpy as np
import pytest
import skimage.data
import torch

from turbnet.atmosphere.exposure import tilt_free_otf
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Constant
from turbnet.errors import InputError
from turbnet.simulate.fit import FEWEST_FRAMES, WEAKEST, Fit, _noise, _sharpen, _track, fit_strength
from turbnet.simulate.sensor import Sensor
from turbnet.simulate.simulator import Simulator

GEOMETRY = OpticalPath.from_d_over_r0(3.0)
SIZE, SHAKE = 96, 4


@pytest.fixture(scope="module")
def scene() -> torch.Tensor:
    size = SIZE + 2 * SHAKE
    return torch.from_numpy(skimage.data.astronaut()[20 : 20 + size, 160 : 160 + size].copy()).float().mean(-1) / 255


def simulated(scene: torch.Tensor, strength: float, seed: int) -> torch.Tensor:
    simulator = Simulator(
        OpticalPath.from_d_over_r0(strength), *scene.shape, components=10, sensor=Sensor(read_noise=0.01)
    )
    with torch.no_grad():
        return simulator(scene[None, None, None], simulator.draw([seed], 40), noise_seed=seed).frames[0, :, 0]


@pytest.fixture(scope="module")
def clip(scene) -> torch.Tensor:
    return simulated(scene, 2.0, seed=101)


def cropped(clip: torch.Tensor, at: torch.Tensor) -> torch.Tensor:
    """A window of each frame, its corner at (x, y)."""
    return torch.stack([frame[y : y + SIZE, x : x + SIZE] for frame, (x, y) in zip(clip, at.tolist(), strict=True)])


@pytest.fixture(scope="module")
def steady(clip) -> Fit:
    return fit_strength(cropped(clip, torch.full((40, 2), SHAKE)), GEOMETRY)


def test_a_known_strength_is_recovered(steady):
    assert steady.d_over_r0 == pytest.approx(2.0, rel=0.15)
    assert 0.02 < steady.uncertainty / steady.d_over_r0 < 0.10
    assert steady.residual == pytest.approx(1.0, abs=0.2)
    assert steady.frames == 40


def test_and_another_whatever_the_strength_of_the_path_given(scene):
    found = fit_strength(simulated(scene, 1.0, seed=102), OpticalPath.from_d_over_r0(0.5))
    assert found.d_over_r0 == pytest.approx(1.0, rel=0.15)


def test_a_shaking_camera_does_not_matter(clip, steady):
    """Shifts common to a frame, of several times the tilt, in whole pixels so that nothing is interpolated."""
    at = torch.randint(0, 2 * SHAKE + 1, (40, 2), generator=torch.Generator().manual_seed(1))
    shaken = fit_strength(cropped(clip, at), GEOMETRY)
    assert shaken.d_over_r0 == pytest.approx(steady.d_over_r0, rel=0.05)


def test_same_clip_same_answer_and_colours_are_averaged(clip, steady):
    middle = cropped(clip, torch.full((40, 2), SHAKE))
    assert fit_strength(middle[:, None].expand(-1, 3, -1, -1), GEOMETRY).d_over_r0 == pytest.approx(
        steady.d_over_r0, rel=1e-3
    )


def test_still_air_is_weak(scene):
    still = Sensor(read_noise=0.01)(scene.expand(12, -1, -1), seed=3)
    assert WEAKEST <= fit_strength(still, GEOMETRY).d_over_r0 < 0.3


def test_windows_follow_a_shift(scene):
    points = torch.tensor([[40.0, 40.0], [60.0, 50.0]])
    moved = torch.stack((torch.roll(scene, (2, -1), (0, 1)), scene))
    shifts, left = _track(moved, scene, points, torch.zeros(2, 2))
    torch.testing.assert_close(shifts[0], torch.tensor([[-1.0, 2.0]]).expand(2, 2), rtol=0, atol=0.02)
    torch.testing.assert_close(shifts[1], torch.zeros(2, 2), rtol=0, atol=1e-4)
    assert left < 2e-3


def test_noise_is_found_in_spite_of_texture(clip):
    # Rounded up by what texture the clip has left at its finest: a tenth at D/r0 = 2.
    assert _noise(clip) == pytest.approx(0.01, rel=0.2)


def test_sharpening_undoes_the_mean_blur():
    """A picture of low frequencies, blurred by the transfer function, comes back."""
    x = torch.arange(128.0)
    wave = 0.5 + 0.3 * torch.cos(2 * torch.pi * x / 16).expand(128, -1)
    blurred = 0.5 + float(tilt_free_otf(np.array(2 / 16), 2.0)) * (wave - 0.5)
    inner = slice(32, -32)
    torch.testing.assert_close(_sharpen(blurred, 2.0)[inner, inner], wave[inner, inner], rtol=0, atol=0.02)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda c: c[: FEWEST_FRAMES - 1], "at least 10"),
        (lambda c: c.index_fill(0, torch.tensor([3]), float("nan")), "NaN"),
        (lambda c: torch.full_like(c, 0.5), "too little texture"),
        (lambda c: 0.5 + 0.01 * torch.randn(c.shape, generator=torch.Generator().manual_seed(0)), "texture"),
        (lambda c: c * 255, r"\[0, 1\]"),
        (lambda c: c[:, :40, :40], "at least"),
        (lambda c: c[0], "expected"),
    ],
    ids=["few", "nan", "flat", "noise", "bytes", "small", "picture"],
)
def test_what_cannot_be_used_is_refused_in_one_line(clip, spoil, message):
    with pytest.raises(InputError, match=message) as error:
        fit_strength(spoil(clip), GEOMETRY)
    assert "\n" not in str(error.value)


def test_still_air_has_no_profile(clip):
    with pytest.raises(InputError, match="still air"):
        fit_strength(clip, OpticalPath(0.2, 7000.0, Constant(0.0)))


@pytest.mark.slow
def test_the_table_of_the_guide():
    """Strengths of 1, 2, 4 on two pictures, frames independent and in wind."""
    fits = runpy.run_path(str(Path(__file__).parents[2] / "tools" / "fit_table.py"))["fits"]
    for name, kind, strength, found in fits():
        for fit in found:
            assert fit.d_over_r0 == pytest.approx(strength, rel=0.15), (name, kind)
