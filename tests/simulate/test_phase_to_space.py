"""The released phase-to-space network against the exact PSFs of fresh draws."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from turbnet.atmosphere.noll import noll_matrix
from turbnet.errors import ParameterError
from turbnet.optics.zernike import noll_to_nm
from turbnet.simulate.phase_to_space import PhaseToSpace, released
from turbnet.simulate.psf_basis import psf_basis, tilt_free_psf

FACTOR = torch.from_numpy(np.linalg.cholesky(noll_matrix(range(4, 37))))


def draw(count: int, strength: float, seed: int = 1000) -> Tensor:
    """a_4..a_36 with the full Noll covariance; seeds of training and of the bases are others."""
    white = torch.randn(count, 33, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (white @ FACTOR.T * strength ** (5 / 6)).float()


@pytest.mark.parametrize("strength", [0.25, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
def test_psfs_are_right_to_five_percent_and_always_better_than_their_mean(strength):
    high = draw(400, strength)
    exact = tilt_free_psf(high).flatten(1)
    size = exact.norm(dim=1)
    learned = ((released()(high).flatten(1) - exact).norm(dim=1) / size).median()
    mean = ((exact.mean(0) - exact).norm(dim=1) / size).median()
    assert float(learned) < 0.5 * float(mean)
    if strength <= 4:
        assert float(learned) < 0.05


def test_no_turbulence_gives_the_diffraction_pattern():
    exact = tilt_free_psf(torch.zeros(1, 33))
    learned = released()(torch.zeros(1, 33))
    assert float((learned - exact).norm() / exact.norm()) < 0.01
    assert float(learned.sum()) == pytest.approx(1.0, abs=0.01)


def test_energy_is_one():
    sums = released()(draw(300, 3.0)).sum((1, 2))
    assert float((sums - 1).abs().max()) < 0.01


def test_a_mirrored_aperture_mirrors_the_psf():
    """It swaps the pixels +-x: O changes its sign, E stays."""
    network = PhaseToSpace().double()
    high = draw(3, 2.0).double()
    features = network.features(high)
    even, odd = torch.zeros_like(high), torch.zeros_like(high)
    for j in range(4, 37):
        part = even if noll_to_nm(j)[0] % 2 == 0 else odd
        part[:, j - 4] = high[:, j - 4]
    mirrored = network.features(even - odd)
    half = features.shape[1] // 2
    torch.testing.assert_close(mirrored[:, :half], features[:, :half])
    torch.testing.assert_close(mirrored[:, half:], -features[:, half:])


def test_gradients_in_the_coefficients():
    network = PhaseToSpace()
    network.load_state_dict(released().state_dict())
    network = network.double().requires_grad_(False)
    basis = psf_basis(4, 2.0, 2.0)
    high = draw(3, 2.0).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda a: network.weights(a, basis), high, fast_mode=True)
    assert torch.autograd.gradcheck(network, high, fast_mode=True)


def test_gradients_are_those_of_the_exact_psfs():
    """Of the weights of the leading components, by finite differences of exact PSFs in double precision."""
    basis, step = psf_basis(3, 2.0, 2.0), 1e-4
    high = draw(40, 2.0)
    inputs = high.clone().requires_grad_()
    (learned,) = torch.autograd.grad(released().weights(inputs, basis)[:, 0].sum(), inputs)
    exact = torch.empty_like(high)
    for mode in range(33):
        ahead, behind = high.double(), high.double()
        ahead[:, mode] += step
        behind[:, mode] -= step
        exact[:, mode] = (basis.project(ahead) - basis.project(behind))[:, 0] / (2 * step)
    assert float((learned - exact).norm() / exact.norm()) < 0.1


@pytest.mark.parametrize(("q", "strength"), [(1.0, 1.0), (1.0, 3.0), (2.0, 2.0), (0.5, 2.0)])
def test_weights_of_any_basis_are_those_of_the_psfs(q, strength):
    """To a few per cent of them, as right as the network's own PSFs."""
    basis, high = psf_basis(12, strength, strength, q=q), draw(1200, strength)
    learned, exact = released().weights(high, basis), basis.project(high)
    assert learned.shape == (1200, 12)
    assert float((learned - exact).norm() / exact.norm()) < 0.05


def test_weights_are_those_of_the_networks_own_psfs():
    basis, high = psf_basis(12, 2.0, 2.0), draw(50, 2.0)
    own = basis.weights(released()(high))
    torch.testing.assert_close(released().weights(high, basis), own, atol=1e-3 * float(own.std()), rtol=1e-3)


def test_fewer_modes_are_those_with_the_rest_zero():
    high = draw(20, 2.0)
    few = torch.cat((high[:, :7], torch.zeros(20, 26)), 1)
    assert torch.equal(released()(high[:, :7]), released()(few))


def test_one_basis_after_the_other():
    one, two, high = psf_basis(4, 1.0, 1.0), psf_basis(6, 3.0, 3.0, q=2.0), draw(10, 2.0)
    first = released().weights(high, one)
    assert released().weights(high, two).shape == (10, 6)
    assert torch.equal(released().weights(high, one), first)


def test_double_precision_comes_back_as_it_went_in():
    basis, high = psf_basis(4, 1.0, 1.0), draw(10, 2.0)
    learned = released().weights(high.double(), basis)
    assert learned.dtype == torch.float64
    torch.testing.assert_close(learned.float(), released().weights(high, basis), rtol=1e-4, atol=1e-6)


def test_modes_and_apertures_it_does_not_know_are_refused():
    with pytest.raises(ParameterError, match="36"):
        released()(torch.zeros(1, 34))
    with pytest.raises(ParameterError, match="apertures"):
        released().weights(torch.zeros(1, 33), replace(psf_basis(4, 1.0, 1.0), points=24))


def test_a_least_squares_last_layer_is_close_already():
    network = PhaseToSpace()
    network.fit_head(draw(2500, 1.0, seed=5))
    high = draw(200, 1.0)
    exact = tilt_free_psf(high)
    with torch.no_grad():
        assert float((network(high) - exact).norm() / exact.norm()) < 0.05
