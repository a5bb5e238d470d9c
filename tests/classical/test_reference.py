import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from turbnet.classical.local import check_clip, local_mean, luminance
from turbnet.classical.reference import low_rank_plus_sparse, non_local_mean, temporal_mean, weighted_mean
from turbnet.errors import InputError, ParameterError
from turbnet.metrics.fidelity import psnr


def with_disk(frames: np.ndarray, radius: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """The clip with a bright disk that crosses it, and where the disk is, (T, H, W)."""
    count, height, width, _ = frames.shape
    y, x = np.mgrid[:height, :width]
    centres = np.linspace(radius, width - radius, count)
    inside = np.stack([(x - centre) ** 2 + (y - height // 2) ** 2 < radius**2 for centre in centres])
    colour = np.array([0.9, 0.8, 0.1], np.float32)
    return np.where(inside[..., None], colour, frames), inside


def test_temporal_mean_is_the_mean(still_clip):
    np.testing.assert_allclose(temporal_mean(still_clip.frames), still_clip.frames.mean(0), atol=1e-6)


def test_non_local_mean_keeps_the_object_that_the_mean_washes_out(still_clip):
    frames, inside = with_disk(still_clip.frames)
    colour = np.array([0.9, 0.8, 0.1])
    mean = temporal_mean(frames)
    for index in (1, 6, 10):
        core = binary_erosion(inside[index], iterations=3)  # on the rim, patches show the background too
        washed = np.abs(mean[core] - colour).mean()
        kept = np.abs(non_local_mean(frames, index)[core] - colour).mean()
        assert kept < 0.02
        assert washed > 0.25  # on a pixel in two or three frames of twelve


def test_non_local_mean_of_a_still_scene_is_nearly_the_mean(still_clip):
    """Away from the object as well: dance alone does not count as motion."""
    mean, non_local = temporal_mean(still_clip.frames), non_local_mean(still_clip.frames, 5)
    good, reference = psnr(non_local, still_clip.scene), psnr(mean, still_clip.scene)
    single = psnr(still_clip.frames[5], still_clip.scene)
    assert good > reference - 0.6
    assert good > single + 0.3


def test_low_rank_plus_sparse_separates_what_was_put_together():
    """A rank-two matrix with a twentieth of its entries spoilt comes back exactly: Candes et al., J. ACM 58 (2011)."""
    rng = np.random.default_rng(0)
    shape = (40, 30, 30, 1)
    low = (rng.standard_normal((40, 2)) @ rng.standard_normal((2, 900))).reshape(shape)
    spoilt = rng.random(shape) < 0.05
    sparse = np.where(spoilt, rng.choice([-5.0, 5.0], shape), 0)
    found_low, found_sparse = low_rank_plus_sparse((low + sparse).astype(np.float32), tolerance=1e-7)
    assert np.linalg.norm(found_low - low) < 1e-3 * np.linalg.norm(low)
    assert np.mean((np.abs(found_sparse) > 0.1) == spoilt) > 0.999


def test_low_rank_part_is_free_of_the_moving_object(still_clip):
    frames, inside = with_disk(still_clip.frames)
    low, sparse = low_rank_plus_sparse(frames)
    np.testing.assert_allclose(low + sparse, frames, atol=1e-3)
    at_disk = inside[6]
    without = np.abs(low[6] - still_clip.frames.mean(0))[at_disk].mean()
    assert without < 0.5 * np.abs(temporal_mean(frames) - still_clip.frames.mean(0))[at_disk].mean()


def test_one_frame_is_its_own_reference(still_clip):
    one = still_clip.frames[:1]
    np.testing.assert_allclose(non_local_mean(one, 0), one[0], atol=1e-6)
    np.testing.assert_allclose(low_rank_plus_sparse(np.zeros_like(one))[0], 0)


def test_weights_of_zero_count_as_equal():
    frames = np.stack([np.zeros((2, 3, 1), np.float32), np.ones((2, 3, 1), np.float32)])
    weights = np.zeros((2, 2, 3), np.float32)
    weights[1, 0] = 1
    np.testing.assert_allclose(weighted_mean(frames, weights)[..., 0], [[1, 1, 1], [0.5, 0.5, 0.5]])


def test_luminance_and_local_mean():
    assert float(luminance(np.ones((1, 1, 3), np.float32))[0, 0]) == pytest.approx(1, abs=1e-6)
    point = np.zeros((2, 9, 9), np.float32)
    point[0, 4, 4] = 9
    np.testing.assert_allclose(local_mean(point, 1)[0, 3:6, 3:6], 1, atol=1e-6)
    assert not local_mean(point, 1)[1].any()


def test_bad_input():
    clip = np.zeros((3, 8, 8, 3), np.float32)
    with pytest.raises(ParameterError, match="index = 3 is outside"):
        non_local_mean(clip, 3)
    with pytest.raises(ParameterError, match="weight"):
        low_rank_plus_sparse(clip, weight=0.0)
    with pytest.raises(InputError, match="a clip is"):
        temporal_mean(clip[0])
    with pytest.raises(InputError, match="NaN"):
        check_clip(np.full((1, 2, 2, 3), np.nan, np.float32))
