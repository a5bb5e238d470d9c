"""What a GPU must give: the processor's results, and a training run that a processor can use."""

import copy
import math

import pytest
import torch

from turbnet.cli import run
from turbnet.data.pairs import PairMaker
from turbnet.deploy.checkpoint import load_network

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")

TINY = {"name": "restorer", "tilt": {"widths": [8, 8, 8]}, "tcja": {"width": 16, "depth": 1}}
TINY |= {"scene": {"widths": [8, 16, 16], "depths": [1, 1, 1]}, "own": {"width": 8, "depth": 1}}


@pytest.fixture(autouse=True)
def whole_precision():
    """Products in float32 and not in its short form, as on a processor."""
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = False
    yield
    torch.backends.cudnn.allow_tf32 = before


def test_the_same_seed_gives_the_same_pair():
    pairs = PairMaker(64, 64, components=4, d_over_r0=(2.0, 4.0), defocus=(0.5, 2.0), blurred=0.5)
    scene = torch.rand(3, 4, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    here, there = pairs(scene, [1, 2, 3]), copy.deepcopy(pairs).cuda()(scene.cuda(), [1, 2, 3])
    for name in ("frames", "blur_only", "tilt"):
        torch.testing.assert_close(getattr(there, name).cpu(), getattr(here, name), atol=1e-3, rtol=1e-3)


def test_the_simulator_is_differentiable():
    pairs = PairMaker(48, 48, components=4)
    simulator, gradients = pairs.simulators[0], []
    for device in ("cpu", "cuda"):
        on = copy.deepcopy(simulator).to(device)
        scene = torch.rand(1, 2, 3, 48, 48, generator=torch.Generator().manual_seed(0)).to(device).requires_grad_()
        on(scene, on.draw([5], 2)).frames.square().sum().backward()
        gradients.append(scene.grad.cpu())
    torch.testing.assert_close(gradients[1], gradients[0], atol=1e-3, rtol=1e-3)


def test_a_network_restores_the_same_frames(trained):
    network = trained(TINY)
    clip = torch.rand(1, 5, 3, 64, 72, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        here = network(clip)
        there = network.cuda()(clip.cuda()).cpu()
    torch.testing.assert_close(there, here, atol=1e-4, rtol=0)


def test_a_run_trains_and_its_checkpoint_works_without_a_gpu(tmp_path):
    arguments = ["experiment=tiny", "trainer=gpu", "callbacks=quiet", f"output={tmp_path}", "trainer.max_epochs=1"]
    assert run(["train", *arguments, "data.steps_per_epoch=6", "data.val_clips=1"]) == 0
    network, _ = load_network(tmp_path / "checkpoints" / "last.ckpt")
    assert all(bool(weight.isfinite().all()) for weight in network.state_dict().values())
    assert not math.isnan(float(network(torch.rand(1, 3, 3, 64, 64)).mean()))
