r"""Apertures on a square grid of pixel centres.

A grid of N points spans the aperture edge to edge: x_i = (2i + 1 - N) / N in aperture radii, i = 0 .. N-1, so no sample
lies on the edge -1 or 1 and the grid is symmetric for odd and for even N. x runs along the last axis (columns, to the
right), y along the one before (rows, downwards).
"""

import numpy as np

from turbnet.errors import check_range
from turbnet.optics.zernike import Array, zernike_basis


def pupil_grid(points: int) -> tuple[Array, Array]:
    """Coordinates (x, y), each (points, points), in aperture radii."""
    check_range("pupil points", points, 1, 2**14)
    axis = (2 * np.arange(points) + 1 - points) / points
    x, y = np.meshgrid(axis, axis)
    return x, y


def circular(points: int, subsamples: int = 1) -> Array:
    """Transmission (points, points) of a circular aperture.

    Args:
        points: grid points across the diameter.
        subsamples: points per pixel and axis at which the edge is tested. 1 gives a hard edge (0 or 1 by the pixel's
            centre); more give the share of the pixel inside, an antialiased edge.

    Raises:
        ParameterError: points or subsamples below 1.
    """
    return annular(points, 0.0, subsamples)


def annular(points: int, obscuration: float, subsamples: int = 1) -> Array:
    """Transmission (points, points) of an aperture with a round central stop of `obscuration` times its diameter.

    Edges as in `circular`.

    Raises:
        ParameterError: obscuration outside [0, 0.99], points or subsamples below 1.
    """
    check_range("pupil points", points, 1, 2**14)
    check_range("obscuration", obscuration, 0.0, 0.99)
    check_range("subsamples", subsamples, 1, 64)
    x, y = pupil_grid(points * subsamples)
    radius = np.hypot(x, y)
    inside = (radius <= 1) & (radius >= obscuration)
    return inside.reshape(points, subsamples, points, subsamples).mean(axis=(1, 3))


def zernike_modes(modes: list[int] | range, points: int) -> Array:
    """Z_j for each j of `modes` on the pupil grid, (modes, points, points), zero outside the unit disk."""
    x, y = pupil_grid(points)
    radius = np.hypot(x, y)
    basis = zernike_basis(modes, np.minimum(radius, 1.0), np.arctan2(y, x))
    return np.where(radius <= 1, basis, 0.0)
