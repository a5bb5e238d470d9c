"""Networks for single frames, and their uncertainty maps."""

import math

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from turbnet.errors import ParameterError
from turbnet.nets import build
from turbnet.nets.dncnn import DnCNN
from turbnet.nets.still import StillRestorer
from turbnet.nets.uncertainty import LEAST, MOST, Maps, Uncertainty, UncertaintyNet, laplace_loss

COMPLEX = {"name": "complex-unet", "widths": [2, 3, 4], "depths": [1, 1, 1]}
SMALL = {"name": "still", "widths": [4, 6, 8], "depths": [1, 1, 1]}
MAPS = {"widths": [4, 6, 8], "depths": [1, 1, 1], "dropout": 0.2}


@torch.no_grad()
@pytest.mark.parametrize("config", [SMALL, {**SMALL, "maps": MAPS}, {"name": "dncnn", "width": 4, "depth": 3}, COMPLEX])
@pytest.mark.parametrize(("batch", "frames", "height", "width"), [(1, 1, 8, 8), (2, 3, 24, 40)])
def test_untrained_they_give_back_the_frames(config, batch, frames, height, width):
    clip = torch.rand(batch, frames, 3, height, width)
    torch.testing.assert_close(build(config)(clip), clip, rtol=0, atol=1e-6)


@torch.no_grad()
@pytest.mark.parametrize("config", [{**SMALL, "maps": MAPS}, {"name": "dncnn", "width": 4, "depth": 3}])
def test_every_frame_is_restored_by_itself(trained, config):
    net, clip = trained(config), torch.rand(2, 3, 3, 16, 24)
    torch.testing.assert_close(net(clip)[1:, 2:], net(clip[1:, 2:]), rtol=0, atol=1e-5)


@pytest.mark.parametrize("config", [SMALL, {**SMALL, "maps": MAPS}, {"name": "dncnn", "width": 4, "depth": 3}, COMPLEX])
def test_every_weight_learns(trained, config):
    net = trained(config)
    net(torch.rand(1, 2, 3, 16, 16)).square().mean().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().sum() > 0, name


@torch.no_grad()
def test_scales_are_bounded_whatever_comes_in(trained):
    net = trained({**SMALL, "maps": MAPS}).maps
    for clip in (torch.zeros(1, 1, 3, 16, 16), torch.ones(1, 1, 3, 16, 16), 1e4 * torch.randn(1, 1, 3, 16, 16)):
        found = net(clip)
        assert found.change.isfinite().all()
        assert found.log_scale.min() >= LEAST
        assert found.log_scale.max() <= MOST
    assert found.maps.shape == (1, 1, 2, 16, 16)


@torch.no_grad()
def test_maps_alone_say_what_the_network_says(trained):
    net, clip = trained({**SMALL, "maps": MAPS}).maps, torch.rand(1, 2, 3, 16, 24)
    alone, found = Maps(net).train()(clip), net(clip, drop=False)
    torch.testing.assert_close(alone[:, :, :2], found.maps)
    torch.testing.assert_close(alone[:, :, 2], found.change.sum(2).abs().mean(2))


@torch.no_grad()
def test_dropout_is_for_training_and_monte_carlo(trained):
    net, clip = trained({**SMALL, "maps": MAPS}).maps, torch.rand(1, 2, 3, 16, 16)
    assert torch.equal(net(clip).change, net(clip).change)
    assert not torch.equal(net(clip, drop=True).change, net(clip, drop=True).change)
    assert not torch.equal(net.train()(clip).change, net(clip).change)


@torch.no_grad()
def test_monte_carlo_adds_the_spread_of_its_passes(trained):
    """One pass says b; several say b^2 + Var / 2, of which the first part is that of a single pass on the average."""
    torch.manual_seed(0)
    net, clip = trained({**SMALL, "maps": MAPS}).maps, torch.rand(1, 1, 3, 16, 16)
    drawn = [net(clip, drop=True) for _ in range(200)]
    changes = torch.stack([one.change for one in drawn])
    expected = torch.stack([one.maps.square() for one in drawn]).mean(0) + changes.var(0).mean(3) / 2
    found = net.monte_carlo(clip, 200)
    # Both are means of 200 draws: they agree to a few of their standard errors of 1 / sqrt(200).
    torch.testing.assert_close(found.maps.square().mean(), expected.mean(), rtol=0.3, atol=0)
    assert found.maps.square().mean() > torch.stack([one.maps.square() for one in drawn]).mean()
    with pytest.raises(ParameterError):
        net.monte_carlo(clip, 1)


def test_the_likelihood_is_best_at_the_true_scale():
    """Of Laplace errors of scale 0.1, -log p is least where b = 0.1, to the accuracy that so many draws allow."""
    generator = torch.Generator().manual_seed(0)
    uniform = torch.rand(1, 1, 3, 128, 128, generator=generator) - 0.5
    error = -0.1 * uniform.sign() * torch.log1p(-2 * uniform.abs())
    nothing = torch.zeros(1, 1, 2, 3, 128, 128)

    def loss(log_b: float) -> torch.Tensor:
        return laplace_loss(Uncertainty(nothing, torch.full((1, 1, 2, 128, 128), log_b)), error, error)

    values = {b: float(loss(math.log(b))) for b in (0.09, 0.1, 0.11)}
    assert min(values, key=values.__getitem__) == 0.1


def test_dropout_out_of_range():
    with pytest.raises(ParameterError, match="dropout"):
        UncertaintyNet(dropout=1.0)
    with pytest.raises(ParameterError, match="depth"):
        DnCNN(depth=1)


def test_those_to_compare_with_cost_as_much():
    """Multiplications a frame, within 5 %."""
    from hydra import compose, initialize_config_module

    costs = {}
    with initialize_config_module("turbnet.configs", version_base="1.3"):
        for name in ("still", "still_plain", "still_unet", "still_complex", "dncnn"):
            net = build(compose("train", overrides=[f"net={name}"]).net).eval()
            with FlopCounterMode(display=False) as counter, torch.no_grad():
                net(torch.zeros(1, 1, 3, 64, 64))
            costs[name] = counter.get_total_flops()
    assert isinstance(build({"name": "still"}), StillRestorer)
    for name, cost in costs.items():
        assert cost == pytest.approx(costs["still"], rel=0.05), name
