"""Tasks on one batch, without a trainer."""

import pytest
import torch
import torch.nn.functional as F

from turbnet.errors import InputError, ParameterError
from turbnet.nets.tilt import SCALES
from turbnet.tasks.losses import charbonnier, frequency_loss, registration_loss
from turbnet.tasks.restoration import Restoration
from turbnet.tasks.tilt import TiltRemoval

SCENE = {"widths": [8, 12, 16], "depths": [1, 1, 1]}
NET = {"name": "restorer", "tilt": {"widths": [8, 8, 8]}, "tcja": {"width": 16, "depth": 1}, "scene": SCENE}
SIMULATOR = {"height": 32, "width": 32, "modes": 10, "components": 3, "read_noise": [0.0, 0.0]}


def make(kind, d_over_r0=(3.0, 3.0), **more):
    torch.manual_seed(0)
    task = kind(net=NET, simulator={**SIMULATOR, "d_over_r0": list(d_over_r0)}, **more)
    task.report = lambda *values: None  # there is no trainer to log to
    return task


@pytest.mark.parametrize("weight", [0.0, 0.02])
def test_tilt_removal_learns_one_clip_by_heart(batch, weight, learn):
    """Two fifths and more of what true tilts would take off the loss go."""
    task = make(TiltRemoval, tilt_weight=weight)
    losses = learn(task, batch, 120, 5e-3)
    pair = task.pair(batch)
    true = [F.avg_pool2d(pair.tilt[0], scale)[None] for scale in SCALES]
    floor = float(registration_loss(pair.frames, pair.blur_only, true)) + weight * 0.1  # the epsilon of tilts
    assert losses[-1] - floor < 0.6 * (losses[0] - floor)


def test_restoration_learns_one_clip_by_heart(batch, learn):
    """The gate's loss, an entropy, has a floor that nobody knows: it is left out."""
    losses = learn(make(Restoration, gate_weight=0.0), batch, 100, 2e-3)
    floor = 1e-3 + 0.01 * 0.1 + 0.4 * 1e-3
    assert losses[-1] - floor < 0.5 * (losses[0] - floor)


def test_a_plain_unet_learns_one_clip_by_heart(batch, learn):
    net = {"name": "unet", "widths": [8, 12, 16], "depths": [1, 1, 1]}
    task = Restoration(net=net, simulator={**SIMULATOR, "d_over_r0": [3.0, 3.0]})
    task.report = lambda *values: None
    losses = learn(task, batch, 100, 2e-3)
    assert losses[-1] < 0.6 * losses[0]
    with pytest.raises(InputError, match="trains a Restorer; the network 'unet' is none"):
        TiltRemoval(net=net, simulator=SIMULATOR)


@pytest.mark.parametrize("maps", [None, {"widths": [4, 6, 8], "depths": [1, 1, 1], "dropout": 0.1}])
def test_a_still_restorer_learns_one_frame_by_heart_and_how_far_off_it_is(batch, maps, learn):
    net = {"name": "still", "widths": [8, 12, 16], "depths": [1, 1, 1], "maps": maps}
    task = Restoration(net=net, simulator={**SIMULATOR, "d_over_r0": [3.0, 3.0]})
    task.report = lambda *values: None
    frame = {**batch, "scene": batch["scene"][:, :1]}
    losses = learn(task, frame, 100, 2e-3)
    assert losses[-1] < 0.6 * losses[0]
    if maps:
        found, pair = task.net.stages(task.pair(frame).frames).uncertainty, task.pair(frame)
        blur, tilt = (float(x.abs().mean()) for x in (pair.target - pair.blur_only, pair.blur_only - pair.frames))
        expected = found.maps.detach().mean((0, 1, 3, 4))
        # It started at e^-3.5 for both; what it says now is of the order of what tilt and blur did to the frame.
        assert 0.2 < float(expected[0] / tilt) < 2
        assert 0.2 < float(expected[1] / blur) < 2


@pytest.mark.parametrize("kind", [TiltRemoval, Restoration])
@pytest.mark.parametrize("strength", [0.0, 10.0])
def test_gradients_are_finite(kind, strength, batch):
    task = make(kind, (strength, strength))
    loss = task.training_step(batch, 0)
    loss.backward()
    assert torch.isfinite(loss)
    for name, parameter in task.net.named_parameters():
        assert parameter.grad is None or torch.isfinite(parameter.grad).all(), name


@pytest.mark.parametrize(
    ("task", "learns"),
    [
        (make(TiltRemoval), {"tilt"}),
        (make(Restoration), {"tilt", "tcja", "fusion", "scene", "own"}),
        (make(Restoration, freeze=["tilt"]), {"tcja", "fusion", "scene", "own"}),
    ],
)
def test_what_a_task_learns(task, learns, batch):
    task.training_step(batch, 0).backward()
    with_gradient = {name.split(".")[0] for name, p in task.net.named_parameters() if p.grad is not None}
    assert with_gradient == learns
    assert {name.split(".")[0] for name, p in task.net.named_parameters() if p.requires_grad} == learns
    assert len(list(task.trained())) == sum(p.requires_grad for p in task.net.parameters())


def test_frozen_tilts_have_no_weight_in_the_loss(batch):
    task = make(Restoration, freeze=["tilt"], own_weight=0.0, scene_weight=0.0, gate_weight=0.0)
    pair = task.pair(batch).settled()
    restored = task.net(pair.frames)
    expected = charbonnier(restored, pair.target) + 0.1 * frequency_loss(restored, pair.target)
    assert task.training_step(batch, 0) == expected


def test_a_scene_that_the_gate_shuts_out_goes_on_learning(batch, learn):
    task = make(Restoration, gate_weight=0.0)
    with torch.no_grad():
        task.net.own.head.bias[-4:] = 40.0  # the gate, for each of 2 x 2 pixels: all frames are themselves
    pair = task.pair(batch).settled()

    def off():
        with torch.no_grad():
            stages = task.net.stages(pair.frames)
        torch.testing.assert_close(stages.frames, stages.own, rtol=0, atol=1e-6)
        return charbonnier(stages.scene, pair.target)

    before = off()
    learn(task, batch, 60, 2e-3)
    assert off() < 0.9 * before


@torch.no_grad()
def test_from_how_many_frames_a_clip_is_restored_in_its_mean_geometry(batch):
    scored = {}
    frames = batch["scene"].shape[1]
    for settled in (frames, frames + 1):
        weights = dict.fromkeys(("frequency_weight", "own_weight", "scene_weight", "gate_weight"), 0.0)
        task = make(Restoration, settled=settled, freeze=["tilt"], moving_weight=1.0, **weights)
        scored[settled] = task.training_step(batch, 0)
    pair, restored = task.pair(batch), task.net(task.pair(batch).frames)
    assert scored[frames] == charbonnier(restored, pair.settled().target)
    assert scored[frames + 1] == charbonnier(restored, pair.target)


@pytest.mark.parametrize("kind", [TiltRemoval, Restoration])
def test_validation_scores_the_input_too(kind, batch):
    task, seen = make(kind), {}
    task.report = lambda stage, values, clips: seen.update(stage=stage, clips=clips, **values)
    task.validation_step(batch, 0)
    assert seen["stage"] == "val"
    assert seen["clips"] == 1
    assert seen["psnr"] > seen["psnr_input"]  # an untrained net already registers


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ({"learning_rate": -1.0}, "learning_rate"),
        ({"weight_decay": -1.0}, "weight_decay"),
        ({"warmup": 2.0}, "warmup"),
    ],
)
def test_out_of_range(more, says):
    with pytest.raises(ParameterError, match=says):
        make(TiltRemoval, **more)


def test_freezing_what_is_no_part():
    with pytest.raises(InputError, match="no part 'tails', but tilt, tcja, fusion, deconvolution, scene, own"):
        make(Restoration, freeze=["tails"])


def test_settled_from_no_frames():
    with pytest.raises(ParameterError, match="settled"):
        make(Restoration, settled=0)


def test_clips_that_the_network_cannot_take():
    with pytest.raises(InputError, match="width of the clips = 36 must be a multiple of 8"):
        TiltRemoval(net=NET, simulator={**SIMULATOR, "width": 36})


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_step_with_a_gradient_that_is_not_finite_is_skipped_and_said(batch, bad):
    task, logged = make(Restoration), {}
    task.log = logged.__setitem__
    optimiser = torch.optim.AdamW(list(task.trained()), lr=1e-2)
    task.training_step(batch, 0).backward()
    before = {name: p.detach().clone() for name, p in task.net.named_parameters()}
    next(iter(task.trained())).grad.view(-1)[0] = bad
    with pytest.warns(UserWarning, match="step 0: gradient not finite, step skipped"):
        task.on_before_optimizer_step(optimiser)
    optimiser.step()
    assert all(torch.equal(before[name], p) for name, p in task.net.named_parameters())
    assert logged == {"train/skipped": 1.0}
    # The next, sound step is taken.
    task.training_step(batch, 0).backward()
    task.on_before_optimizer_step(optimiser)
    optimiser.step()
    assert not all(torch.equal(before[name], p) for name, p in task.net.named_parameters())
    assert logged == {"train/skipped": 1.0}
