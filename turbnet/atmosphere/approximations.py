r"""Approximate Zernike-space covariances from the literature, kept to be compared with the exact one.

- Mid-path: all turbulence sits at z = L/2. A single point then weighs it by 2^(-5/3) = 0.315 where constant Cn2 gives
  3/8, so variances come out 16 % low, and no profile can be told from another.
- Chanan's tilts, which are the mid-path for j = 2, 3: with s = |u - u'| / D,

.. math::
    E[a_2 a_2'] = c_2 (D/r_0)^{5/3} 2^{-5/3} [I_0(s) - I_2(s) \cos 2\psi], \qquad
    I_m(s) = \int_0^\infty \zeta^{-14/3} J_m(2 s \zeta) J_2^2(\zeta)\, d\zeta

  with r0 of a plane wave, c_2 = 7.7554 and the opposite sign of I_2 for a_3. Source: G. A. Chanan, JOSA A 9, 298
  (1992).
- Noll mixing: independent fields, one a mode, mixed at each point by the Cholesky factor of the Noll matrix. Right at
  u = u' only; between points it misses the odd pairs such as (2, 4) altogether. Source: S. H. Chan and N. Chimitt
  (2023).
"""

import numpy as np

from turbnet.atmosphere.covariance import radial_covariance, zernike_covariance
from turbnet.atmosphere.noll import noll_matrix
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Array
from turbnet.errors import check_range

CHANAN = 7.7554
"""c_2, the variance of a tilt divided by I_0(0), at D/r0 = 1."""


def mid_path_covariance(path: OpticalPath, i: int, j: int, dx: Array | float, dy: Array | float = 0.0) -> Array:
    """E[a_i(u) a_j(u')], rad^2, were all turbulence half way; arguments as in `zernike_covariance`."""
    total = path.quadrature()[1].sum()
    return zernike_covariance(path, i, j, dx, dy, layers=(np.array([path.distance / 2]), np.array([total])))


def chanan_integral(order: int, s: Array) -> Array:
    """I_0 or I_2 at the separation s in aperture diameters.

    I_0(0) = 0.05788; the printed 0.05766 stops the integral, which converges like zeta^(1/3), too early.
    """
    check_range("order of the integral", order, 0, 2)
    return radial_covariance(1, 1, order, 2 * np.asarray(s, dtype=np.float64)) / 8


def chanan_tilts(path: OpticalPath, dx: Array | float, dy: Array | float = 0.0) -> Array:
    """2 x 2 covariance of the tilts a_2, a_3 of two scene points dx, dy (m) apart: (..., 2, 2), rad^2."""
    dx, dy = np.broadcast_arrays(np.asarray(dx, dtype=np.float64), np.asarray(dy, dtype=np.float64))
    s, psi = np.hypot(dx, dy) / path.aperture, np.arctan2(dy, dx)
    even, odd = chanan_integral(0, s), chanan_integral(2, s)
    along, across, mixed = even - odd * np.cos(2 * psi), even + odd * np.cos(2 * psi), -odd * np.sin(2 * psi)
    scale = CHANAN * (path.aperture / path.r0_plane) ** (5 / 3) * 2 ** (-5 / 3)
    return scale * np.stack([np.stack([along, mixed], -1), np.stack([mixed, across], -1)], -2)


def noll_mixing(path: OpticalPath, modes: list[int] | range, dx: Array | float, dy: Array | float = 0.0) -> Array:
    """Covariance (..., modes, modes) of independent fields with each mode's own correlation, mixed by Cholesky."""
    own = np.stack([zernike_covariance(path, j, j, dx, dy) / zernike_covariance(path, j, j, 0.0) for j in modes], -1)
    factor = np.linalg.cholesky(noll_matrix(modes))
    return path.d_over_r0 ** (5 / 3) * np.einsum("ik,...k,jk->...ij", factor, own, factor)
