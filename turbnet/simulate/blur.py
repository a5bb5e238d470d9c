r"""Blur: every scene point u spreads by its own tilt-free point-spread function b_u.

.. math::
    B(J)(x) = \sum_u J(u)\, b_u(x - u) \approx \sum_m (\phi_m * (\beta_m J))(x)

with the PSF basis phi of `turbnet.simulate.psf_basis` (beta_0 = 1). The weights beta belong to each point of the coarse
grid and are interpolated to pixels: scattering, indexed by the source.

The components may be summed at half the resolution: what differs from point to point is mostly what turbulence leaves of
the low frequencies. Then J is low-passed and twice every second pixel taken (P), and what the components make of it is put
back below half the Nyquist frequency; P P^T = 1 but for the soft edge of both:

.. math:: B(J) \approx \phi_0 * J + P^T \sum_m \phi_m * (\beta_m \cdot P J)
"""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from turbnet.simulate.phase_to_space import PhaseToSpace
from turbnet.simulate.psf_basis import PSFBasis, low_band, roll_off
from turbnet.simulate.tilt import check_precision, upsample

_TILE = 768
"""Pixels a side up to which a picture is blurred in one piece; larger ones go in pieces that stay in the cache."""
_PIECE = 480


def blur_weights(high_BNhw: Tensor, basis: PSFBasis, network: PhaseToSpace | None = None) -> Tensor:
    """beta on the coarse grid, (B, M, h, w), from coefficients a_4..a_J.

    Args:
        high_BNhw: on the coarse grid, rad; differentiable.
        basis: the PSF basis.
        network: the phase-to-space network; None for exact pupil transforms.
    """
    batch, modes, h, w = high_BNhw.shape
    if not len(basis.components):
        return high_BNhw.new_zeros((batch, 0, h, w))
    points = high_BNhw.permute(0, 2, 3, 1).reshape(-1, modes)
    weights = basis.project(points) if network is None else network.weights(points, basis)
    return weights.view(batch, h, w, -1).permute(0, 3, 1, 2)


def blur(image_BCHW: Tensor, weights_BMhw: Tensor, basis: PSFBasis, stride: int, factor: int = 1) -> Tensor:
    """Scatter the image by the PSFs that `weights` describe on the coarse grid.

    The picture is taken as black beyond its edges: give it a margin of half a kernel and cut that off.

    Args:
        image_BCHW: linear intensities; differentiable.
        weights_BMhw: beta on the coarse grid, from `blur_weights`; differentiable.
        basis: the PSF basis they belong to.
        stride: step of the coarse grid, pixels; even if factor is 2.
        factor: 2 to sum the components at half the resolution.

    Raises:
        InputError: the picture is neither float32 nor float64.
    """
    check_precision(image_BCHW)
    *_, height, width = image_BCHW.shape
    if max(height, width) <= _TILE:
        return _piece(image_BCHW, weights_BMhw, basis, stride, factor, (0, height), (0, width))
    step = _PIECE // stride * stride
    rows = []
    for top in range(0, height, step):
        pieces = [
            _piece(
                image_BCHW,
                weights_BMhw,
                basis,
                stride,
                factor,
                (top, min(top + step, height)),
                (left, min(left + step, width)),
            )
            for left in range(0, width, step)
        ]
        rows.append(torch.cat(pieces, dim=-1))
    return torch.cat(rows, dim=-2)


def _piece(
    image_BCHW: Tensor,
    weights_BMhw: Tensor,
    basis: PSFBasis,
    stride: int,
    factor: int,
    rows: tuple[int, int],
    columns: tuple[int, int],
) -> Tensor:
    """Rows and columns [from, to) of the blurred image, from what lies within half a kernel of them."""
    half = basis.size // 2
    image, offset, sides = image_BCHW, [], []
    for axis, (first, last) in ((-2, rows), (-1, columns)):
        # From a multiple of the stride on, so that the weights' grid begins with the piece.
        start = max(0, first - half) // stride * stride
        stop = min(image_BCHW.shape[axis], last + half)
        image = image.narrow(axis, start, stop - start)
        offset.append(start)
        sides.append(stop - start)
    size = [_fast(n + half, 4 if factor > 1 else 1) for n in sides]
    padded = F.pad(image, (0, size[1] - sides[1], 0, size[0] - sides[0]))
    beta = _fine_weights(weights_BMhw, stride, factor, offset, size)
    blurred = _Scatter.apply(padded, beta, *basis.transfer(size, image, factor), factor)
    top, left = rows[0] - offset[0], columns[0] - offset[1]
    cut: Tensor = blurred[..., top : top + rows[1] - rows[0], left : left + columns[1] - columns[0]]
    return cut


def _fine_weights(weights_BMhw: Tensor, stride: int, factor: int, offset: list[int], size: list[int]) -> Tensor:
    """beta on every `factor`-th pixel of a piece that begins at `offset`, zero where the grid does not reach."""
    context = 3  # grid points that bicubic interpolation looks beyond the piece
    if weights_BMhw.shape[1] == 0:
        return weights_BMhw
    starts, cut = [], weights_BMhw
    for axis, (first, count) in enumerate(zip(offset, size, strict=True)):
        have = weights_BMhw.shape[2 + axis]
        start = max(0, first // stride - context)
        stop = min(have, -(-(first + count) // stride) + context + 1)
        cut = cut.narrow(2 + axis, start, stop - start)
        starts.append((first - start * stride) // factor)
    rows, columns = ((n - 1) * stride // factor + 1 for n in cut.shape[2:])
    fine = upsample(cut, stride // factor, rows, columns)[..., starts[0] :, starts[1] :]
    want = [n // factor for n in size]
    fine = fine[..., : want[0], : want[1]]
    missing = (0, want[1] - fine.shape[-1], 0, want[0] - fine.shape[-2])
    return F.pad(fine, missing) if any(missing) else fine


class _Scatter(torch.autograd.Function):
    """phi_0 * J + P^T sum_m phi_m * (beta_m P J), circular; its adjoint costs what it costs itself."""

    @staticmethod
    def forward(
        ctx: Any, image_BCHW: Tensor, beta_BMhw: Tensor, mean: Tensor, components_M: Tensor, factor: int
    ) -> Tensor:
        size = image_BCHW.shape[-2:]
        spectrum = torch.fft.rfft2(image_BCHW)
        low = _low_pass(spectrum, image_BCHW, factor)
        ctx.factor, ctx.size = factor, size
        ctx.save_for_backward(low, beta_BMhw, mean, components_M)
        spectrum = spectrum * mean
        if len(components_M):
            _put_back(spectrum, _sum_components(low, beta_BMhw, components_M), factor)
        return torch.fft.irfft2(spectrum, s=size)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient_BCHW: Tensor) -> tuple[Tensor | None, Tensor | None, None, None, None]:
        low_BChw, beta_BMhw, mean, components_M = ctx.saved_tensors
        wants_image, wants_beta = ctx.needs_input_grad[:2]
        spectrum = torch.fft.rfft2(gradient_BCHW)
        band = low_band(spectrum, ctx.factor) / ctx.factor
        small = low_BChw.shape[-2:]
        back = torch.zeros_like(low_BChw) if wants_image else None
        weights = torch.empty_like(beta_BMhw) if wants_beta else None
        for m, transfer in enumerate(components_M):
            gathered = torch.fft.irfft2(band * transfer.conj(), s=small)
            if back is not None:
                back.addcmul_(gathered, beta_BMhw[:, m, None])
            if weights is not None:
                weights[:, m] = (gathered * low_BChw).sum(1)
        image = None
        if back is not None:
            spectrum = spectrum * mean.conj()
            if len(components_M):
                passed = torch.fft.rfft2(back) * roll_off(tuple(ctx.size), ctx.factor).to(back)
                _put_back(spectrum, passed, ctx.factor)
            image = torch.fft.irfft2(spectrum, s=ctx.size)
        return image, weights, None, None, None


def _low_pass(spectrum: Tensor, image: Tensor, factor: int) -> Tensor:
    """P: every factor-th pixel of the image below the Nyquist frequency of those, times the factor."""
    if factor == 1:
        return image
    small = [n // factor for n in image.shape[-2:]]
    passed = low_band(spectrum, factor) * roll_off(tuple(image.shape[-2:]), factor).to(image)
    return torch.fft.irfft2(passed, s=small) / factor


def _sum_components(low_BChw: Tensor, beta_BMhw: Tensor, components_M: Tensor) -> Tensor:
    total = torch.fft.rfft2(low_BChw * beta_BMhw[:, :1]) * components_M[0]
    for m in range(1, len(components_M)):
        total.addcmul_(torch.fft.rfft2(low_BChw * beta_BMhw[:, m, None]), components_M[m])
    return total


def _put_back(spectrum: Tensor, low: Tensor, factor: int) -> None:
    """P^T: add to a spectrum that of every factor-th pixel, below the Nyquist frequency of those."""
    if factor == 1:
        spectrum += low
        return
    h, w = low.shape[-2] // 2, low.shape[-1] - 1
    low = low * factor
    spectrum[..., :h, :w] += low[..., :h, :w]
    spectrum[..., -(h - 1) :, :w] += low[..., h + 1 :, :w]


def _fast(size: int, multiple: int = 1) -> int:
    """Smallest multiple >= size that FFTs like."""
    from scipy.fft import next_fast_len

    return multiple * int(next_fast_len(-(-size // multiple), real=True))
