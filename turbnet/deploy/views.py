r"""A clip seen several ways: restored upright, turned and mirrored, and averaged.

The fluctuations of air that matter have no direction of their own, so a restoration of a turned or mirrored clip, turned
back, is as good as that of the clip itself, and what a network gets wrong is in part another thing each time:

.. math::
    \hat S = \frac{1}{N} \sum_{n=1}^{N} g_n^{-1} f(g_n I), \qquad g_n \in D_4

(Timofte et al., Seven ways to improve example-based single image super resolution, CVPR 2016). N times the work.
"""

from collections.abc import Callable

import numpy as np

from turbnet.errors import check_range

MOST = 8
"""The square's symmetries."""


class Views:
    """A network, averaged over views of the frames.

    Args:
        network: (1, T, C, h, w) -> (1, T, C, h, w), of any height and width.
        count: N, 1 to 8: upright, transposed, turned by half a turn, both, and their mirror images.

    Raises:
        ParameterError: `count` is out of range.
    """

    def __init__(self, network: Callable[[np.ndarray], np.ndarray], count: int) -> None:
        self._network, self.count = network, int(check_range("views", count, 1, MOST))

    def __call__(self, frames_BTCHW: np.ndarray) -> np.ndarray:
        """Restored frames, their mean over the views."""
        total = self._network(frames_BTCHW)
        for view in range(1, self.count):
            total = total + _seen(self._network(_seen(frames_BTCHW, view)), view, back=True)
        return total / np.float32(self.count)


def _seen(frames_BTCHW: np.ndarray, view: int, back: bool = False) -> np.ndarray:
    """The frames in a view, or a view's frames upright again."""
    transposed, turned, mirrored = view & 1, view & 2, view & 4
    if transposed and not back:
        frames_BTCHW = frames_BTCHW.swapaxes(-1, -2)
    if turned:
        frames_BTCHW = frames_BTCHW[..., ::-1, ::-1]
    if mirrored:
        frames_BTCHW = frames_BTCHW[..., ::-1]
    if transposed and back:
        frames_BTCHW = frames_BTCHW.swapaxes(-1, -2)
    return np.ascontiguousarray(frames_BTCHW)
