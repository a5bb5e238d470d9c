"""Complex maps as real ones: the arithmetic is that of torch's own complex numbers."""

import pytest
import torch
import torch.nn.functional as F

from turbnet.nets.complex_unet import ComplexConv2d, ComplexUNet, MagnitudeNorm


def as_complex(x_NCHW: torch.Tensor) -> torch.Tensor:
    return torch.complex(*x_NCHW.chunk(2, dim=1))


@torch.no_grad()
@pytest.mark.parametrize(("size", "stride"), [(1, 1), (3, 1), (2, 2)])
def test_a_convolution_is_that_of_complex_numbers(size, stride):
    torch.manual_seed(0)
    layer, x = ComplexConv2d(3, 5, size, stride).double(), torch.randn(2, 6, 8, 10, dtype=torch.float64)
    layer.bias.normal_()
    reach = size // 2 if stride == 1 else 0
    padded = F.pad(x, (reach,) * 4, mode="replicate") if reach else x
    weight, bias = torch.complex(layer.real, layer.imaginary), torch.complex(*layer.bias.chunk(2))
    wanted = F.conv2d(as_complex(padded), weight, bias, stride=stride)
    torch.testing.assert_close(as_complex(layer(x)), wanted)


@torch.no_grad()
def test_a_convolution_starts_with_the_variance_of_a_real_one():
    """Of torch's own, 1 / (3 n) for n inputs; of 5 million products the mean square is known to a few per mille."""
    torch.manual_seed(0)
    found = as_complex(ComplexConv2d(64, 64)(torch.randn(1, 128, 48, 48))).abs().square().mean()
    real = torch.nn.Conv2d(128, 128, 3, padding=1, bias=False)(torch.randn(1, 128, 48, 48)).square().mean()
    assert float(found) == pytest.approx(2 * float(real), rel=0.1)


@torch.no_grad()
def test_the_norm_turns_no_phase_and_knows_no_scale():
    x, norm = torch.randn(1, 8, 5, 5), MagnitudeNorm(4)
    out = as_complex(norm(x))
    torch.testing.assert_close(out.angle(), as_complex(x).angle(), rtol=0, atol=1e-5)
    torch.testing.assert_close(out.abs().square().mean(1), torch.ones(1, 5, 5), rtol=0, atol=1e-3)
    torch.testing.assert_close(norm(1e4 * x), norm(x), rtol=0, atol=1e-3)
    assert norm(torch.zeros(1, 8, 2, 2)).isfinite().all()


def test_gradients():
    torch.manual_seed(0)
    net = ComplexUNet((1, 1, 1), (1, 1, 1)).double()
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    clip = torch.rand(1, 1, 3, 8, 8, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(net, clip, fast_mode=True)


@torch.no_grad()
def test_the_mean_of_the_clip_is_the_imaginary_part():
    torch.manual_seed(0)
    net, clip = ComplexUNet((2, 3, 4), (1, 1, 1)), torch.rand(1, 3, 3, 16, 16)
    torch.nn.init.normal_(net.correct.weight, std=0.1)
    alone = net(clip[:, :1])
    assert (net(clip)[:, :1] - alone).abs().max() > 1e-3
    torch.testing.assert_close(net(clip[:, :1].expand(1, 3, 3, 16, 16)), alone.expand(1, 3, 3, 16, 16))
