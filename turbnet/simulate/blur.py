r"""Blur: every scene point u spreads by its own tilt-free point-spread function b_u.

.. math::
    B(J)(x) = \sum_u J(u)\, b_u(x - u) \approx \sum_m (\phi_m * (\beta_m J))(x), \qquad
    b_u \approx \phi_0 + \sum_{m \ge 1} \beta_m(u)\, \phi_m

with phi_0 the mean PSF (beta_0 = 1) and phi_m the principal components of tilt-free PSFs. The weights beta are the
projection of the exact PSF |F{P e^{j phi}}|^2 of each point of the coarse grid, interpolated to pixels: scattering,
indexed by the source.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from turbnet.atmosphere.noll import noll_matrix
from turbnet.errors import check_range
from turbnet.optics.pupil import circular, pupil_grid
from turbnet.optics.zernike import zernike_basis
from turbnet.simulate.tilt import upsample

_PUPIL = 16  # samples across the aperture; twice as many in its Fourier plane make the pixel lambda / (2 D)
KERNEL = 2 * _PUPIL - 1
"""Width of a PSF kernel, pixels."""

_CHUNK = 1024  # PSFs at a time: what one step leaves is still in the processor's cache at the next


@lru_cache
def _pupil(modes: int) -> tuple[Tensor, Tensor]:
    """The aperture on a _PUPIL^2 grid: the part of each sample inside the disk, and Z_4..Z_modes there, (modes-3, samples).

    Counting samples at the rim by the part of their area inside makes sixteen across as good as many more.
    """
    x, y = pupil_grid(_PUPIL)
    basis = zernike_basis(range(4, modes + 1), np.hypot(x, y), np.arctan2(y, x))
    part = circular(_PUPIL, subsamples=16)
    return torch.as_tensor(part).flatten(), torch.as_tensor(basis).flatten(1)


def _spread(high_PN: Tensor) -> Tensor:
    """|F{P e^{j phi}}|^2 in FFT order, not normalised, (P, 2 _PUPIL, 2 _PUPIL)."""
    part, basis = _pupil(high_PN.shape[-1] + 3)
    phase = high_PN @ basis.to(high_PN)
    wave = torch.polar(part.to(phase).expand_as(phase), phase).view(-1, _PUPIL, _PUPIL)
    field = torch.fft.fft2(wave, s=(2 * _PUPIL, 2 * _PUPIL))
    return field.real.square() + field.imag.square()


def tilt_free_psf(high_PN: Tensor) -> Tensor:
    """Tilt-free PSFs (P, KERNEL, KERNEL) of coefficients a_4..a_J (P, J-3), rad; each sums to one."""
    psf = torch.fft.fftshift(_spread(high_PN), dim=(-2, -1))[:, 1:, 1:]  # odd, centred on the zero shift
    return psf / psf.sum(dim=(-2, -1), keepdim=True)


@dataclass(frozen=True)
class PSFBasis:
    """Mean and leading components of tilt-free PSFs.

    Attributes:
        mean: (KERNEL, KERNEL), sums to one.
        components: phi_m, (M, KERNEL, KERNEL); each sums to nearly zero, as differences of PSFs do.
        dual: (M, KERNEL, KERNEL); the weight of phi_m in a PSF b is sum_x (b - mean)(x) dual_m(x).
    """

    mean: Tensor
    components: Tensor
    dual: Tensor

    def weights(self, psf_Pkk: Tensor) -> Tensor:
        """Weights of the components in PSFs, (P, M)."""
        return (psf_Pkk - self.mean.to(psf_Pkk)).flatten(1) @ self.dual.flatten(1).T.to(psf_Pkk)

    def project(self, high_PN: Tensor) -> Tensor:
        """`weights(tilt_free_psf(high))`, (P, M), without making the PSFs: one product with |F|^2 as it comes."""
        parts = []
        for chunk in high_PN.split(_CHUNK):
            products = _spread(chunk).flatten(1) @ self._in_fft_order.to(high_PN)
            parts.append(products[:, :-1] / products[:, -1:] - (self.dual * self.mean).sum((1, 2)).to(high_PN))
        return torch.cat(parts)

    @cached_property
    def _in_fft_order(self) -> Tensor:
        """The dual and a sum over the kernel as columns, (4 _PUPIL^2, M + 1)."""
        columns = F.pad(torch.cat((self.dual, torch.ones_like(self.mean)[None])), (1, 0, 1, 0))
        return torch.fft.ifftshift(columns, dim=(-2, -1)).flatten(1).T.contiguous()

    def psf(self, weights_PM: Tensor) -> Tensor:
        """PSFs (P, KERNEL, KERNEL) from their weights."""
        return self.mean + torch.einsum("pm,mij->pij", weights_PM, self.components)


@lru_cache
def psf_basis(components: int, weakest: float, strongest: float, modes: int = 36, samples: int = 3000) -> PSFBasis:
    r"""Leading components of PSFs in Kolmogorov turbulence with D/r0 log-uniform between two strengths.

    They are the principal components in the metric that matters for pictures: amplitudes of natural pictures fall as 1/f,
    so an error of the PSF at frequency f shows in the picture as 1/f of itself, and

    .. math:: \|b\|^2 = \sum_f |\hat b(f)|^2 / f^2 = b^T G\, b, \qquad G = R R^T

    Principal components u_m of R^T b give phi_m = R^{-T} u_m and the dual R u_m. Half as many of these reach the same
    error of the blurred picture as of plain principal components (D/r0 = 3 and above).

    Args:
        components: M, how many to keep beyond the mean.
        weakest, strongest: range of D/r0.
        modes: highest Noll index.
        samples: PSFs to learn from; seeded, so the basis is always the same.
    """
    check_range("PSF components", components, 0, 500)
    generator = torch.Generator().manual_seed(0)
    factor = torch.as_tensor(np.linalg.cholesky(noll_matrix(range(4, modes + 1))), dtype=torch.float32)
    log_range = np.log(max(weakest, 1e-3)), np.log(max(strongest, 1e-3))
    strength = torch.exp(log_range[0] + (log_range[1] - log_range[0]) * torch.rand(samples, 1, generator=generator))
    high = (torch.randn(samples, modes - 3, generator=generator) @ factor.T) * strength ** (5 / 6)
    psf = tilt_free_psf(high).double()
    mean = psf.mean(0)
    root = _picture_metric_root()
    flat = (psf - mean).flatten(1) @ root
    # Subspace iteration: only the leading components are wanted, of 961.
    span = torch.randn(flat.shape[1], components + 8, generator=generator, dtype=torch.float64)
    for _ in range(4):
        span, _ = torch.linalg.qr(flat.T @ (flat @ span))
    _, vectors = torch.linalg.eigh(span.T @ (flat.T @ (flat @ span)))
    leading = span @ vectors.flip(1)[:, :components]

    def kernels(columns: Tensor) -> Tensor:
        return columns.T.float().reshape(components, KERNEL, KERNEL).contiguous()

    return PSFBasis(
        mean.float(),
        kernels(torch.linalg.solve_triangular(root.T, leading, upper=True)),
        kernels(root @ leading),
    )


@lru_cache
def _picture_metric_root() -> Tensor:
    """R of G = R R^T, (KERNEL^2, KERNEL^2): the metric 1/f^2 between kernels; frequencies below 1/64 count as 1/64."""
    size = 64
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
    lag = np.fft.ifft2(np.maximum(f, 1 / size) ** -2).real
    offset = np.arange(KERNEL)[:, None] - np.arange(KERNEL)
    metric = lag[offset[:, None, :, None], offset[None, :, None, :]].reshape(KERNEL**2, KERNEL**2)
    return torch.linalg.cholesky(torch.as_tensor(metric))


def blur_weights(high_BNhw: Tensor, basis: PSFBasis) -> Tensor:
    """beta on the coarse grid, (B, M, h, w), from coefficients a_4..a_J by exact pupil transforms."""
    batch, modes, h, w = high_BNhw.shape
    if not len(basis.components):
        return high_BNhw.new_zeros((batch, 0, h, w))
    points = high_BNhw.permute(0, 2, 3, 1).reshape(-1, modes)
    return basis.project(points).view(batch, h, w, -1).permute(0, 3, 1, 2)


def blur(image_BCHW: Tensor, weights_BMhw: Tensor, basis: PSFBasis, stride: int) -> Tensor:
    """Scatter the image by the PSFs that `weights` describe on the coarse grid.

    The picture is taken as black beyond its edges: give it a margin of KERNEL // 2 pixels and cut that off.

    Args:
        image_BCHW: linear intensities; differentiable.
        weights_BMhw: beta on the coarse grid, from `blur_weights`; differentiable.
        basis: the PSF basis they belong to.
        stride: step of the coarse grid, pixels.
    """
    *_, height, width = image_BCHW.shape
    half = KERNEL // 2
    size = [_fast(n + KERNEL - 1) for n in (height, width)]
    kernels = torch.cat((basis.mean[None], basis.components)).to(image_BCHW)
    kernels = F.pad(kernels, (0, size[1] - KERNEL, 0, size[0] - KERNEL))
    transfer = torch.fft.rfft2(torch.roll(kernels, (-half, -half), (1, 2)))
    spectrum = torch.fft.rfft2(image_BCHW, s=size) * transfer[0]
    for m, weight_Bhw in enumerate(weights_BMhw.unbind(1)):
        beta = upsample(weight_Bhw[:, None], stride, height, width)
        spectrum = spectrum + torch.fft.rfft2(image_BCHW * beta, s=size) * transfer[m + 1]
    return torch.fft.irfft2(spectrum, s=size)[..., :height, :width]


def _fast(size: int) -> int:
    """Smallest number >= size that FFTs like."""
    from scipy.fft import next_fast_len

    return int(next_fast_len(size, real=True))
