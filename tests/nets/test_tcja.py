import pytest
import torch
import torch.nn.functional as F

from turbnet.errors import ParameterError
from turbnet.nets.tcja import JointAttention, TCJATransformer, _unit


def features(net: TCJATransformer, clip: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Of a clip and its mean, with the same confidence everywhere."""
    return net(clip.mean(1, keepdim=True), clip, torch.full_like(clip[:, :, :1], 0.5))[:2]


def made(**more) -> TCJATransformer:
    torch.manual_seed(0)
    return TCJATransformer(**{"width": 8, "depth": 2, **more}).eval()


@pytest.mark.parametrize(("batch", "frames", "height", "width"), [(1, 1, 4, 4), (3, 2, 12, 20), (1, 7, 28, 4)])
def test_shapes(batch, frames, height, width):
    still, own = features(made(), torch.rand(batch, frames, 3, height, width))
    assert still.shape == (batch, 8, height // 4, width // 4)
    assert own.shape == (batch, frames, 8, height // 4, width // 4)


@torch.no_grad()
def test_order_of_frames_does_not_matter():
    net, clip = made(), torch.rand(1, 5, 3, 12, 16)
    order = torch.tensor([3, 0, 4, 1, 2])
    (still, own), (again, mixed) = features(net, clip), features(net, clip[:, order])
    torch.testing.assert_close(mixed, own[:, order], rtol=0, atol=1e-5)
    torch.testing.assert_close(again, still, rtol=0, atol=1e-5)


@torch.no_grad()
def test_clips_of_a_batch_do_not_mix():
    net, clips = made(), torch.rand(2, 3, 3, 8, 12)
    for whole, alone in zip(features(net, clips), features(net, clips[1:]), strict=True):
        torch.testing.assert_close(whole[1:], alone, rtol=0, atol=1e-5)


@torch.no_grad()
def test_frames_and_the_reference_see_each_other():
    net, clip = made(), torch.rand(1, 3, 3, 8, 8)
    changed = clip.clone()
    changed[:, 2] = torch.rand(3, 8, 8)
    # The means differ too; what is left beyond them is attention.
    changed[:, 1] += clip[:, 2] - changed[:, 2]
    for before, after in zip(features(net, clip), features(net, changed), strict=True):
        assert (after - before)[:, :1].abs().max() > 1e-4


@torch.no_grad()
def test_what_is_far_has_no_influence():
    """Space is mixed by convolutions only: two 3 x 3 layers a block and one at the start, on patches of 4 pixels."""
    net, clip = made(depth=1), torch.rand(1, 2, 3, 8, 64)
    changed = clip.clone()
    changed[..., 48:] = 0
    far = slice(0, 12 - 3)
    for before, after in zip(features(net, clip), features(net, changed), strict=True):
        torch.testing.assert_close(after[..., far], before[..., far], rtol=0, atol=1e-6)
        assert not torch.allclose(after[..., 9:12], before[..., 9:12])


class TestJointAttention:
    @staticmethod
    def by_definition(net: JointAttention, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The attention of one clip written out token by token; also its weights (H, W, T G, T G)."""
        frames, channels, height, width = x.shape
        qkv = F.conv2d(x, net.expand.weight, net.expand.bias)
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
        torch.testing.assert_close(net(clip)[0][0], expected, rtol=0, atol=1e-5)

    @torch.no_grad()
    def test_the_weights_of_a_token_sum_to_one(self):
        """With every value the same, any blend of them with weights of sum one is that value."""
        torch.manual_seed(2)
        net, clip = JointAttention(6, groups=2), torch.randn(1, 3, 6, 4, 5)
        net.expand.weight[12:] = 0
        net.expand.bias[12:] = 2.0
        net.project.weight.copy_(torch.eye(6)[:, :, None, None])
        net.project.bias.zero_()
        torch.testing.assert_close(net(clip)[0], torch.full_like(clip, 2.0))

    @pytest.mark.parametrize("scale", [0.0, 1e-6, 1.0, 1e6])
    @pytest.mark.parametrize("temperature", [1.5, 100.0])
    def test_finite_for_any_size_of_input(self, scale, temperature):
        torch.manual_seed(3)
        net = JointAttention(8)
        with torch.no_grad():
            net.log_temperature.fill_(temperature)  # exp(100) is infinite: held to its bound
            net.expand.bias.zero_()
        x = (scale * torch.randn(1, 3, 8, 4, 4)).requires_grad_()
        out, _ = net(x)
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
