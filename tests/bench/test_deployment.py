"""What restoring costs: the rows are there, and mean what they say."""

import json

import numpy as np
import pytest
from torch import nn

from turbnet.bench import deployment, page
from turbnet.cli import run
from turbnet.deploy.card import ModelCard
from turbnet.deploy.export import export_onnx
from turbnet.report import Report, Row


class Mean(nn.Module):
    """Every frame is the mean of its window: perfect for a still scene."""

    def forward(self, frames_BTCHW):
        return frames_BTCHW.mean(1, keepdim=True).expand_as(frames_BTCHW) + 0 * frames_BTCHW


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("mean") / "mean.onnx"
    export_onnx(Mean(), ModelCard("mean", {}, size_multiple=8, frames=6), path)
    return path


def test_a_still_camera_sees_something_pass_and_then_nothing():
    scene = deployment.static_camera(8, 0.0)
    assert scene.clean.shape == scene.frames.shape == (8, 256, 256, 3)
    assert np.abs(scene.frames - scene.clean).max() < 1 / 255
    changes = np.abs(np.diff(scene.clean, axis=0)).max((1, 2, 3))
    assert (changes[:3] > 0.1).all()
    assert (changes[4:] == 0).all()
    rows = np.abs(np.diff(scene.clean, axis=0)).max((0, 2, 3)) > 0
    assert not rows[:128].any()
    assert not rows[192:].any()


def test_through_air_every_frame_is_another():
    frames = deployment.static_camera(3, 2.0).frames
    assert np.abs(np.diff(frames, axis=0)).mean((1, 2, 3)).min() > 0.005
    assert 0 <= frames.min() < frames.max() <= 1


def test_rows_of_a_model(model, tmp_path, capsys):
    target = tmp_path / "rows.json"
    command = ["bench", "deployment", "--model", str(model), "--only", "speed,skip", "--quick", "--quiet"]
    assert run([*command, "--json", str(target)]) == 0
    rows = {row["name"].removeprefix(f"{model}: "): row["value"] for row in json.loads(target.read_text())["rows"]}
    assert rows["256 x 256, clip of 6"] > 0
    assert rows["--skip, clear air: tiles skipped"] == 1
    assert rows["--skip, clear air: likeness to the input, at most 100"] == pytest.approx(100)
    assert 0 <= rows["--skip, still camera: tiles skipped"] < 1
    whole, spared = (rows[f"--skip, still camera: PSNR, {what}"] for what in ("all restored", "with --skip"))
    assert spared == pytest.approx(whole, abs=0.3)
    assert "frames a second" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["deployment", "--only", "speed,colour"], "no family 'colour'"),
        (["deployment", "--model", "no.onnx"], "no.onnx"),
        (["all"], "output"),
        (["all", "--output", __file__], "is a file"),
    ],
)
def test_what_cannot_be_measured(arguments, complaint, capsys):
    assert run(["bench", *arguments]) == 2
    assert complaint in capsys.readouterr().err


def test_everything_on_one_page(monkeypatch, tmp_path):
    """Each suite gives rows, text and figures; a row that misses its reference makes the whole miss."""

    def suite(name):
        def found(folder=tmp_path, quick=True, quiet=True):
            if name != "deployment":
                (tmp_path / f"{name}.png").write_bytes(b"")
            report = Report()
            report.add(Row.compared(name, 2.0, 1.0, 0.5) if name == "simulator" else Row(name, 1.0))
            return report, f"table of {name}"

        return found if name != "deployment" else (lambda quick, quiet: found())

    for name in ("physics", "simulator", "restoration", "deployment"):
        monkeypatch.setattr(page, f"_{name}", suite(name))
    report = page.write(tmp_path, quick=True, quiet=True)
    text = (tmp_path / "bench.md").read_text()
    for name in ("physics", "simulator", "restoration", "deployment"):
        assert f"table of {name}" in text
    assert "![simulator](simulator.png)" in text
    assert [row["name"] for row in json.loads((tmp_path / "bench.json").read_text())["rows"]] == [
        "physics",
        "simulator",
        "restoration",
        "deployment",
    ]
    assert not report.ok


def test_eight_bits_are_judged(model):
    """A network without convolutions loses nothing and gains nothing, so that it is not worth it; rounding loses little."""
    rows = {row.name: row.value for row in deployment.run([str(model)], ("precision",), quick=True, quiet=True).rows}
    for kind in ("static", "dynamic", "text"):
        assert abs(rows[f"{model}: int8: loses, {kind} scenes"]) < 0.01
    assert rows[f"{model}: int8: faster by"] > 0
    assert rows[f"{model}: int8: worth it"] in ("yes", "no")
