r"""Mean transfer functions of long and short exposures.

.. math::
    H_{LE}(f) = \exp\{-3.44\,(\lambda L f / r_0)^{5/3}\}, \qquad
    H_{SE}(f) = \exp\{-3.44\,(\lambda L f / r_0)^{5/3}\,[1 - \alpha\,(\lambda L f / D)^{1/3}]\}

times the OTF of the aperture. Here f is in units of the cutoff, D / (lambda L) cycles per metre of the scene, so that
lambda L f / r0 becomes f D/r0. A long exposure averages over the wandering of the image, a short one (as the mean of
frames put back in place) does not. Source: D. L. Fried, JOSA 56, 1372 (1966); the exponent 5/3 is missing in some
printed texts.
"""

import numpy as np

from turbnet.atmosphere.profiles import Array
from turbnet.errors import check_range
from turbnet.optics.psf import diffraction_mtf


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
