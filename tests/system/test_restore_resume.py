"""`turbnet restore --resume`: killed at any moment and begun again, the same bytes come out."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from turbnet.deploy.restore import restore_clip
from turbnet.deploy.session import Model
from turbnet.errors import InputError
from turbnet.media.clip import read_clip, write_clip


def clip(path: Path, frames: int = 100, grey: bool = False) -> Path:
    """Pictures that change all the time, coarse enough for a video."""
    coarse = np.random.default_rng(3).random((frames, 6, 8, 1 if grey else 3), np.float32)
    write_clip(path, np.broadcast_to(coarse.repeat(8, 1).repeat(8, 2), (frames, 48, 64, 3)), grey=grey)
    return path


class Killed(BaseException):
    """As SIGKILL would, but within the process."""


def interrupted(model: Model, after: int) -> Model:
    """A model that ends its run at a call."""
    calls = 0

    class Interrupted(Model):
        def __call__(self, frames_BTCHW):
            nonlocal calls
            calls += 1
            if calls > after:
                raise Killed
            return super().__call__(frames_BTCHW)

    model.__class__ = Interrupted
    return model


@pytest.mark.parametrize("passes", [1, 2, 3])
@pytest.mark.parametrize("frames", [5, 24, 25, 61, 100])
def test_wherever_it_ends_it_goes_on_to_the_same_bytes(model, tmp_path, passes, frames):
    source = clip(tmp_path / "in.mkv", frames)
    settings = {"passes": passes, "window": 5}
    restore_clip(source, tmp_path / "whole.mkv", Model.load(model, 1), **settings)
    runs, kept, after = 0, 0, 3
    while True:
        runs += 1
        try:
            again = interrupted(Model.load(model, 1), after)
            done = restore_clip(source, tmp_path / "out.mkv", again, resume=True, **settings)
            break
        except Killed:
            after += 4
            assert not (tmp_path / "out.mkv").exists()
            part = tmp_path / ".out.mkv.part"
            kept = max(kept, len(list(part.glob("0*.mkv"))))
    assert done.frames == frames
    assert done.resumed == kept * 24
    assert runs > 1 or frames <= 24
    assert (tmp_path / "out.mkv").read_bytes() == (tmp_path / "whole.mkv").read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == {"in.mkv", "whole.mkv", "out.mkv"}


@pytest.mark.parametrize("target", ["out.mp4", "out.tif", "out.gif", "frames"])
@pytest.mark.parametrize("grey", [False, True])
def test_every_kind_of_destination(model, tmp_path, target, grey):
    source = clip(tmp_path / "in.mkv", 60, grey)
    whole = tmp_path / f"whole{Path(target).suffix}"
    restore_clip(source, whole, Model.load(model, 1))
    with pytest.raises(Killed):
        restore_clip(source, tmp_path / target, interrupted(Model.load(model, 1), 9), resume=True)
    done = restore_clip(source, tmp_path / target, Model.load(model, 1), resume=True)
    assert done.resumed > 0
    files = (
        [[path.read_bytes() for path in sorted(folder.iterdir())] for folder in (tmp_path / target, whole)]
        if whole.is_dir()
        else [path.read_bytes() for path in (tmp_path / target, whole)]
    )
    assert files[0] == files[1]


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "turbnet", "restore", *map(str, arguments)]


def test_killed_by_the_system_at_several_moments(model, tmp_path):
    source = clip(tmp_path / "in.mkv", 600)
    words = (source, "--model", model, "--window", 5, "--tile", 32, "--threads", 1, "--passes", 2)
    subprocess.run(command(*words, "-o", tmp_path / "whole.mp4", "--quiet"), check=True)
    target, part = tmp_path / "out.mp4", tmp_path / ".out.mp4.part"
    killed = 0
    for wanted in (0, 3, 7, 12):  # chunks
        process = subprocess.Popen(command(*words, "-o", target, "--resume", "--quiet"))
        while process.poll() is None and not (part.is_dir() and len(list(part.glob("0*.mkv"))) >= wanted):
            time.sleep(0.01)
        process.kill()
        killed += process.wait() == -signal.SIGKILL
        assert target.exists() == (process.returncode == 0)
    assert killed >= 3
    report = tmp_path / "report.json"
    done = subprocess.run(
        command(*words, "-o", target, "--resume", "--json", report), capture_output=True, text=True, check=True
    )
    rows = {row["name"]: row["value"] for row in json.loads(report.read_text())["rows"]}
    assert rows["frames restored by an earlier run"] >= 12 * 24
    assert "of them by an earlier run" in done.stdout
    assert target.read_bytes() == (tmp_path / "whole.mp4").read_bytes()
    assert not part.exists()


@pytest.fixture
def broken_off(model, tmp_path) -> Path:
    """A folder in which out.mkv is half restored from in.mkv."""
    source = clip(tmp_path / "in.mkv", 60)
    with pytest.raises(Killed):
        restore_clip(source, tmp_path / "out.mkv", interrupted(Model.load(model, 1), 9), resume=True)
    return tmp_path


def test_other_settings_or_another_source_are_refused(model, broken_off):
    source, target = broken_off / "in.mkv", broken_off / "out.mkv"
    others = ({"passes": 2}, {"views": 2}, {"window": 5}, {"crop": (0, 0, 40, 40)})
    for settings in others:
        (says,) = settings
        with pytest.raises(InputError, match=f"its {says} differs"):
            restore_clip(source, target, Model.load(model, 1), resume=True, **settings)
    os.utime(source, ns=(0, 0))
    with pytest.raises(InputError, match="its source differs"):
        restore_clip(source, target, Model.load(model, 1), resume=True)
    assert (broken_off / ".out.mkv.part").exists()


def test_without_resume_nothing_is_kept_and_nothing_taken(model, broken_off):
    done = restore_clip(broken_off / "in.mkv", broken_off / "out.mkv", Model.load(model, 1))
    assert done.resumed == 0
    assert len(read_clip(broken_off / "out.mkv")[0]) == 60


def test_broken_off_before_anything_is_kept_leaves_nothing(model, tmp_path):
    source = clip(tmp_path / "in.mkv", 60)
    with pytest.raises(Killed):
        restore_clip(source, tmp_path / "out.mkv", interrupted(Model.load(model, 1), 2), resume=True)
    assert [path.name for path in tmp_path.iterdir()] == ["in.mkv"]


def test_a_model_that_carries_something_along_is_refused(model, tmp_path):
    source, network = clip(tmp_path / "in.mkv", 8), Model.load(model, 1)
    network.card = replace(network.card, carried={"state": {"shape": [4], "scale": 1}})
    with pytest.raises(InputError, match="leave --resume out"):
        restore_clip(source, tmp_path / "out.mkv", network, window=1, resume=True)
    assert [path.name for path in tmp_path.iterdir()] == ["in.mkv"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["in.mkv", "-o", "out.mkv", "--skip"], "leave --resume or --skip out"),
        (["-", "-o", "out.mkv"], "cannot be resumed"),
        (["in.mkv", "-o", "-"], "cannot be resumed"),
    ],
)
def test_what_cannot_be_resumed_is_one_line(model, tmp_path, arguments, says):
    stream = clip(tmp_path / "in.mkv", 8).read_bytes()
    done = subprocess.run(
        command(*arguments, "--model", model, "--resume"), input=stream, cwd=tmp_path, capture_output=True, check=False
    )
    assert (done.returncode, done.stdout) == (2, b"")
    assert done.stderr.count(b"\n") == 1
    assert says in done.stderr.decode()
    assert [path.name for path in tmp_path.iterdir()] == ["in.mkv"]
