import math

import numpy as np
import pytest
import torch

from turbnet.errors import ParameterError
from turbnet.optics import psf as optics
from turbnet.optics.pupil import annular, circular, zernike_modes

POINTS = 64


@pytest.fixture
def pupil():
    return torch.tensor(circular(POINTS, subsamples=8))


@pytest.fixture
def flat():
    return torch.zeros(POINTS, POINTS, dtype=torch.float64)


def radius(size, centre):
    y, x = np.mgrid[:size, :size] - centre
    return np.hypot(x, y)


def aberrations(count, seed=0):
    modes = torch.tensor(zernike_modes(range(2, 12), POINTS))
    weights = torch.randn(count, 10, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return torch.einsum("bj,jyx->byx", 0.5 * weights, modes)


@pytest.mark.parametrize("q", [1.0, 0.5, 0.7])
@pytest.mark.parametrize("size", [31, 32])
def test_flat_phase_gives_the_airy_pattern(flat, pupil, q, size):
    spread = optics.psf(flat, pupil, size, q).numpy()
    expected = optics.airy(q * radius(size, size // 2) / 2)
    np.testing.assert_allclose(spread / spread.max(), expected, atol=2e-4)


def test_first_dark_ring_is_at_the_rayleigh_limit():
    assert optics.rayleigh_limit(0.2, 500e-9) == pytest.approx(1.21967 * 500e-9 / 0.2, rel=1e-5)
    assert optics.airy(np.array(1.2196698912665045)) == pytest.approx(0, abs=1e-25)


@pytest.mark.parametrize(("mode", "axis"), [(2, 1), (3, 0)])
@pytest.mark.parametrize("q", [1.0, 0.5])
@pytest.mark.parametrize("pixels", [3, -2])
def test_positive_tilt_moves_the_psf_the_positive_way(flat, pupil, mode, axis, q, pixels):
    coefficient = pixels * math.pi * q / 4
    tilt = coefficient * torch.tensor(zernike_modes([mode], POINTS))[0]
    # Windows of all pixels the pupil grid can tell apart are periodic, so a shift is a roll, exactly.
    size = int(2 * POINTS / q)
    moved = optics.psf(tilt, torch.tensor(circular(POINTS)), size, q)
    still = optics.psf(flat, torch.tensor(circular(POINTS)), size, q)
    torch.testing.assert_close(moved, torch.roll(still, pixels, dims=axis), atol=1e-12, rtol=0)


def test_unit_sum_and_batches(pupil):
    phases = aberrations(3)
    spread = optics.psf(phases, pupil, 33)
    assert spread.shape == (3, 33, 33)
    torch.testing.assert_close(spread.sum((-2, -1)), torch.ones(3, dtype=torch.float64))
    torch.testing.assert_close(spread[1], optics.psf(phases[1], pupil, 33))


def test_psf_agrees_with_the_padded_fft(pupil):
    phase = aberrations(1)[0]
    size = 2 * POINTS
    field = torch.zeros(size, size, dtype=torch.complex128)
    field[:POINTS, :POINTS] = torch.polar(pupil, phase)
    expected = torch.fft.fftshift(torch.fft.fft2(field).abs().square())
    torch.testing.assert_close(optics.psf(phase, pupil, size), expected / expected.sum(), atol=1e-14, rtol=1e-10)


def test_longer_wavelength_widens_the_psf(flat, pupil):
    ratio = 0.8  # lambda / lambda'
    wide = optics.psf(flat, pupil, 31, q=0.5 * ratio)
    expected = optics.airy(ratio * 0.5 * radius(31, 15) / 2)
    np.testing.assert_allclose(wide / wide.max(), expected, atol=2e-4)


@pytest.mark.parametrize("points", [128, 129])
def test_otf_of_a_clear_aperture_is_the_analytic_mtf(points):
    clear = torch.tensor(circular(points, 8))
    size = 2 * points
    transfer = optics.otf(optics.psf(torch.zeros_like(clear), clear, size))
    frequency = np.fft.fftfreq(size)
    expected = optics.diffraction_mtf(np.hypot(frequency[:, None], frequency) / 0.5)
    np.testing.assert_allclose(transfer.real, expected, atol=6e-3)  # of order 1/points: the sampled rim
    assert transfer.imag.abs().max() < 1e-12


def test_central_obscuration_lowers_middle_and_raises_high_frequencies(flat):
    stop, clear = torch.tensor(annular(POINTS, 0.4, 8)), torch.tensor(circular(POINTS, 8))
    change = optics.otf(optics.psf(flat, stop, 128)).abs() - optics.otf(optics.psf(flat, clear, 128)).abs()
    assert change[0, 20] < -0.05
    assert change[0, 50] > 0.02


def test_amplitude_transfer_is_the_pupil_itself():
    points = 65
    hard = torch.tensor(circular(points))
    phase = torch.tensor(zernike_modes([7], points))[0]
    transfer = optics.amplitude_transfer(phase, hard, 2 * points)
    pupil_field = torch.polar(hard, phase)
    indices = -(torch.arange(points) - points // 2) % (2 * points)  # rho = 2 i / N sits at -i/(2N) cycles a pixel
    torch.testing.assert_close(transfer[indices][:, indices], pupil_field, atol=1e-11, rtol=0)


def test_two_points_add_in_intensity_or_in_amplitude(flat, pupil):
    amplitude = optics.amplitude_spread(flat, pupil, 41)
    spread = amplitude.abs().square()
    scene = torch.zeros(64, 64, dtype=torch.float64)
    scene[30, 20] = scene[30, 22] = 1.0
    incoherent = optics.incoherent_image(scene, spread)
    shift = torch.roll(spread, 2, dims=1)
    torch.testing.assert_close(incoherent[20:41, 8:31], (spread + shift)[10:31, 8:31], atol=1e-12, rtol=0)
    # In antiphase coherent points cancel half way between them; incoherent ones cannot.
    antiphase = scene.to(torch.complex128)
    antiphase[30, 22] = -1.0
    assert optics.coherent_image(antiphase, amplitude)[30, 21] < 1e-20
    assert incoherent[30, 21] > 0.5 * incoherent.max()


@pytest.mark.parametrize("shape", [(7, 5), (8, 9)])
@pytest.mark.parametrize("kernel_size", [3, 4, 11])
def test_convolution_agrees_with_the_sum(shape, kernel_size):
    generator = torch.Generator().manual_seed(1)
    image = torch.randn(shape, dtype=torch.float64, generator=generator)
    kernel = torch.randn(kernel_size, kernel_size, dtype=torch.float64, generator=generator)
    expected = torch.zeros(shape, dtype=torch.float64)
    for y, x in np.ndindex(shape):
        for v, u in np.ndindex(shape):
            dy, dx = y - v + kernel_size // 2, x - u + kernel_size // 2
            if 0 <= dy < kernel_size and 0 <= dx < kernel_size:
                expected[y, x] += image[v, u] * kernel[dy, dx]
    torch.testing.assert_close(optics.convolve(image, kernel), expected)


@pytest.mark.parametrize("sigma", [2.0, 3.5])
def test_the_exponential_blur_has_its_width_and_its_transfer_function(sigma):
    """H(f) = {1 + (2 pi a f)^2}^(-3/2), a = sigma / sqrt(3), folded at every whole cycle a pixel by the sampling."""
    kernel = optics.exponential_psf(sigma, 129)
    x = torch.arange(129, dtype=torch.float64) - 64
    assert float(kernel.sum()) == pytest.approx(1, abs=1e-12)
    assert float((kernel.sum(0) * x**2).sum()) == pytest.approx(sigma**2, rel=0.03)
    f = torch.fft.fftfreq(129, dtype=torch.float64)
    whole = torch.arange(-20.0, 21.0, dtype=torch.float64)
    folded = (f[:, None, None] + whole[:, None]).square() + whole**2
    wanted = (1 + (2 * math.pi * sigma / math.sqrt(3)) ** 2 * folded).pow(-1.5).sum((1, 2))
    torch.testing.assert_close(optics.otf(kernel)[0].real, wanted / wanted[0], rtol=0, atol=1e-3)


def test_gradients():
    small = torch.tensor(circular(6, 4))
    phase = torch.randn(2, 6, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    assert torch.autograd.gradcheck(lambda p: optics.psf(p, small, 5, 0.8), phase)
    assert torch.autograd.gradcheck(lambda p: optics.otf(optics.psf(p, small, 5)).abs(), phase)


def test_float32_stays_float32(pupil):
    spread = optics.psf(aberrations(1).float(), pupil.float(), 33)
    assert spread.dtype == torch.float32
    torch.testing.assert_close(spread.double(), optics.psf(aberrations(1), pupil, 33), atol=1e-6, rtol=0)


def test_bad_input_is_named(flat, pupil):
    for bad in ((0.0, 9), (float("nan"), 9), (2.0, 0)):
        with pytest.raises(ParameterError):
            optics.exponential_psf(*bad)
    with pytest.raises(ParameterError, match="PSF size = 129"):
        optics.psf(flat, pupil, 129)
    with pytest.raises(ParameterError, match="square grid"):
        optics.psf(flat[:10], pupil, 9)
    with pytest.raises(ParameterError, match="q = 0"):
        optics.psf(flat, pupil, 9, 0.0)
    with pytest.raises(ParameterError, match="wavelength = 525 m .*1e-07"):
        optics.rayleigh_limit(0.2, 525)
    with pytest.raises(ParameterError, match="obscuration = 1 "):
        annular(16, 1.0)
    with pytest.raises(ParameterError, match="pupil points = 0"):
        circular(0)


@pytest.mark.parametrize("points", [32, 33])
def test_pupils_are_symmetric_and_have_the_area_of_a_disk(points):
    smooth, hard = circular(points, 16), circular(points)
    assert set(np.unique(hard)) == {0.0, 1.0}
    for grid in (smooth, hard):
        np.testing.assert_array_equal(grid, grid[::-1])
        np.testing.assert_array_equal(grid, grid.T)
    assert smooth.mean() == pytest.approx(math.pi / 4, rel=2e-3)
    assert annular(points, 0.5, 16).mean() == pytest.approx(math.pi / 4 * 0.75, rel=4e-3)
