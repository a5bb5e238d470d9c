import pytest
import torch

from turbnet.errors import ParameterError
from turbnet.optics.psf import convolve
from turbnet.optics.superposition import gather, gather_basis, scatter, scatter_basis, superposition_matrix


def random(*shape, seed=0):
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("shape", [(9, 12), (3, 10), (1, 1)])
@pytest.mark.parametrize("size", [1, 3, 7])
def test_scatter_and_gather_agree_with_the_dense_matrix(shape, size):
    image, kernels = random(*shape), random(*shape, size, size, seed=1)
    matrix = superposition_matrix(kernels)
    torch.testing.assert_close(scatter(image, kernels).flatten(), matrix @ image.flatten())
    mirrored = superposition_matrix(kernels.flip(-2, -1))
    torch.testing.assert_close(gather(image, kernels).flatten(), mirrored.T @ image.flatten())


def test_dense_matrix_agrees_with_the_definition():
    kernels = random(4, 5, 3, 3)
    matrix = superposition_matrix(kernels).reshape(4, 5, 4, 5)
    assert matrix[2, 3, 1, 4] == kernels[1, 4, 1 + 1, -1 + 1]  # x - u = (1, -1)
    assert matrix[0, 0, 3, 3] == 0


def test_equal_kernels_make_both_a_convolution():
    image, kernel = random(8, 11), random(5, 5, seed=2)
    kernels = kernel.expand(8, 11, 5, 5)
    torch.testing.assert_close(scatter(image, kernels), convolve(image, kernel))
    torch.testing.assert_close(gather(image, kernels), convolve(image, kernel))


def test_a_point_source_shows_its_own_psf_only_when_scattered():
    kernels = random(15, 15, 5, 5)
    image = torch.zeros(15, 15, dtype=torch.float64)
    image[7, 6] = 1.0
    window = slice(5, 10), slice(4, 9)
    torch.testing.assert_close(scatter(image, kernels)[window], kernels[7, 6])
    assert (gather(image, kernels)[window] - kernels[7, 6]).norm() > 0.2 * kernels[7, 6].norm()


def test_scattering_keeps_the_light_and_gathering_keeps_a_flat_scene():
    kernels = random(20, 20, 5, 5)
    kernels /= kernels.sum((-2, -1), keepdim=True)
    inner = torch.zeros(20, 20, dtype=torch.float64)
    inner[5:15, 5:15] = random(10, 10, seed=3)
    assert scatter(inner, kernels).sum() == pytest.approx(inner.sum())
    flat = torch.ones(20, 20, dtype=torch.float64)
    torch.testing.assert_close(gather(flat, kernels)[4:-4, 4:-4], flat[4:-4, 4:-4])


def test_a_basis_gives_the_same_as_the_kernels_it_stands_for():
    image, basis, weights = random(2, 3, 9, 8), random(4, 5, 5, seed=1), random(4, 9, 8, seed=2)
    kernels = torch.einsum("mhw,mkl->hwkl", weights, basis)
    torch.testing.assert_close(scatter_basis(image, basis, weights), scatter(image, kernels))
    torch.testing.assert_close(gather_basis(image, basis, weights), gather(image, kernels))


def test_gradients():
    image, kernels = random(4, 3).requires_grad_(), random(4, 3, 3, 3).requires_grad_()
    assert torch.autograd.gradcheck(scatter, (image, kernels))
    assert torch.autograd.gradcheck(gather, (image, kernels))


@pytest.mark.parametrize("shape", [(4, 4, 4, 4), (4, 5, 3, 3), (4, 4, 3, 5)])
def test_kernels_that_do_not_fit_are_refused(shape):
    with pytest.raises(ParameterError, match="kernels"):
        scatter(random(4, 4), random(*shape))
