"""Re-degradation: nothing of the observed frame gets through the code, and the true code suffices."""

import math

import pytest
import skimage.data
import torch

from turbnet.atmosphere.path import OpticalPath
from turbnet.errors import ParameterError
from turbnet.media.colour import to_linear, to_srgb
from turbnet.nets import build
from turbnet.nets.redegradation import (
    CELL,
    FORMS,
    Code,
    LinearRedegradation,
    PhysicalRedegradation,
    at_pixels,
    code_of,
)
from turbnet.simulate.simple import theoretical_tilt_std
from turbnet.simulate.simulator import Simulator
from turbnet.simulate.width import equivalent_sigma, short_exposure_sigma

CONFIG = {"name": "redegrading", "restorer": {"name": "still", "widths": [4, 4, 4], "depths": [1, 1, 1]}}


@pytest.fixture(scope="module")
def picture():
    return torch.from_numpy(skimage.data.astronaut()[64:160, 160:256].copy()).float().permute(2, 0, 1)[None, None] / 255


def some_code(form: str, frames: int = 2, cells: int = 6) -> Code:
    generator = torch.Generator().manual_seed(0)
    size = FORMS[form]().blur_size
    return Code(
        torch.randn(1, frames, 2, cells, cells, generator=generator),
        torch.randn(1, frames, size, cells, cells, generator=generator),
    )


@torch.no_grad()
@pytest.mark.parametrize("form", FORMS)
def test_of_a_constant_picture_nothing_can_be_made_but_that_constant(form):
    """No leak: whatever the code says, D makes no picture of it; the frames that were observed are not reproduced."""
    grey = torch.full((1, 1, 3, 96, 96), 0.4)
    out = FORMS[form]()(grey, some_code(form))
    assert out.shape == (1, 2, 3, 96, 96)
    assert float(out.mean()) == pytest.approx(0.4, abs=0.01)
    # The physical form's PSF basis is good to about 45 dB.
    assert float(out.std()) < (1e-5 if form == "linear" else 0.01)


@torch.no_grad()
@pytest.mark.parametrize("form", FORMS)
def test_the_code_is_a_bottleneck(form, picture):
    """Fewer than a twelfth as many numbers as pixels, and E sees no more of the frame than that."""
    net = build({**CONFIG, "form": form}).eval()
    code = net.code(picture.expand(1, 2, -1, -1, -1))
    assert code.tilt.shape == (1, 2, 2, 96 // CELL, 96 // CELL)
    assert (code.tilt.numel() + code.blur.numel()) < picture.numel() * 2 / 12


@torch.no_grad()
@pytest.mark.parametrize(("strength", "least"), [(1.0, 44.0), (2.0, 40.0), (4.0, 36.0)])
def test_the_true_code_reproduces_what_was_seen(picture, strength, least):
    """Through the simulator with 36 modes and a finer grid, without noise; at D/r0 = 4 cells are too coarse for 40 dB."""
    path = OpticalPath.from_d_over_r0(8.0)
    simulator = Simulator(path, 96, 96, 36, 8, 8, (0.0, 8.0), margin=16)
    draw = simulator.draw([1], 3, None, d_over_r0=torch.tensor([strength])).centred()
    seen = to_srgb(simulator(to_linear(picture), draw).frames.clamp(0, 1))
    again = PhysicalRedegradation(modes=36)(picture, code_of(draw, 36, 96, 96))
    error = (again - seen)[..., 8:-8, 8:-8].square().mean()
    assert -10 * math.log10(float(error)) > least


@torch.no_grad()
@pytest.mark.parametrize("form", FORMS)
def test_a_code_of_nothing_changes_little(form, picture):
    size = FORMS[form]().blur_size
    nothing = Code(torch.zeros(1, 1, 2, 6, 6), torch.zeros(1, 1, size, 6, 6))
    if form == "linear":
        nothing.blur[:, :, 0] = 30.0  # the narrowest kernel
    out = FORMS[form]()(picture, nothing)
    assert (out - picture)[..., 8:-8, 8:-8].abs().mean() < 0.01


@pytest.mark.parametrize("form", FORMS)
def test_gradients_reach_picture_and_code(form, picture):
    code = Code(*(part.requires_grad_() for part in some_code(form)))
    scene = picture.clone().requires_grad_()
    FORMS[form]()(scene, code).square().mean().backward()
    for part in (scene, *code):
        assert part.grad.isfinite().all()
        assert part.grad.abs().sum() > 0


@torch.no_grad()
def test_at_pixels_is_linear_between_the_middles_of_cells():
    cells = torch.tensor([[[[0.0, 16.0, 32.0]]]])
    row = at_pixels(cells, 0, 1, 1, 48)[0, 0, 0]
    expected = (torch.arange(48) - 7.5).clamp(0, 32)
    torch.testing.assert_close(row, expected, rtol=0, atol=1e-4)
    torch.testing.assert_close(
        at_pixels(cells, -16, 8, 1, 10)[0, 0, 0],
        (torch.arange(-16, 64, 8) - 7.5).clamp(0, 32).float(),
        rtol=0,
        atol=1e-4,
    )


def test_the_dance_tells_the_strength():
    """Of 40 frames and 64 independent cells: the variance is known to sqrt(2 / 5000), the strength to 3/5 of that."""
    generator = torch.Generator().manual_seed(1)
    tilt = theoretical_tilt_std(3.0) * torch.randn(1, 40, 2, 8, 8, generator=generator)
    code = Code(tilt + 1.7, torch.zeros(1, 40, 1, 8, 8))  # another aim of the camera is no dance
    assert float(code.strength()) == pytest.approx(3.0, rel=4 * 0.6 * math.sqrt(2 / 5000))
    assert float(Code(tilt[:, :1], tilt[:, :1]).strength()) == 0


def test_the_prior_is_least_at_the_blur_that_goes_with_the_dance():
    generator = torch.Generator().manual_seed(1)
    tilt = theoretical_tilt_std(3.0) * torch.randn(1, 40, 2, 8, 8, generator=generator)
    linear = LinearRedegradation()
    widths = equivalent_sigma(linear.kernels.detach())

    def cost(kernel: int) -> float:
        blur = torch.zeros(1, 40, 8, 8, 8)
        blur[:, :, kernel] = 30.0
        return float(linear.prior(Code(tilt, blur)).detach())

    for kernel, width in enumerate(widths):
        wanted = short_exposure_sigma(3.0)
        assert (cost(kernel) < 1e-3) == (float(width) > 0.97 * wanted)
    physical = PhysicalRedegradation(modes=21)
    sure = [float(physical.prior(Code(tilt, a * torch.ones(1, 40, 18, 8, 8)))) for a in (0.05, 0.2, 0.8)]
    assert sure[1] < sure[0]
    assert sure[1] < sure[2]


@torch.no_grad()
def test_only_the_restorer_runs():
    net, clip = build(CONFIG).eval(), torch.rand(1, 2, 3, 32, 48)
    torch.testing.assert_close(net(clip), net.restorer(clip))
    found = net.stages(clip)
    assert found.frames.shape == clip.shape


@pytest.mark.parametrize("change", [{"form": "magic"}, {"degradation": {"size": 4}}, {"degradation": {"kernels": 1}}])
def test_values_out_of_range(change):
    with pytest.raises(ParameterError):
        build({**CONFIG, **change})
