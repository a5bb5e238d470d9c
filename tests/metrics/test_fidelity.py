import warnings

import numpy as np
import pytest
import skimage.data
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.image import MultiScaleStructuralSimilarityIndexMeasure

from turbnet.errors import InputError
from turbnet.metrics.fidelity import MS_SSIM_SIZE, ms_ssim, psnr, ssim

SETTINGS = {"data_range": 1.0, "gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}


@pytest.fixture(scope="module")
def clips():
    """A photograph three times, odd sizes, beside noisier and noisier copies of it: float64 (3, 97, 83, 3)."""
    reference = np.stack([skimage.data.astronaut()[40:137, 150:233] / 255.0] * 3)
    noise = np.random.default_rng(0).normal(size=reference.shape)
    return np.clip(reference + noise * np.array([0.01, 0.05, 0.2])[:, None, None, None], 0, 1), reference


def scikit(restored, reference):
    pairs = list(zip(restored, reference, strict=True))
    return (
        [peak_signal_noise_ratio(second, first, data_range=1.0) for first, second in pairs],
        [structural_similarity(first, second, channel_axis=-1, **SETTINGS) for first, second in pairs],
    )


@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-6), (np.float32, 1e-5)])
@pytest.mark.parametrize("border", [0, 7])
def test_agree_with_scikit_image(clips, dtype, tolerance, border):
    restored, reference = (clip.astype(dtype) for clip in clips)
    inner = np.s_[:, border : 97 - border, border : 83 - border]
    expected_psnr, expected_ssim = scikit(restored[inner].astype(float), reference[inner].astype(float))
    np.testing.assert_allclose(psnr(restored, reference, border), expected_psnr, atol=1e-5)
    np.testing.assert_allclose(ssim(restored, reference, border), expected_ssim, atol=tolerance)


def test_one_channel(clips):
    restored, reference = (clip[0, ..., :1] for clip in clips)
    expected = structural_similarity(restored[..., 0], reference[..., 0], **SETTINGS)
    assert ssim(restored, reference) == pytest.approx(expected, abs=1e-6)


def test_known_psnr():
    # A constant error of 0.1 has MSE 0.01: 20 dB.
    assert psnr(np.full((4, 4, 3), 0.6), np.full((4, 4, 3), 0.5)) == pytest.approx(20.0, abs=1e-6)


def test_identical_frames(clips):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.all(psnr(clips[0], clips[0]) == np.inf)
        np.testing.assert_allclose(ssim(clips[0], clips[0]), 1.0, atol=1e-12)


def test_tensors_and_a_still_reference(clips):
    restored, reference = (torch.from_numpy(clip) for clip in clips)
    for measure in (psnr, ssim):
        scores = measure(restored, reference[0])
        assert isinstance(scores, torch.Tensor)
        np.testing.assert_array_equal(scores.numpy(), measure(*clips))
        assert measure(restored[None], reference[None]).shape == (1, 3)


@pytest.fixture(scope="module")
def large():
    """Two photographs of MS_SSIM_SIZE + 5 pixels beside noisy copies, float64 (2, H, W, 3)."""
    side = MS_SSIM_SIZE + 5
    reference = np.stack(
        [skimage.data.astronaut()[:side, 150 : 150 + side] / 255.0, skimage.data.coffee()[:side, :side] / 255.0]
    )
    noise = np.random.default_rng(0).normal(size=reference.shape)
    return np.clip(reference + noise * np.array([0.02, 0.2])[:, None, None, None], 0, 1), reference


@pytest.mark.parametrize("border", [0, 2])
def test_ms_ssim_agrees_with_torchmetrics(large, border):
    scores = ms_ssim(*large, border)
    side = large[0].shape[1]
    for score, restored, reference in zip(scores, *large, strict=True):
        inner = np.s_[border : side - border, border : side - border]
        pair = (torch.from_numpy(frame[inner]).movedim(-1, 0)[None] for frame in (restored, reference))
        assert score == pytest.approx(
            float(MultiScaleStructuralSimilarityIndexMeasure(data_range=1.0)(*pair)), abs=1e-5
        )
    assert scores[0] > scores[1]


def test_ms_ssim_of_identical_and_of_small_frames(large):
    np.testing.assert_allclose(ms_ssim(large[1], large[1]), 1.0, atol=1e-6)
    with pytest.raises(InputError, match="NaN"):
        ms_ssim(large[0] * np.nan, large[1])
    with pytest.raises(InputError, match=f"at least {MS_SSIM_SIZE}x{MS_SSIM_SIZE} must remain"):
        ms_ssim(large[0][:, 6:], large[1][:, 6:])


@pytest.mark.parametrize("measure", [psnr, ssim])
@pytest.mark.parametrize(
    ("first", "second", "border", "says"),
    [
        (np.zeros((20, 20, 3)), np.zeros((20, 21, 3)), 0, "cannot compare frames of shape"),
        (np.zeros((2, 20, 20, 3)), np.zeros((3, 20, 20, 3)), 0, "cannot compare frames of shape"),
        (np.zeros((20, 20)), np.zeros((20, 20)), 0, "cannot compare frames of shape"),
        (np.zeros((20, 20, 3), np.uint8), np.zeros((20, 20, 3)), 0, "scale them to floating point"),
        (np.full((20, 20, 3), np.nan), np.zeros((20, 20, 3)), 0, "NaN"),
        (np.zeros((20, 20, 3)), np.full((20, 20, 3), np.nan), 0, "NaN"),
        (np.zeros((20, 20, 3)), np.zeros((20, 20, 3)), 10, "too small for a border of 10"),
        (np.zeros((20, 20, 3)), np.zeros((20, 20, 3)), -1, "border = -1 pixels is outside"),
    ],
)
def test_bad_input(measure, first, second, border, says):
    with pytest.raises(InputError, match=says):
        measure(first, second, border)


def test_frame_smaller_than_the_window():
    assert ssim(np.ones((11, 11, 1)), np.ones((11, 11, 1))) == pytest.approx(1.0)
    with pytest.raises(InputError, match="at least 11x11 must remain"):
        ssim(np.ones((11, 10, 1)), np.ones((11, 10, 1)))


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_frames_are_compared_in_float32(clips, dtype):
    restored, reference = (torch.from_numpy(clip).to(dtype) for clip in clips)
    for score in (psnr, ssim):
        torch.testing.assert_close(score(restored, reference), score(restored.float(), reference.float()))
