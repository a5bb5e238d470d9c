import numpy as np
import pytest
import skimage.data
from scipy.ndimage import gaussian_filter

from turbnet.errors import InputError
from turbnet.metrics.sharpness import noise_level, sharpness

PICTURE = skimage.data.astronaut()[20:121, 140:237] / 255.0


def test_gradient_energy_of_a_wave():
    """cos(k x) has the mean gradient energy sin(k)^2 / 2 by central differences."""
    k = 2 * np.pi / 10
    wave = np.tile(np.cos(k * np.arange(102))[None, :, None], (9, 1, 1))
    assert sharpness(wave) == pytest.approx(np.sin(k) ** 2 / 2, rel=1e-9)
    assert sharpness(wave.transpose(1, 0, 2)) == pytest.approx(np.sin(k) ** 2 / 2, rel=1e-9)


def test_blur_lowers_and_noise_raises_it():
    blurred = gaussian_filter(PICTURE, (1, 1, 0))
    assert sharpness(blurred) < 0.7 * sharpness(PICTURE)
    noise = np.random.default_rng(0).normal(size=PICTURE.shape) * 0.05
    # Half of sigma^2 an axis; 29,000 values.
    assert sharpness(PICTURE + noise) - sharpness(PICTURE) == pytest.approx(0.05**2, rel=0.1)


@pytest.mark.parametrize("sigma", [0.01, 0.1])
def test_noise_level(sigma):
    plane = np.add.outer(np.linspace(0, 0.5, 120), np.linspace(0.1, 0.4, 150))[..., None]
    assert noise_level(plane) == pytest.approx(0, abs=1e-12)
    noisy = plane + np.random.default_rng(0).normal(size=plane.shape) * sigma
    # 17,000 values, neighbours correlated: 0.76 / sqrt(17,000 / 4) = 1.2 %; three of these.
    assert noise_level(noisy) == pytest.approx(sigma, rel=0.036)


@pytest.mark.parametrize("measure", [sharpness, noise_level])
def test_bad_input(measure):
    with pytest.raises(InputError, match="has no sharpness"):
        measure(np.zeros((2, 9, 3)))
    with pytest.raises(InputError, match="has no sharpness"):
        measure(np.zeros((9, 9)))
    with pytest.raises(InputError, match="NaN"):
        measure(np.full((9, 9, 3), np.nan))
