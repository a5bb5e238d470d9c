r"""Sharpness and noise of a frame that has no reference.

.. math::
    \text{sharpness} = \langle (\partial_x I)^2 + (\partial_y I)^2 \rangle, \qquad
    \sigma = \sqrt{\tfrac{\pi}{2}}\;\tfrac{1}{6}\,\langle |N * I| \rangle, \quad
    N = \begin{pmatrix} 1 & -2 & 1 \\ -2 & 4 & -2 \\ 1 & -2 & 1 \end{pmatrix}

Sharpness is gradient energy by central differences, full scale^2 / pixel^2; noise of standard deviation sigma a pixel
adds sigma^2 to it (half from each axis), so it compares pictures of like noise only. N is blind to planes and parabolas
and sees noise six times enlarged (J. Immerkaer, Comput. Vis. Image Underst. 64, 300 (1996)); fine texture counts as
noise.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from turbnet.errors import InputError

Picture = NDArray[np.floating[Any]]


def sharpness(frame: Picture) -> float:
    """Gradient energy of a frame (H, W, C) in [0, 1], mean over pixels and channels.

    Raises:
        InputError: smaller than 3 x 3 pixels, or NaN.
    """
    frame = _checked(frame)
    across, down = frame[1:-1, 2:] - frame[1:-1, :-2], frame[2:, 1:-1] - frame[:-2, 1:-1]
    return float((across**2 + down**2).mean() / 4)


def noise_level(frame: Picture) -> float:
    """Standard deviation of white noise in a frame (H, W, C) in [0, 1]; errors as `sharpness`."""
    frame = _checked(frame)
    across = frame[:, 2:] - 2 * frame[:, 1:-1] + frame[:, :-2]
    filtered = across[2:] - 2 * across[1:-1] + across[:-2]
    return float(np.sqrt(np.pi / 2) / 6 * np.abs(filtered).mean())


def _checked(frame: Picture) -> NDArray[np.float64]:
    if frame.ndim != 3 or min(frame.shape[:2]) < 3:
        raise InputError(f"a frame of shape {frame.shape} has no sharpness; it must be (H, W, C), 3 x 3 pixels or more")
    if not np.isfinite(frame).all():
        raise InputError("the frame holds NaN or infinite pixels")
    return np.asarray(frame, dtype=np.float64)
