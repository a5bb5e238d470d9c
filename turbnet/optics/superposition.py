r"""Images through a blur that changes from point to point.

.. math::
    \text{scatter: } I(x) = \sum_u J(u)\, h_u(x - u), \qquad \text{gather: } I(x) = \sum_u J(u)\, h_x(x - u)

Scattering is what light does: each source point u spreads by its own PSF. Gathering, one weighted mean per image point,
is its look-alike: the two agree only where the PSF is the same everywhere. Each is the other's adjoint once the kernels
are mirrored. Nothing comes from beyond the border.

Kernels are odd-sized, K x K with the centre at K // 2. They come either one per pixel (exact, memory H W K^2) or as
h_u = sum_m w_m(u) phi_m (a basis, memory M (H W + K^2)); `superposition_matrix` is the dense reference for small
images.
"""

import torch.nn.functional as F
from torch import Tensor

from turbnet.errors import ParameterError
from turbnet.optics.psf import convolve


def scatter(image: Tensor, kernels: Tensor) -> Tensor:
    """I(x) = sum_u J(u) h_u(x - u).

    Args:
        image: J, (..., H, W).
        kernels: h, (H, W, K, K), the PSF of each source pixel.
    """
    height, width, size = _check(image, kernels)
    flat = image.reshape(-1, 1, height * width)
    columns = kernels.reshape(height * width, size * size).T * flat  # (B, K*K, H*W)
    return F.fold(columns, (height, width), size, padding=size // 2).reshape(image.shape)


def gather(image: Tensor, kernels: Tensor) -> Tensor:
    """I(x) = sum_u J(u) h_x(x - u); arguments as in `scatter`, the kernels now belong to the image pixels."""
    height, width, size = _check(image, kernels)
    columns = F.unfold(image.reshape(-1, 1, height, width), size, padding=size // 2)
    weights = kernels.flip(-2, -1).reshape(height * width, size * size).T
    return (columns * weights).sum(1).reshape(image.shape)


def scatter_basis(image: Tensor, basis: Tensor, weights: Tensor) -> Tensor:
    """sum_m phi_m ⊛ (w_m J): `scatter` with h_u = sum_m w_m(u) phi_m.

    Args:
        image: J, (..., H, W).
        basis: phi, (M, K, K).
        weights: w, (M, H, W).
    """
    return convolve(weights * image[..., None, :, :], basis).sum(-3)


def gather_basis(image: Tensor, basis: Tensor, weights: Tensor) -> Tensor:
    """sum_m w_m (phi_m ⊛ J): `gather` with h_x = sum_m w_m(x) phi_m."""
    return (weights * convolve(image[..., None, :, :], basis)).sum(-3)


def superposition_matrix(kernels: Tensor) -> Tensor:
    """The matrix A, (H W, H W), with I = A J for `scatter`: A[x, u] = h_u(x - u), read off entry by entry.

    For `gather`, A[x, u] = h_x(x - u): the transpose of this matrix for the mirrored kernels.
    """
    height, width, size, _ = kernels.shape
    matrix = kernels.new_zeros(height, width, height, width)
    half = size // 2
    for row in range(height):
        for column in range(width):
            top, left = row - half, column - half
            rows = range(max(top, 0), min(top + size, height))
            columns = range(max(left, 0), min(left + size, width))
            window = kernels[
                row, column, rows.start - top : rows.stop - top, columns.start - left : columns.stop - left
            ]
            matrix[rows.start : rows.stop, columns.start : columns.stop, row, column] = window
    return matrix.reshape(height * width, height * width)


def _check(image: Tensor, kernels: Tensor) -> tuple[int, int, int]:
    height, width = image.shape[-2:]
    size = kernels.shape[-1]
    if kernels.shape != (height, width, size, size) or size % 2 == 0:
        raise ParameterError(
            f"kernels {tuple(kernels.shape)} must be ({height}, {width}, K, K) with odd K for an image of that size"
        )
    return height, width, size
