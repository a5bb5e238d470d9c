import numpy as np
import pytest
import skimage.data
import torch
from scipy.signal import fftconvolve

from turbnet.atmosphere.noll import noll_covariance, noll_matrix
from turbnet.classical.blind import KernelModel, blind_deconvolution, blind_kernel, kernel_weights, strength_of_dance
from turbnet.classical.blind import _lasso as lasso
from turbnet.classical.deconvolution import total_variation
from turbnet.classical.local import luminance
from turbnet.errors import InputError, ParameterError
from turbnet.media.colour import to_linear
from turbnet.metrics.fidelity import psnr
from turbnet.simulate.draw import TILT_PIXELS
from turbnet.simulate.psf_basis import tilt_free_psf

NOISE = 0.003


def draw_psf(d_over_r0: float, seed: int) -> np.ndarray:
    factor = torch.from_numpy(np.linalg.cholesky(noll_matrix(range(4, 37)))).float()
    high = torch.randn(1, 33, generator=torch.Generator().manual_seed(seed)) @ factor.T
    return tilt_free_psf(high * d_over_r0 ** (5 / 6))[0].numpy()


def seen_through(scene: np.ndarray, psf: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    seen = np.stack([fftconvolve(scene[..., c], psf, "valid") for c in range(3)], axis=-1)
    seen = seen + NOISE * np.random.default_rng(0).standard_normal(seen.shape)
    return seen.astype(np.float32), scene[15:-15, 15:-15]


@pytest.fixture(scope="module")
def pictures() -> list[np.ndarray]:
    crops = skimage.data.astronaut()[:190, 140:330], skimage.data.chelsea()[60:250, 90:280]
    return [to_linear((crop / 255).astype(np.float32)) for crop in crops]


def test_strength_of_dance_is_that_of_the_tilts():
    """Independent draws; D/r0 goes with the 6/5 power of sigma, known to 1 / sqrt(2 * 2 * 39 * independent pixels)."""
    sigma = TILT_PIXELS * (noll_covariance(2, 2) * 3.0 ** (5 / 3)) ** 0.5
    shifts = sigma * np.random.default_rng(0).standard_normal((40, 2, 30, 30)).astype(np.float32)
    assert strength_of_dance(shifts) == pytest.approx(3.0, rel=0.02)
    assert strength_of_dance(shifts + 5) == pytest.approx(3.0, rel=0.02)  # a constant displacement is no dance
    assert strength_of_dance(np.zeros((2, 2, 4, 4), np.float32)) == 0
    with pytest.raises(InputError, match="two frames"):
        strength_of_dance(shifts[:1])


def test_strength_of_a_simulated_clip(still_clip):
    """True tilts of one clip of 12: neighbouring points move together, so it is known to some 20 %."""
    assert strength_of_dance(still_clip.tilt) == pytest.approx(3.0, rel=0.35)


def test_lasso_against_its_optimality_conditions():
    rng = np.random.default_rng(0)
    columns, y = rng.standard_normal((6, 50)), rng.standard_normal(50)
    price = np.full(6, 4.0)
    b = lasso(columns @ columns.T, columns @ y, price)
    pull = columns @ (y - b @ columns)
    assert 0 < np.count_nonzero(b) < 6
    np.testing.assert_allclose(pull[b != 0], price[0] * np.sign(b[b != 0]), atol=1e-6)
    assert np.all(np.abs(pull[b == 0]) <= price[0] + 1e-6)


def test_model_kernels_sum_to_one():
    model = KernelModel.around(3.0, 8)
    assert model.components.shape == (8, *model.mean.shape)
    assert np.all(np.diff(model.scale) < 0.3 * model.scale[:-1])  # falling, but for the scatter of the draw
    for weights in (np.zeros(8, np.float32), 3 * model.scale):
        kernel = model.kernel(weights)
        assert kernel.sum() == pytest.approx(1, abs=1e-5)
        assert kernel.min() >= 0


def test_weights_between_a_sharp_and_a_blurred_picture_are_those_of_the_psf(pictures):
    """With the sharp picture given, what is found is nearer to the true PSF than the mean PSF is."""
    model = KernelModel.around(3.0)
    for seed in range(4):
        psf = draw_psf(3.0, seed)
        seen, sharp = seen_through(pictures[0], psf)
        found = model.kernel(kernel_weights(luminance(seen), luminance(sharp), model))
        assert np.linalg.norm(found - psf) < 0.85 * np.linalg.norm(model.mean - psf)


def test_blind_rounds_gain_over_the_mean_psf(pictures):
    """Eight PSFs, each the same over its picture: on average the search brings more than half a decibel."""
    gains, scores = [], []
    for seed in range(4):
        for picture in pictures:
            seen, sharp = seen_through(picture, draw_psf(4.0, seed))
            kernels = (blind_kernel(luminance(seen), NOISE, 4.0, rounds=rounds) for rounds in (0, 3))
            mean, blind = (psnr(total_variation(seen, kernel, NOISE).clip(0, 1), sharp, 8) for kernel in kernels)
            gains.append(blind - mean)
            scores.append(blind - psnr(seen, sharp, 8))
    assert np.mean(gains) > 0.5
    assert np.mean(scores) > 2


def test_blind_deconvolution_returns_what_its_kernel_makes(pictures):
    seen, _ = seen_through(pictures[1], draw_psf(2.0, 0))
    restored, kernel = blind_deconvolution(seen, NOISE, 2.0)
    np.testing.assert_array_equal(restored, total_variation(seen, kernel, NOISE))


def test_small_pictures_keep_the_mean_psf():
    picture = np.random.default_rng(0).random((20, 40), np.float32)
    np.testing.assert_allclose(blind_kernel(picture, NOISE, 2.0), KernelModel.around(2.0).mean.clip(0), atol=1e-4)


def test_bad_input(pictures):
    with pytest.raises(ParameterError, match="D/r0"):
        blind_deconvolution(pictures[0], NOISE, 20.0)
    with pytest.raises(ParameterError, match="components"):
        KernelModel.around(2.0, 400)
