r"""How often a short exposure is nearly free of turbulence.

A frame is lucky when the mean square of its tilt-free phase over the aperture is at most 1 rad^2:

.. math::
    P = \Pr\Big[\Delta^2 = \sum_{j \ge 4} a_j^2 \le 1\Big] \approx 5.6\, e^{-0.1557\,(D/r_0)^2}, \qquad D/r_0 \ge 3.5.

In the Karhunen-Loève modes of the tilt-free phase the sum has independent terms, lambda_k xi_k^2 with xi_k standard
normal, and P is a single integral. Modes beyond those counted enter with their mean. Source: D. L. Fried, JOSA 68, 1651
(1978).
"""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy.integrate import quad
from scipy.optimize import minimize_scalar

from turbnet.atmosphere.noll import noll_matrix, residual_variance
from turbnet.atmosphere.profiles import Array
from turbnet.errors import check_range


def lucky_probability(d_over_r0: Array | float) -> Array:
    """Fried's formula; a fit for D/r0 >= 3.5, held at 1 where it would exceed it."""
    return np.minimum(5.6 * np.exp(-0.1557 * np.asarray(d_over_r0, dtype=np.float64) ** 2), 1.0)


def tilt_free_modes(order: int) -> range:
    """Noll indices of the modes above the tilts up to the radial order `order`."""
    check_range("radial order", order, 2, 100)
    return range(4, (order + 1) * (order + 2) // 2 + 1)


def lucky_monte_carlo(d_over_r0: float, samples: int, order: int = 12, seed: int = 0) -> tuple[float, float]:
    """P and its standard error from drawn vectors of correlated Zernike coefficients.

    Args:
        d_over_r0: D/r0, 0 to 100.
        samples: frames drawn.
        order: highest radial order drawn; the rest enters with its mean.
        seed: of the draw.
    """
    check_range("D/r0", d_over_r0, 0.0, 100.0)
    check_range("samples", samples, 1, 10**9)
    generator = np.random.default_rng(seed)
    scale = d_over_r0 ** (5 / 3)
    factor = np.linalg.cholesky(noll_matrix(tilt_free_modes(order)))
    lucky, limit = 0, 1 - scale * residual_variance(order)
    for start in range(0, samples, 10_000):
        white = generator.standard_normal((min(10_000, samples - start), len(factor)))
        lucky += int((scale * ((white @ factor.T) ** 2).sum(axis=1) <= limit).sum())
    probability = lucky / samples
    return probability, float(np.sqrt(probability * (1 - probability) / samples))


def karhunen_loeve(modes: Sequence[int]) -> tuple[Array, Array]:
    """Variances at D/r0 = 1 (rad^2, falling) and Zernike coefficients (modes, modes; one column each) of the
    Karhunen-Loève modes spanned by the Zernike modes: uncorrelated, and of all bases the one that gathers most variance
    in its first members.
    """
    variances, vectors = np.linalg.eigh(noll_matrix(modes))
    return variances[::-1], vectors[:, ::-1]


def lucky_karhunen_loeve(d_over_r0: float, order: int = 12) -> float:
    r"""P by inverting the moment generating function of sum lambda_k xi_k^2, for probabilities as small as 1e-200.

    .. math:: P = \frac1{2\pi i} \int \frac{e^{s}}{s} \prod_k (1 + 2\lambda_k s)^{-1/2}\, ds

    along a parabola around the negative axis that starts at the saddle point of the integrand, so that nothing cancels.
    """
    check_range("D/r0", d_over_r0, 0.0, 100.0)
    scale = d_over_r0 ** (5 / 3)
    limit = 1 - scale * residual_variance(order)
    if scale == 0 or limit <= 0:
        return float(limit > 0)
    variances = scale * _tilt_free_variances(order)

    def exponent(s: complex) -> complex:
        return complex(s * limit - 0.5 * np.log(1 + 2 * variances * s).sum() - np.log(s))

    saddle = np.exp(minimize_scalar(lambda t: exponent(np.exp(t)).real, bounds=(-10, 15), method="bounded").x)
    peak = exponent(saddle).real

    def integrand(t: float) -> float:
        s, slope = saddle * (1 + 1j * t - 0.25 * t**2), 1j - 0.5 * t
        return float((np.exp(exponent(s) - peak) * slope).imag)

    integral = quad(integrand, 0, np.inf, limit=500, epsabs=1e-10)[0]
    return float(np.exp(peak) * saddle * integral / np.pi)


@lru_cache(maxsize=8)
def _tilt_free_variances(order: int) -> Array:
    return karhunen_loeve(tilt_free_modes(order))[0]
