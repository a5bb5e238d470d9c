r"""Reference frames: one still picture of what a clip shows, free of dance though not of blur.

**Temporal mean.** R = 1/T sum_t I_t. Right where nothing moves; moving objects are smeared along their way.

**Low rank plus sparse** (robust principal components). The clip as a matrix M (pixels, T) is taken apart by

.. math:: \min \|L\|_* + \lambda \|S\|_1 \quad \text{such that}\quad L + S = M, \qquad \lambda = 1/\sqrt{\max(HWC, T)}

L is the still scene, S what moves and flickers. Inexact augmented Lagrangian: Lin, Chen & Ma, arXiv:1009.5055 (2010).

**Non-local mean.** A frame is averaged with the others only where they show the same thing,

.. math::
    R_t = \frac{\sum_s w_s\, I_s}{\sum_s w_s}, \qquad
    w_s = \exp\{-\max(d_s / 2\sigma^2 - 1,\ 0)\}, \qquad
    d_s(x) = \overline{(Y_s - Y_t)^2}

with the bar a mean over the patch around x and Y the luminance. sigma^2(x), the patch mean of the robust variance over
time, is what dance and noise do at x by themselves: two frames of a still scene differ by 2 sigma^2, so w is near 1 there
and R near the mean. What moves differs by more and is kept as frame t has it. Patches: Buades, Coll & Morel, CVPR (2005), here
along time alone; over turbulence: Mao, Chimitt & Chan, IEEE TCI 6, 1415 (2020).
"""

from collections.abc import Iterator

import numpy as np

from turbnet.classical.local import Array, check_clip, local_mean, luminance
from turbnet.errors import ParameterError, check_range
from turbnet.simulate.parallel import on_all_cores

PATCH = 5
"""Half the side of the patches that are compared, pixels."""

_QUANTUM = (1 / 255) ** 2 / 12  # variance of rounding to 8 bits: no two frames are more alike than this


def temporal_mean(frames_THWC: Array) -> Array:
    """Mean over time, (H, W, C)."""
    return check_clip(frames_THWC).mean(axis=0)


def low_rank_plus_sparse(
    frames_THWC: Array, weight: float | None = None, tolerance: float = 1e-5, iterations: int = 100
) -> tuple[Array, Array]:
    """The still and the moving part of a clip, each (T, H, W, C); they add up to the clip within `tolerance`.

    Args:
        weight: lambda, the price of what moves; None: 1 / sqrt(max(H W C, T)).
        tolerance: ends when |M - L - S| is below it, relative to |M|.
        iterations: at most so many.

    Raises:
        ParameterError: a weight or tolerance that is not positive.
    """
    clip = check_clip(frames_THWC)
    frames = len(clip)
    matrix = clip.reshape(frames, -1).astype(np.float64)  # (T, pixels): the transpose changes nothing
    weight = 1 / np.sqrt(max(matrix.shape)) if weight is None else weight
    if weight <= 0 or tolerance <= 0:
        raise ParameterError(f"weight = {weight:g} and tolerance = {tolerance:g} must both be positive")
    size = np.linalg.norm(matrix)
    largest = float(np.linalg.norm(matrix @ matrix.T, 2)) ** 0.5
    if size == 0:
        return clip, np.zeros_like(clip)
    multiplier = matrix / max(largest, np.abs(matrix).max() / weight)
    sparse = np.zeros_like(matrix)
    penalty = 1.25 / largest
    for _ in range(iterations):
        low = _shrink_singular_values(matrix - sparse + multiplier / penalty, 1 / penalty)
        rest = matrix - low + multiplier / penalty
        sparse = np.sign(rest) * np.maximum(np.abs(rest) - weight / penalty, 0)
        gap = matrix - low - sparse
        multiplier += penalty * gap
        penalty *= 1.5
        if np.linalg.norm(gap) < tolerance * size:
            break
    return low.reshape(clip.shape).astype(np.float32), sparse.reshape(clip.shape).astype(np.float32)


def _shrink_singular_values(matrix: np.ndarray, threshold: float) -> np.ndarray:
    """U max(s - threshold, 0) V^T of a wide matrix, from the eigenvectors of its small Gram matrix."""
    squares, vectors = np.linalg.eigh(matrix @ matrix.T)
    values = np.sqrt(np.maximum(squares, 1e-300))
    kept = values > threshold
    vectors, shrink = vectors[:, kept], 1 - threshold / values[kept]
    return (vectors * shrink) @ (vectors.T @ matrix)


def still_variance(luminance_THW: Array, radius: int = PATCH) -> Array:
    """sigma^2 (H, W): variance over time by the median deviation, (1.4826 MAD)^2, averaged over patches.

    What covers a pixel in fewer than half of the frames does not enter.
    """
    deviation = np.abs(luminance_THW - np.median(luminance_THW, axis=0))
    robust = np.asarray(1.4826 * np.median(deviation, axis=0), np.float32)
    return local_mean(robust**2, radius) + np.float32(_QUANTUM)


def similarity(luminance_THW: Array, index: int, variance_HW: Array, radius: int = PATCH) -> Array:
    """w (T, H, W) of every frame for frame `index`: one where they show the same thing, and at `index` itself."""
    difference = local_mean((luminance_THW - luminance_THW[index]) ** 2, radius)
    return np.exp(-np.maximum(difference / (2 * variance_HW) - 1, 0))


def non_local_mean(frames_THWC: Array, index: int, radius: int = PATCH) -> Array:
    """Frame `index` averaged over time with what shows the same, (H, W, C).

    Args:
        index: the frame whose moving objects are kept, 0 to T - 1.
        radius: patches are (2 radius + 1)^2 pixels.

    Raises:
        ParameterError: there is no such frame.
    """
    clip = check_clip(frames_THWC)
    index = int(check_range("index", index, 0, len(clip) - 1))
    y = luminance(clip)
    return weighted_mean(clip, similarity(y, index, still_variance(y, radius), radius))


def non_local_means(
    frames_THWC: Array, weights_THW: Array | None = None, radius: int = PATCH, cores: int = 1
) -> Iterator[Array]:
    """Yield `non_local_mean` of every frame in turn.

    Args:
        weights_THW: factors beside the similarity, a sharpness for instance; None: all one.
        cores: frames at a time.
    """
    clip = check_clip(frames_THWC)
    y = luminance(clip)
    variance_HW = still_variance(y, radius)

    def one(index: int) -> Array:
        weights = similarity(y, index, variance_HW, radius)
        return weighted_mean(clip, weights if weights_THW is None else weights * weights_THW)

    yield from on_all_cores(one, range(len(clip)), cores)


def weighted_mean(frames_THWC: Array, weights_THW: Array) -> Array:
    """sum_t w_t I_t / sum_t w_t at every pixel, (H, W, C); weights of zero everywhere count as equal."""
    total = weights_THW.sum(axis=0)
    nowhere = total <= 0
    mean = np.zeros(frames_THWC.shape[1:], np.float32)
    for frame_HWC, weight_HW in zip(frames_THWC, weights_THW, strict=True):
        mean += frame_HWC * np.where(nowhere, np.float32(1), weight_HW)[..., None]
    return mean / np.where(nowhere, np.float32(len(frames_THWC)), total)[..., None]
