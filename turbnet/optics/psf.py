r"""Point spread and transfer functions of an aperture, and the images it forms.

.. math::
    h(p) = \int P(\rho)\, e^{i\phi(\rho)}\, e^{-i \pi q\, p \cdot \rho / 2}\, d^2\rho, \qquad
    \mathrm{PSF} = |h|^2 / \textstyle\sum |h|^2

with rho in aperture radii and p in pixels of q lambda / (2D) radians: q = 1 is Nyquist sampling of the intensity. The
transform is a matrix product on the wanted pixels only (R. Soummer et al., Opt. Express 15, 15935 (2007)), so any q and
any size are exact up to the sampling of the pupil, with no padding. With this sign a_2 > 0 moves the PSF to +x (right)
and a_3 > 0 to +y (down), by 4a / (pi q) pixels.

Another wavelength lambda' seen by the same detector: phase times lambda / lambda', q times lambda / lambda'.

Tensors are batched over leading axes and everything is differentiable. Source: J. W. Goodman, Introduction to Fourier
Optics, chapters 5 and 6.
"""

import math

import numpy as np
import torch
from scipy.special import j1
from torch import Tensor

from turbnet.errors import ParameterError, check_range
from turbnet.optics.zernike import Array


def amplitude_spread(phase: Tensor, pupil: Tensor, size: int, q: float = 1.0) -> Tensor:
    """Complex amplitude h on `size` x `size` pixels, the optical axis at pixel `size // 2`.

    Args:
        phase: phi on the pupil grid, (..., N, N), rad; the grid of `turbnet.optics.pupil.pupil_grid`.
        pupil: transmission P, (N, N) or (..., N, N).
        size: pixels along a side of the result.
        q: pixel in units of lambda / (2D).

    Returns:
        (..., size, size), complex, scaled so that its Fourier transform over all pixels is the pupil.

    Raises:
        ParameterError: shapes differ, or the window reaches beyond the 2N/q pixels the pupil grid can tell apart.
    """
    points = phase.shape[-1]
    if phase.shape[-2:] != pupil.shape[-2:] or phase.shape[-2] != points:
        raise ParameterError(f"phase {tuple(phase.shape)} and pupil {tuple(pupil.shape)} must share one square grid")
    check_range("q", q, 1e-3, 1e3)
    check_range("PSF size", size, 1, int(2 * points / q), f"pixels (2N/q for N = {points} pupil points)")
    axis = (2 * torch.arange(points, dtype=phase.dtype, device=phase.device) + 1 - points) / points
    pixel = torch.arange(size, dtype=phase.dtype, device=phase.device) - size // 2
    angle = (-0.5 * math.pi * q) * pixel[:, None] * axis
    kernel_PN = torch.polar(torch.full_like(angle, q / (2 * points)), angle)
    field = torch.polar(pupil.to(phase.dtype).expand_as(phase), phase)
    return kernel_PN @ field @ kernel_PN.mT


def psf(phase: Tensor, pupil: Tensor, size: int, q: float = 1.0) -> Tensor:
    """|h|^2 with unit sum over the window, (..., size, size); arguments as in `amplitude_spread`."""
    intensity = amplitude_spread(phase, pupil, size, q).abs().square()
    return intensity / intensity.sum((-2, -1), keepdim=True)


def otf(spread: Tensor) -> Tensor:
    """Optical transfer function of a PSF (..., H, W), 1 at zero frequency; complex, frequencies in FFT order.

    The axis of the PSF is its pixel (H // 2, W // 2), so a centred symmetric PSF has a real OTF. Frequencies are
    `torch.fft.fftfreq` cycles per pixel; the cutoff D/lambda is q/2 cycles per pixel.
    """
    transfer = torch.fft.fft2(torch.fft.ifftshift(spread, dim=(-2, -1)))
    return transfer / transfer[..., :1, :1]


def amplitude_transfer(phase: Tensor, pupil: Tensor, size: int, q: float = 1.0) -> Tensor:
    """Amplitude transfer function of coherent light: Fourier transform of h, in FFT order, (..., size, size).

    It is the pupil itself: P(rho) e^{i phi(rho)} at -q rho / 4 cycles per pixel, so its cutoff is half that of the OTF.
    """
    spread = amplitude_spread(phase, pupil, size, q)
    return torch.fft.fft2(torch.fft.ifftshift(spread, dim=(-2, -1)))


def exponential_psf(sigma: float, size: int) -> Tensor:
    r"""A blur that falls off exponentially, (size, size), float64, unit sum over the window, centred on `size // 2`.

    .. math::
        h(r) \propto e^{-r/a}, \qquad H(f) = \{1 + (2\pi a f)^2\}^{-3/2}, \qquad \sigma = \sqrt 3\, a

    A mean over Gaussians of many widths, as where a blur changes while it is looked at, or of air and glass that scatter. In
    clips of word cards through hot air, registered and averaged, its iteration of Richardson and Lucy reads 18 of 20
    words, that of a Gaussian 14 at best (docs/benchmarks.md).

    Args:
        sigma: RMS width along either axis, pixels.
        size: pixels along a side.

    Raises:
        ParameterError: a value out of range.
    """
    check_range("sigma", sigma, 0.05, 1000.0, "pixels")
    axis = torch.arange(int(check_range("PSF size", size, 1, 4096)), dtype=torch.float64, device="cpu") - size // 2
    kernel = torch.exp(-math.sqrt(3) / sigma * torch.hypot(axis[:, None], axis))
    return kernel / kernel.sum()


def convolve(image: Tensor, kernel: Tensor) -> Tensor:
    """image ⊛ kernel, same size as the image, nothing beyond its border; the kernel's axis is its pixel size // 2.

    Args:
        image: (..., H, W), real or complex.
        kernel: (..., h, w), real or complex; leading axes broadcast.
    """
    (height, width), (kh, kw) = image.shape[-2:], kernel.shape[-2:]
    full = (height + kh - 1, width + kw - 1)
    top, left = kh // 2, kw // 2
    if image.is_complex() or kernel.is_complex():
        result = torch.fft.ifft2(torch.fft.fft2(image, s=full) * torch.fft.fft2(kernel, s=full))
    else:
        result = torch.fft.irfft2(torch.fft.rfft2(image, s=full) * torch.fft.rfft2(kernel, s=full), s=full)
    return result[..., top : top + height, left : left + width]


def incoherent_image(intensity: Tensor, spread: Tensor) -> Tensor:
    """I = J ⊛ PSF: light from different points of the scene adds in intensity (sunlight)."""
    return convolve(intensity, spread)


def coherent_image(field: Tensor, amplitude: Tensor) -> Tensor:
    """I = |U ⊛ h|^2: light from different points of the scene adds in amplitude (laser)."""
    return convolve(field, amplitude).abs().square()


def airy(angle: Array) -> Array:
    """Airy pattern [2 J_1(pi v) / (pi v)]^2, peak 1, at v = angle times D / lambda."""
    x = np.pi * np.asarray(angle, dtype=np.float64)
    safe = np.where(x == 0, 1.0, x)
    return np.where(x == 0, 1.0, 2 * j1(safe) / safe) ** 2


def diffraction_mtf(frequency: Array) -> Array:
    """(2/pi) [acos f - f sqrt(1 - f^2)] of a circular aperture, f in units of the cutoff D / lambda, 0 beyond."""
    f = np.clip(np.abs(np.asarray(frequency, dtype=np.float64)), 0.0, 1.0)
    return 2 / np.pi * (np.arccos(f) - f * np.sqrt(1 - f**2))


def rayleigh_limit(aperture: float, wavelength: float) -> float:
    """1.2197 lambda / D, rad: the first dark ring of the Airy pattern, where two points count as just resolved.

    Args:
        aperture: diameter D, m.
        wavelength: lambda, m.
    """
    check_range("aperture", aperture, 1e-3, 50.0, "m")
    check_range("wavelength", wavelength, 1e-7, 2e-5, "m")
    return 1.2196698912665045 * wavelength / aperture
