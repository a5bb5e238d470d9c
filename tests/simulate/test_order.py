"""Tilt first, blur second, both by source point: against dense scatter with the whole PSF of every point.

The reference takes its PSFs from `turbnet.optics.psf` (a matrix DFT of a 32-point pupil, tilt as a phase ramp), not from
the simulator.
"""

import numpy as np
import pytest
import skimage.data
import torch
from torch import Tensor

from turbnet.atmosphere.path import OpticalPath
from turbnet.optics.psf import convolve, psf
from turbnet.optics.pupil import circular, pupil_grid
from turbnet.optics.superposition import gather, scatter, scatter_basis
from turbnet.optics.zernike import zernike_basis
from turbnet.simulate.blur import blur, blur_weights
from turbnet.simulate.draw import TILT_PIXELS
from turbnet.simulate.field import ZernikeField
from turbnet.simulate.psf_basis import psf_basis
from turbnet.simulate.simulator import Simulator
from turbnet.simulate.tilt import carry, tilt, upsample

POINTS, MODES, WINDOW = 32, 36, 47


def whole_psfs(coefficients_NHW: Tensor) -> Tensor:
    """PSF of a_2..a_J at every pixel, (H, W, WINDOW, WINDOW)."""
    x, y = pupil_grid(POINTS)
    modes = torch.from_numpy(zernike_basis(range(2, MODES + 1), np.hypot(x, y), np.arctan2(y, x))).float()
    pupil = torch.from_numpy(circular(POINTS, subsamples=16)).float()
    _, height, width = coefficients_NHW.shape
    chunks = coefficients_NHW.flatten(1).T.split(512)
    kernels = [psf(torch.einsum("pn,nyx->pyx", chunk, modes), pupil, WINDOW) for chunk in chunks]
    return torch.cat(kernels).view(height, width, WINDOW, WINDOW)


def fine_coefficients(draw, size: int) -> Tensor:
    return upsample(draw.coefficients[0], draw.stride, size, size)[0]


def relative(a: Tensor, b: Tensor) -> float:
    return float((a - b).norm() / b.norm())


def test_points_spread_by_the_psf_of_their_source():
    """B T is the scatter of whole PSFs; T B and gathering are not. Tilts are rounded to pixels: no interpolation here."""
    size = 96
    draw = ZernikeField(OpticalPath.from_d_over_r0(3.0), size, size, modes=MODES, stride=2).draw([1])
    coefficients = fine_coefficients(draw, size)
    pixels = (TILT_PIXELS * coefficients[:2]).round()
    coefficients = torch.cat((pixels / TILT_PIXELS, coefficients[2:]))
    scene = torch.zeros(size, size)
    scene[24:-23:16, 24:-23:16] = 1

    basis = psf_basis(200, 3.0, 3.0)
    beta = blur_weights(coefficients[None, 2:], basis)
    parts = torch.cat((torch.ones(1, 1, size, size), beta), dim=1)
    kernels = torch.cat((basis.mean[None], basis.components))
    moved = tilt(scene * parts, pixels[None], stride=1)
    tilt_then_blur = convolve(moved[0], kernels).sum(0)
    blur_then_tilt = tilt(scatter_basis(scene, kernels, parts[0])[None, None], pixels[None], stride=1)[0, 0]

    whole = whole_psfs(coefficients)
    exact = scatter(scene, whole)
    assert relative(tilt_then_blur, exact) < 0.02
    assert relative(blur_then_tilt, exact) > 0.2
    assert relative(gather(scene, whole), exact) > 0.2


@pytest.mark.parametrize("strength", [0.5, 1.0, 2.0, 3.0, 4.5])
def test_a_picture_is_right_to_45_dB(strength):
    """The simulator as it comes against dense scatter over a picture, both with a uniform scene kept uniform."""
    size, inner = 112, (..., slice(24, -24), slice(24, -24))
    scene = torch.from_numpy(skimage.data.astronaut()[100 : 100 + size, 150 : 150 + size, 0].copy()).float() / 255
    simulator = Simulator(OpticalPath.from_d_over_r0(strength), size, size, modes=MODES, components=60, margin=0)
    draw = simulator.draw([0])
    seen = simulator(scene[None, None, None], draw).frames[0, 0, 0]
    whole = whole_psfs(fine_coefficients(draw, size))
    exact = scatter(scene, whole) / scatter(torch.ones_like(scene), whole)
    error = -10 * torch.log10((seen - exact)[inner].square().mean())
    assert float(error) > 45


def test_blur_goes_with_its_point():
    """Weights taken at the place of arrival instead of the source would be wrong by more than those carried along."""
    size, stride = 96, 4
    draw = ZernikeField(OpticalPath.from_d_over_r0(4.5), size, size, modes=MODES, stride=stride).draw([0])
    scene = torch.from_numpy(skimage.data.camera()[100:196, 200:296].copy()).float()[None, None] / 255
    basis = psf_basis(60, 4.5, 4.5)
    weights = blur_weights(draw.high[0], basis)
    moved = tilt(scene, draw.tilt[0], stride)
    exact = scatter(scene[0, 0], whole_psfs(fine_coefficients(draw, size)))

    def error(carried: Tensor) -> float:
        return float((blur(moved, carried, basis, stride)[0, 0] - exact)[24:-24, 24:-24].square().mean())

    assert error(carry(weights, draw.tilt[0], stride)) < 0.5 * error(weights)
