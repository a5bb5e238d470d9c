r"""Reference frames: one still picture of what a clip shows, free of dance though not of blur.

**Temporal mean.** R = 1/T sum_t I_t. Right where nothing moves; moving objects are smeared along their way.

**Low rank plus sparse** (robust principal components). The clip as a matrix M (pixels, T) is taken apart by

.. math:: \min \|L\|_* + \lambda \|S\|_1 \quad \text{such that}\quad L + S = M, \qquad \lambda = 1/\sqrt{\max(HWC, T)}

L is the still scene, S what moves and flickers. Inexact augmented Lagrangian: Lin, Chen & Ma, arXiv:1009.5055 (2010).

**Non-local mean.** A frame is averaged with the others only where they show the same thing,

.. math::
    R_t = \frac{\sum_s w_s\, I_s}{\sum_s w_s}, \qquad
    w_s = \exp\{-d_s / 2 h \sigma^2\}, \qquad
    d_s(x) = \tfrac12 \overline{e_{st}^2 + e_{ts}^2}

e_st(x) is how far the luminance of frame t at x lies outside the range that frame s covers within four pixels of x:
dance moves things within that range and gives 0, what another frame does not have gives the whole difference. The bar is
a mean over the patch around x; sigma^2(x), the patch mean of the robust variance over time, is the scale of what dance
and noise do there; h = 0.1. For a still scene w is near 1 and R near the mean; what moves is kept as frame t has it.
Patches: Buades, Coll & Morel, CVPR (2005), here along time; over turbulence: Mao, Chimitt & Chan, IEEE TCI 6, 1415 (2020).
"""

from collections.abc import Iterator

import numpy as np

from turbnet.classical.local import Array, check_clip, local_mean, luminance
from turbnet.errors import ParameterError, check_range
from turbnet.simulate.parallel import on_all_cores

REACH = 4
"""How far dance may carry things for frames to count as alike, pixels."""

PATCH = 5
"""Half the side of the patches that are compared, pixels."""

_TOLERANCE = np.float32(0.1)  # h: of still scenes at D/r0 = 3, d / 2 sigma^2 is below it on 97 % of the pixels
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


class Similarity:
    """Where other frames of a clip show what one shows.

    Args:
        luminance_THW: of the clip.
        radius: patches are (2 radius + 1)^2 pixels.
    """

    def __init__(self, luminance_THW: Array, radius: int = PATCH) -> None:
        from scipy.ndimage import maximum_filter, minimum_filter

        self._y, self._radius = luminance_THW, radius
        self._highest, self._lowest = (
            extreme(luminance_THW, size=2 * REACH + 1, axes=(1, 2)) for extreme in (maximum_filter, minimum_filter)
        )
        self._scale = 2 * _TOLERANCE * still_variance(luminance_THW, radius)

    def weights(self, index: int) -> Array:
        """w (T, H, W) of every frame for frame `index`; one at `index` itself."""
        weights = np.empty_like(self._y)
        for s, y in enumerate(self._y):
            here = _outside(self._y[index], self._lowest[s], self._highest[s])
            there = _outside(y, self._lowest[index], self._highest[index])
            weights[s] = np.exp(-local_mean(0.5 * (here**2 + there**2), self._radius) / self._scale)
        return weights


def _outside(value: Array, lowest: Array, highest: Array) -> Array:
    """How far a value lies outside a range."""
    return np.asarray(np.maximum(np.maximum(value - highest, lowest - value), 0), np.float32)


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
    return weighted_mean(clip, Similarity(luminance(clip), radius).weights(index))


def non_local_means(
    frames_THWC: Array, weights_THW: Array | None = None, radius: int = PATCH, cores: int = 1
) -> Iterator[Array]:
    """Yield `non_local_mean` of every frame in turn.

    Args:
        weights_THW: factors beside the similarity, a sharpness for instance; None: all one.
        cores: frames at a time.
    """
    clip = check_clip(frames_THWC)
    similarity = Similarity(luminance(clip), radius)

    def one(index: int) -> Array:
        weights = similarity.weights(index)
        return weighted_mean(clip, weights if weights_THW is None else weights * weights_THW)

    yield from on_all_cores(one, range(len(clip)), cores)


def weighted_mean(frames_THWC: Array, weights_THW: Array) -> Array:
    """sum_t w_t I_t / sum_t w_t at every pixel, (H, W, C); weights of zero everywhere count as equal."""
    total = weights_THW.sum(axis=0)
    nowhere = total <= 0
    mean = np.zeros(frames_THWC.shape[1:], np.float32)
    for frame_HWC, weight_HW in zip(frames_THWC, weights_THW, strict=True):
        mean += frame_HWC * np.where(nowhere, np.float32(1), weight_HW)[..., None]
    return np.divide(mean, np.where(nowhere, np.float32(len(frames_THWC)), total)[..., None], dtype=np.float32)
