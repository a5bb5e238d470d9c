r"""What an aperture makes of a field in its plane: Zernike coefficients and PSFs.

Coefficients are those of the least-squares fit of phi by modes 1 .. J over the samples inside the aperture, which on a
grid of samples, where the polynomials are only nearly orthogonal, is what keeps tilt out of the other modes.
"""

import numpy as np
import torch
from torch import Tensor

from turbnet.errors import check_range
from turbnet.optics.psf import psf
from turbnet.optics.pupil import circular, pupil_grid
from turbnet.optics.zernike import zernike_basis

EDGE_SUBSAMPLES = 8


class Aperture:
    """A circular aperture on the grid of `turbnet.optics.pupil.pupil_grid`.

    Args:
        points: samples across the diameter, n.
        modes: J, Zernike modes that are fitted, from piston (1) on.
        like: tensor whose (real) type and device the results take.
    """

    def __init__(self, points: int, modes: int = 36, like: Tensor | None = None) -> None:
        check_range("pupil points", points, 8, 2**14)
        check_range("Zernike modes", modes, 3, 1000)
        like = torch.empty(0) if like is None else like
        x, y = pupil_grid(points)
        inside = np.hypot(x, y) <= 1
        basis = zernike_basis(range(1, modes + 1), np.hypot(x, y), np.arctan2(y, x)) * inside
        weights = np.zeros_like(basis)
        weights[:, inside] = np.linalg.pinv(basis[:, inside].T)
        self.inside = torch.from_numpy(inside).to(like.device)
        self.transmission = torch.from_numpy(circular(points, EDGE_SUBSAMPLES)).to(like)
        self._basis, self._weights = (torch.from_numpy(a).to(like) for a in (basis, weights))

    def coefficients(self, phase: Tensor) -> Tensor:
        """a_1 .. a_J of phases (..., n, n), (..., J), rad; index j - 1."""
        return phase.flatten(-2) @ self._weights.flatten(1).T

    def phase(self, coefficients: Tensor) -> Tensor:
        """sum_j a_j Z_j, j = 1 .. K <= J, of (..., K), inside the aperture, (..., n, n), rad."""
        count = coefficients.shape[-1]
        return (coefficients @ self._basis[:count].flatten(1)).unflatten(-1, self._basis.shape[1:])

    def psf(self, fields: Tensor, size: int, q: float = 1.0, *, without: Tensor | None = None) -> Tensor:
        """PSFs (..., size, size), unit sum, of fields (..., n, n); pixel and orientation as in `turbnet.optics.psf`.

        Args:
            fields: complex, in the aperture's plane.
            size: pixels along a side.
            q: pixel in units of lambda / (2D).
            without: Zernike coefficients (..., K) from piston on to take off first; two tilts make it tilt-free.
        """
        angle = torch.angle(fields)
        if without is not None:
            angle = angle - self.phase(without)
        return psf(angle, fields.abs() * self.transmission, size, q)
