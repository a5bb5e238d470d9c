r"""A path cut into slabs, each stood in for by one thin phase screen.

Slab l, between z_l^- and z_l^+, is given the strength and the place

.. math::
    I_l = \int_{z_l^-}^{z_l^+} C_n^2(z)\, dz, \qquad
    \Big(\frac{L - z_l}{L}\Big)^{5/3} I_l = \int_{z_l^-}^{z_l^+} C_n^2(z) \Big(\frac{L-z}{L}\Big)^{5/3} dz

so that the plane-wave and the spherical-wave Fried parameter of the screens are those of the path, whatever the profile
and however few the slabs. Each screen has r0 = (0.423 k^2 I_l)^(-3/5).
"""

from dataclasses import dataclass

import numpy as np

from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Array
from turbnet.errors import check_range


@dataclass(frozen=True)
class Slabs:
    """Thin screens in the order of the light, from the scene to the aperture.

    Attributes:
        z: distances of the screens from the aperture, falling, (count,), m.
        cn2_dz: their strengths I_l, (count,), m^(1/3).
        r0: their plane-wave Fried parameters, (count,), m; infinite where the air is still.
        thickness: of each slab, m.
    """

    z: Array
    cn2_dz: Array
    r0: Array
    thickness: float


def slabs(path: OpticalPath, count: int) -> Slabs:
    """`count` slabs of equal thickness.

    Raises:
        ParameterError: count outside 1 .. 1000.
    """
    check_range("slabs", count, 1, 1000)
    thickness = path.distance / count
    z, weight = path.quadrature()
    slab = np.minimum((z / thickness).astype(int), count - 1)
    cn2_dz = np.bincount(slab, weight, count).astype(np.float64)
    toward = np.bincount(slab, weight * (1 - z / path.distance) ** (5 / 3), count)
    filled = np.maximum(cn2_dz, np.finfo(np.float64).tiny)
    middle = (np.arange(count) + 0.5) * thickness
    place = np.where(cn2_dz > 0, path.distance * (1 - (toward / filled) ** (3 / 5)), middle)
    with np.errstate(divide="ignore"):
        r0 = (0.423 * path.wavenumber**2 * cn2_dz) ** (-3 / 5)
    return Slabs(place[::-1], cn2_dz[::-1], r0[::-1], thickness)
