r"""Exact mean transfer function of the tilt-free wave, where Fried's short-exposure formula is an approximation.

With phi Gaussian and phi' = phi - a_2 Z_2 - a_3 Z_3, the transfer function at the shift s is the mean over the overlap
of the aperture with itself of

.. math::
    \exp\{-\tfrac12 E[(\phi'(x) - \phi'(x+s))^2]\}, \qquad
    E[\cdot] = D(s) - 2 \sum_{i=2,3} \Delta Z_i\, \Delta h_i + \sum_{i=2,3} (\Delta Z_i)^2\, E[a_i^2]

where Delta takes the difference between x and x + s and h_i(x) = E[a_i phi(x)] up to a constant, which for a mode of
zero mean is -1/2 the aperture's average of Z_i(y) D(x - y). Source: J. Y. Wang and J. K. Markey, JOSA 68, 78 (1978).
"""

import numpy as np
from scipy.signal import fftconvolve

from turbnet.atmosphere.noll import noll_covariance
from turbnet.atmosphere.profiles import Array
from turbnet.errors import check_range
from turbnet.optics.pupil import circular, pupil_grid


def tilt_free_otf(points: int, d_over_r0: float) -> Array:
    """Mean OTF of aperture and tilt-free Kolmogorov phase, (2 points, 2 points), 1 at zero shift, which comes first.

    Args:
        points: samples across the aperture; a shift of `points` samples is the cutoff D / lambda.
        d_over_r0: D/r0, near field (phase fluctuations only).

    Raises:
        ParameterError: points outside 8 .. 128, or D/r0 outside 0 .. 100.
    """
    check_range("pupil points", points, 8, 128)
    strength = check_range("D/r0", d_over_r0, 0.0, 100.0) ** (5 / 3)
    x, y = pupil_grid(points)
    inside = circular(points) > 0
    tilts = np.stack([2 * x * inside, 2 * y * inside])
    shift = np.arange(1 - points, points) / points
    structure = 6.88 * strength * np.hypot(shift[:, None], shift) ** (5 / 3)
    weights = tilts / (tilts**2).sum(axis=(1, 2), keepdims=True)
    shared = np.stack([-0.5 * fftconvolve(structure, weight, mode="valid") for weight in weights])
    variance = noll_covariance(2, 2) * strength
    otf = np.zeros((2 * points, 2 * points))
    for row in range(points):
        for column in range(1 - points, points):
            a = (slice(0, points - row), slice(max(0, -column), points - max(0, column)))
            b = (slice(row, points), slice(max(0, column), points + min(0, column)))
            both = inside[a] & inside[b]
            tilt = (tilts[:, *b] - tilts[:, *a])[:, both]
            common = (shared[:, *b] - shared[:, *a])[:, both]
            fluctuation = structure[row + points - 1, column + points - 1] + (
                variance * tilt**2 - 2 * tilt * common
            ).sum(0)
            otf[row, column] = otf[-row, -column] = np.exp(-0.5 * fluctuation).sum()
    return otf / otf[0, 0]
