import numpy as np
import pytest
import skimage.data
from scipy.ndimage import gaussian_filter, map_coordinates, shift

from turbnet.errors import InputError
from turbnet.metrics.registration import estimate_displacements, estimate_shift, margin_of, undo_shift

PICTURE = skimage.data.astronaut()[20:181, 120:293] / 255.0  # odd sizes


def moved(picture, x, y):
    """What stands at (0, 0) of the picture stands at (x, y) afterwards."""
    return shift(picture, (y, x, 0), order=3, mode="mirror")


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.4, -0.7), (-2.3, 1.6), (6.0, 4.0)])
@pytest.mark.parametrize("sigma", [0, 1])
def test_shift_of_a_whole_picture(offset, sigma):
    """A cubic kernel moves a picture by up to 0.03 pixels too little or too much between whole pixels."""
    image = gaussian_filter(moved(PICTURE, *offset), (sigma, sigma, 0))
    np.testing.assert_allclose(estimate_shift(image, PICTURE), offset, atol=0.04)


def test_shift_is_antisymmetric():
    there, back = estimate_shift(moved(PICTURE, 0.5, 1.25), PICTURE), estimate_shift(PICTURE, moved(PICTURE, 0.5, 1.25))
    np.testing.assert_allclose(there, np.negative(back), atol=0.06)


def test_noise_moves_the_estimate_as_theory_says():
    """Cramer-Rao: the standard deviation is sigma / sqrt(sum g^2) with all pixels alike; the Hann weights cost a bit."""
    rng, sigma = np.random.default_rng(0), 0.05
    grey = PICTURE.mean(-1, keepdims=True)
    found = np.array([estimate_shift(grey + rng.normal(size=grey.shape) * sigma, grey) for _ in range(24)])
    weight = np.hanning(grey.shape[0] + 2)[1:-1, None] * np.hanning(grey.shape[1] + 2)[1:-1]
    g_y, g_x = np.gradient(grey[..., 0])
    matrix = np.array([[(weight * a * b).sum() for a in (g_x, g_y)] for b in (g_x, g_y)])
    spread = np.array([[(weight**2 * a * b).sum() for a in (g_x, g_y)] for b in (g_x, g_y)])
    inverse = np.linalg.inv(matrix)
    expected = sigma * np.sqrt(np.diag(inverse @ spread @ inverse))
    # 48 values: their root mean square is right to 1 / sqrt(96) = 10 %; three of these. Cubic sampling smooths noise a bit.
    assert np.sqrt(np.mean((found / expected) ** 2)) == pytest.approx(1.0, abs=0.35)


def test_windows_follow_a_motion_that_varies():
    """A stretch about the middle: shifts grow linearly from there."""
    rows, columns = np.mgrid[0:161, 0:173].astype(float)
    grey = PICTURE.mean(-1)
    stretched = map_coordinates(grey, (rows, 86 + (columns - 86) / 1.02), order=3, mode="mirror")
    found = estimate_displacements(stretched[..., None], grey[..., None])
    assert found.shape == (6 * 6, 2)
    centres = np.linspace(0, 173 - 32, 6).round() + 15.5
    expected = np.repeat((centres - 86) * 0.02, 6)
    kept = np.isfinite(found[:, 0])
    assert kept.mean() > 0.6
    # Within a window of 32 the shift itself varies by 0.64 pixels, and texture is not even.
    np.testing.assert_allclose(found[kept, 0], expected[kept], atol=0.2)
    np.testing.assert_allclose(found[kept, 1], 0, atol=0.2)


def test_flat_windows_are_left_out():
    picture = np.full((64, 64, 1), 0.5)
    picture[:32, :32] = PICTURE[40:72, 40:72, :1]
    found = estimate_displacements(picture, picture)
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1:]).all()
    stripes = np.tile(np.sin(np.arange(64) / 2)[None, :, None] / 2 + 0.5, (64, 1, 1))
    with pytest.raises(InputError, match="too flat"):
        estimate_shift(stripes, stripes)


def test_undoing_a_shift():
    offset = (1.3, -0.6)
    back = undo_shift(moved(PICTURE, *offset), offset)
    margin = margin_of(offset)
    assert margin == 4
    inner = np.s_[margin:-margin, margin:-margin]
    assert np.sqrt(np.mean((back[inner] - PICTURE[inner]) ** 2)) < 0.02
    np.testing.assert_allclose(undo_shift(PICTURE, (0.0, 0.0)), PICTURE, atol=1e-12)


@pytest.mark.parametrize("estimate", [estimate_shift, estimate_displacements])
@pytest.mark.parametrize(
    ("first", "second", "says"),
    [
        (np.zeros((20, 20, 3)), np.zeros((20, 21, 3)), "cannot register pictures of shape"),
        (np.zeros((20, 20)), np.zeros((20, 20)), "cannot register pictures of shape"),
        (np.zeros((7, 20, 3)), np.zeros((7, 20, 3)), "too small to be registered"),
        (np.full((20, 20, 3), np.nan), np.zeros((20, 20, 3)), "NaN"),
        (np.zeros((20, 20, 3)), np.full((20, 20, 3), np.inf), "NaN"),
    ],
)
def test_bad_input(estimate, first, second, says):
    with pytest.raises(InputError, match=says):
        estimate(first, second)
