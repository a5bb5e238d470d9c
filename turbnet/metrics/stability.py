r"""How still a restored clip of a still scene is.

.. math::
    \text{jitter} = \sqrt{\tfrac{1}{2}\,\bigl\langle |d_w(t) - \langle d_w\rangle_t|^2 \bigr\rangle_{t,w}}, \qquad
    \text{flicker} = \sqrt{\bigl\langle (m(t) - \langle m\rangle_t)^2 \bigr\rangle_t}

with d_w(t) the shift of window w of frame t against the mean of the clip (`turbnet.metrics.registration`), so jitter is
the standard deviation of an axis, in pixels, comparable with that of the turbulent tilts; and m(t) the mean of frame t,
full scale 1. Noise adds to the jitter: a window of texture g and noise sigma has sigma / (g sqrt(pixels)) of it.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from turbnet.errors import InputError
from turbnet.metrics.registration import estimate_displacements

Picture = NDArray[np.floating[Any]]


def jitter(frames: Iterable[Picture], mean: Picture) -> float:
    """Residual motion in pixels, root mean square of an axis.

    Args:
        frames: (H, W, C) each, in [0, 1]; at least two.
        mean: their mean over time.

    Raises:
        InputError: fewer than two frames, no window with texture, NaN.
    """
    displacements_TW2 = np.stack([estimate_displacements(frame, mean) for frame in frames])
    if len(displacements_TW2) < 2:
        raise InputError("a clip of one frame has no jitter")
    textured = displacements_TW2[:, np.isfinite(displacements_TW2).all((0, 2))]
    if textured.shape[1] == 0:
        raise InputError("the clip is too flat for motion to be seen")
    return float(np.sqrt(np.mean((textured - textured.mean(0)) ** 2)))


def flicker(levels: NDArray[np.floating[Any]]) -> float:
    """Standard deviation over time of the frames' mean values (T,)."""
    return float(np.std(levels))
