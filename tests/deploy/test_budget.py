"""A point of the measured curve for a time or a quality."""

import json

import numpy as np
import pytest

from turbnet.cli import run
from turbnet.deploy import budget
from turbnet.deploy.budget import Setting
from turbnet.errors import InputError
from turbnet.media.clip import write_clip

POINTS = [Setting("s", 1, 1.0, 1.0), Setting("s", 8, 4.0, 2.0), Setting("s", 32, 6.0, 4.0)]


@pytest.fixture(autouse=True)
def three_points(monkeypatch):
    monkeypatch.setattr(budget, "curve", lambda: POINTS)


@pytest.mark.parametrize(("gain", "window"), [(0.0, 1), (1.0, 1), (1.1, 8), (6.0, 32)])
def test_the_cheapest_that_gains_enough(gain, window):
    assert budget.for_quality(gain).window == window


@pytest.mark.parametrize(("milliseconds", "window"), [(71, 1), (139, 8), (277, 32), (1e6, 32)])
def test_the_best_within_the_budget(milliseconds, window):
    """This machine is as fast as the one that measured: 256 x 256 pixels take 65.5 ms at the cheapest point."""
    assert budget.for_budget(milliseconds, 256, 256, measure=lambda point, threads: 1.0).window == window


def test_a_slower_machine_does_less():
    assert budget.for_budget(277, 256, 256, measure=lambda point, threads: 3.0).window == 1


def test_tiles_that_overlap_cost_more():
    """512 x 512 is four tiles of 272 x 272: 0.296 million pixels, not 0.262."""
    with pytest.raises(InputError, match="296 ms here at the least"):
        budget.for_budget(280, 512, 512, measure=lambda point, threads: 1.0)


def test_what_nothing_can_do():
    with pytest.raises(InputError, match="the most is 6.0 dB"):
        budget.for_quality(7.0)
    with pytest.raises(InputError, match="at the least"):
        budget.for_budget(10, 256, 256, measure=lambda point, threads: 1.0)
    with pytest.raises(InputError, match="budget-ms"):
        budget.for_budget(-1, 256, 256)


def test_this_machine_takes_some_time():
    assert 0.05 < budget.seconds_here(Setting("s", 1, 0.0, 0.0), threads=1) < 1000


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--quality", "99"], "the most is 6.0 dB"),
        (["--quality", "1", "--budget-ms", "5"], "not both"),
        (["--quality", "1", "--model", "s"], "leave --model"),
        (["--quality", "1", "--views", "2"], "leave --model"),
        (["--budget-ms", "1e-6"], "at the least"),
    ],
)
def test_the_command_line_says_what_cannot_be(arguments, complaint, tmp_path, capsys):
    write_clip(tmp_path / "in.png", np.full((1, 16, 16, 3), 0.5, np.float32))
    assert run(["restore", str(tmp_path / "in.png"), "-o", str(tmp_path / "out.png"), *arguments]) == 2
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / "out.png").exists()


def test_the_command_line_restores_as_chosen(tmp_path):
    write_clip(tmp_path / "in.mkv", np.full((3, 32, 32, 3), 0.5, np.float32))
    report = tmp_path / "report.json"
    command = ["restore", str(tmp_path / "in.mkv"), "-o", str(tmp_path / "out.mkv"), "--quality", "1", "--quiet"]
    assert run([*command, "--json", str(report)]) == 0
    rows = {row["name"]: row["value"] for row in json.loads(report.read_text())["rows"]}
    assert rows["window"] == 1


def test_views_are_chosen_too(tmp_path, monkeypatch):
    """The best point restores every window twice: once transposed."""
    monkeypatch.setattr(budget, "curve", lambda: [*POINTS, Setting("s", 32, 7.0, 8.0, views=2)])
    assert budget.for_quality(6.5).views == 2
    assert budget.for_budget(1e6, 64, 64, measure=lambda point, threads: 1.0).views == 2
    write_clip(tmp_path / "in.tiff", np.random.default_rng(0).random((2, 32, 32, 3), dtype=np.float32))
    for name, options in (("chosen", ["--quality", "6.5"]), ("given", ["--views", "2", "--window", "32"])):
        assert (
            run(["restore", str(tmp_path / "in.tiff"), "-o", str(tmp_path / f"{name}.tiff"), *options, "--quiet"]) == 0
        )
    assert (tmp_path / "chosen.tiff").read_bytes() == (tmp_path / "given.tiff").read_bytes()
