import numpy as np
import pytest
from scipy.signal import fftconvolve

from turbnet.classical import deconvolution
from turbnet.classical.deconvolution import plug_and_play, richardson_lucy, total_variation, transfer_function, wiener
from turbnet.errors import InputError, ParameterError
from turbnet.metrics.fidelity import psnr

NOISE = 0.003


def lopsided() -> np.ndarray:
    """A kernel of no symmetry, so that a flipped or shifted one shows, (11, 9)."""
    y, x = np.mgrid[-5:6, -4:5]
    kernel = np.exp(-((x - 0.4 * y) ** 2) / 3 - y**2 / 6) + 0.4 * np.exp(-((x - 2) ** 2) - (y - 3) ** 2)
    return (kernel / kernel.sum()).astype(np.float32)


@pytest.fixture(scope="module")
def blurred(scene) -> tuple[np.ndarray, np.ndarray]:
    """A picture as seen through a window: what lies beyond it is blurred into it. And its sharp self."""
    kernel = lopsided()
    seen = np.stack([fftconvolve(scene[..., c], kernel, "valid") for c in range(3)], axis=-1)
    seen = seen + NOISE * np.random.default_rng(0).standard_normal(seen.shape)
    return seen.astype(np.float32), scene[5:-5, 4:-4]


@pytest.mark.parametrize(
    ("name", "restore", "gain"),
    [
        ("wiener", lambda y, h: wiener(y, h, 0.1), 2.5),
        ("richardson_lucy", richardson_lucy, 2.5),
        ("total_variation", lambda y, h: total_variation(y, h, NOISE), 4),
        ("chambolle", lambda y, h: plug_and_play(y, h, deconvolution.chambolle, NOISE, 2.0), 3),
        ("non_local_means", lambda y, h: plug_and_play(y, h, deconvolution.non_local_means, NOISE, 2.0), 3),
    ],
)
def test_restores_a_blurred_picture_without_harm_to_its_border(blurred, name, restore, gain):
    seen, sharp = blurred
    restored = restore(seen, lopsided())
    assert restored.shape == seen.shape
    assert restored.dtype == np.float32
    assert psnr(restored.clip(0, 1), sharp) > psnr(seen.clip(0, 1), sharp) + gain
    frame = np.ones(seen.shape[:2], bool)
    frame[6:-6, 6:-6] = False
    assert np.abs(restored - sharp)[frame].mean() < 1.05 * np.abs(seen - sharp)[frame].mean()


def test_transfer_function_is_convolution_with_the_middle_at_zero():
    picture = np.random.default_rng(0).random((20, 24), np.float32)
    point = np.zeros((5, 3), np.float32)
    point[2, 1] = 1
    np.testing.assert_allclose(transfer_function(point, (20, 24)), 1, atol=1e-6)
    point = np.roll(point, (1, -1), (0, 1))
    moved = np.fft.irfft2(transfer_function(point, (20, 24)) * np.fft.rfft2(picture), s=(20, 24))
    np.testing.assert_allclose(moved, np.roll(picture, (1, -1), (0, 1)), atol=1e-6)


def test_wiener_gain_of_one_wave():
    """On a whole number of periods across and nothing at the border to continue, gain = h / (h^2 + NSR f^2)."""
    x = np.arange(256)
    wave = np.sin(2 * np.pi * x / 8).astype(np.float32)
    picture = np.broadcast_to(wave[:, None, None], (256, 256, 1))
    kernel = np.full((3, 1), 1 / 3, np.float32)
    h = (1 + 2 * np.cos(2 * np.pi / 8)) / 3
    restored = wiener(picture, kernel, 4.0)[64:192, 128, 0]
    gain = restored @ wave[64:192] / (wave[64:192] @ wave[64:192])
    assert gain == pytest.approx(h / (h**2 + 4.0 / 64), rel=0.01)


def test_total_variation_scales_with_brightness(blurred):
    seen, _ = blurred
    whole, half = total_variation(seen, lopsided(), NOISE), total_variation(seen / 2, lopsided(), NOISE / 2)
    np.testing.assert_allclose(2 * half, whole, atol=2e-3)


def test_twelve_steps_of_total_variation_are_enough(blurred):
    """Away from the border, where the scene beyond has to be made up, a hundred more change nothing that counts."""
    seen, sharp = blurred
    few, many = (psnr(total_variation(seen, lopsided(), NOISE, iterations=n), sharp, 8) for n in (12, 120))
    assert few == pytest.approx(many, abs=0.1)


def test_total_variation_keeps_a_flat_picture_flat():
    flat = np.full((30, 41, 3), 0.4, np.float32)
    np.testing.assert_allclose(total_variation(flat, lopsided(), NOISE), 0.4, atol=1e-4)


def test_plug_and_play_with_no_denoiser_is_least_squares(blurred):
    """The identity in place of a denoiser leaves the data term alone: h * x comes to the data."""
    seen, _ = blurred
    x = plug_and_play(seen, lopsided(), lambda picture, noise: picture, NOISE, iterations=100)
    again = np.stack([fftconvolve(x[..., c], lopsided(), "valid") for c in range(3)], axis=-1)
    assert np.sqrt(np.mean((again - seen[5:-5, 4:-4]) ** 2)) < 2 * NOISE


@pytest.mark.parametrize("size", [(1, 1), (2, 9), (31, 16)])
def test_any_size(size):
    picture = np.random.default_rng(0).random((*size, 2), np.float32)
    for restored in (
        wiener(picture, lopsided()),
        richardson_lucy(picture, lopsided(), 3),
        total_variation(picture, lopsided(), NOISE),
    ):
        assert restored.shape == picture.shape
        assert np.isfinite(restored).all()


def test_bad_input(scene):
    with pytest.raises(InputError, match="two odd sides"):
        wiener(scene, np.full((2, 3), 1 / 6, np.float32))
    with pytest.raises(InputError, match="sums to one"):
        total_variation(scene, 2 * lopsided(), NOISE)
    with pytest.raises(InputError, match="a picture is"):
        richardson_lucy(scene[..., 0], lopsided())
    with pytest.raises(InputError, match="NaN"):
        wiener(scene * np.nan, lopsided())
    with pytest.raises(ParameterError, match="noise = 0 must be positive"):
        total_variation(scene, lopsided(), 0.0)
    with pytest.raises(ParameterError, match="noise_to_signal"):
        wiener(scene, lopsided(), -1.0)
    with pytest.raises(ParameterError, match="iterations"):
        richardson_lucy(scene, lopsided(), 0)
