import logging
import os
import signal

import pytest
import torch
from omegaconf import OmegaConf

from turbnet.errors import InputError
from turbnet.tasks.checkpoint import load_net, read_checkpoint
from turbnet.tasks.fit import _check_precision, check_targets, fit
from turbnet.tasks.interruption import Interruption
from turbnet.tasks.tilt import TiltRemoval


def plain(value) -> bool:
    if isinstance(value, dict):
        return all(isinstance(key, str) and plain(item) for key, item in value.items())
    if isinstance(value, list):
        return all(map(plain, value))
    return value is None or isinstance(value, str | int | float | bool)


def same(first: dict, second: dict) -> bool:
    return first.keys() == second.keys() and all(torch.equal(first[key], second[key]) for key in first)


def test_a_run_leaves_what_it_says(stage_one, curve):
    checkpoints = {path.name for path in (stage_one / "checkpoints").iterdir()}
    assert "last.ckpt" in checkpoints
    assert len(checkpoints) == 2  # and the best
    assert not any("=" in name for name in checkpoints)  # an override could not name it
    assert list((stage_one / "tensorboard/version_0").glob("events.*"))
    assert OmegaConf.load(stage_one / "config.yaml").data.size == 32
    rows = curve(stage_one)
    assert sum(bool(row["train/loss"]) for row in rows) == 4
    assert sum(bool(row["val/psnr"]) for row in rows) == 2


class _Pressed(Interruption):
    """Ctrl-C in the middle of the third step."""

    finished = 0

    def on_before_backward(self, trainer, module, loss):
        if trainer.global_step == 2:
            os.kill(os.getpid(), signal.SIGINT)

    def on_train_batch_end(self, *arguments):
        type(self).finished += 1
        super().on_train_batch_end(*arguments)


def test_ctrl_c_ends_training_after_the_step_at_hand(tiny, tmp_path, monkeypatch):
    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr("turbnet.tasks.fit.Interruption", _Pressed)
    with pytest.raises(SystemExit):  # lightning makes one of it
        fit(tiny(tmp_path / "run", "trainer.max_epochs=50"))
    assert _Pressed.finished == 3
    assert signal.getsignal(signal.SIGINT) == before


@pytest.mark.parametrize(
    ("machine", "known", "tiles", "precision"),
    [
        ("x86_64", True, True, "bf16-mixed"),
        ("x86_64", True, False, "32-true"),
        ("x86_64", False, False, "32-true"),
        ("aarch64", True, False, "bf16-mixed"),
        ("aarch64", False, False, "32-true"),
    ],
)
def test_bfloat16_is_for_processors_where_it_pays(monkeypatch, capsys, machine, known, tiles, precision):
    monkeypatch.setattr("platform.machine", lambda: machine)
    monkeypatch.setattr(torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: known)
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: tiles)
    trainer = {"accelerator": "cpu", "precision": "bf16-mixed"}
    _check_precision(trainer)
    assert trainer["precision"] == precision
    assert ("bfloat16" in capsys.readouterr().out) == (precision == "32-true")


def test_a_checkpoint_holds_tensors_and_plain_values(stage_one):
    checkpoint = torch.load(stage_one / "checkpoints/last.ckpt", weights_only=True)
    assert plain(checkpoint["hyper_parameters"])
    assert checkpoint["hyper_parameters"]["net"]["tilt"] == {"widths": [4, 4, 4]}
    assert checkpoint["hyper_parameters"]["seed"] == 0
    assert checkpoint["global_step"] == 4


def test_tilt_removal_leaves_the_transformer_alone(stage_one, tiny, weights):
    from hydra.utils import instantiate

    torch.manual_seed(0)
    before = instantiate(tiny(stage_one, "task=tilt").task, _convert_="all").net.state_dict()
    after = weights(stage_one / "checkpoints/last.ckpt")
    tcja = [name for name in after if name.startswith("tcja.")]
    tilt = [name for name in after if name.startswith("tilt.")]
    assert all(torch.equal(before[name], after[name]) for name in tcja)
    assert not any(torch.equal(before[name], after[name]) for name in tilt)


@pytest.mark.parametrize("task", ["restoration", "tilt"])
def test_a_resumed_run_is_bitwise_the_uninterrupted_one(train, tmp_path, weights, curve, task):
    more = (f"task={task}", "trainer.max_epochs=4", "data.moving=0.5", "callbacks.checkpoint.save_top_k=-1")
    whole = train(tmp_path / "whole", *more)
    torch.manual_seed(1)  # whatever the state of the process
    resumed = train(tmp_path / "resumed", *more, f"resume={whole}/checkpoints/epoch0001.ckpt")
    final, again = (folder / "checkpoints/last.ckpt" for folder in (whole, resumed))
    assert torch.load(again, weights_only=True)["global_step"] == 8
    assert same(weights(final), weights(again))
    assert not same(weights(final), weights(whole / "checkpoints/epoch0001.ckpt"))
    rows = [row for row in curve(whole) if int(row["epoch"] or -1) >= 2]
    assert len(rows) >= 6
    assert rows == [row for row in curve(resumed) if int(row["epoch"] or -1) >= 2]


def test_epochs_that_nobody_validates_leave_their_weights_too(train, tmp_path, weights):
    more = ("trainer.max_epochs=3", "trainer.check_val_every_n_epoch=2", "+callbacks.last.save_top_k=-1")
    more += ("callbacks.last.filename='each{epoch}'", "+callbacks.last.auto_insert_metric_name=false")
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    train(whole, *more)
    train(resumed, *more, f"resume={whole}/checkpoints/each0.ckpt")
    kept = sorted(path.name for path in (whole / "checkpoints").iterdir())
    assert kept == ["each0.ckpt", "each1.ckpt", "each2.ckpt", "epoch0001.ckpt"]
    assert torch.load(whole / "checkpoints/each2.ckpt", weights_only=True)["global_step"] == 6
    for name in kept[1:]:
        assert same(weights(whole / "checkpoints" / name), weights(resumed / "checkpoints" / name))


def test_resuming_into_the_same_folder_keeps_the_first_curve(train, tmp_path, curve):
    run = train(tmp_path / "run", "trainer.max_epochs=1")
    before = curve(run)
    train(run, "trainer.max_epochs=2", f"resume={run}/checkpoints/last.ckpt")
    assert curve(run) == before
    assert (run / "csv/version_1/metrics.csv").is_file()


@pytest.mark.parametrize("workers", [0, 1])
def test_every_epoch_trains_on_fresh_clips(train, tmp_path, monkeypatch, workers):
    seen = []

    class Noted(TiltRemoval):
        def training_step(self, batch, index):
            seen.extend(batch["seed"].tolist())
            return super().training_step(batch, index)

    Noted.__module__ = TiltRemoval.__module__  # only classes of the package may be named
    monkeypatch.setattr("turbnet.tasks.tilt.TiltRemoval", Noted)
    train(tmp_path, "task=tilt", "trainer.max_epochs=3", f"data.workers={workers}")
    assert len(seen) == len(set(seen)) == 12


def test_the_seed_decides_the_run(train, tmp_path, stage_one, weights):
    torch.manual_seed(5)
    again, other = train(tmp_path / "a", "task=tilt"), train(tmp_path / "b", "task=tilt", "seed=1")
    first = weights(stage_one / "checkpoints/last.ckpt")
    assert same(first, weights(again / "checkpoints/last.ckpt"))
    assert not same(first, weights(other / "checkpoints/last.ckpt"))


@pytest.mark.parametrize("drawn", [False, True])
def test_where_turbulence_is_made_does_not_matter(train, tmp_path, stage_one, weights, drawn):
    elsewhere = ("data.workers=1", "data.simulator=${simulator}", f"data.drawn={drawn}")
    run = train(tmp_path, "task=tilt", *elsewhere)
    assert same(weights(stage_one / "checkpoints/last.ckpt"), weights(run / "checkpoints/last.ckpt"))


def test_second_stage_starts_from_the_first_and_may_freeze_it(train, tmp_path, stage_one, weights):
    start = stage_one / "checkpoints/last.ckpt"
    second = train(tmp_path, f"task.start_from={start}", "task.freeze=[tilt]", "task.weight_decay=0.1")
    before, after = weights(start), weights(second / "checkpoints/last.ckpt")
    for name in before:
        assert torch.equal(before[name], after[name]) == name.startswith("tilt."), name


def test_start_from_refuses_another_network(tiny, tmp_path, stage_one):
    start = stage_one / "checkpoints/last.ckpt"
    with pytest.raises(Exception, match="holds another network") as caught:
        fit(tiny(tmp_path / "out", f"task.start_from={start}", "net.tcja.width=16"))
    assert isinstance(caught.value.__cause__, InputError)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["task=tilt", "net.tcja.width=16"], "holds another network"),
        (["task=restoration"], "other parts of the network"),
    ],
)
def test_resume_refuses_what_it_cannot_go_on_from(tiny, tmp_path, stage_one, more, says):
    with pytest.raises(InputError, match=says):
        fit(tiny(tmp_path / "out", f"resume={stage_one}/checkpoints/last.ckpt", *more))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "content", [b"", b"no checkpoint", b"PK\3\4 no archive", b"seed: 0\nthreads: 1\n", b"\x80\x02s"]
)
def test_a_file_that_is_no_checkpoint(tmp_path, content):
    path = tmp_path / "a.ckpt"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.ckpt"):
        read_checkpoint(path)


def test_a_cut_checkpoint(tmp_path, stage_one):
    whole = (stage_one / "checkpoints/last.ckpt").read_bytes()
    path = tmp_path / "cut.ckpt"
    for part in (0.1, 0.5, 0.99):
        path.write_bytes(whole[: int(part * len(whole))])
        with pytest.raises(InputError, match=r"cut\.ckpt"):
            read_checkpoint(path)


class Runs:
    """Code that a pickle would run."""

    def __reduce__(self):
        return print, ("executed",)


@pytest.mark.parametrize("content", [Runs(), {"hyper_parameters": Runs()}, {"state_dict": {}}, [1], 3])
def test_what_is_not_ours_is_refused_and_never_executed(tmp_path, capsys, content):
    torch.save(content, tmp_path / "a.ckpt")
    with pytest.raises(InputError, match=r"a\.ckpt"):
        read_checkpoint(tmp_path / "a.ckpt")
    assert capsys.readouterr().out == ""


def test_load_net(stage_one, weights):
    path = stage_one / "checkpoints/last.ckpt"
    assert same(load_net(path), weights(path))
    with pytest.raises(InputError, match="there is no checkpoint"):
        load_net(path.with_name("absent.ckpt"))


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "builtins.eval",
        "turbnet",
        "turbnetx.tasks.Task",
        "lightning.fabric.Fabric",
        "lightning.pytorchx.Trainer",
        "turbnet.tasks.fit.instantiate",
        "turbnet.tasks.checkpoint.torch.load",
        "turbnet.media.atomic.os.system",
        "turbnet.tasks.checkpoint.Path",
        "turbnet.no.such.thing",
        "lightning.pytorch.trainer.trainer.os.system",
        3,
        ["os.system"],
    ],
)
@pytest.mark.parametrize("where", ["plain", "nested", "list"])
def test_targets_outside_the_packages_are_refused(target, where):
    bad = {"_target_": target}
    config = {
        "plain": {"task": bad},
        "nested": {"task": {"_target_": "turbnet.tasks.tilt.TiltRemoval", "net": {"tilt": bad}}},
        "list": {"trainer": {"callbacks": [{"a": 1}, [bad]]}},
    }[where]
    with pytest.raises(InputError, match="may only name classes"):
        check_targets(config)


def test_our_own_targets_pass():
    check_targets(
        {
            "task": {"_target_": "turbnet.tasks.tilt.TiltRemoval"},
            "callbacks": [{"_target_": "lightning.pytorch.callbacks.ModelCheckpoint"}],
            "trainer": {"_target_": "lightning.pytorch.Trainer", "strategy": None},
        }
    )


def test_a_forbidden_target_stops_a_run(tiny, tmp_path):
    with pytest.raises(InputError, match=r"config\.callbacks\.progress\._target_"):
        fit(tiny(tmp_path / "out", "+callbacks.progress={_target_: os.getcwd}"))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("seed=-1", "seed = -1"),
        ("seed=x", "seed = 'x'"),
        ("seed=null", "seed = None"),
        ("threads=0", "threads = 0"),
        ("trainer.max_epochs=many", "trainer.max_epochs = 'many'"),
        ("trainer.max_steps=1.5", "trainer.max_steps = 1.5"),
    ],
)
def test_numbers_that_cannot_be_used(tiny, tmp_path, override, says):
    with pytest.raises(InputError, match=says):
        fit(tiny(tmp_path / "out", override))


def test_lightning_notices_are_silent(stage_one):
    """Warnings remain."""
    for name in ("lightning.pytorch.utilities.rank_zero", "lightning.fabric.utilities.distributed"):
        assert logging.getLogger(name).getEffectiveLevel() == logging.WARNING
