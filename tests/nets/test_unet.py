import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from turbnet.nets import build
from turbnet.nets.unet import UNet


@torch.no_grad()
@pytest.mark.parametrize(("batch", "frames", "height", "width"), [(1, 1, 8, 8), (3, 2, 24, 40), (1, 5, 16, 72)])
def test_untrained_it_gives_back_the_frames(batch, frames, height, width):
    clip = torch.rand(batch, frames, 3, height, width)
    torch.testing.assert_close(UNet((4, 4, 4), (1, 1, 1))(clip), clip, rtol=0, atol=1e-6)


@torch.no_grad()
def test_a_frame_knows_the_others_by_their_mean_alone():
    torch.manual_seed(0)
    net = UNet((4, 4, 4), (1, 1, 1))
    torch.nn.init.normal_(net.net.correct.weight, std=0.1)
    clip = torch.rand(1, 3, 3, 16, 16)
    swapped = clip[:, [0, 2, 1]]
    torch.testing.assert_close(net(swapped)[:, 0], net(clip)[:, 0], rtol=0, atol=1e-5)
    assert (net(clip[:, :1])[:, 0] - net(clip)[:, 0]).abs().max() > 1e-3


def test_it_costs_what_s_costs():
    """Multiplications a frame of a clip of 12, within 3 %."""
    from hydra import compose, initialize_config_module

    costs = []
    with initialize_config_module("turbnet.configs", version_base="1.3"):
        for name in ("s", "unet"):
            net = build(compose("train", overrides=[f"net={name}"]).net)
            with FlopCounterMode(display=False) as counter, torch.no_grad():
                net(torch.zeros(1, 12, 3, 64, 64))
            costs.append(counter.get_total_flops())
    assert costs[1] == pytest.approx(costs[0], rel=0.03)
