r"""Zernike covariance of the phase once diffraction between the air and the aperture counts.

To first order (Rytov) a spatial frequency kappa of the air at z, on a spherical wave, reaches the aperture as phase
with the amplitude cos q and as log-amplitude with sin q:

.. math::
    E[a_i(u)\, a_j(u')] = \int_0^L dz \int d^2\kappa\; 2\pi k^2\, 0.033\, C_n^2(z)\, \kappa^{-11/3}
        \cos^2 q\; Q_i(\kappa c)\, Q_j^*(\kappa c)\, e^{i\kappa\cdot(u-u')z/L}, \qquad
    q = \frac{\kappa^2 z c}{2k}, \quad c = \frac{L-z}{L}

With q = 0 this is `turbnet.atmosphere.covariance`, the near field, D^2 >> lambda L. At a Fresnel number D^2/(lambda L)
of 11 the tilt of one point hardly notices (0.3 %); the higher modes do (18 % at j = 11 .. 15), and so does the
difference of the tilts of neighbours, which only small eddies make (28 % at one Nyquist pixel). Valid for weak
fluctuation.
Source: V. I. Tatarskii, The Effects of the Turbulent Atmosphere on Wave Propagation (1971), ch. 3.
"""

import numpy as np
from scipy.special import jv

from turbnet.atmosphere.covariance import angular_terms
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Array
from turbnet.optics.zernike import fourier_radial, noll_to_nm

LAYERS = 48


def diffracted_covariance(
    path: OpticalPath, i: int, j: int, dx: Array | float, layers: tuple[Array, Array] | None = None
) -> Array:
    """E[a_i(u) a_j(u')] of the phase with diffraction, rad^2, for u - u' = (dx, 0).

    Args:
        path: aperture, distance, profile, wavelength.
        i, j: Noll indices, at least 2.
        dx: separations in the scene, m, any shape.
        layers: points z (m) and weights Cn2 dz (m^(1/3)) of a layered atmosphere, such as that of a split-step run's
            screens; by default the continuous path.
    """
    dx = np.asarray(dx, dtype=np.float64)
    (n, _), (n2, _) = noll_to_nm(i), noll_to_nm(j)
    radius = path.aperture / 2
    # x = kappa c R = t^3: smooth at 0 even for the tilts; beyond x = 80 nothing is left of the low orders.
    gauss, weight = np.polynomial.legendre.leggauss(12)
    panels = np.linspace(0, 80 ** (1 / 3), 121)
    half = 0.5 * np.diff(panels)[:, None]
    t = (panels[:-1, None] + half * (gauss + 1)).ravel()
    x, step = t**3, (half * weight).ravel() * 3 * t**2
    total = np.zeros(dx.shape)
    for z, cn2_dz in zip(*(layers or path.layers(LAYERS)), strict=True):
        c = 1 - z / path.distance
        kappa = x / (c * radius)
        filtered = np.cos(kappa**2 * z * c / (2 * path.wavenumber)) ** 2 * fourier_radial(n, x) * fourier_radial(n2, x)
        density = step / (c * radius) * 2 * np.pi * path.wavenumber**2 * 0.033 * cn2_dz * kappa ** (-8 / 3) * filtered
        shift = np.abs(dx)[..., None] * z / path.distance * kappa
        for mu, amplitude, angle in angular_terms(i, j):
            direction = np.cos(mu * np.where(dx < 0, np.pi, 0.0) - angle)
            total += 2 * np.pi * amplitude * direction * (jv(mu, shift) @ density)
    return total
