import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from turbnet.classical import sharpness
from turbnet.classical.fusion import fourier_burst, fuse, hard_weights, patch_fusion, soft_weights
from turbnet.classical.local import luminance
from turbnet.errors import InputError, ParameterError
from turbnet.metrics.fidelity import psnr


@pytest.fixture(scope="module")
def halves(scene) -> np.ndarray:
    """Two frames, one sharp on the left, one on the right, (2, H, W, 3)."""
    soft = gaussian_filter(scene, (2, 2, 0))
    left = np.arange(scene.shape[1]) < scene.shape[1] // 2
    return np.stack([np.where(left[:, None], scene, soft), np.where(left[:, None], soft, scene)])


@pytest.mark.parametrize("measure", sharpness.MEASURES.values(), ids=sharpness.MEASURES)
def test_sharpness_falls_with_blur(scene, measure):
    y = luminance(scene)
    means = [measure(gaussian_filter(y, sigma)).mean() for sigma in (0, 0.7, 1.5, 3)]
    assert means == sorted(means, reverse=True)
    assert means[-1] < 0.75 * means[0]


@pytest.mark.parametrize("measure", sharpness.MEASURES.values(), ids=sharpness.MEASURES)
def test_sharpness_is_zero_where_flat_and_takes_clips(measure):
    flat = np.full((2, 20, 30), 0.7, np.float32)
    np.testing.assert_allclose(measure(flat), 0, atol=1e-9)
    flat[1, 10, 15] = 0
    assert measure(flat)[1].max() > 0
    np.testing.assert_allclose(measure(flat)[1], measure(flat[1]), atol=1e-7)


def test_sharpness_of_a_ramp():
    """Slope (a, b): tv1 = a + b, tv2 = sqrt(a^2 + b^2), laplacian 0, variance (a^2 + b^2)(n^2 - 1)/12 over n^2 pixels."""
    a, b, n = 0.003, 0.004, 15
    y, x = np.mgrid[:64, :64]
    ramp = (a * x + b * y).astype(np.float32)
    middle = (32, 32)
    assert sharpness.tv1(ramp)[middle] == pytest.approx(a + b, rel=1e-3)
    assert sharpness.tv2(ramp)[middle] == pytest.approx(np.hypot(a, b), rel=1e-3)
    assert sharpness.laplacian(ramp)[middle] == pytest.approx(0, abs=1e-9)
    assert sharpness.variance(ramp)[middle] == pytest.approx((a**2 + b**2) * (n**2 - 1) / 12, rel=1e-2)


def test_consistency_ignores_brightness_and_sees_displacement(scene):
    y = luminance(scene)
    np.testing.assert_allclose(sharpness.consistency(0.5 * y + 0.1, y), 1, atol=1e-3)
    steps = [sharpness.consistency(np.roll(y, k, 1), y).mean() for k in (0, 1, 2, 4)]
    assert steps == sorted(steps, reverse=True)
    assert steps[-1] < 0.8
    flat = np.zeros_like(y)
    np.testing.assert_allclose(sharpness.consistency(flat, flat), 1)


@pytest.mark.parametrize("power", [0.0, 2.0, 64.0])
def test_soft_weights(power):
    s = np.random.default_rng(0).random((4, 5, 6), np.float32)
    w = soft_weights(s, power)
    np.testing.assert_allclose(w.sum(0), 1, atol=1e-5)
    np.testing.assert_allclose(w, s**power / (s**power).sum(0), atol=1e-4)
    np.testing.assert_allclose(soft_weights(0 * s, power), 0.25)


def test_hard_weights_take_the_sharpest():
    s = np.stack([np.full((2, 2), value, np.float32) for value in (3, 1, 4, 1, 5, 9, 2, 6)])
    np.testing.assert_allclose(hard_weights(s, 0.25)[:, 0, 0], [0, 0, 0, 0, 0, 0.5, 0, 0.5])
    np.testing.assert_allclose(hard_weights(s, 0.01)[:, 0, 0], [0, 0, 0, 0, 0, 1, 0, 0])
    np.testing.assert_allclose(hard_weights(np.ones_like(s), 0.5).sum(0), 1)


@pytest.mark.parametrize("aggregate", [fuse, patch_fusion])
@pytest.mark.parametrize("weigh", [lambda s: soft_weights(s, 16.0), lambda s: hard_weights(s, 0.5)])
def test_lucky_fusion_takes_the_sharp_half_of_each(halves, scene, aggregate, weigh):
    fused = aggregate(halves, weigh(np.stack([sharpness.variance(luminance(frame)) for frame in halves])))
    assert psnr(fused, scene) > max(psnr(frame, scene) for frame in halves) + 1.5
    assert psnr(fused, scene) > psnr(halves.mean(0), scene) + 1.5


@pytest.mark.parametrize("patch", [2, 7, 32, 200])
def test_patches_leave_no_trace(scene, patch):
    """Equal frames come back, whatever the weights, on sizes that no patch divides."""
    frames = np.stack([scene[:45, :61]] * 3)
    weights = np.random.default_rng(0).random(frames.shape[:3], np.float32)
    np.testing.assert_allclose(patch_fusion(frames, weights, patch), frames[0], atol=1e-5)


def test_fourier_burst_takes_what_each_frame_has_kept(scene):
    """One frame blurred across, one down: at large p the burst is sharp both ways, at p = 0 it is the mean."""
    burst = np.stack([gaussian_filter(scene, (2, 0, 0), mode="wrap"), gaussian_filter(scene, (0, 2, 0), mode="wrap")])
    np.testing.assert_allclose(fourier_burst(burst, 0.0), burst.mean(0), atol=1e-5)
    sharp = psnr(fourier_burst(burst, 11.0), scene)
    assert sharp > psnr(burst.mean(0), scene) + 3
    assert sharp > max(psnr(frame, scene) for frame in burst) + 3


@pytest.mark.parametrize("size", [(1, 1), (7, 10), (31, 16)])
def test_any_size(size):
    frames = np.random.default_rng(0).random((3, *size, 2), np.float32)
    for fused in (fourier_burst(frames), patch_fusion(frames, frames[..., 0])):
        assert fused.shape == (*size, 2)
        assert fused.dtype == np.float32


def test_bad_input(scene):
    with pytest.raises(ParameterError, match="power"):
        soft_weights(scene, -1.0)
    with pytest.raises(ParameterError, match="share"):
        hard_weights(scene, 0.0)
    with pytest.raises(ParameterError, match="patch"):
        patch_fusion(scene[None], scene[None, ..., 0], 1)
    with pytest.raises(InputError, match="a clip is"):
        fourier_burst(scene)
