r"""Lucky fusion: one picture from the best parts of many registered frames.

Seeing changes from frame to frame and from place to place. With S_t(x) a sharpness (`turbnet.classical.sharpness`),

.. math::
    \text{soft:}\quad w_t = \frac{S_t^p}{\sum_s S_s^p} \qquad\qquad
    \text{hard:}\quad w_t = \tfrac1k \ \text{for the k sharpest frames at x, else 0}

and the fused picture is sum_t w_t I_t, pixel by pixel or, without seams whatever the weights, patch by patch: overlapping
patches under raised-cosine windows that sum to one (`patch_fusion`).

**Fourier burst accumulation** judges every spatial frequency by itself: a blur can only weaken it, so

.. math:: \hat u = \sum_t w_t \hat I_t, \qquad w_t(f) = \frac{|\bar I_t(f)|^p}{\sum_s |\bar I_s(f)|^p}

with bar I the modulus smoothed over f, its mean over the channels. p = 0 is the mean, p -> infinity the greatest at each
frequency. Delbracio & Sapiro, IEEE TCI 1, 270 (2015).
"""

import numpy as np

from turbnet.classical.local import Array, check_clip
from turbnet.classical.reference import weighted_mean
from turbnet.errors import check_range


def soft_weights(sharpness_THW: Array, power: float = 2.0) -> Array:
    """S^p / sum S^p over time, (T, H, W); equal where all are 0.

    Args:
        sharpness_THW: non-negative.
        power: p, 0 to 64.
    """
    check_range("power", power, 0.0, 64.0)
    best = sharpness_THW.max(axis=0)
    relative = np.divide(sharpness_THW, best, out=np.ones_like(sharpness_THW), where=best > 0) ** np.float32(power)
    return relative / relative.sum(axis=0)


def hard_weights(sharpness_THW: Array, share: float = 0.25) -> Array:
    """1/k for the k sharpest frames at each pixel and 0 for the others, (T, H, W).

    Args:
        share: k/T, above 0 to 1; k is rounded and at least 1.
    """
    check_range("share", share, 1e-6, 1.0)
    keep = max(round(share * len(sharpness_THW)), 1)
    rank = np.argsort(np.argsort(-sharpness_THW, axis=0, kind="stable"), axis=0)
    return (rank < keep).astype(np.float32) / np.float32(keep)


def fuse(frames_THWC: Array, weights_THW: Array) -> Array:
    """sum_t w_t I_t / sum_t w_t at every pixel, (H, W, C)."""
    return weighted_mean(check_clip(frames_THWC), weights_THW)


def patch_fusion(frames_THWC: Array, weights_THW: Array, patch: int = 32) -> Array:
    """Fusion patch by patch, (H, W, C): a patch of a frame enters as a whole, with the mean weight over it.

    Args:
        weights_THW: non-negative.
        patch: side, pixels, 2 to 1024; neighbours overlap by half.
    """
    check_range("patch", patch, 2, 1024, "pixels")
    clip = check_clip(frames_THWC)
    _, height, width, channels = clip.shape
    half = patch // 2
    patch = 2 * half
    margins = [(half, half + -side % half) for side in (height, width)]
    padded = np.pad(clip, [(0, 0), *margins, (0, 0)], mode="symmetric")
    weights = np.pad(weights_THW, [(0, 0), *margins], mode="symmetric")
    ramp = np.sin(np.pi * (np.arange(patch) + 0.5) / patch) ** 2
    window = np.outer(ramp, ramp).astype(np.float32)[..., None]
    fused = np.zeros(padded.shape[1:], np.float32)
    for top in range(0, padded.shape[1] - patch + 1, half):
        for left in range(0, padded.shape[2] - patch + 1, half):
            place = np.s_[top : top + patch, left : left + patch]
            mean = weights[(slice(None), *place)].mean(axis=(1, 2))
            mean = mean / mean.sum() if mean.any() else np.full(len(clip), 1 / len(clip))
            fused[place] += window * np.tensordot(mean.astype(np.float32), padded[(slice(None), *place)], 1)
    return fused[half : half + height, half : half + width]


def fourier_burst(frames_THWC: Array, power: float = 11.0, smoothing: float = 0.02) -> Array:
    """Fourier burst accumulation of registered frames, (H, W, C).

    Args:
        power: p, 0 to 64.
        smoothing: standard deviation over which the moduli are smoothed, as a share of the band, 0 to 1.
    """
    from scipy.fft import irfft2, rfft2
    from scipy.ndimage import gaussian_filter

    check_range("power", power, 0.0, 64.0)
    check_range("smoothing", smoothing, 0.0, 1.0)
    clip = check_clip(frames_THWC)
    height, width = clip.shape[1:3]
    spectrum = rfft2(clip, axes=(1, 2))
    modulus = np.abs(spectrum).mean(axis=-1)
    if smoothing > 0:  # rows wrap around, columns end at the middle of the band
        sigma = smoothing * height, smoothing * width
        modulus = gaussian_filter(modulus, sigma, axes=(1, 2), mode=("wrap", "reflect"))
    weights = soft_weights(modulus, power)
    return irfft2(np.einsum("thw,thwc->hwc", weights, spectrum), s=(height, width), axes=(0, 1))
