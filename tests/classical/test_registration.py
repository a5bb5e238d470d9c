import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from turbnet.classical.local import luminance
from turbnet.classical.reference import temporal_mean
from turbnet.classical.registration import control_point_flow, optical_flow, register, warp
from turbnet.errors import InputError, ParameterError
from turbnet.metrics.fidelity import psnr

INNER = (..., slice(12, -12), slice(12, -12))


def smooth_shift(height: int, width: int, size: float, seed: int = 0) -> np.ndarray:
    """A random shift, smooth over some 20 pixels, `size` pixels strong."""
    noise = np.random.default_rng(seed).standard_normal((2, height, width))
    field = gaussian_filter(noise, (0, 20, 20))
    return (size * field / field.std()).astype(np.float32)


@pytest.mark.parametrize("flow", [optical_flow, control_point_flow])
def test_finds_a_smooth_shift(scene, flow):
    """reference(x) = moving(x + d(x)) by construction."""
    moving = luminance(scene)
    truth = smooth_shift(*moving.shape, 1.5)
    reference = warp(moving[..., None], truth)[..., 0]
    error = flow(moving, reference) - truth
    # Against 1.5 pixels; what is flat cannot be seen to move, so the median over the picture.
    assert np.median(np.abs(error[INNER])) < 0.15


@pytest.mark.parametrize("flow", [optical_flow, control_point_flow])
def test_positive_shift_means_the_frame_lies_to_the_right(scene, flow):
    reference = luminance(scene)
    moving = np.roll(reference, 2, axis=1)
    dx, dy = flow(moving, reference)
    assert np.median(dx) == pytest.approx(2, abs=0.1)
    assert np.median(dy) == pytest.approx(0, abs=0.1)


@pytest.mark.parametrize("flow", [optical_flow, control_point_flow])
def test_no_motion_is_no_shift(scene, flow):
    y = luminance(scene)
    assert np.abs(flow(y, y)).max() < 1e-3


@pytest.mark.parametrize("reduction", [1, 2])
def test_registered_clip_of_turbulence(still_clip, reduction):
    """Registration brings frames together and near the truth; at half resolution nearly as well."""
    frames = still_clip.frames
    registered, shifts = register(frames, temporal_mean(frames), reduction=reduction, cores=2)
    assert shifts.shape == (12, 2, 160, 160)
    assert registered.var(axis=0).mean() < 0.5 * frames.var(axis=0).mean()
    assert psnr(registered.mean(0), still_clip.scene) > psnr(frames.mean(0), still_clip.scene) + 1
    # Differences between frames: the reference's own distortion, the mean of 12 tilts, stays unknown.
    error = (shifts - shifts.mean(0)) - (still_clip.tilt - still_clip.tilt.mean(0))
    assert np.median(np.abs(error[INNER])) < 0.35 * np.median(np.abs(still_clip.tilt))


def test_cores_do_not_change_the_result(still_clip):
    frames = still_clip.frames[:3]
    one, two = (register(frames, frames.mean(0), cores=cores)[0] for cores in (1, 2))
    np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("size", [(1, 1), (5, 9), (33, 47)])
def test_any_size(size):
    frames = np.random.default_rng(0).random((2, *size, 1), np.float32)
    for flow in (optical_flow, control_point_flow):
        registered, _ = register(frames, frames[0], flow=flow, reduction=2)
        assert registered.shape == frames.shape
        assert np.isfinite(registered).all()


def test_bad_input(scene):
    y = luminance(scene)
    with pytest.raises(InputError, match="one size"):
        optical_flow(y, y[:-1])
    with pytest.raises(ParameterError, match="spacing"):
        control_point_flow(y, y, spacing=2)
