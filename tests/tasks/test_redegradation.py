"""Re-degradation with and without ground truth, in seconds."""

import numpy as np
import pytest
import skimage.data
import torch
from omegaconf import OmegaConf

from turbnet.classical.methods import METHODS
from turbnet.data.footage import Footage, footage_paths
from turbnet.data.pairs import Pair, PairMaker
from turbnet.data.unlabelled import Fused, Whole, kept_whole, whole_clip
from turbnet.deploy.checkpoint import load_network
from turbnet.errors import InputError
from turbnet.media.clip import write_clip
from turbnet.media.colour import to_linear, to_srgb
from turbnet.nets.restorer import Restorer
from turbnet.nets.still import StillRestorer
from turbnet.tasks.checkpoint import load_net, read_checkpoint
from turbnet.tasks.finetune import Finetuning
from turbnet.tasks.fit import fit
from turbnet.tasks.redegradation import Redegradation

RESTORER = {"name": "still", "widths": [8, 12, 16], "depths": [1, 1, 1]}
SIMULATOR = {"height": 32, "width": 32, "modes": 10, "components": 3, "read_noise": [0.0, 0.0], "d_over_r0": [3.0, 3.0]}


CLIP_RESTORER = {
    "name": "restorer",
    "tilt": {"widths": [4, 4, 4]},
    "tcja": {"width": 8, "depth": 1},
    "scene": {"widths": [8, 12, 16], "depths": [1, 1, 1]},
}


def make(kind, form="linear", restorer=RESTORER, **more):
    torch.manual_seed(0)
    net = {"name": "redegrading", "form": form, "restorer": restorer, "code": {"width": 8, "depth": 1}}
    if form == "physical":
        net["degradation"] = {"modes": 10, "components": 3}
    task = kind(net=net, simulator=SIMULATOR, **more)
    task.report = lambda stage, values, clips: task.__dict__.setdefault("seen", []).append(values)
    return task


def untold(task, batch):
    """The pair of a batch as a clip without truth, its fused picture perfect, beside the batch itself."""
    pair = task.pair(batch)
    clip = {"scene": pair.frames, "fused": pair.target[:, 0], "seed": batch["seed"], "hardness": batch["hardness"]}
    return {"clips": clip, "scenes": batch}


@pytest.mark.parametrize("form", ["linear", "physical"])
def test_it_learns_one_clip_by_heart(form, batch, learn):
    task = make(Redegradation, form)
    losses = learn(task, batch, 60, 2e-3)
    assert losses[-1] < losses[0]
    first, last = task.seen[0], task.seen[-1]
    for name in ("charbonnier", "true_redegraded"):
        assert last[name] < 0.9 * first[name], name


@pytest.mark.parametrize("form", ["linear", "physical"])
def test_without_truth_it_learns_to_give_what_was_seen(form, batch, learn):
    """A few steps on one clip: what was restored explains it better, by a likelier blur, and agrees more; the old stays."""
    task = make(Finetuning, form)
    learn(task, untold(task, batch), 40, 2e-3)
    first, last = task.seen[0], task.seen[-1]
    for name in ("unsupervised", "agree", "old_charbonnier"):
        assert last[name] < first[name], name
    assert last["prior"] <= first["prior"] + 0.01  # of a linear form it starts at zero


@pytest.mark.parametrize("kind", [Redegradation, Finetuning])
def test_the_still_scene_of_a_restorer_of_clips_has_a_loss_of_its_own(kind, batch):
    """The gate prefers the frames everywhere: without that loss the scene would not learn."""
    moves = {}
    for weight in (0.0, 0.6):
        task = make(kind, restorer=CLIP_RESTORER, scene_weight=weight)
        restorer = task.net.restorer
        with torch.no_grad():
            restorer.own.head.bias[-4:] = 40.0
        task.training_step(untold(task, batch) if kind is Finetuning else batch, 0).backward()
        moves[weight] = sum(float(p.grad.abs().max()) for p in restorer.scene.parameters() if p.grad is not None)
    assert moves[0.0] < 1e-6 < 1e-3 < moves[0.6]


def test_frames_of_a_still_scene_come_to_agree(batch, learn):
    """Of what each has of its own, noise and dance, 3 % is left, and 24 % where only the fused picture makes them agree."""
    task = make(Finetuning, restorer=CLIP_RESTORER)
    both = untold(task, batch)
    spread = []
    for steps in (0, 40):
        learn(task, both, steps, 2e-3)
        spread.append(float(task.net(both["clips"]["scene"]).detach().std(1).mean()))
    assert spread[1] < 0.1 * spread[0]


def test_values_and_networks_that_do_not_fit(batch):
    with pytest.raises(InputError, match="trains a Redegrading"):
        Redegradation(net=RESTORER, simulator=SIMULATOR)
    with pytest.raises(InputError, match="no checkpoint"):
        make(Redegradation, start_from="nowhere.ckpt")


@pytest.fixture(scope="module")
def clips(tmp_path_factory):
    """A folder with two short clips of still scenes."""
    folder = tmp_path_factory.mktemp("clips")
    maker = PairMaker(48, 48, d_over_r0=(4.0, 4.0), modes=10, components=3)
    for number, top in enumerate((40, 200)):
        picture = torch.from_numpy(skimage.data.astronaut()[top : top + 48, 100:148].copy()).float().permute(2, 0, 1)
        frames = maker(picture.expand(1, 6, 3, 48, 48) / 255, [number]).frames[0]
        write_clip(folder / f"{number}.mkv", frames.permute(0, 2, 3, 1).numpy())
    return folder


STILL = ("net=redegrading", "net.form=linear", "net.restorer.widths=[4,4,4]", "net.restorer.depths=[1,1,1]")
CLIP = (
    "net=redegrading_clip",
    "net.form=linear",
    "net.restorer.tilt.widths=[4,4,4]",
    "net.restorer.tcja={width: 8, depth: 1}",
    "net.restorer.scene={widths: [4,4,4], depths: [1,1,1]}",
)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """fit(overrides...) of seconds; returns the folder."""
    from hydra import compose, initialize_config_module

    def go(name, *overrides):
        folder = tmp_path_factory.mktemp(name)
        small = ["threads=1", "callbacks=quiet", "data.size=32", "data.batch_size=2", "data.steps_per_epoch=2"]
        small += ["data.val_clips=2", "trainer.max_epochs=2", "simulator.modes=10", "simulator.components=3"]
        with initialize_config_module("turbnet.configs", version_base="1.3"):
            fit(compose("train", overrides=[*small, f"output={folder}", *overrides]))
        return folder

    return go


@pytest.mark.parametrize(("net", "name", "kind"), [(STILL, "still", StillRestorer), (CLIP, "restorer", Restorer)])
def test_pre_training_then_fine_tuning_as_a_user_does(run, clips, net, name, kind):
    first = run("first", *net, "task=redegradation", "data.frames=3")
    start = first / "checkpoints/last.ckpt"
    more = (*net, "task=finetune", "data=clips", f"data.clips=[{clips}]", "data.clip_frames=3", "data.frames=3")
    tuned = run("tuned", *more, f"task.start_from={start}")
    before, after = (read_checkpoint(run / "checkpoints/last.ckpt")["state_dict"] for run in (first, tuned))
    assert before.keys() == after.keys()
    assert any(not torch.equal(before[part], after[part]) for part in before)
    assert OmegaConf.load(tuned / "config.yaml").task.rehearsal_weight == 1.0
    restorer, hyper = load_network(tuned / "checkpoints/last.ckpt")
    assert isinstance(restorer, kind)  # to run and to export
    assert hyper["net"]["name"] == name
    again = run("again", *more, f"task.start_from={start}", "callbacks.checkpoint.save_top_k=-1")
    resumed = run("resumed", *more, f"task.start_from={start}", f"resume={again}/checkpoints/epoch0000.ckpt")
    for other in (again, resumed):
        same = read_checkpoint(other / "checkpoints/last.ckpt")["state_dict"]
        assert all(torch.equal(after[part], same[part]) for part in after)


def test_a_restorer_alone_can_be_started_from(tmp_path):
    state = {
        f"net.{name}": torch.full_like(x, 0.5) for name, x in make(Redegradation).net.restorer.state_dict().items()
    }
    torch.save({"hyper_parameters": {"net": RESTORER}, "state_dict": state}, tmp_path / "restorer.ckpt")
    task = make(Redegradation, start_from=str(tmp_path / "restorer.ckpt"))
    assert all((x == 0.5).all() for x in task.net.restorer.state_dict().values())


def test_a_released_restorer_of_any_size_can_be_started_from():
    from hydra import compose, initialize_config_module

    with initialize_config_module("turbnet.configs", version_base="1.3"):
        config = compose("train", overrides=["net=redegrading_clip", "net@net.restorer=s", "task=redegradation"])
    net = OmegaConf.to_container(config.net)
    task = Redegradation(net=net, simulator=SIMULATOR, start_from="s")
    released = load_net("s", net["restorer"])
    assert all(torch.equal(x, released[name]) for name, x in task.net.restorer.state_dict().items())


def test_every_cut_comes_with_its_place_in_the_fused_picture(tmp_path):
    """Where nothing dances, the fused picture of a cut is the part of it that the cut shows."""
    picture = skimage.data.astronaut()[40:104, 100:164].astype(np.float32) / 255
    write_clip(tmp_path / "still.mkv", np.broadcast_to(picture, (5, 64, 64, 3)))
    paths = footage_paths([tmp_path])
    data = Fused(Footage(paths, 3, 32, 40, seed=3), {path: whole_clip(path, METHODS["mean"]) for path in paths})
    for index in range(6):
        cut = data[index]
        torch.testing.assert_close(cut["fused"], cut["scene"][0], atol=1e-5, rtol=0)


def test_the_fused_picture_is_where_the_cut_shows_it():
    """Of 4 frames of 40 at D/r0 = 4: the true picture in the geometry of all of them, moved into that of the four.

    Mean tilts of the two differ by sqrt(1/4 - 1/40) = 0.47 of a frame's, 1.3 pixels RMS. The picture moved has a fifth of
    the error or less; the bound is a quarter.
    """
    maker = PairMaker(96, 96, d_over_r0=(4.0, 4.0), modes=15, components=4, independent=1.0)
    picture = torch.from_numpy(skimage.data.astronaut()[20:116, 180:276].copy()).float().permute(2, 0, 1) / 255
    pair = maker(picture.expand(1, 40, 3, 96, 96), [5])
    frames, still = pair.frames[0].permute(0, 2, 3, 1).numpy(), pair.settled().target[0, 0].permute(1, 2, 0).numpy()
    whole = Whole(to_linear(frames).mean(0), still)
    inside = np.s_[8:-8, 8:-8]
    for first in (0, 20):
        few = Pair(*(part[:, first : first + 4] for part in vars(pair).values()))
        truth = few.settled().target[0, 0].permute(1, 2, 0).numpy()
        moved = whole.seen_by(frames[first : first + 4])
        errors = [((x - truth)[inside] ** 2).mean() for x in (moved, still)]
        assert errors[0] < 0.25 * errors[1]


def test_a_fused_picture_is_nearer_the_truth_than_a_frame(tmp_path):
    maker = PairMaker(64, 64, d_over_r0=(3.0, 3.0), modes=15, components=4, independent=1.0)
    picture = torch.from_numpy(skimage.data.astronaut()[20:84, 180:244].copy()).float().permute(2, 0, 1) / 255
    pair = maker(picture.expand(1, 10, 3, 64, 64), [5])
    write_clip(tmp_path / "clip.mkv", pair.frames[0].permute(0, 2, 3, 1).numpy())
    still = whole_clip(tmp_path / "clip.mkv", METHODS["pipeline"]).fused
    truth, frames = pair.target[0, 0].permute(1, 2, 0).numpy(), pair.frames[0].permute(0, 2, 3, 1).numpy()
    inside = np.s_[..., 8:-8, 8:-8, :]
    errors = [((x - truth)[inside] ** 2).mean() for x in (still, frames)]
    assert errors[0] < 0.4 * errors[1]


def test_of_a_long_clip_some_frames_are_fused(tmp_path):
    """All of it, equally spaced: the mean of a ramp is its middle."""
    ramp = np.linspace(0, 1, 120, dtype=np.float32)[:, None, None, None] * np.ones((1, 16, 16, 3), np.float32)
    write_clip(tmp_path / "ramp.mkv", ramp)
    expected = to_srgb(torch.from_numpy(to_linear(ramp[:, 0, 0, 0])).mean())
    whole = whole_clip(tmp_path / "ramp.mkv", METHODS["mean"])
    assert abs(float(whole.fused.mean()) - float(expected)) < 0.01
    assert abs(float(whole.mean.mean()) - float(to_linear(ramp[:, 0, 0, 0]).mean())) < 0.01


def test_the_picture_of_a_whole_clip_is_made_once(tmp_path, capsys):
    """Of the same clip by the same method, wherever it lies; a damaged one is said to be."""
    kept, picture = tmp_path / "kept", skimage.data.astronaut()[40:72, 100:140].astype(np.float32) / 255
    folders = [tmp_path / name for name in ("first", "second", "darker")]
    for folder, level in zip(folders, (1, 1, 0.5), strict=True):
        write_clip(folder, np.broadcast_to(level * picture, (3, 32, 40, 3)))
    wholes = [kept_whole(kept, folder, "mean") for folder in folders]
    assert capsys.readouterr().out == "fusing the frames of first\nfusing the frames of darker\n"
    for found, made in zip(wholes, (whole_clip(folder, METHODS["mean"]) for folder in folders), strict=True):
        assert all(np.array_equal(*parts) for parts in zip(found, made, strict=True))
    kept_whole(kept, folders[0], "optical-flow")
    files = list(kept.iterdir())
    assert len(files) == 3
    for file in files:
        file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(InputError, match="cannot read .*npy"):
        kept_whole(kept, folders[0], "mean")


def test_clips_that_cannot_be_used(run, clips, tmp_path):
    more = (*STILL, "task=finetune", "data=clips", "task.start_from=null")
    with pytest.raises(Exception, match="too few"):
        run("long", *more, f"data.clips=[{clips}]", "data.clip_frames=40")
    with pytest.raises(Exception, match="no clips"):
        run("none", *more, f"data.clips=[{tmp_path}]")
    with pytest.raises(Exception, match="there is no method guess"):
        run("guess", *more, f"data.clips=[{clips}]", "data.fuse=guess", "data.clip_frames=3")
