"""PSFs at pixels of q, and the basis's energies, beside what is measured on fresh PSFs."""

import numpy as np
import pytest
import torch

from turbnet.atmosphere.noll import noll_covariance, noll_matrix
from turbnet.errors import ParameterError
from turbnet.optics.psf import amplitude_spread
from turbnet.optics.pupil import circular, pupil_grid
from turbnet.optics.zernike import zernike_basis
from turbnet.simulate.psf_basis import (
    PUPIL,
    _whole_basis,
    in_metric,
    kernel_size,
    psf_basis,
    psf_samples,
    resampling,
    tilt_free_psf,
)


def fresh_high(count: int, seed: int) -> torch.Tensor:
    """a_4..a_36 at D/r0 = 2.5, other ones than those the basis learns from."""
    factor = torch.from_numpy(np.linalg.cholesky(noll_matrix(range(4, 37)))).float()
    white = torch.randn(count, 33, generator=torch.Generator().manual_seed(seed))
    return white @ factor.T * 2.5 ** (5 / 6)


@pytest.fixture(scope="module")
def high() -> torch.Tensor:
    return fresh_high(40, seed=5).double()


@pytest.fixture(scope="module")
def fresh() -> torch.Tensor:
    """As many PSFs as a tolerance of their energies needs."""
    return tilt_free_psf(fresh_high(1500, seed=77))


def half_pixels(high: torch.Tensor, size: int = 31) -> torch.Tensor:
    """|h|^2 at every half Nyquist pixel, by the matrix transform of `turbnet.optics.psf`, (P, 2 size + 1, ...)."""
    x, y = pupil_grid(PUPIL)
    modes = torch.from_numpy(zernike_basis(range(4, 37), np.hypot(x, y), np.arctan2(y, x)))
    pupil = torch.from_numpy(circular(PUPIL, subsamples=16))
    phase = torch.einsum("pn,nyx->pyx", high, modes)
    return amplitude_spread(phase, pupil, 2 * size + 1, q=0.5).abs().square()


def normalised(psf: torch.Tensor) -> torch.Tensor:
    return psf / psf.sum((-2, -1), keepdim=True)


def test_nyquist_pixels_are_the_samples_themselves(high):
    matrix = resampling(1.0)
    assert matrix.shape == (31, 32)
    assert torch.equal(matrix.sum(1), torch.ones(31, dtype=torch.float64))
    expected = normalised(half_pixels(high)[:, 1::2, 1::2])  # 63 half pixels: the odd ones are whole ones
    torch.testing.assert_close(tilt_free_psf(high), expected, rtol=1e-9, atol=1e-12)


def test_pixels_of_two_are_means_of_neighbours(high):
    """Of the intensity half a Nyquist pixel to both sides of the middle, along each axis."""
    assert kernel_size(2.0) == 15
    fine = half_pixels(high)  # middle at 31, pixels of q = 2 every 4 of these
    across = 0.5 * (fine[..., 3 - 1 : -3 : 4] + fine[..., 3 + 1 : -1 : 4])
    both = 0.5 * (across[:, 3 - 1 : -3 : 4] + across[:, 3 + 1 : -1 : 4])
    assert both.shape[-2:] == (15, 15)
    torch.testing.assert_close(tilt_free_psf(high, 2.0), normalised(both), rtol=1e-6, atol=1e-9)


def test_half_pixels_contain_the_whole_ones(high):
    fine = tilt_free_psf(high, 0.5)
    assert fine.shape[-1] == kernel_size(0.5) == 61
    torch.testing.assert_close(fine, normalised(half_pixels(high, 30)), rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(normalised(fine[:, ::2, ::2]), tilt_free_psf(high), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("q", [0.5, 0.7, 1.0, 1.3, 2.0, 4.0, 40.0])
def test_kernels_are_odd_and_sum_to_one(high, q):
    psf = tilt_free_psf(high[:5], q)
    assert psf.shape == (5, kernel_size(q), kernel_size(q))
    assert kernel_size(q) % 2 == 1
    torch.testing.assert_close(psf.sum((1, 2)), torch.ones(5, dtype=torch.float64))


@pytest.mark.parametrize("q", [0.5, 2.0])
def test_projection_is_that_of_the_psfs_at_any_pixel(high, q):
    basis = psf_basis(8, 2.5, 2.5, q=q)
    few = high[:20].float()
    weights = basis.weights(tilt_free_psf(few, q))
    torch.testing.assert_close(basis.project(few), weights, atol=2e-3 * float(weights.std()), rtol=1e-3)


@pytest.mark.parametrize("components", [0, 4, 16])
def test_energies_are_those_of_fresh_psfs(fresh, components):
    """`variance` is what the components hold of PSFs, `left` what they do not; both within 4 standard errors."""
    basis = psf_basis(components, 2.5, 2.5)
    deviation = fresh - basis.mean
    weights = basis.weights(fresh)
    residual = in_metric(deviation - torch.einsum("pm,mij->pij", weights, basis.components)).square().sum(1).double()
    # The basis learnt its own energies from 3000 PSFs.
    error = float(residual.std()) * np.sqrt(1 / len(fresh) + 1 / 3000)
    # It also suits those 3000 better than others, by some M / 3000 of what it holds.
    suits = components / 3000 * float(basis.variance.sum())
    assert abs(float(residual.mean()) - basis.left) < 4 * error + suits
    if components:
        energies = weights.double().square()
        errors = energies.std(0) * np.sqrt(1 / len(fresh) + 1 / 3000)
        # Late components are nearly alike in energy and mix: only their sum is certain.
        assert bool(((energies.mean(0) - basis.variance)[:4].abs() < 4.5 * errors[:4]).all())
        total = energies.sum(1)
        error = float(total.std()) * np.sqrt(1 / len(fresh) + 1 / 3000)
        assert abs(float(total.mean() - basis.variance.sum())) < 4 * error + suits


def test_distance_in_the_metric_is_that_of_the_weights():
    """||sum_m w_m phi_m||^2 is |w|^2: components are orthonormal in the metric whose dual reads them."""
    basis = psf_basis(10, 2.5, 2.5)
    weights = torch.randn(30, 10, generator=torch.Generator().manual_seed(1))
    one, two = basis.psf(weights).split(15)
    distance = in_metric(one - two).square().sum(1)
    torch.testing.assert_close(distance, (weights[:15] - weights[15:]).square().sum(1), rtol=1e-3, atol=0)
    # <b, phi_m> by the dual is the product of both in the metric.
    products = in_metric(one - basis.mean) @ in_metric(basis.components).T
    torch.testing.assert_close((one - basis.mean).flatten(1) @ basis.dual.flatten(1).T, products, rtol=1e-3, atol=1e-3)


def test_metric_is_the_sum_over_frequencies():
    """Against its definition, on the 64 frequencies that a kernel of 31 pixels has."""
    kernel = torch.randn(1, 31, 31, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    spectrum = torch.fft.fft2(kernel[0], s=(64, 64)).abs() / 64
    f = torch.hypot(torch.fft.fftfreq(64), torch.fft.fftfreq(64)[:, None]).double().clamp(min=1 / 64)
    assert float(in_metric(kernel).square().sum()) == pytest.approx(float((spectrum / f).square().sum()), rel=1e-6)


def test_leading_components_leave_the_rest():
    basis = psf_basis(20, 2.5, 2.5)
    few = basis.leading(5)
    assert torch.equal(few.components, basis.components[:5])
    assert few.left == pytest.approx(basis.left + float(basis.variance[5:].sum()))
    assert (basis.variance.diff() <= 0).all()
    with pytest.raises(ParameterError, match="components"):
        few.leading(6)


def test_a_wide_range_of_strengths_is_log_uniform():
    """Variance of a_4 over the samples: the mean of (D/r0)^(5/3) over it."""
    samples = psf_samples(1.0, 4.0, 15)
    assert samples.shape == (3000, 12)
    exact = noll_covariance(4, 4) * (4 ** (5 / 3) - 1) / (5 / 3 * np.log(4))
    energies = samples[:, 0].double().square()
    assert abs(float(energies.mean()) - exact) < 4 * float(energies.std()) / np.sqrt(3000)


def test_a_basis_made_on_two_threads_is_the_same_to_rounding():
    """Matrix products and sums are taken in another order."""
    basis = psf_basis(8, 2.5, 2.5)
    psf = tilt_free_psf(fresh_high(20, seed=3))
    try:
        torch.set_num_threads(2)
        _whole_basis.cache_clear()
        other = psf_basis(8, 2.5, 2.5)
    finally:
        torch.set_num_threads(1)
        _whole_basis.cache_clear()
    rounding = 1e-3 * float(psf.std())
    torch.testing.assert_close(other.psf(other.weights(psf)), basis.psf(basis.weights(psf)), rtol=0, atol=rounding)
