from dataclasses import replace

import pytest
import skimage.data
import torch
from scipy.special import j1

import turbnet.simulate.blur as blur_module
from turbnet.atmosphere.path import OpticalPath
from turbnet.errors import InputError, ParameterError
from turbnet.simulate.blur import blur, blur_weights
from turbnet.simulate.field import ZernikeField
from turbnet.simulate.psf_basis import PSFBasis, kernel_size, psf_basis, tilt_free_psf

KERNEL = kernel_size()

HALF = KERNEL // 2


def random_high(points: int, strength: float, seed: int = 0, modes: int = 36) -> torch.Tensor:
    import numpy as np

    from turbnet.atmosphere.noll import noll_matrix

    factor = torch.from_numpy(np.linalg.cholesky(noll_matrix(range(4, modes + 1)))).float()
    noise = torch.randn(points, modes - 3, generator=torch.Generator().manual_seed(seed))
    return noise @ factor.T * strength ** (5 / 6)


def test_still_air_gives_the_airy_pattern():
    psf = tilt_free_psf(torch.zeros(1, 33, dtype=torch.float64))[0]
    x = torch.arange(1, 8, dtype=torch.float64)
    # Pixel lambda/(2D): the argument of the Airy function is pi D / lambda times x pixels = pi x / 2.
    v = torch.pi * x / 2
    airy = torch.from_numpy((2 * j1(v.numpy()) / v.numpy()) ** 2)
    measured = psf[HALF, HALF + 1 : HALF + 8] / psf[HALF, HALF]
    assert float((measured - airy).abs().max()) < 0.005  # of the peak; sixteen samples across the aperture


def test_psfs_sum_to_one_and_are_centred_for_even_modes():
    psf = tilt_free_psf(random_high(20, 3.0).double())
    torch.testing.assert_close(psf.sum((1, 2)), torch.ones(20, dtype=torch.float64))
    defocus = torch.zeros(1, 33, dtype=torch.float64)
    defocus[0, 0] = 1.0
    psf = tilt_free_psf(defocus)[0]
    torch.testing.assert_close(psf, psf.flip(0, 1), atol=1e-12, rtol=0)


def test_weights_of_the_components_are_read_by_the_dual():
    basis = psf_basis(12, 3.0, 3.0)
    gram = basis.dual.flatten(1) @ basis.components.flatten(1).T
    torch.testing.assert_close(gram, torch.eye(12), atol=1e-4, rtol=0)


def test_projection_is_that_of_the_psfs():
    basis = psf_basis(12, 3.0, 3.0)
    high = random_high(600, 4.0, seed=3)
    torch.testing.assert_close(basis.project(high), basis.weights(tilt_free_psf(high)), atol=1e-4, rtol=1e-4)


def test_errors_show_less_in_pictures_than_with_plain_principal_components():
    """Error of a blurred 1/f picture with 10 components against that with 10 plain principal components."""
    psf = tilt_free_psf(random_high(300, 3.0, seed=11))
    basis = psf_basis(10, 3.0, 3.0)
    training = (tilt_free_psf(random_high(2000, 3.0, seed=12)) - basis.mean).flatten(1)
    plain = torch.linalg.svd(training, full_matrices=False).Vh[:10]
    flat = (psf - basis.mean).flatten(1)
    f = torch.hypot(torch.fft.fftfreq(64), torch.fft.fftfreq(64)[:, None]).clamp(min=1 / 64)

    def shows(error):
        return float((torch.fft.fft2(error.view(-1, KERNEL, KERNEL), s=(64, 64)).abs() / f).square().sum())

    ours = shows(flat - basis.weights(psf) @ basis.components.flatten(1))
    theirs = shows(flat - flat @ plain.T @ plain)
    assert ours < 0.75 * theirs


def test_no_component_is_one_blur_for_all():
    basis = psf_basis(0, 2.0, 2.0)
    scene = torch.zeros(1, 1, 65, 65)
    scene[..., 32, 32] = 1
    out = blur(scene, blur_weights(torch.randn(1, 33, 17, 17), basis), basis, 4)
    torch.testing.assert_close(out[0, 0, 17:48, 17:48], basis.mean, atol=1e-6, rtol=0)


def test_basis_explains_psfs_better_with_every_component():
    psf = tilt_free_psf(random_high(200, 3.0, seed=7))
    errors = []
    for components in (0, 5, 20, 60):
        basis = psf_basis(components, 3.0, 3.0)
        errors.append(float((basis.psf(basis.weights(psf)) - psf).square().sum() / psf.square().sum()) ** 0.5)
    assert errors == sorted(errors, reverse=True)
    assert errors[0] < 0.5
    assert errors[-1] < 0.06


def test_point_sources_spread_by_their_own_psf():
    """The operator on a grid of points, 32 pixels apart, is the sum of each point's represented PSF."""
    basis = psf_basis(30, 3.0, 3.0)
    high = random_high(9, 3.0, seed=5)
    scene = torch.zeros(1, 1, 3 * 32, 3 * 32)
    scene[..., 16::32, 16::32] = 1
    coarse = torch.nn.functional.interpolate(high.T.view(1, 33, 3, 3), scale_factor=32, mode="nearest")
    out = blur(scene, blur_weights(coarse, basis), basis, stride=1)[0, 0]
    for index, psf in enumerate(basis.psf(basis.weights(tilt_free_psf(high)))):
        y, x = 16 + 32 * (index // 3), 16 + 32 * (index % 3)
        window = out[y - HALF : y + HALF + 1, x - HALF : x + HALF + 1]
        torch.testing.assert_close(window, psf, atol=1e-6, rtol=0)


def test_energy_is_kept_away_from_the_border():
    basis = psf_basis(8, 1.0, 4.0)
    scene = torch.zeros(2, 3, 97, 97)
    scene[..., 33:64, 33:64] = torch.rand(31, 31)
    weights = blur_weights(
        torch.nn.functional.interpolate(random_high(2 * 49, 3).T.reshape(33, 2, 7, 7).transpose(0, 1), size=25), basis
    )
    out = blur(scene, weights, basis, 4)
    torch.testing.assert_close(out.sum((2, 3)), scene.sum((2, 3)), rtol=1e-4, atol=0)


def test_gradients_in_picture_and_coefficients():
    basis = psf_basis(3, 2.0, 2.0, modes=8)
    high = (0.3 * random_high(4, 2.0, modes=8)).double().T.reshape(1, 5, 2, 2).requires_grad_()
    scene = torch.rand(1, 1, 5, 4, dtype=torch.float64, requires_grad=True)
    blurred = lambda s, a: blur(s, blur_weights(a, basis), basis, 4)  # noqa: E731
    assert torch.autograd.gradcheck(blurred, (scene, high), atol=1e-6, fast_mode=True)


def test_too_many_components_are_refused():
    with pytest.raises(ParameterError, match="components"):
        psf_basis(1000, 1.0, 1.0)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def double(basis: PSFBasis) -> PSFBasis:
    parts = {name: getattr(basis, name).double() for name in ("mean", "components", "dual", "variance")}
    return replace(basis, **parts)


def field_weights(size: int, strength: float, components: int) -> tuple[torch.Tensor, PSFBasis]:
    draw = ZernikeField(OpticalPath.from_d_over_r0(strength), size, size, modes=36).draw([0])
    basis = psf_basis(components, strength, strength)
    return blur_weights(draw.high[0], basis), basis


def smooth_scene(size: int, highest: float) -> torch.Tensor:
    """Noise of frequencies below `highest` cycles a pixel, in a window with no edges, (1, 1, size, size)."""
    noise = torch.randn(size, size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    f = torch.fft.fftfreq(size).abs()
    low = torch.fft.ifft2(torch.fft.fft2(noise) * (f < highest) * (f < highest)[:, None]).real
    window = torch.zeros(size, dtype=torch.float64)
    window[size // 5 : -(size // 5)] = torch.hann_window(size - 2 * (size // 5), dtype=torch.float64)
    window = window.square()  # tails of its spectrum fall as f^-5
    return (low * window * window[:, None])[None, None]


@pytest.mark.parametrize("size", [160, 161])
@pytest.mark.parametrize(("depth", "error"), [(0.0, 1e-5), (0.5, 5e-3)])
def test_half_the_resolution_is_exact_below_its_soft_edge(size, depth, error):
    """To 0.21 cycles a pixel, with the same weights everywhere; others bring what bicubic interpolation has beyond."""
    basis, scene = psf_basis(12, 3.0, 3.0), smooth_scene(size, 0.12)
    wave = torch.cos(2 * torch.pi / 80 * torch.arange(1 + -(-size // 4)) * 4.0)
    some = torch.randn(1, 12, 1, 1, generator=generator(1)) * basis.variance.sqrt()[:, None, None]
    weights = (some * (1 + depth * wave * wave[:, None])).double()
    full, half = (blur(scene, weights, basis, 4, factor) for factor in (1, 2))
    components = full - blur(scene, weights[:, :0], basis.leading(0), 4)
    assert float((half - full).norm() / components.norm()) < error


def test_half_the_resolution_is_wrong_only_by_what_it_cannot_hold():
    """White noise has three quarters of its energy beyond; most of the components' energy lies below."""
    weights, basis = field_weights(96, 3.0, 20)
    scene = torch.rand(1, 1, 96, 96, generator=torch.Generator().manual_seed(2))
    full, half = (blur(scene, weights, basis, 4, factor) for factor in (1, 2))
    components = full - blur(scene, weights[:, :0], basis.leading(0), 4)
    assert 0.01 < float((half - full).norm() / components.norm()) < 0.5


@pytest.mark.parametrize("size", [(150, 150), (97, 170), (131, 40)])
@pytest.mark.parametrize("stride", [4, 3])
def test_tiles_are_the_whole(monkeypatch, size, stride):
    basis = psf_basis(8, 2.0, 2.0)
    noise = generator(3)
    h, w = (1 + -(-n // stride) for n in size)
    weights = torch.randn(2, 8, h, w, generator=noise) * basis.variance.sqrt()[:, None, None]
    scene = torch.rand(2, 3, *size, generator=noise)
    whole = blur(scene, weights, basis, stride)
    monkeypatch.setattr(blur_module, "_TILE", 64)
    monkeypatch.setattr(blur_module, "_PIECE", 50)
    torch.testing.assert_close(blur(scene, weights, basis, stride), whole, rtol=0, atol=5e-6)


def test_tiles_at_half_the_resolution_differ_by_far_less_than_half_the_resolution_does(monkeypatch):
    """A piece ends sharply half a kernel away, from which its low pass rings a little."""
    weights, basis = field_weights(160, 3.0, 20)
    scene = torch.from_numpy(skimage.data.camera()[100:260, 200:360].copy()).float()[None, None] / 255
    full, half = (blur(scene, weights, basis, 4, factor) for factor in (1, 2))
    monkeypatch.setattr(blur_module, "_TILE", 64)
    monkeypatch.setattr(blur_module, "_PIECE", 48)
    tiles = blur(scene, weights, basis, 4, 2)
    assert float((tiles - half).square().mean()) < 0.1 * float((half - full).square().mean())


@pytest.mark.parametrize("factor", [1, 2])
@pytest.mark.parametrize("tile", [768, 24])
def test_the_adjoint_is_the_gradient(monkeypatch, factor, tile):
    """<B x, y> = <x, B^T y>, and B is linear in the weights beyond the mean's part as well."""
    monkeypatch.setattr(blur_module, "_TILE", tile)
    monkeypatch.setattr(blur_module, "_PIECE", 20)
    basis = double(psf_basis(5, 2.0, 2.0))
    x, other, y = (torch.randn(2, 3, 37, 30, generator=generator(n), dtype=torch.float64) for n in range(3))
    x.requires_grad_()
    weights = torch.randn(2, 5, 11, 9, generator=generator(3), dtype=torch.float64).requires_grad_()
    seen = blur(x, weights, basis, 4, factor)
    back, turn = torch.autograd.grad((seen * y).sum(), (x, weights))
    for scene in (x.detach(), other):
        product = (blur(scene, weights.detach(), basis, 4, factor) * y).sum()
        assert float((scene * back).sum()) == pytest.approx(float(product), rel=1e-9)
    mean = (blur(x.detach(), torch.zeros_like(weights), basis, 4, factor) * y).sum()
    weighted = float((seen.detach() * y).sum() - mean)
    assert float((weights.detach() * turn).sum()) == pytest.approx(weighted, rel=1e-9)


@pytest.mark.parametrize("factor", [1, 2])
def test_gradients_at_both_resolutions(factor):
    basis = double(psf_basis(3, 2.0, 2.0))
    scene = torch.rand(2, 1, 9, 7, generator=generator(0), dtype=torch.float64, requires_grad=True)
    weights = torch.randn(2, 3, 4, 3, generator=generator(1), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s, w: blur(s, w, basis, 4, factor), (scene, weights), fast_mode=True)


def test_coarse_numbers_are_refused():
    basis = psf_basis(1, 3.0, 3.0)
    with pytest.raises(InputError, match="float32"):
        blur(torch.ones(1, 1, 9, 9, dtype=torch.uint8), torch.zeros(1, 1, 3, 3), basis, 4)
