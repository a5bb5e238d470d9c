r"""Mean transfer functions of long and short exposures.

.. math::
    H_{LE}(f) = \exp\{-3.44\,(\lambda L f / r_0)^{5/3}\}, \qquad
    H_{SE}(f) = \exp\{-3.44\,(\lambda L f / r_0)^{5/3}\,[1 - \alpha\,(\lambda L f / D)^{1/3}]\}

times the OTF of the aperture. f is in units of the cutoff, D / (lambda L) cycles per metre of the scene, so that
lambda L f / r0 becomes f D/r0. A long exposure averages over the wandering of the image, a short one (as the mean of
frames put back in place) does not.

H_LE is exact. H_SE takes the tilt to be independent of the tilt-free phase, which it is not: for frames whose Zernike
tilts are removed it is too low, at middle frequencies by 7 % at D/r0 = 1, 22 % at 2 and a factor 2.4 at 4.
`tilt_free_otf` is exact for them. Source: D. L. Fried, JOSA 56, 1372 (1966); the exponent 5/3 is missing in some
printed texts.
"""

import numpy as np

from turbnet.atmosphere.noll import noll_covariance
from turbnet.atmosphere.profiles import Array
from turbnet.errors import check_range
from turbnet.optics.psf import diffraction_mtf
from turbnet.optics.zernike import zernike


def long_exposure_factor(frequency: Array, d_over_r0: float) -> Array:
    """H_LE of the air alone at |f| in units of the cutoff D / lambda."""
    check_range("D/r0", d_over_r0, 0.0, 1e3)
    return np.exp(-3.44 * (np.abs(frequency) * d_over_r0) ** (5 / 3))


def short_exposure_factor(frequency: Array, d_over_r0: float, alpha: float = 1.0) -> Array:
    """H_SE of the air alone at |f| <= 1 in units of the cutoff D / lambda.

    Args:
        frequency: any shape.
        d_over_r0: D/r0.
        alpha: 1 in the near field (D above sqrt(lambda L)), 1/2 in the far field, where scintillation takes its share.
    """
    check_range("D/r0", d_over_r0, 0.0, 1e3)
    check_range("alpha", alpha, 0.0, 1.0)
    f = np.abs(frequency)
    return np.exp(-3.44 * (f * d_over_r0) ** (5 / 3) * (1 - alpha * f ** (1 / 3)))


def long_exposure_otf(frequency: Array, d_over_r0: float) -> Array:
    """OTF of air and circular aperture together, long exposure; frequency in units of the cutoff."""
    return diffraction_mtf(frequency) * long_exposure_factor(frequency, d_over_r0)


def short_exposure_otf(frequency: Array, d_over_r0: float, alpha: float = 1.0) -> Array:
    """OTF of air and circular aperture together, short exposure; frequency in units of the cutoff."""
    return diffraction_mtf(frequency) * short_exposure_factor(np.clip(frequency, -1, 1), d_over_r0, alpha)


def tilt_free_otf(frequency: Array, d_over_r0: float) -> Array:
    r"""Mean OTF of air and aperture together for frames whose Zernike tilts a_2, a_3 are removed, near field.

    .. math::
        H(f) = \frac1\pi \int \exp\{-\tfrac12 E[(\phi'(\rho_+) - \phi'(\rho_-))^2]\}\, d^2\rho, \qquad
        \rho_\pm = \rho \pm f \hat x, \quad \phi' = \phi - a_2 Z_2 - a_3 Z_3

    over the points for which both lie in the unit disk. The expectation is 6.88 (f D/r0)^(5/3) less what the tilt, with
    its correlation to the other modes of m = 1, explains of it.

    Args:
        frequency: in units of the cutoff, any shape.
        d_over_r0: D/r0.
    """
    check_range("D/r0", d_over_r0, 0.0, 1e3)
    f = np.minimum(np.abs(np.asarray(frequency, dtype=np.float64)), 1.0)
    return np.array([_tilt_free(value, d_over_r0 ** (5 / 3)) for value in f.ravel()]).reshape(f.shape)


def _tilt_free(f: float, strength: float) -> float:
    gauss, weight = np.polynomial.legendre.leggauss(32)
    angle = np.arccos(f) * gauss[:, None]  # the overlap of two disks, y = sin(angle), |x| <= cos(angle) - f
    half_width = np.cos(angle) - f
    x, y = half_width * gauss, np.sin(angle)
    area = np.arccos(f) * weight[:, None] * np.cos(angle) * half_width * weight
    explained = np.zeros_like(x)
    for order in range(1, 42, 2):
        first = order * (order + 1) // 2 + 1
        j = first + first % 2  # the cosine of m = 1 in this order
        plus, minus = (zernike(j, np.hypot(x + shift, y), np.arctan2(y, x + shift)) for shift in (f, -f))
        explained += noll_covariance(2, j) * (plus - minus)
    tilt = 4 * f  # Z_2(rho+) - Z_2(rho-)
    structure = 6.88 * f ** (5 / 3) - 2 * tilt * explained + tilt**2 * noll_covariance(2, 2)
    return float(np.sum(area * np.exp(-0.5 * strength * structure)) / np.pi)
