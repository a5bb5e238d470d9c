r"""How wide turbulence makes the image of a point: equivalent widths, from theory and from draws.

An equivalent width is that of the Gaussian as sharp as a point-spread function b or transfer function H,

.. math:: \frac{1}{4\pi\sigma^2} = \sum_x b(x)^2 = \int |H(f)|^2\, d^2f,

which exists where the second moment of a diffraction-limited spot does not, and does not depend on where the spot is.
"""

from functools import lru_cache

import numpy as np
import torch
from scipy.interpolate import BSpline, make_interp_spline
from torch import Tensor

from turbnet.atmosphere.exposure import tilt_free_otf
from turbnet.atmosphere.noll import noll_matrix
from turbnet.errors import check_range
from turbnet.simulate.psf_basis import tilt_free_psf

STRONGEST = 10.0
"""Largest D/r0 of tables and simple models."""

_STRENGTHS = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.5, 8.0, STRONGEST])


def equivalent_sigma(psf_Pkk: Tensor) -> Tensor:
    """Standard deviation of the Gaussian as sharp as each PSF, (P,), pixels."""
    return (4 * np.pi * psf_Pkk.square().sum((-2, -1))).rsqrt()


def short_exposure_sigma(d_over_r0: float) -> float:
    """Equivalent width of the mean tilt-free PSF of all Zernike modes, diffraction included, Nyquist pixels.

    Raises:
        ParameterError: D/r0 outside 0 .. 10.
    """
    return float(np.exp(_short_exposure_table()(check_range("D/r0", d_over_r0, 0.0, STRONGEST))))


def width_statistics(d_over_r0: float) -> tuple[float, float]:
    """Mean and standard deviation of the equivalent width of single tilt-free PSFs (`tilt_free_psf`), Nyquist pixels.

    Raises:
        ParameterError: D/r0 outside 0 .. 10.
    """
    mean, spread = _width_table()(check_range("D/r0", d_over_r0, 0.0, STRONGEST))
    return float(mean), float(max(spread, 0.0))


@lru_cache(maxsize=1)
def _short_exposure_table() -> BSpline:
    """log sigma over D/r0."""
    x, weight = np.polynomial.legendre.leggauss(12)
    frequency = 0.5 * (x + 1)  # in units of the cutoff, half a cycle per pixel
    area = 2 * np.pi * 0.25 * 0.5 * weight * frequency
    sharpness = np.array([area @ tilt_free_otf(frequency, strength) ** 2 for strength in _STRENGTHS])
    return make_interp_spline(_STRENGTHS, -0.5 * np.log(4 * np.pi * sharpness), k=3)


@lru_cache(maxsize=1)
def _width_table(modes: int = 36, samples: int = 4000) -> BSpline:
    """Mean and spread over D/r0, from the same seeded Kolmogorov draws at every strength."""
    factor = torch.as_tensor(np.linalg.cholesky(noll_matrix(range(4, modes + 1))), dtype=torch.float32)
    high = torch.randn(samples, modes - 3, generator=torch.Generator().manual_seed(0)) @ factor.T
    rows = []
    for strength in _STRENGTHS:
        widths = equivalent_sigma(torch.cat([tilt_free_psf(part) for part in (high * strength ** (5 / 6)).split(500)]))
        rows.append((float(widths.mean()), float(widths.std())))
    return make_interp_spline(_STRENGTHS, np.array(rows), k=3)
