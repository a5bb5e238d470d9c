r"""Tilt-free point-spread functions of Zernike coefficients, and the basis in which a few weights describe them.

.. math::
    b_u \propto |\mathcal{F}\{P\, e^{j \sum_{j \ge 4} a_j(u) Z_j}\}|^2, \qquad
    b_u \approx \phi_0 + \sum_{m \ge 1} \beta_m(u)\, \phi_m

with phi_0 the mean and phi_m the principal components in the metric that matters for pictures: amplitudes of natural
pictures fall as 1/f, so an error of the PSF at frequency f shows in the picture as 1/f of itself, and

.. math:: \|b\|^2 = \sum_f |\hat b(f)|^2 / f^2, \qquad \beta_m = \langle b - \phi_0, \phi_m \rangle

Half as many of these reach the same error of the blurred picture as of plain principal components (D/r0 = 3 and above).
"""

from collections.abc import Sequence
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

PUPIL = 16
"""Samples across the aperture; twice as many in its Fourier plane make the pixel lambda / (2 D)."""
SAMPLES = 3000
"""PSFs that a basis learns from."""
MOST = 120
"""Components that a basis holds."""

_CHUNK = 1024  # PSFs at a time: what one step leaves is still in the processor's cache at the next
_PASS = 0.42  # cycles a pixel of the smaller picture up to which all passes
_LOWEST = 1 / 64  # cycles a pixel; lower frequencies count as this one


@lru_cache
def _pupil(modes: int, points: int) -> tuple[Tensor, Tensor]:
    """The aperture on a points^2 grid: the part of each sample inside the disk, and Z_4..Z_modes, (modes-3, samples).

    Counting samples at the rim by the part of their area inside makes sixteen across as good as many more.
    """
    x, y = pupil_grid(points)
    basis = zernike_basis(range(4, modes + 1), np.hypot(x, y), np.arctan2(y, x))
    part = circular(points, subsamples=16)
    return torch.as_tensor(part).flatten(), torch.as_tensor(basis).flatten(1)


def _spread(high_PN: Tensor, points: int) -> Tensor:
    """|F{P e^{j phi}}|^2 in FFT order, not normalised, (P, 2 points, 2 points)."""
    part, basis = _pupil(high_PN.shape[-1] + 3, points)
    phase = high_PN @ basis.to(high_PN)
    part = part.to(phase)
    wave = torch.complex(part * phase.cos(), part * phase.sin()).view(-1, points, points)
    field = torch.fft.fft2(wave, s=(2 * points, 2 * points))
    return field.real.square() + field.imag.square()


def kernel_size(q: float = 1.0, points: int = PUPIL) -> int:
    """Width of a kernel, pixels of q lambda / (2 D), odd: what the Fourier plane of `points` samples holds."""
    return 2 * max(int((points - 1) / q + 1e-9), 1) + 1


@lru_cache
def resampling(q: float, points: int = PUPIL) -> Tensor:
    r"""From Nyquist samples in FFT order to pixels of q lambda / (2 D), (kernel_size, 2 points); separable.

    The intensity is band-limited, so its samples say all about it. Pixels larger than Nyquist's collect light over their
    own area where a Nyquist sample stands for its own: the transfer function sinc(q f) / sinc(f), the mean of neighbours
    for q = 2. Smaller ones only sample it.
    """
    size = kernel_size(q, points)
    if q == 1:
        nyquist = torch.eye(2 * points, dtype=torch.float64)
        return nyquist.roll(points - 1, 0)[:size]
    f = np.fft.fftfreq(2 * points)
    transfer = np.sinc(q * f) / np.sinc(f) if q > 1 else np.ones_like(f)
    place = q * (np.arange(size) - size // 2)
    phase = 2 * np.pi * f * (place[:, None, None] - np.arange(2 * points)[:, None])
    return torch.from_numpy((transfer * np.cos(phase)).mean(-1))


def tilt_free_psf(high_PN: Tensor, q: float = 1.0, points: int = PUPIL) -> Tensor:
    """Tilt-free PSFs (P, kernel_size, kernel_size) of coefficients a_4..a_J (P, J-3), rad; each sums to one.

    Args:
        high_PN: differentiable.
        q: pixel in units of lambda / (2 D).
        points: samples across the aperture.
    """
    spread = _spread(high_PN, points)
    if q == 1:
        psf = torch.fft.fftshift(spread, dim=(-2, -1))[:, 1:, 1:]  # odd, centred on the zero shift
    else:
        matrix = resampling(q, points).to(spread)
        psf = matrix @ spread @ matrix.T
    return psf / psf.sum(dim=(-2, -1), keepdim=True)


def in_metric(kernels_Pkk: Tensor) -> Tensor:
    """Kernels in the metric of pictures: their Fourier transforms over f, (P, N) real; distances there are those above."""
    size = _metric_size(kernels_Pkk.shape[-1])
    weight = _metric_weight(size).to(kernels_Pkk)
    half = kernels_Pkk.shape[-1] // 2
    padded = F.pad(kernels_Pkk, (0, size - kernels_Pkk.shape[-1]) * 2).roll((-half, -half), (-2, -1))
    return torch.view_as_real(torch.fft.rfft2(padded, norm="ortho") * weight).flatten(1)


def _metric_size(kernel: int) -> int:
    """Samples a side of the Fourier plane: kernels and their differences must not wrap around."""
    return 64 * -(-2 * kernel // 64)


@lru_cache
def _metric_weight(size: int) -> Tensor:
    """1/f on the half-plane of frequencies, each pair counted once for both."""
    fy, fx = np.meshgrid(np.fft.fftfreq(size), np.fft.rfftfreq(size), indexing="ij")
    pairs = np.full(size // 2 + 1, 2.0)
    pairs[[0, -1]] = 1.0
    return torch.from_numpy(np.sqrt(pairs) / np.maximum(np.hypot(fx, fy), _LOWEST))


@dataclass(frozen=True, eq=False)
class PSFBasis:
    """Mean and leading components of tilt-free PSFs.

    Attributes:
        mean: (K, K), sums to one.
        components: phi_m, (M, K, K); each sums to nearly zero, as differences of PSFs do.
        dual: (M, K, K); the weight of phi_m in a PSF b is sum_x (b - mean)(x) dual_m(x).
        variance: of the weights over the PSFs it was made of, (M,): energies in the metric of pictures.
        left: energy of those PSFs beyond all components.
        q: pixel in units of lambda / (2 D).
        points: samples across the aperture of the PSFs.
    """

    mean: Tensor
    components: Tensor
    dual: Tensor
    variance: Tensor
    left: float
    q: float = 1.0
    points: int = PUPIL

    @property
    def size(self) -> int:
        """Width of a kernel, K."""
        return self.mean.shape[-1]

    def leading(self, components: int) -> "PSFBasis":
        """The first `components` of it."""
        check_range("PSF components", components, 0, len(self.components))
        m = components
        left = self.left + float(self.variance[m:].sum())
        kept = (self.components[:m], self.dual[:m], self.variance[:m])
        return PSFBasis(self.mean, *kept, left, self.q, self.points)

    def weights(self, psf_Pkk: Tensor) -> Tensor:
        """Weights of the components in PSFs, (P, M)."""
        return (psf_Pkk - self.mean.to(psf_Pkk)).flatten(1) @ self.dual.flatten(1).T.to(psf_Pkk)

    def project(self, high_PN: Tensor) -> Tensor:
        """`weights(tilt_free_psf(high))`, (P, M), without making the PSFs: one product with |F|^2 as it comes."""
        offset = (self.dual * self.mean).sum((1, 2)).to(high_PN)
        columns = self.nyquist_columns.to(high_PN)
        parts = []
        for chunk in high_PN.split(_CHUNK):
            products = _spread(chunk, self.points).flatten(1) @ columns
            parts.append(products[:, :-1] / products[:, -1:] - offset)
        return torch.cat(parts)

    @cached_property
    def nyquist_columns(self) -> Tensor:
        """The dual, and a sum over the kernel, of Nyquist samples in FFT order: columns, (4 points^2, M + 1)."""
        matrix = resampling(self.q, self.points)
        kernels = torch.cat((self.dual, torch.ones_like(self.mean)[None])).double()
        return (matrix.T @ kernels @ matrix).flatten(1).T.to(self.mean.dtype).contiguous()

    def psf(self, weights_PM: Tensor) -> Tensor:
        """PSFs (P, K, K) from their weights."""
        return self.mean.to(weights_PM) + torch.einsum("pm,mij->pij", weights_PM, self.components.to(weights_PM))

    def transfer(self, size: Sequence[int], like: Tensor, factor: int = 1) -> list[Tensor]:
        """Transfer functions of mean and components on the half-plane of an FFT of `size`, complex.

        Args:
            size: rows and columns of the FFT.
            like: the pictures, for their precision and device.
            factor: keep only what an FFT of 1 / factor of the size holds of the components.

        Returns:
            a list of two: (rows, columns // 2 + 1) of the mean, (M, ...) of the components.
        """
        key = (tuple(size), like.dtype, like.device, factor)
        if key not in self._transfers:
            half = self.size // 2
            kernels = torch.cat((self.mean[None], self.components)).to(like)
            kernels = F.pad(kernels, (0, size[1] - self.size, 0, size[0] - self.size))
            whole = torch.fft.rfft2(kernels.roll((-half, -half), (1, 2)))
            self._transfers[key] = [whole[0], low_band(whole[1:], factor) * roll_off(tuple(size), factor).to(like)]
        return self._transfers[key]

    @cached_property
    def _transfers(self) -> dict[object, list[Tensor]]:
        return {}


def low_band(spectrum: Tensor, factor: int) -> Tensor:
    """Of a half-plane spectrum (..., rows, columns // 2 + 1) what an FFT of 1/factor of the size holds below its Nyquist."""
    if factor == 1:
        return spectrum
    rows, columns = spectrum.shape[-2] // factor, 2 * (spectrum.shape[-1] - 1) // factor
    h, w = rows // 2, columns // 2
    low = spectrum.new_zeros((*spectrum.shape[:-2], rows, w + 1))
    low[..., :h, :w] = spectrum[..., :h, :w]
    low[..., h + 1 :, :w] = spectrum[..., -(h - 1) :, :w]
    return low


@lru_cache
def roll_off(size: Sequence[int], factor: int) -> Tensor:
    """What passes from an FFT of `size` to one of 1/factor of it: 1, falling like a squared cosine in the outer sixth.

    A sharp cut would ring across the picture. (rows, columns // 2 + 1) of the smaller one.
    """
    rows, columns = (n // factor for n in size)
    if factor == 1:
        return torch.ones(rows, columns // 2 + 1)
    sides = []
    for f in (np.fft.fftfreq(rows), np.fft.rfftfreq(columns)):
        outer = np.clip((np.abs(f) - _PASS) / (0.5 - _PASS), 0, 1)
        sides.append(torch.from_numpy(np.cos(np.pi / 2 * outer) ** 2).float())
    return torch.outer(*sides)


@lru_cache
def psf_samples(weakest: float, strongest: float, modes: int = 36, count: int = SAMPLES) -> Tensor:
    """Coefficients a_4..a_J (count, J-3), rad, of Kolmogorov turbulence with D/r0 log-uniform between two strengths.

    Seeded: always the same.
    """
    generator = torch.Generator().manual_seed(0)
    factor = torch.as_tensor(np.linalg.cholesky(noll_matrix(range(4, modes + 1))), dtype=torch.float32)
    low, high = np.log(max(weakest, 1e-3)), np.log(max(strongest, 1e-3))
    strength = torch.exp(low + (high - low) * torch.rand(count, 1, generator=generator))
    return (torch.randn(count, modes - 3, generator=generator) @ factor.T) * strength ** (5 / 6)


@lru_cache
def _whole_basis(weakest: float, strongest: float, modes: int, q: float, points: int, most: int) -> PSFBasis:
    psf = tilt_free_psf(psf_samples(weakest, strongest, modes), q, points)
    mean = psf.mean(0)
    deviation = psf - mean
    spread = in_metric(deviation)
    # Subspace iteration: only the leading components are wanted.
    span = torch.randn(spread.shape[1], most + 8, generator=torch.Generator().manual_seed(0))
    for _ in range(3):
        span, _ = torch.linalg.qr(spread.T @ (spread @ span))
    scores = (spread @ span).double()
    energies, turn = torch.linalg.eigh(scores.T @ scores / len(psf))
    energies, turn = energies.flip(0)[:most], turn.flip(1)[:, :most]
    # A component is the mean of the PSFs by their score on it; its dual, the metric applied to it.
    scores = scores @ turn
    components = (scores.T @ deviation.flatten(1).double()) / len(psf) / energies.clamp(min=1e-20)[:, None]
    components = components.float().view(most, *mean.shape)
    left = float(spread.square().sum() / len(psf) - energies.sum())
    return PSFBasis(mean, components, _lower(components), energies.float(), max(left, 0.0), q, points)


def _lower(kernels_Mkk: Tensor) -> Tensor:
    """The metric applied to kernels: <b, kernel> = sum_x b(x) lower(x), same shape."""
    kernel = kernels_Mkk.shape[-1]
    size = _metric_size(kernel)
    weight = _metric_weight(size) ** 2
    weight[:, 1:-1] /= 2  # not a sum over pairs here
    padded = F.pad(kernels_Mkk.double(), (0, size - kernel) * 2)
    lowered = torch.fft.irfft2(torch.fft.rfft2(padded) * weight, s=(size, size))
    return lowered[:, :kernel, :kernel].float().contiguous()


def psf_basis(
    components: int, weakest: float, strongest: float, modes: int = 36, q: float = 1.0, points: int = PUPIL
) -> PSFBasis:
    """Leading components of PSFs in Kolmogorov turbulence with D/r0 log-uniform between two strengths.

    Args:
        components: M, how many to keep beyond the mean.
        weakest, strongest: range of D/r0.
        modes: highest Noll index.
        q: pixel in units of lambda / (2 D).
        points: samples across the aperture.

    Raises:
        ParameterError: more components than 500 or than a kernel has pixels.
    """
    size = kernel_size(q, points)
    check_range("PSF components", components, 0, min(500, size**2 - 1))
    most = min(max(components, MOST), size**2 - 1)
    return _whole_basis(weakest, strongest, modes, q, points, most).leading(components)
