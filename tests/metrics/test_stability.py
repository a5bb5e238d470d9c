import numpy as np
import pytest
import skimage.data
from scipy.ndimage import shift

from turbnet.errors import InputError
from turbnet.metrics.stability import flicker, jitter

PICTURE = skimage.data.astronaut()[20:120, 140:237] / 255.0


def clip_of(offsets):
    return np.stack([shift(PICTURE, (y, x, 0), order=3, mode="mirror") for x, y in offsets])


@pytest.mark.parametrize("sigma", [0.1, 0.5, 1.5])
def test_known_motion(sigma):
    offsets = np.random.default_rng(0).normal(size=(16, 2)) * sigma
    clip = clip_of(offsets)
    expected = np.sqrt(np.mean((offsets - offsets.mean(0)) ** 2))
    # The mean is blurred by the motion itself, and cubic kernels are right to 0.03 pixels.
    assert jitter(clip, clip.mean(0)) == pytest.approx(expected, rel=0.05, abs=0.02)


def test_a_steady_drift_counts():
    offsets = np.linspace(-1, 1, 9)[:, None] * (1.0, 0.0)
    clip = clip_of(offsets)
    assert jitter(clip, clip.mean(0)) == pytest.approx(np.sqrt(np.mean(offsets**2)), rel=0.05)


def test_a_still_clip():
    clip = np.stack([PICTURE] * 3)
    assert jitter(clip, PICTURE) == pytest.approx(0.0, abs=1e-9)
    noisy = clip_of(np.zeros((8, 2))) + np.random.default_rng(1).normal(size=(8, *PICTURE.shape)) * 0.02
    # Noise of 0.02 / sqrt(3) in grey, texture 0.05 a pixel, 32 x 32 pixels: 0.01 pixels and some more where texture is weak.
    assert 0.004 < jitter(noisy, noisy.mean(0)) < 0.06


def test_flicker():
    assert flicker(np.array([0.4, 0.6, 0.4, 0.6])) == pytest.approx(0.1)


def test_what_has_no_jitter():
    with pytest.raises(InputError, match="a clip of one frame"):
        jitter(PICTURE[None], PICTURE)
    flat = np.full((3, 40, 40, 3), 0.5)
    with pytest.raises(InputError, match="too flat"):
        jitter(flat, flat[0])
    with pytest.raises(InputError, match="NaN"):
        jitter(flat * np.nan, flat[0])
