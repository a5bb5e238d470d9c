import pytest
import torch
import torch.nn.functional as F

from turbnet.errors import InputError, ParameterError
from turbnet.nets import build
from turbnet.nets.restorer import Restorer
from turbnet.nets.tcja import JointAttention, TCJATransformer, _unit


def trained(**more) -> TCJATransformer:
    """A net whose every weight takes part, as after training."""
    torch.manual_seed(0)
    net = TCJATransformer(**{"width": 8, "depth": 2, **more})
    with torch.no_grad():
        net.correct.weight.normal_(std=0.1)
        net.gate.weight.normal_(std=0.1)
    return net.eval()


@pytest.mark.parametrize(("batch", "frames", "height", "width"), [(1, 1, 4, 4), (3, 2, 12, 20), (1, 7, 28, 4)])
def test_shapes(batch, frames, height, width):
    clip = torch.rand(batch, frames, 3, height, width)
    assert trained()(clip).shape == clip.shape


@torch.no_grad()
def test_order_of_frames_does_not_matter():
    net, clip = trained(), torch.rand(1, 5, 3, 12, 16)
    order = torch.tensor([3, 0, 4, 1, 2])
    torch.testing.assert_close(net(clip[:, order]), net(clip)[:, order], rtol=0, atol=1e-5)


@torch.no_grad()
def test_clips_of_a_batch_do_not_mix():
    net, clips = trained(), torch.rand(2, 3, 3, 8, 12)
    torch.testing.assert_close(net(clips)[1:], net(clips[1:]), rtol=0, atol=1e-5)


@torch.no_grad()
def test_frames_see_each_other():
    net, clip = trained(), torch.rand(1, 3, 3, 8, 8)
    changed = clip.clone()
    changed[:, 2] = torch.rand(3, 8, 8)
    # The means differ too; what is left beyond them is attention.
    changed[:, 1] += clip[:, 2] - changed[:, 2]
    assert (net(changed)[:, 0] - net(clip)[:, 0]).abs().max() > 1e-4


@torch.no_grad()
def test_what_is_far_has_no_influence():
    """Space is mixed by convolutions only: three 3 x 3 layers a block and one at each end, on patches of 4 pixels."""
    net, clip = trained(depth=1), torch.rand(1, 2, 3, 8, 64)
    changed = clip.clone()
    changed[..., 48:] = 0
    reach = 4 * (1 + 2 + 1)
    far = slice(0, 48 - reach)
    torch.testing.assert_close(net(changed)[..., far], net(clip)[..., far], rtol=0, atol=1e-6)
    assert not torch.allclose(net(changed)[..., 40:48], net(clip)[..., 40:48])


@torch.no_grad()
def test_untrained_it_blends_the_frame_and_the_mean():
    clip = torch.rand(1, 4, 3, 8, 8)
    mean = clip.mean(1, keepdim=True)
    gate = torch.sigmoid(torch.tensor(-1.5))
    torch.testing.assert_close(TCJATransformer(width=8, depth=1)(clip), mean + gate * (clip - mean))


class TestJointAttention:
    @staticmethod
    def by_definition(net: JointAttention, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The attention of one clip written out token by token; also its weights (H, W, T G, T G)."""
        frames, channels, height, width = x.shape
        qkv = F.conv2d(x, net.expand.weight, net.expand.bias)
        qkv = F.conv2d(qkv, net.mix.weight, net.mix.bias, padding=1, groups=3 * channels)
        q, k, v = qkv.view(frames, 3, net.groups, channels // net.groups, height, width).unbind(1)
        q, k = F.normalize(q, dim=2), F.normalize(k, dim=2)
        logits = torch.einsum("tgchw,sfchw->hwtgsf", q, k) * net.log_temperature.exp().view(1, 1, 1, net.groups, 1, 1)
        weights = logits.flatten(4).softmax(-1)
        out = torch.einsum("hwtgs,schw->tgchw", weights, v.flatten(0, 1)).reshape(frames, channels, height, width)
        return F.conv2d(out, net.project.weight, net.project.bias), weights.flatten(2, 3)

    @torch.no_grad()
    def test_against_the_definition(self):
        torch.manual_seed(1)
        net, clip = JointAttention(6, groups=2), torch.rand(1, 3, 6, 4, 5)
        net.log_temperature.copy_(torch.tensor([[0.5], [1.5]]))
        expected, _ = self.by_definition(net, clip[0])
        torch.testing.assert_close(net(clip)[0], expected, rtol=0, atol=1e-5)

    @torch.no_grad()
    def test_the_weights_of_a_token_sum_to_one(self):
        """With every value the same, any blend of them with weights of sum one is that value."""
        torch.manual_seed(2)
        net, clip = JointAttention(6, groups=2), torch.randn(1, 3, 6, 4, 5)
        net.expand.weight[12:] = 0
        net.expand.bias[12:] = 0
        net.mix.bias[12:] = 2.0
        net.project.weight.copy_(torch.eye(6)[:, :, None, None])
        net.project.bias.zero_()
        torch.testing.assert_close(net(clip), torch.full_like(clip, 2.0))

    @pytest.mark.parametrize("scale", [0.0, 1e-6, 1.0, 1e6])
    @pytest.mark.parametrize("temperature", [1.5, 100.0])
    def test_finite_for_any_size_of_input(self, scale, temperature):
        torch.manual_seed(3)
        net = JointAttention(8)
        with torch.no_grad():
            net.log_temperature.fill_(temperature)  # exp(100) is infinite: held to its bound
            net.expand.bias.zero_()
            net.mix.bias.zero_()
        x = (scale * torch.randn(1, 3, 8, 4, 4)).requires_grad_()
        out = net(x)
        out.square().mean().backward()
        assert torch.isfinite(out).all()
        assert torch.isfinite(x.grad).all()
        assert all(torch.isfinite(p.grad).all() for p in net.parameters())

    def test_queries_and_keys_have_unit_length_computed_in_float32(self):
        """300 squared is above half precision's largest number, 65504."""
        x = (300 * torch.randn(5, 8)).half()
        torch.testing.assert_close(_unit(x), F.normalize(x.float(), dim=-1))

    def test_groups_must_divide_the_channels(self):
        with pytest.raises(ParameterError, match="groups = 3 must divide channels = 8"):
            JointAttention(8, groups=3)


class TestRestorer:
    config = {"name": "restorer", "tilt": {"widths": [4, 4, 4]}, "tcja": {"width": 8, "depth": 1}}

    @torch.no_grad()
    @pytest.mark.parametrize("frames", [1, 2, 7])
    def test_any_number_of_frames(self, frames):
        net = build(self.config)
        clip = torch.rand(1, frames, 3, 24, 8)
        assert net(clip).shape == clip.shape

    def test_size_multiple_holds_both_parts(self):
        assert build(self.config).size_multiple == 8
        assert Restorer(tcja={"width": 6, "depth": 1, "patch": 3}).size_multiple == 24

    @torch.no_grad()
    def test_a_still_clip_stays_as_it_is(self):
        clip = torch.rand(1, 1, 3, 16, 16).expand(1, 4, 3, 16, 16)
        torch.testing.assert_close(build(self.config)(clip), clip, rtol=0, atol=1e-5)

    @pytest.mark.parametrize("scale", [1.0, 1e6])
    def test_bfloat16_autocast_is_finite_and_near_float32(self, scale):
        torch.manual_seed(4)
        net = build(self.config)
        net.tcja.load_state_dict(trained(depth=1).state_dict())
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
            ({"name": "unet"}, "there is no network named 'unet'"),
            ({"name": None}, "there is no network named None"),
            ({"depth": 3}, "depth"),
            ({"tcja": {"wide": 3}}, "wide"),
            ({"tcja": {"width": 8, "groups": 3}}, "groups = 3"),
        ],
    )
    def test_a_network_that_cannot_be_built(self, change, says):
        with pytest.raises(InputError, match=says):
            build({**self.config, **change})
