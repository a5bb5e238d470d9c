r"""How each frame of a still camera is exposed, seen from a background that it has shown before.

Cameras change their exposure with what stands before them. The means m_t of the blocks of frame t follow those of the
background,

.. math::
    m_t = a_t m + b_t

but where something else is to be seen, which a fit by least absolute departures is not swayed by.
"""

from dataclasses import dataclass

import numpy as np

LAST_BIT = 0.75 / 255
"""Of eight, full scale 1: what varies by less does not show."""

_FLAT = 0.01**2  # variance of the means of blocks of a scene that tells no slope


@dataclass(frozen=True)
class Exposure:
    """Every frame's slope a_t and level b_t, (T, 1, 1)."""

    slope: np.ndarray
    level: np.ndarray

    def shown(self, picture_CHW: np.ndarray) -> np.ndarray:
        """The picture as each frame was exposed, (T, C, H, W) float32."""
        slope, level = (x[:, None].astype(np.float32) for x in (self.slope, self.level))
        frames: np.ndarray = picture_CHW * slope + level
        return frames

    def taken_out(self, frames: np.ndarray) -> np.ndarray:
        """Frames (T, ..., h, w) as if all had been exposed like the background."""
        slope, level = (x.reshape(-1, *[1] * (frames.ndim - 1)).astype(frames.dtype) for x in (self.slope, self.level))
        alike: np.ndarray = (frames - level) / slope
        return alike

    def mean(self, frames_TCHW: np.ndarray) -> np.ndarray:
        """That of the frames taken out, (C, H, W) float32."""
        weights = (1 / self.slope / len(frames_TCHW)).ravel()
        level = float((weights * self.level.ravel()).sum())
        picture: np.ndarray = np.tensordot(weights.astype(np.float32), frames_TCHW, 1) - np.float32(level)
        return picture


def exposures(expected_hw: np.ndarray, means_Thw: np.ndarray) -> Exposure:
    """How each frame is exposed: as expected, unless another exposure explains a good part of a departure that shows.

    Args:
        expected_hw: means of the blocks of a background.
        means_Thw: of the same blocks of frames, most of which show it.
    """
    x, y = expected_hw.ravel(), means_Thw.reshape(len(means_Thw), -1)
    slope, level, weights = np.ones((len(y), 1)), np.zeros((len(y), 1)), np.ones_like(y)
    for _ in range(20):
        total = weights.sum(1, keepdims=True)
        middle, mean = (weights * x).sum(1, keepdims=True) / total, (weights * y).sum(1, keepdims=True) / total
        off = x - middle
        # A flat scene tells no slope.
        common, own = (weights * off * (y - mean)).sum(1, keepdims=True), (weights * off**2).sum(1, keepdims=True)
        slope = (common + _FLAT * total) / (own + _FLAT * total)
        level = mean - slope * middle
        weights = 1 / (np.abs(y - slope * x - level) + 1e-3)
    before, after = (np.median(np.abs(y - fit), axis=1, keepdims=True) for fit in (x, slope * x + level))
    other = (before > LAST_BIT) & (after < 0.7 * before) & (slope > 0.5) & (slope < 2)
    return Exposure(np.where(other, slope, 1)[..., None], np.where(other, level, 0)[..., None])
