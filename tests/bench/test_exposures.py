import pytest
import torch

from turbnet.bench.exposures import width
from turbnet.simulate.psf_basis import tilt_free_psf


def test_width_of_a_gaussian():
    axis = torch.arange(63.0) - 31
    for sigma in (1.5, 3.0, 5.0):
        image = torch.exp(-(axis**2 + axis[:, None] ** 2) / (2 * sigma**2))
        assert width(image) == pytest.approx(2.3548 * sigma, rel=0.01)


def test_width_of_the_airy_pattern():
    """1.029 lambda / D, and a pixel is lambda / (2 D)."""
    assert width(tilt_free_psf(torch.zeros(1, 33), points=32)[0]) == pytest.approx(2 * 1.029, rel=0.01)
