import numpy as np
import pytest
import torch

from turbnet.errors import ParameterError
from turbnet.nets.inverse import InverseFilters, wiener_kernel


@pytest.mark.parametrize("strength", [0.0, 1.5, 6.0])
def test_a_kernel_keeps_the_level_and_has_no_direction(strength):
    kernel = wiener_kernel(strength, 15)
    assert float(kernel.sum()) == pytest.approx(1, abs=1e-5)
    for turned in (kernel.T, kernel[::-1], kernel[:, ::-1]):
        np.testing.assert_allclose(turned, kernel, rtol=0, atol=1e-6)


def test_in_still_air_a_picture_stays():
    kernel = wiener_kernel(0.0, 15)
    expected = np.zeros((15, 15))
    expected[7, 7] = 1
    np.testing.assert_allclose(kernel, expected, rtol=0, atol=1e-6)


@torch.no_grad()
@pytest.mark.parametrize("strength", [1.5, 3.0])
def test_it_undoes_the_short_exposure_blur(strength):
    """Blurred by H, whose definition is written out here, and filtered: nine tenths and more of the error go."""
    nu = torch.fft.fftfreq(96)
    f = (2 * torch.hypot(nu[:, None], nu)).clamp(max=1)
    blur = torch.exp(-3.44 * (strength * f) ** (5 / 3) * (1 - f ** (1 / 3)))
    smooth = torch.fft.ifft2(torch.fft.fft2(torch.rand(96, 96)) * torch.exp(-((f / 0.25) ** 2))).real
    scene = (smooth - smooth.mean()) / smooth.std() * 0.15 + 0.5
    seen = torch.fft.ifft2(torch.fft.fft2(scene) * blur).real
    clear = InverseFilters((strength,))(seen[None, None])[0, 0, 0]
    inner = (slice(16, -16), slice(16, -16))
    before, after = ((x - scene)[inner].square().mean() for x in (seen, clear))
    assert after < 0.1 * before


@torch.no_grad()
def test_each_channel_by_itself():
    net, picture = InverseFilters((1.5, 4.5), size=9), torch.rand(2, 3, 20, 17)
    out = net(picture)
    assert out.shape == (2, 2, 3, 20, 17)
    torch.testing.assert_close(out[1:, :, 2:], net(picture[1:, 2:]), rtol=0, atol=1e-6)


def test_values_out_of_range():
    with pytest.raises(ParameterError, match="size of a filter"):
        InverseFilters(size=64)
    with pytest.raises(ParameterError, match="D/r0"):
        InverseFilters((-1.0,))
