import math

import pytest
import torch

from turbnet.errors import ParameterError
from turbnet.simulate.draw import Draw


@pytest.fixture
def draw() -> Draw:
    return Draw(torch.randn(2, 3, 7, 5, 6, generator=torch.Generator().manual_seed(0)), stride=4, margin=8, q=2.0)


def test_a_tilt_is_four_over_pi_nyquist_pixels_a_radian(draw):
    torch.testing.assert_close(draw.tilt, draw.coefficients[:, :, :2] * 4 / (math.pi * 2.0))


def test_blur_strength_is_the_rms_phase_beyond_the_tilt(draw):
    strength = draw.blur_strength
    assert strength.shape == (2, 3, 1, 5, 6)
    expected = math.sqrt(sum(float(draw.coefficients[1, 2, n, 3, 4]) ** 2 for n in range(2, 7)))
    assert float(strength[1, 2, 0, 3, 4]) == pytest.approx(expected, rel=1e-6)


def test_centred_takes_one_shift_from_a_whole_clip(draw):
    centred = draw.centred()
    assert float(centred.tilt.mean((1, 3, 4)).abs().max()) < 1e-6
    taken = draw.tilt - centred.tilt
    torch.testing.assert_close(taken, taken[:, :1, :, :1, :1].expand_as(taken), rtol=0, atol=1e-6)
    assert (centred.stride, centred.margin, centred.q) == (4, 8, 2.0)


@pytest.mark.parametrize("scale", [0.25, 0.5, 1, 2, 2.5])
def test_at_scale_is_the_same_atmosphere_in_other_pixels(draw, scale):
    scaled = draw.at_scale(scale)
    assert (scaled.stride, scaled.margin, scaled.q) == (4 * scale, 8 * scale, 2.0 / scale)
    assert isinstance(scaled.stride, int)
    assert scaled.coefficients is draw.coefficients
    torch.testing.assert_close(scaled.tilt, draw.tilt * scale)


@pytest.mark.parametrize("scale", [0.0, 0.125, 0.375, 1.1, -1])
def test_a_grid_that_is_not_whole_pixels_is_refused(draw, scale):
    with pytest.raises(ParameterError, match="whole"):
        draw.at_scale(scale)
