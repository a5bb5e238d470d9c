import math

import numpy as np
import pytest
import torch
from scipy.special import fresnel, j1

from turbnet.errors import ParameterError
from turbnet.optics.propagation import (
    angular_spectrum,
    coordinates,
    fraunhofer,
    fresnel_one_step,
    fresnel_two_step,
    thin_lens,
)

WAVELENGTH = 525e-9


def gaussian(count: int, spacing: float, waist: float, z: float) -> torch.Tensor:
    """A Gaussian beam z metres past its waist, e^{ikz} left out."""
    x = coordinates(count, spacing)
    q = z - 1j * math.pi * waist**2 / WAVELENGTH
    amplitude = -1j * math.pi * waist**2 / WAVELENGTH / q
    return amplitude * torch.exp(1j * math.pi / (WAVELENGTH * q) * (x[:, None] ** 2 + x**2))


def error(field: torch.Tensor, expected: torch.Tensor) -> float:
    return float((field - expected).norm() / expected.norm())


def energy(field: torch.Tensor, spacing: float) -> float:
    return float((field.abs() ** 2).sum() * spacing**2)


@pytest.mark.parametrize("count", [192, 193])
@pytest.mark.parametrize("ratio", [1.0, 0.8, 1.7])
def test_gaussian_beam_by_angular_spectrum(count, ratio):
    spacing, z = 0.5e-3, 200.0
    field = angular_spectrum(gaussian(count, spacing, 8e-3, 0), WAVELENGTH, spacing, ratio * spacing, z)
    assert error(field, gaussian(count, ratio * spacing, 8e-3, z)) < 2e-7


@pytest.mark.parametrize("count", [256, 255])
@pytest.mark.parametrize("z", [300.0, -300.0])
def test_gaussian_beam_by_one_and_two_steps(count, z):
    spacing = 0.8e-3
    source = gaussian(count, spacing, 8e-3, 0)
    field, spacing_out = fresnel_one_step(source, WAVELENGTH, spacing, z)
    assert spacing_out == pytest.approx(WAVELENGTH * abs(z) / (count * spacing))
    assert error(field, gaussian(count, spacing_out, 8e-3, z)) < 1e-8
    field = fresnel_two_step(source, WAVELENGTH, spacing, 0.6 * spacing, z)
    assert error(field, gaussian(count, 0.6 * spacing, 8e-3, z)) < 1e-6


def test_talbot_image_of_a_grating_repeats():
    period, count = 16, 64
    spacing = 1e-3
    x = torch.arange(count)
    grating = (x % period < 5).to(torch.complex128).expand(count, count)
    talbot = 2 * (period * spacing) ** 2 / WAVELENGTH
    assert error(angular_spectrum(grating, WAVELENGTH, spacing, spacing, talbot), grating) < 1e-9
    half = angular_spectrum(grating, WAVELENGTH, spacing, spacing, talbot / 2)
    assert error(half, grating.roll(period // 2, -1)) < 1e-9
    assert error(half, grating) > 0.5


def test_square_aperture_against_fresnel_integrals():
    """Fresnel number 3.05: the field near the axis, where the sharp edge's sampling error has died out."""
    count, width, z = 1024, 0.08, 1000.0
    spacing = width / 112  # critical sampling: count spacing^2 = lambda z
    x = coordinates(count, spacing)
    inside = ((x.abs() < width / 2) + 0.5 * ((x.abs() - width / 2).abs() < spacing / 100)).to(torch.complex128)
    field = angular_spectrum(inside[:, None] * inside, WAVELENGTH, spacing, spacing, z)
    scale = math.sqrt(2 / (WAVELENGTH * z))
    s1, c1 = fresnel(scale * (width / 2 - x.numpy()))
    s0, c0 = fresnel(scale * (-width / 2 - x.numpy()))
    one = torch.from_numpy(((c1 - c0) + 1j * (s1 - s0)) * np.exp(-0.25j * np.pi) / np.sqrt(2))
    middle = slice(count // 2 - 28, count // 2 + 29)
    assert error(field[middle, middle], (one[:, None] * one)[middle, middle]) < 5e-3


def test_far_field_of_a_circle_is_the_airy_pattern():
    count, diameter, z = 512, 0.02, 5e4
    spacing = diameter / 96
    fine = coordinates(count * 4, spacing / 4)  # the edge by 4x4 supersampling, centres of the sub-samples
    offset = (fine + spacing / 8).view(count, 4)
    inside = (offset[:, :, None, None] ** 2 + offset**2 < (diameter / 2) ** 2).double().mean(dim=(1, 3))
    # The supersampled cells sit 3/8 spacing off the samples: a pure phase in the far field.
    field, spacing_out = fraunhofer(inside.to(torch.complex128), WAVELENGTH, spacing, z)
    intensity = (field.abs() ** 2).numpy()
    r = np.hypot(*np.meshgrid(*[coordinates(count, spacing_out).numpy()] * 2))
    v = np.pi * diameter * r / (WAVELENGTH * z)
    v[v == 0] = 1e-9
    airy = (math.pi * diameter**2 / (4 * WAVELENGTH * z)) ** 2 * (2 * j1(v) / v) ** 2
    near = v < 12
    assert np.abs(intensity - airy)[near].max() < 2e-3 * airy.max()


def test_a_lens_focuses_to_the_far_field():
    count, f = 256, 50.0
    spacing = 0.4e-3
    source = gaussian(count, spacing, 5e-3, 0).roll(3, -1)
    focused, out = fresnel_one_step(thin_lens(source, WAVELENGTH, spacing, f), WAVELENGTH, spacing, f)
    far, far_out = fraunhofer(source, WAVELENGTH, spacing, f)
    assert out == pytest.approx(far_out)
    assert error(focused, far) < 1e-9


@pytest.mark.parametrize("dtype", [torch.complex64, torch.complex128])
def test_energy_is_kept_and_batches_agree(dtype):
    generator = torch.Generator().manual_seed(0)
    spacing, z = 1e-3, 700.0
    field = torch.randn(2, 3, 64, 64, dtype=dtype, generator=generator)
    tolerance = 1e-5 if dtype == torch.complex64 else 1e-12
    one, one_out = fresnel_one_step(field, WAVELENGTH, spacing, z)
    far, far_out = fraunhofer(field, WAVELENGTH, spacing, z)
    two = fresnel_two_step(field, WAVELENGTH, spacing, 2 * spacing, z)
    asm = angular_spectrum(field, WAVELENGTH, spacing, 2 * spacing, z)
    for result, out in [(one, one_out), (far, far_out), (two, 2 * spacing), (asm, 2 * spacing)]:
        assert result.dtype == dtype
        assert energy(result, out) == pytest.approx(energy(field, spacing), rel=tolerance)
    alone = angular_spectrum(field[1, 2], WAVELENGTH, spacing, 2 * spacing, z)
    torch.testing.assert_close(asm[1, 2], alone)


def test_propagation_there_and_back_is_the_identity():
    field = torch.randn(33, 33, dtype=torch.complex128, generator=torch.Generator().manual_seed(1))
    there = angular_spectrum(field, WAVELENGTH, 1e-3, 1.5e-3, 200.0)
    assert error(angular_spectrum(there, WAVELENGTH, 1.5e-3, 1e-3, -200.0), field) < 1e-10
    assert angular_spectrum(field, WAVELENGTH, 1e-3, 1e-3, 0.0) is field


def test_gradients_in_float64():
    field = torch.randn(6, 6, dtype=torch.complex128, requires_grad=True)
    assert torch.autograd.gradcheck(lambda u: angular_spectrum(u, WAVELENGTH, 1e-3, 2e-3, 5.0), (field,))
    assert torch.autograd.gradcheck(lambda u: fresnel_one_step(u, WAVELENGTH, 1e-3, 5.0)[0], (field,))


def test_bad_input_is_named():
    field = torch.ones(8, 8, dtype=torch.complex64)
    with pytest.raises(ParameterError, match="complex of shape"):
        angular_spectrum(torch.ones(8, 8), WAVELENGTH, 1e-3, 1e-3, 1.0)
    with pytest.raises(ParameterError, match="complex of shape"):
        fresnel_one_step(field[:5], WAVELENGTH, 1e-3, 1.0)
    with pytest.raises(ParameterError, match="wavelength = 525"):
        fraunhofer(field, 525, 1e-3, 1.0)
    with pytest.raises(ParameterError, match="spacing_in = 0"):
        angular_spectrum(field, WAVELENGTH, 0.0, 1e-3, 1.0)
    with pytest.raises(ParameterError, match="use angular_spectrum"):
        fresnel_two_step(field, WAVELENGTH, 1e-3, 1e-3, 1.0)
    with pytest.raises(ParameterError, match="distance"):
        fraunhofer(field, WAVELENGTH, 1e-3, -1.0)
    with pytest.raises(ParameterError, match="distance = nan"):
        fresnel_one_step(field, WAVELENGTH, 1e-3, float("nan"))
    with pytest.raises(ParameterError, match="focal_length"):
        thin_lens(field, WAVELENGTH, 1e-3, 0.0)
