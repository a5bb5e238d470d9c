"""Local averages and luminance: what reference frames, sharpness and registration share.

Pictures are (H, W) or (H, W, C), clips (T, H, W) or (T, H, W, C), linear intensities.
"""

import numpy as np
from numpy.typing import NDArray

from turbnet.errors import InputError

Array = NDArray[np.float32]

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""Rec. 709: the luminance of linear R, G, B."""


def luminance(picture: Array) -> Array:
    """Y = 0.2126 R + 0.7152 G + 0.0722 B of linear (..., H, W, 3); a single channel (..., H, W, 1) as it is."""
    return picture[..., 0] if picture.shape[-1] == 1 else picture @ _LUMINANCE


def local_mean(picture: Array, radius: int) -> Array:
    """Mean over the square of (2 radius + 1)^2 pixels around each, over the last two axes (..., H, W)."""
    from scipy.ndimage import uniform_filter

    return uniform_filter(picture, size=2 * radius + 1, axes=(-2, -1), mode="reflect")


def check_clip(frames_THWC: Array) -> Array:
    """The clip in float32.

    Raises:
        InputError: it is not (T, H, W, C) with T >= 1, or holds values that are not finite.
    """
    if frames_THWC.ndim != 4 or 0 in frames_THWC.shape:
        raise InputError(
            f"a clip is (frames, height, width, channels), none of them 0; this one is {frames_THWC.shape}"
        )
    if not np.isfinite(frames_THWC).all():
        raise InputError("the clip holds NaN or infinite values")
    return np.asarray(frames_THWC, np.float32)
