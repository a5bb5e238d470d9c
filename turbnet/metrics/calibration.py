r"""Whether a network knows how wrong it is: an uncertainty map beside the errors that were really made.

A map gives the scale b of a Laplace distribution of the error r at each pixel, p(r) = e^{-|r| / b} / 2b, so that

.. math::
    P(|r| \le q_p\, b) = p, \qquad q_p = -\ln(1 - p).

- *Reliability*: the share of errors within q_p b against p; the expected calibration error is the mean distance of the two.
- *Temperature*: the factor tau on b that makes the errors most likely; for Laplace it is the mean of |r| / b.
- *Sparsification*: the mean error of the pixels left when the most uncertain are taken away, over that of all; AUSE is
  the area between this curve and the oracle's, which takes the worst away first (Ilg et al., ECCV 2018).
- *Rank correlation*: Spearman's, of map and error.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr

from turbnet.errors import InputError

Array = NDArray[np.float64]

LEVELS = np.linspace(0.05, 0.95, 19)
"""Probabilities p at which reliability is looked at."""
STEPS = 50
"""Points of a sparsification curve."""


def reliability(residual: Array, scale: Array) -> Array:
    """Share of the errors |residual| within q_p scale, at each of `LEVELS`, (19,).

    Raises:
        InputError: shapes differ, nothing to look at, values that are not finite, a scale that is not positive.
    """
    ratio = _ratio(residual, scale)
    return np.array([(ratio <= -np.log1p(-p)).mean() for p in LEVELS])


def calibration_error(residual: Array, scale: Array) -> float:
    """Expected calibration error, 0 to 1; raises as `reliability`."""
    return float(np.abs(reliability(residual, scale) - LEVELS).mean())


def temperature(residual: Array, scale: Array) -> float:
    """tau, by which a scale is to be multiplied; raises as `reliability`."""
    return float(_ratio(residual, scale).mean())


def sparsification(error: Array, uncertainty: Array) -> Array:
    """Mean error of what is left when a share f of the most uncertain is taken away, over that of all; f = 0, 1/50 .. 49/50.

    Raises:
        InputError: as `reliability`; errors that are negative.
    """
    error, uncertainty = _pair(error, uncertainty)
    if (error < 0).any():
        raise InputError("errors must not be negative; give their absolute values")
    kept = error[np.argsort(-uncertainty, kind="stable")]
    total = kept[::-1].cumsum()[::-1]
    starts = (np.arange(STEPS) * len(kept)) // STEPS
    left = total[starts] / (len(kept) - starts)
    return left / left[0] if left[0] > 0 else np.ones(STEPS)


def ause(error: Array, uncertainty: Array) -> float:
    """Area under the sparsification error: 0 for a map that ranks errors as they are; raises as `sparsification`."""
    return float((sparsification(error, uncertainty) - sparsification(error, error)).mean())


def rank_correlation(error: Array, uncertainty: Array) -> float:
    """Spearman's rank correlation, -1 to 1; 0 where either is the same everywhere; raises as `reliability`."""
    error, uncertainty = _pair(error, uncertainty)
    if np.ptp(error) == 0 or np.ptp(uncertainty) == 0:
        return 0.0
    return float(spearmanr(error, uncertainty).statistic)


def _ratio(residual: Array, scale: Array) -> Array:
    residual, scale = _pair(residual, scale)
    if (scale <= 0).any():
        raise InputError("a scale must be positive everywhere")
    return np.abs(residual) / scale


def _pair(first: Array, second: Array) -> tuple[Array, Array]:
    first, second = np.asarray(first, np.float64), np.asarray(second, np.float64)
    if first.shape != second.shape or not first.size:
        raise InputError(f"errors {first.shape} and their map {second.shape} must be of one shape, not empty")
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        raise InputError("errors and their map must be finite")
    return first.ravel(), second.ravel()
