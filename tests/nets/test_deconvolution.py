import numpy as np
import pytest
import torch
import torch.nn.functional as F
from kornia.filters import gaussian_blur2d

from turbnet.errors import ParameterError
from turbnet.media.colour import to_linear, to_srgb
from turbnet.nets.deconvolution import (
    Deconvolution,
    RichardsonLucy,
    _blurred,
    defocus_kernel,
    tails_kernel,
    turbulence_kernel,
)
from turbnet.optics.psf import convolve, exponential_psf


def scene() -> torch.Tensor:
    """A bright and a dark disc on grey, no sharper than a lens shows them, linear, (1, 1, 96, 96)."""
    y, x = torch.meshgrid(torch.arange(96) - 48.0, torch.arange(96) - 48.0, indexing="ij")

    def disc(row: float, column: float, radius: float) -> torch.Tensor:
        return torch.sigmoid(radius - torch.hypot(y - row, x - column))

    return (0.3 + 0.6 * disc(-12, -8, 9) - 0.29 * disc(10, 14, 6))[None, None]


def blurred(linear: torch.Tensor, strength: float) -> torch.Tensor:
    """Through the short-exposure transfer function, whose definition is written out here, and encoded."""
    nu = [torch.fft.fftfreq(n) for n in linear.shape[-2:]]
    f = (2 * torch.hypot(nu[0][:, None], nu[1])).clamp(max=1)
    transfer = torch.exp(-3.44 * (strength * f) ** (5 / 3) * (1 - f ** (1 / 3)))
    return to_srgb(torch.fft.ifft2(torch.fft.fft2(linear) * transfer).real.clamp(0, 1))


def guesses(seen: torch.Tensor, *kernels: np.ndarray, steps: int = 8) -> torch.Tensor:
    """What the iteration makes of an encoded picture, encoded, (K, C, H, W)."""
    return to_srgb(RichardsonLucy(kernels, steps)(to_linear(seen))[0].clamp(0, 1))


def error(encoded: torch.Tensor, linear: torch.Tensor) -> float:
    inner = (..., slice(20, -20), slice(20, -20))
    return float((to_linear(encoded) - linear)[inner].square().mean())


KERNELS = [
    turbulence_kernel(0.0),
    turbulence_kernel(2.0),
    turbulence_kernel(6.5),
    defocus_kernel(2.5),
    tails_kernel(3.5),
]


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_kernel_keeps_the_light_and_has_no_direction(kernel):
    assert float(kernel.sum()) == pytest.approx(1, abs=1e-5)
    assert kernel.min() >= 0
    for turned in (kernel.T, kernel[::-1], kernel[:, ::-1]):
        np.testing.assert_allclose(turned, kernel, rtol=0, atol=1e-6)


@torch.no_grad()
@pytest.mark.parametrize(("strength", "left"), [(2.0, 0.4), (3.0, 0.1), (4.5, 0.15)])
def test_it_undoes_the_blur_of_its_strength(strength, left):
    linear = scene()
    seen = blurred(linear, strength)
    clear = guesses(seen, turbulence_kernel(strength))
    assert error(clear, linear) < left * error(seen, linear)


@torch.no_grad()
@pytest.mark.parametrize("kernel", KERNELS[1:])
def test_two_scales_blur_as_the_whole_kernel_does(kernel):
    net, picture, reach = RichardsonLucy([kernel], 1), scene(), len(kernel) // 2
    padded = F.pad(picture, (reach, reach, reach, reach), mode="replicate")
    whole = F.conv2d(padded, torch.from_numpy(kernel)[None, None])
    two = _blurred(picture, net.near, net.far)
    assert (two - whole).square().mean() < 3e-3 * (whole - picture).square().mean()


@torch.no_grad()
def test_it_brings_back_what_a_lens_out_of_focus_takes():
    """A Gaussian leaves so little of the fine parts that they come back slowly: more steps do better."""
    linear = scene()
    seen = to_srgb(gaussian_blur2d(linear, (19, 19), (2.5, 2.5)))
    errors = [error(guesses(seen, defocus_kernel(2.5), steps=steps), linear) for steps in (8, 24)]
    assert errors[1] < 0.7 * errors[0] < 0.7 * 0.25 * error(seen, linear)


@torch.no_grad()
def test_of_a_blur_with_tails_its_kernel_makes_more_than_a_gaussian():
    linear = scene()
    around = F.pad(linear, (40, 40, 40, 40), mode="replicate")
    seen = to_srgb(convolve(around, exponential_psf(3.5, 61).float())[..., 40:-40, 40:-40])
    tails, bell = (
        error(guesses(seen, kernel, steps=30), linear) for kernel in (tails_kernel(3.5), defocus_kernel(2.5))
    )
    assert tails < 0.5 * bell < 0.5 * error(seen, linear)


@torch.no_grad()
def test_the_kernel_of_the_true_strength_does_best():
    linear = scene()
    for strength in (2.0, 3.0, 4.5):
        kernels = [turbulence_kernel(tried) for tried in (2.0, 3.0, 4.5)]
        errors = [error(guess, linear) for guess in guesses(blurred(linear, strength), *kernels)]
        assert min(errors) == errors[(2.0, 3.0, 4.5).index(strength)]


@torch.no_grad()
@pytest.mark.parametrize("level", [0.0, 0.02, 0.5, 1.0])
def test_a_flat_picture_stays(level):
    picture = torch.full((1, 3, 24, 30), level)
    darkest = float(to_srgb(torch.tensor(1e-3)))
    found = Deconvolution()(picture)
    torch.testing.assert_close(found, picture[:, None].expand_as(found).clamp(min=darkest), rtol=0, atol=1e-5)


@torch.no_grad()
@pytest.mark.parametrize("size", [(2, 2), (6, 64), (34, 20)])
def test_any_even_size_and_every_value_in_range(size):
    net = Deconvolution(tails=(3.5,))
    for picture in (torch.rand(2, 3, *size), torch.randint(0, 2, (2, 3, *size)).float()):
        found = net(picture)
        assert found.shape == (2, 6, 3, *size)
        assert found.isfinite().all()
        assert found.min() >= 0
        assert found.max() <= 1


@torch.no_grad()
def test_what_lies_outside_the_range_stays():
    picture, net = torch.rand(1, 3, 16, 16), Deconvolution()
    far = 1e6 * (picture - 0.5)
    torch.testing.assert_close(
        net(far) - far[:, None], net(far.clamp(0, 1)) - far[:, None].clamp(0, 1), rtol=0, atol=0.1
    )


@torch.no_grad()
def test_each_channel_and_each_strength_by_itself():
    picture, all_of_them = torch.rand(2, 3, 26, 22), Deconvolution((2.0, 4.5), (1.5,))
    found = all_of_them(picture)
    torch.testing.assert_close(found[1:, :, 2:], all_of_them(picture[1:, 2:]), rtol=0, atol=1e-5)
    torch.testing.assert_close(found[:, 1:], Deconvolution((4.5,), (1.5,))(picture), rtol=0, atol=1e-5)


@torch.no_grad()
def test_mirror_images_come_out_as_mirror_images():
    picture, net = torch.rand(1, 3, 24, 24), Deconvolution()
    for turn in (lambda x: x.flip(-1), lambda x: x.flip(-2), lambda x: x.transpose(-1, -2)):
        torch.testing.assert_close(net(turn(picture).contiguous()), turn(net(picture)), rtol=0, atol=1e-4)


def test_no_gradient_passes_and_nothing_is_stored():
    net = Deconvolution()
    assert not net(torch.rand(1, 3, 16, 16, requires_grad=True)).requires_grad
    assert not list(net.parameters())
    assert not net.state_dict()


@torch.no_grad()
def test_the_work_is_done_in_float32():
    picture = torch.rand(1, 3, 24, 24)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        inside = Deconvolution()(picture)
    torch.testing.assert_close(inside, Deconvolution()(picture), rtol=0, atol=0)


def test_it_is_built_where_tensors_have_no_values():
    """As a checkpoint's network is, to compare shapes before anything is loaded."""
    with torch.device("meta"):
        assert Deconvolution(tails=(3.5,)).count == 6


def test_values_out_of_range():
    with pytest.raises(ParameterError, match="sigma"):
        Deconvolution(tails=(-1.0,))
    with pytest.raises(ParameterError, match="needs a kernel"):
        Deconvolution((), ())
    assert Deconvolution((), (), (3.5,)).count == 1
    with pytest.raises(ParameterError, match="size of a kernel"):
        turbulence_kernel(2.0, 64)
    with pytest.raises(ParameterError, match="size of a kernel"):
        defocus_kernel(2.0, 5)
    with pytest.raises(ParameterError, match="D/r0"):
        turbulence_kernel(-1.0)
    with pytest.raises(ParameterError, match="steps"):
        RichardsonLucy(KERNELS, 0)
    with pytest.raises(ParameterError, match="sigma"):
        defocus_kernel(0.0)
