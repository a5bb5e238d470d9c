r"""Paraxial propagation of a sampled field through still air, and through a thin lens.

The Fresnel integral over the distance z, k = 2 pi / lambda (the constant phase e^{ikz} is left out):

.. math::
    U(x, z) = \frac{1}{i \lambda z} \int U(\xi, 0)\, e^{\frac{ik}{2z} |x - \xi|^2} d^2\xi
            = \mathcal{F}^{-1}\{ e^{-i\pi\lambda z |f|^2}\, \mathcal{F}\{U(\xi, 0)\} \}

The first form is one Fourier transform (`fresnel_one_step`, whose output spacing is fixed by the input's), two of them
through a third plane (`fresnel_two_step`, free spacing), the second form a convolution (`angular_spectrum`, free
spacing). Far away the quadratic phase of the source no longer matters (`fraunhofer`). Each of them is unitary on its
grid: the sum of |U|^2 spacing^2 is kept to rounding.

Fields are complex tensors (..., N, N), any leading axes, sample (N//2, N//2) on the axis; complex64 or complex128, on
any device. Lengths in metres. A phase is formed in float64 and rounded once, since it runs to thousands of radians.
Source: D. G. Voelz, Computational Fourier Optics (2011), ch. 5; J. D. Schmidt, Numerical Simulation of Optical Wave
Propagation (2010), ch. 6-8.
"""

import math

import torch
from torch import Tensor

from turbnet.errors import ParameterError, check_range


def coordinates(count: int, spacing: float, device: torch.device | str = "cpu") -> Tensor:
    """The `count` sample positions (i - count//2) spacing, float64."""
    return (torch.arange(count, dtype=torch.float64, device=device) - count // 2) * spacing


def frequencies(count: int, spacing: float, device: torch.device | str = "cpu") -> Tensor:
    """The frequencies of torch.fft.fft, cycles per unit of `spacing`, float64, zero first."""
    return torch.fft.fftfreq(count, spacing, dtype=torch.float64, device=device)


def fresnel_one_step(field: Tensor, wavelength: float, spacing: float, distance: float) -> tuple[Tensor, float]:
    """Fresnel propagation by a single Fourier transform.

    Args:
        field: U at the input plane, (..., N, N).
        wavelength: lambda, m.
        spacing: of the input samples, m.
        distance: z, m; negative goes back.

    Returns:
        U at the output plane and the spacing of its samples, lambda |z| / (N spacing), m.

    Raises:
        ParameterError: a field that is not square and complex, or a length out of its range.
    """
    count = _check(field, wavelength, distance, spacing=spacing)
    spacing_out = wavelength * abs(distance) / (count * spacing)
    field = _chirp(field, spacing, 1 / (wavelength * distance))
    field = _fourier(field, inverse=distance < 0) * (spacing**2 / (1j * wavelength * distance))
    return _chirp(field, spacing_out, 1 / (wavelength * distance)), spacing_out


def fresnel_two_step(
    field: Tensor, wavelength: float, spacing_in: float, spacing_out: float, distance: float
) -> Tensor:
    """Fresnel propagation by two Fourier transforms, with an output spacing of one's choice.

    The way goes through a plane at z1 = distance / (1 - m), m = spacing_out / spacing_in, whose own spacing is what
    one step gives. Arguments as `fresnel_one_step`; m = 1 has no such plane (use `angular_spectrum`).

    Raises:
        ParameterError: also when the two spacings are equal.
    """
    _check(field, wavelength, distance, spacing_in=spacing_in, spacing_out=spacing_out)
    magnification = spacing_out / spacing_in
    if abs(magnification - 1) < 1e-6:
        raise ParameterError(
            f"two-step propagation needs spacing_out ({spacing_out:g} m) to differ from spacing_in; "
            "use angular_spectrum for equal spacings"
        )
    first = distance / (1 - magnification)
    field, middle = fresnel_one_step(field, wavelength, spacing_in, first)
    return fresnel_one_step(field, wavelength, middle, distance - first)[0]


def angular_spectrum(
    field: Tensor, wavelength: float, spacing_in: float, spacing_out: float, distance: float
) -> Tensor:
    r"""Fresnel propagation as a convolution, with an output spacing of one's choice.

    With m = spacing_out / spacing_in the integral is, exactly,

    .. math::
        U(x) = e^{\frac{ik}{2z} \frac{m-1}{m} |x|^2} \mathcal{F}^{-1}\{ e^{-i\pi\lambda (z/m) |f|^2}
               \mathcal{F}\{ \tfrac1m e^{\frac{ik}{2z} (1-m) |\xi|^2} U(\xi) \} \}

    Arguments as `fresnel_one_step`. Light that leaves the grid comes back at the opposite edge.
    """
    count = _check(field, wavelength, distance, spacing_in=spacing_in, spacing_out=spacing_out)
    magnification = spacing_out / spacing_in
    if distance == 0:
        return field
    if magnification != 1:
        field = _chirp(field, spacing_in, (1 - magnification) / (wavelength * distance)) / magnification
    transfer = fresnel_transfer(count, spacing_in, wavelength, distance / magnification, field.device).to(field.dtype)
    field = torch.fft.ifft2(torch.fft.fft2(field) * transfer[:, None] * transfer)
    if magnification != 1:
        field = _chirp(field, spacing_out, (magnification - 1) / (magnification * wavelength * distance))
    return field


def fraunhofer(field: Tensor, wavelength: float, spacing: float, distance: float) -> tuple[Tensor, float]:
    """The far field: as `fresnel_one_step` without the quadratic phase in the input plane.

    Right where distance >> pi (input radius)^2 / lambda, or in the focal plane of a lens that holds the aperture.
    """
    count = _check(field, wavelength, distance, spacing=spacing)
    check_range("distance", distance, 1e-12, math.inf, "m")
    spacing_out = wavelength * distance / (count * spacing)
    field = _fourier(field) * (spacing**2 / (1j * wavelength * distance))
    return _chirp(field, spacing_out, 1 / (wavelength * distance)), spacing_out


def thin_lens(field: Tensor, wavelength: float, spacing: float, focal_length: float) -> Tensor:
    """The field behind a thin lens: times exp(-i k |x|^2 / (2 f)); f > 0 m converges. Arguments as above."""
    _check(field, wavelength, focal_length, spacing=spacing)
    if focal_length == 0:
        raise ParameterError("focal_length = 0 m: a lens of no focal length does not exist")
    return _chirp(field, spacing, -1 / (wavelength * focal_length))


def fresnel_transfer(
    count: int, spacing: float, wavelength: float, distance: float, device: torch.device | str = "cpu"
) -> Tensor:
    """exp(-i pi lambda z f^2) over `frequencies(count, spacing)`, complex128: one axis of the transfer function."""
    f = frequencies(count, spacing, device)
    return torch.polar(torch.ones_like(f), -math.pi * wavelength * distance * f**2)


def _chirp(field: Tensor, spacing: float, rate: float) -> Tensor:
    """Times exp(i pi rate |x|^2), rate in 1/m^2."""
    x = coordinates(field.shape[-1], spacing, field.device)
    chirp = torch.polar(torch.ones_like(x), math.pi * rate * x**2).to(field.dtype)
    return field * chirp[:, None] * chirp


def _fourier(field: Tensor, inverse: bool = False) -> Tensor:
    """Discrete sum over e^{-2 pi i f x} (e^{+...} for the inverse sign), both axes centred on sample N//2."""
    axes = (-2, -1)
    field = torch.fft.ifftshift(field, dim=axes)
    field = torch.fft.ifft2(field, norm="forward") if inverse else torch.fft.fft2(field)
    return torch.fft.fftshift(field, dim=axes)


def _check(field: Tensor, wavelength: float, distance: float, **spacings: float) -> int:
    if not field.is_complex() or field.ndim < 2 or field.shape[-1] != field.shape[-2]:
        raise ParameterError(f"field must be complex of shape (..., N, N), not {field.dtype} {tuple(field.shape)}")
    check_range("wavelength", wavelength, 1e-8, 1e-3, "m")
    check_range("distance", distance, -1e12, 1e12, "m")
    for name, value in spacings.items():
        check_range(name, value, 1e-9, 1e3, "m")
    return int(field.shape[-1])
