"""The whole restorer."""

import math

import pytest
import torch

from turbnet.errors import InputError
from turbnet.nets import build
from turbnet.nets.restorer import Restorer, _sums, dance

CONFIG = {
    "name": "restorer",
    "tilt": {"widths": [4, 4, 4]},
    "tcja": {"width": 8, "depth": 1},
    "scene": {"widths": [8, 8, 8], "depths": [1, 1, 1]},
}


@torch.no_grad()
@pytest.mark.parametrize("frames", [1, 2, 7])
def test_any_number_of_frames(frames):
    net = build(CONFIG)
    clip = torch.rand(1, frames, 3, 24, 8)
    assert net(clip).shape == clip.shape


def test_size_multiple_holds_both_parts():
    assert build(CONFIG).size_multiple == 8
    assert Restorer(tcja={"width": 6, "depth": 1, "patch": 3}).size_multiple == 24


@torch.no_grad()
def test_a_still_clip_stays_as_it_is():
    clip = torch.rand(1, 1, 3, 16, 16).expand(1, 4, 3, 16, 16)
    torch.testing.assert_close(build(CONFIG)(clip), clip, rtol=0, atol=1e-5)


@pytest.mark.parametrize("scale", [1.0, 1e6])
def test_bfloat16_autocast_is_finite_and_near_float32(trained, scale):
    net = trained(CONFIG)
    clip = scale * torch.rand(1, 3, 3, 16, 16)
    with torch.autocast("cpu", torch.bfloat16):
        half = net(clip)
    (half.float() / scale).abs().mean().backward()  # of the size of a loss: what is near 1e30 may overflow
    assert all(torch.isfinite(p.grad).all() for p in net.parameters() if p.grad is not None)
    assert torch.isfinite(half).all()
    if scale == 1:  # bfloat16 keeps 8 bits
        torch.testing.assert_close(half.float(), net(clip), rtol=0, atol=0.05)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"name": "vnet"}, "there is no network named 'vnet'"),
        ({"name": None}, "there is no network named None"),
        ({"depth": 3}, "depth"),
        ({"tcja": {"wide": 3}}, "wide"),
        ({"tcja": {"width": 8, "groups": 3}}, "groups = 3"),
    ],
)
def test_a_network_that_cannot_be_built(change, says):
    with pytest.raises(InputError, match=says):
        build({**CONFIG, **change})


@torch.no_grad()
def test_untrained_it_gives_the_reference():
    clip = torch.rand(1, 4, 3, 16, 16)
    out = build(CONFIG).stages(clip)
    torch.testing.assert_close(out.scene, out.registered.reference, rtol=0, atol=1e-5)
    gate = torch.sigmoid(torch.tensor(-2.0))
    torch.testing.assert_close(out.own, (clip + out.registered.frames) / 2, rtol=0, atol=1e-5)
    expected = out.scene + gate * (out.own - out.scene)
    torch.testing.assert_close(out.frames, expected, rtol=0, atol=1e-5)


@torch.no_grad()
def test_which_way_time_runs_does_not_matter(trained):
    net, clip = trained(CONFIG), torch.rand(1, 7, 3, 16, 24)
    torch.testing.assert_close(net(clip.flip(1)), net(clip).flip(1), rtol=0, atol=1e-4)


@torch.no_grad()
def test_clips_of_a_batch_do_not_mix(trained):
    net, clips = trained(CONFIG), torch.rand(2, 3, 3, 16, 24)
    torch.testing.assert_close(net(clips)[1:], net(clips[1:]), rtol=0, atol=1e-4)


def test_every_weight_learns(trained):
    net = trained(CONFIG)
    net(torch.rand(1, 3, 3, 16, 16)).square().mean().backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().sum() > 0, name


@torch.no_grad()
def test_the_lucky_fusion_is_a_mean_over_time(trained):
    """Its weights are positive and sum to one, so that it stays within what the frames hold at each pixel."""
    net = trained(CONFIG)
    clip = torch.rand(1, 5, 3, 16, 16)
    registered = net.tilt(clip)
    _, features, _ = net.tcja(registered.reference, registered.frames, registered.confidence)
    fused, _ = net.fusion(registered.frames, 10 * features, registered.confidence)
    assert (fused <= registered.frames.amax(1)[:, None] + 1e-6).all()
    assert (fused >= registered.frames.amin(1)[:, None] - 1e-6).all()


@torch.no_grad()
@pytest.mark.parametrize("frames", [1, 2, 40])
def test_the_dance_is_the_variance_of_the_tilt(frames):
    """Of many frames, many pixels: tilts of 1.5 pixels RMS in each axis about an aim of their own."""
    generator = torch.Generator().manual_seed(0)
    tilt = 1.5 * torch.randn(1, frames, 2, 32, 32, generator=generator) + 3.0
    maps = dance(_sums(tilt, None))
    assert maps.shape == (1, 2, 64, 64)
    torch.testing.assert_close(maps[:, 1], torch.full((1, 64, 64), math.log(frames) / 2))
    expected = 0.0 if frames == 1 else 1.5**2
    # Means of 25 pixels and more, two axes, n - 1 frames each: the worst of a thousand within five standard errors.
    error = 5 * expected * math.sqrt(2 / (2 * 25 * max(frames - 1, 1)))
    found = (2 * maps[:, 0]).exp() - 0.01
    assert (found - expected).abs().max() < error + 1e-5
