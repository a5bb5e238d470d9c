"""The whole restorer."""

import pytest
import torch

from turbnet.errors import InputError
from turbnet.nets import build
from turbnet.nets.restorer import Restorer

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
    half.float().square().mean().backward()
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
def test_order_of_frames_does_not_matter(trained):
    net, clip = trained(CONFIG), torch.rand(1, 5, 3, 16, 24)
    order = torch.tensor([3, 0, 4, 1, 2])
    torch.testing.assert_close(net(clip[:, order]), net(clip)[:, order], rtol=0, atol=1e-4)


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
