import json
import subprocess
import sys

import numpy as np
import pytest
import skimage.data
from scipy.ndimage import gaussian_filter, shift

from turbnet import cli
from turbnet.data.boxes import write_boxes
from turbnet.data.text_scenes import render_scene
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


def evaluate(folder, capsys, *more, **clips):
    options = [text for name, value in clips.items() for text in (f"--{name}", str(folder / value))]
    code = cli.run(["evaluate", *options, "--json", str(folder / "m.json"), "--border", "2", *more])
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


def test_a_fixed_shift_is_told_apart(folder, capsys):
    """The picture moved by (1.5, -0.5) pixels: scored as it is, then with the shift undone."""
    picture = skimage.data.chelsea()[50:131, 100:201] / 255.0
    write_clip(folder / "straight.tif", np.stack([picture] * 2))
    write_clip(folder / "shifted.tif", np.stack([shift(picture, (-0.5, 1.5, 0), order=3, mode="mirror")] * 2))
    rows, _ = evaluate(folder, capsys, restored="shifted.tif", reference="straight.tif")
    assert rows["restored shift x"] == pytest.approx(1.5, abs=0.05)
    assert rows["restored shift y"] == pytest.approx(-0.5, abs=0.05)
    assert rows["restored registered psnr"] > rows["restored psnr"] + 6
    assert rows["restored registered ssim"] > rows["restored ssim"]
    rows, _ = evaluate(folder, capsys, restored="straight.tif", reference="straight.tif")
    assert rows["restored shift x"] == pytest.approx(0.0, abs=1e-6)
    assert "restored registered psnr" not in rows


def test_figures_without_a_reference(folder, capsys):
    rows, table = evaluate(folder, capsys, restored="reference.mkv", input="input.tif")
    # The picture moves by 0, 1, 2, 3 pixels across: sqrt(1.25) along x, none along y.
    assert rows["restored jitter"] == pytest.approx(np.sqrt(1.25 / 2), rel=0.1)
    assert rows["input noise"] > 5 * rows["restored noise"]
    assert rows["restored sharpness of the mean"] < rows["restored sharpness"] < rows["input sharpness"]
    assert rows["restored flicker"] < 0.01
    assert "jitter" in table
    still, _ = evaluate(folder, capsys, restored="still.png")
    assert "restored jitter" not in still


@pytest.fixture(scope="module")
def texts(tmp_path_factory):
    """A clip of sharp text and one of text blurred beyond reading, with one table for each way to name them."""
    folder = tmp_path_factory.mktemp("texts")
    scene = render_scene(np.random.default_rng(5), 120, 200, "words", size=(20, 20), contrast=(0.8, 0.9), perspective=0)
    blurred = gaussian_filter(scene.picture, (6, 6, 0))
    write_clip(folder / "sharp.tif", np.stack([scene.picture] * 2))
    write_clip(folder / "blurred.tif", np.stack([scene.picture, blurred]))
    write_boxes(folder / "one.tsv", {"any.tif": scene.boxes})
    write_boxes(folder / "two.tsv", {"sharp.tif": scene.boxes, "blurred.tif": scene.boxes[:2]})
    return folder, len(scene.boxes)


def test_text_of_a_clip(texts, capsys):
    folder, count = texts
    rows, table = evaluate(folder, capsys, "--ocr", "proxy", restored="sharp.tif", input="blurred.tif", boxes="one.tsv")
    assert rows["restored text words"] == rows["input text words"] == count
    assert rows["restored text cer"] < 0.3
    assert rows["input text cer worst"] > 0.8
    assert rows["input text cer worst frame"] == 1
    assert rows["restored text cer"] < rows["input text cer of the mean"]
    assert rows["restored text words read"] == pytest.approx(count * rows["restored text word accuracy"])
    assert "word accuracy" in table


def test_text_of_the_files_a_table_names(texts, capsys):
    folder, count = texts
    rows, _ = evaluate(folder, capsys, "--ocr", "builtin", transcripts="two.tsv")
    assert rows["sharp.tif text words"] == count
    assert rows["blurred.tif text words"] == 2
    assert rows["all text words"] == count + 2
    assert rows["sharp.tif text cer"] < 0.15
    assert rows["blurred.tif text cer worst"] > 0.5
    assert rows["all text words read worst frame"] == 1


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "give --restored, the clip to score, or --boxes"),
        (["--boxes", "two.tsv", "--input", "sharp.tif"], "give --restored"),
        (["--boxes", "none.tsv"], "cannot read the boxes none.tsv"),
        (["--boxes", "one.tsv"], "there is no file or folder any.tif"),
        (["--boxes", "two.tsv", "--ocr", "eagle"], "there is no reader eagle; choose one of builtin, rapidocr"),
        (["--boxes", "two.tsv", "--restored", "other.png"], "two.tsv has no boxes for other.png"),
        (["--boxes", "one.tsv", "--restored", "other.png", "--ocr", "proxy"], "does not lie inside the picture"),
    ],
)
def test_bad_text_input_is_one_line(texts, capsys, monkeypatch, arguments, says):
    monkeypatch.chdir(texts[0])
    write_clip("other.png", np.full((1, 30, 30, 3), 0.5))
    code = cli.run(["evaluate", "--quiet", *arguments])
    printed = capsys.readouterr()
    assert (code, printed.out) == (2, "")
    assert says in printed.err
    assert printed.err.count("\n") == 1


def test_the_extra_is_named_when_it_is_missing(texts, capsys, monkeypatch):
    monkeypatch.chdir(texts[0])
    monkeypatch.setitem(sys.modules, "rapidocr", None)
    assert cli.run(["evaluate", "--boxes", "two.tsv", "--ocr", "rapidocr", "--quiet"]) == 2
    assert "needs the extra 'ocr': pip install 'turbnet[ocr]'" in capsys.readouterr().err


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
        ("-", "still.png", [], "save the pipe or camera to a file first"),
        ("still.png", "-", [], "save the pipe or camera to a file first"),
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
