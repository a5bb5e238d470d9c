r"""Single-point statistics of Zernike coefficients in Kolmogorov turbulence.

.. math::
    E[a_i a_j] = 2.2461\,(-1)^{(n_i+n_j-2m)/2} \sqrt{(n_i+1)(n_j+1)}\,
        \frac{\Gamma((n_i+n_j-5/3)/2)}
             {\Gamma((n_i-n_j+17/3)/2)\,\Gamma((n_j-n_i+17/3)/2)\,\Gamma((n_i+n_j+23/3)/2)} (D/r_0)^{5/3}

for equal m and (equal parity of i and j, or m = 0); zero otherwise. Source: Noll, JOSA 66, 207 (1976). The prefactor is
the one consistent with a structure function of 6.88 (r/r0)^(5/3); 2.2698, also printed, is 1.06 % high.
"""

from collections.abc import Sequence

import numpy as np
from scipy.special import gammaln, gammasgn

from turbnet.atmosphere.profiles import Array
from turbnet.errors import check_range
from turbnet.optics.zernike import noll_to_nm

PREFACTOR = 2.2461


def noll_covariance(i: int, j: int) -> float:
    """E[a_i a_j] at D/r0 = 1, rad^2, for Noll indices i, j >= 2 (piston has no finite variance)."""
    check_range("Noll index i", i, 2, 10**6)
    check_range("Noll index j", j, 2, 10**6)
    (ni, mi), (nj, mj) = noll_to_nm(i), noll_to_nm(j)
    if mi != mj or (mi != 0 and (i - j) % 2):
        return 0.0
    top = (ni + nj - 5 / 3) / 2
    bottom = np.array([(ni - nj + 17 / 3) / 2, (nj - ni + 17 / 3) / 2, (ni + nj + 23 / 3) / 2])
    sign = (-1) ** ((ni + nj - 2 * mi) // 2) * gammasgn(top) * np.prod(gammasgn(bottom))
    size = np.exp(gammaln(top) - gammaln(bottom).sum())
    return float(PREFACTOR * sign * np.sqrt((ni + 1) * (nj + 1)) * size)


def noll_matrix(modes: Sequence[int]) -> Array:
    """Covariance matrix of the coefficients of `modes` at D/r0 = 1, rad^2; scales with (D/r0)^(5/3)."""
    return np.array([[noll_covariance(i, j) for j in modes] for i in modes])


def residual_variance(order: int) -> float:
    """Mean-square phase left over the pupil at D/r0 = 1 once all modes up to radial order `order` are removed, rad^2.

    1.030 without piston (order 0), 0.134 without tilts (order 1), falling like order^(-5/3).
    """
    check_range("radial order", order, 0, 1000)
    n = np.arange(order + 1, 20001, dtype=np.float64)
    size = gammaln(n - 5 / 6) - 2 * gammaln(17 / 6) - gammaln(n + 23 / 6)
    per_order = PREFACTOR * (n + 1) ** 2 * np.exp(size)  # all n + 1 modes of an order have the same variance
    return float(per_order.sum())
