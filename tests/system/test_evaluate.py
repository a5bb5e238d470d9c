import json
import subprocess
import sys

import numpy as np
import pytest
import skimage.data

from turbnet import cli
from turbnet.media.clip import read_clip, write_clip
from turbnet.media.colour import to_linear, to_srgb
from turbnet.metrics.fidelity import psnr, ssim


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """reference: a moving picture; input: it with strong noise; restored: with little, most of it in frame 2."""
    folder = tmp_path_factory.mktemp("clips")
    picture = skimage.data.chelsea()[50:113, 100:201] / 255.0
    reference = np.stack([np.roll(picture, shift, axis=1) for shift in range(4)])
    noise = np.random.default_rng(0).normal(size=reference.shape)
    write_clip(folder / "reference.mkv", reference)
    write_clip(folder / "input.tif", reference + 0.2 * noise)
    write_clip(folder / "restored", reference + np.array([0.02, 0.02, 0.05, 0.02])[:, None, None, None] * noise)
    write_clip(folder / "still.png", reference[:1])
    write_clip(folder / "short.gif", reference[:3])
    write_clip(folder / "small.png", reference[:1, 1:])
    write_clip(folder / "tiny.png", reference[:1, :8, :8])
    return folder


def evaluate(folder, capsys, **clips):
    options = [text for name, value in clips.items() for text in (f"--{name}", str(folder / value))]
    code = cli.run(["evaluate", *options, "--json", str(folder / "m.json"), "--border", "2"])
    printed = capsys.readouterr()
    assert (code, printed.err) == (0, "")
    document = json.loads((folder / "m.json").read_text())
    assert set(document) == {"version", "command", "machine", "rows"}
    assert all(set(row) == {"name", "value", "unit", "reference", "tolerance", "ok"} for row in document["rows"])
    return {row["name"]: row["value"] for row in document["rows"]}, printed.out


def test_figures_of_a_clip(folder, capsys):
    rows, table = evaluate(folder, capsys, restored="restored", reference="reference.mkv", input="input.tif")
    restored, reference, degraded = (read_clip(folder / name)[0] for name in ("restored", "reference.mkv", "input.tif"))
    mean = np.stack([to_srgb(to_linear(degraded.astype(float)).mean(axis=0)).astype(np.float32)] * 4)
    for name, clip in {"restored": restored, "input": degraded, "temporal mean": mean}.items():
        assert rows[f"{name} frames"] == 4
        for measure, function in (("psnr", psnr), ("ssim", ssim)):
            expected = function(clip, reference, 2)
            assert rows[f"{name} {measure}"] == pytest.approx(expected.mean(), rel=1e-5)
            assert rows[f"{name} {measure} worst"] == pytest.approx(expected.min(), rel=1e-5)
            assert rows[f"{name} {measure} worst frame"] == expected.argmin()
    assert rows["restored psnr worst frame"] == 2
    assert rows["restored psnr"] > rows["temporal mean psnr"] > rows["input psnr"]
    assert f"{rows['restored psnr']:.2f}" in table
    assert f"{rows['temporal mean ssim']:.4f}" in table


def test_still_reference_stands_beside_every_frame(folder, capsys):
    rows, _ = evaluate(folder, capsys, restored="reference.mkv", reference="still.png", input="input.tif")
    clip = read_clip(folder / "reference.mkv")[0]
    expected = psnr(clip, clip[0], 2)
    assert rows["restored frames"] == 4
    assert rows["restored psnr"] == "inf"  # the first frame is the still
    assert rows["restored psnr worst"] == pytest.approx(expected.min(), rel=1e-5)
    assert rows["temporal mean frames"] == 1


@pytest.mark.parametrize(
    ("restored", "reference", "more", "says"),
    [
        ("restored", "short.gif", [], "ends after 3 frames but"),
        ("short.gif", "reference.mkv", [], "ends after 3 frames but"),
        ("still.png", "reference.mkv", [], "ends after 1 frames but"),
        ("small.png", "still.png", [], "small.png is 101x62 pixels but"),
        ("still.png", "still.png", ["--input", "small.png"], "small.png is 101x62 pixels but"),
        ("tiny.png", "tiny.png", [], "at least 11x11 must remain"),
        ("still.png", "still.png", ["--border", "40"], "too small for a border of 40"),
        ("missing.mp4", "still.png", [], "there is no file or folder"),
        ("still.png", "still.png", ["--json", "none/m.json"], "does not exist; create it first"),
    ],
)
def test_bad_input_is_one_line(folder, capsys, monkeypatch, restored, reference, more, says):
    monkeypatch.chdir(folder)
    code = cli.run(["evaluate", "--restored", restored, "--reference", reference, "--quiet", *more])
    printed = capsys.readouterr()
    assert (code, printed.out) == (2, "")
    assert says in printed.err
    assert printed.err.count("\n") == 1


def test_command_line_does_not_import_lightning(folder):
    arguments = ["evaluate", "--restored", str(folder / "restored"), "--reference", str(folder / "reference.mkv")]
    script = (
        "import sys, turbnet.cli\n"
        f"assert turbnet.cli.run({arguments!r}) == 0\n"
        "print([name for name in ('lightning', 'pytorch_lightning', 'hydra', 'kornia') if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("[]\n")
    assert done.stderr == ""
