"""`turbnet train` as a user runs it, from a folder of their own."""

import csv
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

import turbnet.cli

SECONDS = [
    "experiment=tiny",
    "callbacks=quiet",
    "threads=1",
    "data.size=32",
    "data.frames=2",
    "data.batch_size=2",
    "data.steps_per_epoch=2",
    "data.val_clips=2",
    "trainer.max_epochs=1",
    "trainer.log_every_n_steps=1",
    "net.tilt.widths=[4,4,4]",
    "net.tcja.width=8",
    "net.tcja.depth=1",
    "net.scene.widths=[4,4,4]",
    "simulator.modes=10",
    "simulator.components=2",
]


@pytest.fixture
def command(capfd, monkeypatch, tmp_path):
    """Runs turbnet train, in this process, in an empty folder: command(*arguments) gives (code, stdout, stderr)."""

    def run(*arguments):
        monkeypatch.chdir(tmp_path)
        capfd.readouterr()
        code = turbnet.cli.run(["train", *map(str, arguments)])
        return code, *capfd.readouterr()

    return run


def in_a_process_of_its_own(*arguments, cwd):
    whole = [sys.executable, "-m", "turbnet", "train", *map(str, arguments)]
    done = subprocess.run(whole, capture_output=True, text=True, check=False, cwd=cwd, timeout=300)
    return done.returncode, done.stdout, done.stderr


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """A finished run: its folder and what the command said."""
    folder = tmp_path_factory.mktemp("first")
    code, out, err = in_a_process_of_its_own(*SECONDS, "callbacks=default", cwd=folder)
    assert code == 0, err
    (run,) = (folder / "outputs" / "train").iterdir()
    return run, out, err


def rows(run):
    with (run / "csv" / "version_0" / "metrics.csv").open() as file:
        # Times are never the same twice.
        return [{k: v for k, v in row.items() if not k.startswith("speed/")} for row in csv.DictReader(file)]


def weights(run):
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def refused(done, *words):
    """The command said why it cannot, in one line."""
    code, out, err = done
    assert code == 2, err
    assert out == ""
    assert err.count("\n") == 1, err
    assert err.startswith("turbnet train: ")
    assert all(word in err for word in words), err


def test_outputs(first):
    run, *_ = first
    assert {path.name for path in run.iterdir()} >= {"config.yaml", "csv", "tensorboard", "checkpoints"}
    assert {path.name for path in (run / "checkpoints").iterdir()} == {"epoch0000.ckpt", "last.ckpt"}
    assert list((run / "tensorboard/version_0").glob("events.*"))
    config = OmegaConf.load(run / "config.yaml")
    assert config.data.size == 32
    assert config.simulator.height == 32  # resolved
    assert [row["step"] for row in rows(run) if row["train/loss"]] == ["0", "1"]
    assert all(row["val/psnr"] for row in rows(run) if row["val/loss"])


def test_the_console_shows_the_outputs_the_bar_and_no_noise(first):
    run, out, err = first
    assert out.splitlines()[0] == f"outputs: {run}"
    assert "train/loss" in out
    for noise in ("INFO", "Tip", "TPU", "[20", "LeafSpec"):
        assert noise not in out + err


def test_the_configuration_is_shown_and_nothing_done(command, tmp_path):
    code, out, err = command("experiment=tiny", "--cfg", "job")
    assert (code, err) == (0, "")
    assert OmegaConf.create(out).task._target_ == "turbnet.tasks.restoration.Restoration"
    assert not list(tmp_path.iterdir())


def test_help(command):
    code, out, err = command("--help")
    assert (code, err) == (0, "")
    assert out.startswith("turbnet train")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["learning_rate=1"], ["learning_rate"]),
        (["net=huge"], ["net/huge", "tiny"]),
        (["seed=-1"], ["seed = -1"]),
        (["data=folders"], ["data.folders"]),
        (["data.folders=[/no/such/folder]"], ["there is no folder /no/such/folder"]),
        (["data.size=33"], ["must be a multiple of 8"]),
        (["data.size=33", "trainer=ddp_cpu"], ["must be a multiple of 8"]),
        (["resume=absent.ckpt"], ["there is no checkpoint", "absent.ckpt"]),
        (["output=/proc/absent/run"], ["/proc/absent"]),
        (["hydra.run.dir=/proc/absent/run"], ["/proc/absent"]),
        (["task._target_=os.system"], ["os.system", "may only name classes"]),
        (["trainer.precision=7"], ["Precision 7 is invalid"]),
    ],
)
def test_what_cannot_be_used_is_one_line(command, arguments, words):
    refused(command(*SECONDS, *arguments), *words)


def test_resume_from_another_network_and_from_no_checkpoint(command, first):
    run, *_ = first
    refused(command(*SECONDS, "net.tcja.width=16", f"resume={run}/checkpoints/epoch0000.ckpt"), "another network")
    refused(command(*SECONDS, f"resume={run}/config.yaml"), "config.yaml", "not a checkpoint")


def test_resume(command, first):
    run, *_ = first
    code, _, err = command(*SECONDS, "trainer.max_epochs=2", f"resume={run}/checkpoints/last.ckpt", "output=on")
    assert code == 0, err
    steps = {int(row["step"]) for row in rows(Path("on")) if row["train/loss"]}
    assert steps == {2, 3}


def test_several_geometries(command):
    wide = [*SECONDS[1:], "simulator=wide", "simulator.geometries=2", "simulator.modes=10", "simulator.components=2"]
    code, _, err = command(*wide, "output=wide")
    assert code == 0, err
    known = torch.load("wide/checkpoints/last.ckpt", weights_only=True)["hyper_parameters"]["simulator"]
    assert known["geometries"] == 2
    assert known["distance"] == [2000, 6000]
    refused(command(*wide, "simulator.aperture=[0.3,0.1]"), "aperture", "must be a range")
    refused(command(*wide, "simulator.modes=many"), "modes", "whole number")


def test_two_stages(command):
    code, _, err = command("experiment=tiny_tilt", *SECONDS[1:], "output=one")
    assert code == 0, err
    start = "task.start_from=one/checkpoints/last.ckpt"
    code, _, err = command(*SECONDS, start, "task.freeze=[tilt]", "output=two")
    assert code == 0, err
    before, after = weights(Path("one")), weights(Path("two"))
    assert all(torch.equal(before[name], after[name]) == name.startswith("net.tilt.") for name in before)


def test_the_curve_is_the_same_whatever_the_number_of_workers(command, first):
    run, *_ = first
    code, _, err = command(*SECONDS, "callbacks=default", "data.workers=2", "output=again")
    assert code == 0, err
    assert rows(run)
    assert rows(Path("again")) == rows(run)


def test_a_sweep(command, tmp_path):
    code, _, err = command("-m", *SECONDS, "seed=0,1")
    assert code == 0, err
    (sweep,) = (tmp_path / "outputs" / "sweep").iterdir()
    assert [OmegaConf.load(sweep / job / "config.yaml").seed for job in "01"] == [0, 1]
    first, second = (next(row for row in rows(sweep / job) if row["train/loss"]) for job in "01")
    assert first["train/loss"] != second["train/loss"]


@pytest.mark.slow
def test_a_sweep_of_submitit(tmp_path):
    """The jobs of a sweep in processes of their own."""
    pytest.importorskip("submitit", reason="needs turbnet[cluster]")
    launcher = ["hydra/launcher=submitit_local", "hydra.launcher.timeout_min=10"]
    code, _, err = in_a_process_of_its_own("-m", *launcher, *SECONDS, "seed=0,1", cwd=tmp_path)
    assert code == 0, err
    (sweep,) = (tmp_path / "outputs" / "sweep").iterdir()
    assert [OmegaConf.load(sweep / job / "config.yaml").seed for job in "01"] == [0, 1]
    assert all((sweep / job / "checkpoints" / "last.ckpt").is_file() for job in "01")


def test_configs_of_a_user(command, tmp_path):
    (tmp_path / "my_configs" / "experiment").mkdir(parents=True)
    (tmp_path / "my_configs" / "experiment" / "mine.yaml").write_text(
        "# @package _global_\ndefaults:\n  - tiny\n  - override /task: tilt\nseed: 7\n"
    )
    code, out, err = command("--config-dir", "my_configs", "experiment=mine", "--cfg", "job")
    assert code == 0, err
    config = OmegaConf.create(out)
    assert config.seed == 7
    assert config.task._target_ == "turbnet.tasks.tilt.TiltRemoval"
    assert config.data.size == 96  # of tiny


@pytest.mark.parametrize("experiment", ["tiny", pytest.param("tiny_tilt", marks=pytest.mark.slow)])
def test_two_processes_take_the_step_of_one(command, tmp_path, experiment):
    """Each of two processes sees one clip of the batch; averaged gradients are those of the whole batch."""
    common = [*SECONDS[1:], f"experiment={experiment}", "task.learning_rate=1e-4", "trainer.gradient_clip_val=null"]
    code, _, err = command(*common, "data.steps_per_epoch=1", "output=one")
    assert code == 0, err
    code, out, err = in_a_process_of_its_own(
        *common, "trainer=ddp_cpu", "data.batch_size=1", "output=two", cwd=tmp_path
    )
    assert code == 0, err
    assert out.count("outputs: ") == 1
    assert torch.load("two/checkpoints/last.ckpt", weights_only=True)["global_step"] == 1
    one, two = weights(Path("one")), weights(Path("two"))
    for name in one:
        torch.testing.assert_close(
            two[name], one[name], rtol=0, atol=1e-6, msg=lambda text, name=name: f"{name}: {text}"
        )


def interrupt(process: subprocess.Popen[str], patience: float = 10) -> str:
    """What it says on standard error; Ctrl-C again where Python drops one, as it does inside a destructor."""
    for _ in range(6):
        process.send_signal(signal.SIGINT)
        try:
            return process.communicate(timeout=patience)[1]
        except subprocess.TimeoutExpired:
            continue
    raise AssertionError("it goes on")


def test_an_interrupted_run_says_so_and_leaves_a_checkpoint_to_resume_from(tmp_path):
    arguments = [*SECONDS, "trainer.max_epochs=100000", "output=run"]
    whole = [sys.executable, "-m", "turbnet", "train", *arguments]
    with subprocess.Popen(whole, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path) as process:
        try:
            last = tmp_path / "run" / "checkpoints" / "last.ckpt"
            until = time.monotonic() + 120
            while not last.exists() and process.poll() is None and time.monotonic() < until:
                time.sleep(0.2)
            err = interrupt(process)
        finally:
            process.kill()
    assert process.returncode == 130, err
    assert err.endswith("turbnet train: interrupted\n")
    assert weights(tmp_path / "run")
