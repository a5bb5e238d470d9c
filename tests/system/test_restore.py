"""`turbnet restore` on files, as a user runs it. The network blends each frame with the mean of its window."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image
from skimage import data

from turbnet.media.clip import open_clip, open_writer

WINDOW = 6


def turbnet(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "turbnet", *(str(argument) for argument in arguments)]
    return subprocess.run(command, capture_output=True, text=True)


def moving_clip(frames: int, height: int, width: int) -> np.ndarray:
    """A photograph that drifts, (T, H, W, 3)."""
    picture = (data.astronaut()[::2, ::2] / 255).astype(np.float32)
    return np.stack([np.roll(picture, (3 * k, 2 * k), (0, 1))[:height, :width] for k in range(frames)])


def write(path: Path, frames_THWC: np.ndarray) -> Path:
    with open_writer(path) as writer:
        for frame_HWC in frames_THWC:
            writer.write(frame_HWC)
    return path


def read(path: Path) -> np.ndarray:
    with open_clip(path) as clip:
        return np.stack(list(clip))


def test_clip_of_one_window(model, tmp_path):
    frames_THWC = moving_clip(WINDOW, 61, 83)
    source = write(tmp_path / "in.tiff", frames_THWC)
    done = turbnet("restore", source, "-o", tmp_path / "out.tiff", "--model", model, "--quiet")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    expected = 0.75 * frames_THWC + 0.25 * frames_THWC.mean(0)
    np.testing.assert_allclose(read(tmp_path / "out.tiff"), expected, atol=1.1 / 255)


def test_long_clip_in_tiles_with_a_report(model, tmp_path):
    frames_THWC = moving_clip(20, 101, 130)
    source = write(tmp_path / "in.mkv", frames_THWC)
    target, report = tmp_path / "out.mkv", tmp_path / "report.json"
    done = turbnet(
        "restore", source, "-o", target, "--model", model, "--tile", 64, "--crop", "10,20,111,77", "--json", report
    )
    assert done.returncode == 0, done.stderr
    assert "20 frames of 111x77" in done.stdout
    restored = read(target)
    assert restored.shape == (20, 77, 111, 3)
    rows = {row["name"]: row["value"] for row in json.loads(report.read_text())["rows"]}
    assert (rows["frames"], rows["window"], rows["tiles of a frame"]) == (20, WINDOW, 4)
    # In one tile the same comes out: tiles leave no trace.
    done = turbnet("restore", source, "-o", tmp_path / "whole.mkv", "--model", model, "--crop", "10,20,111,77")
    assert done.returncode == 0, done.stderr
    np.testing.assert_allclose(read(tmp_path / "whole.mkv"), restored, atol=1.1 / 255)


@pytest.mark.parametrize("size", [(3, 3), (1, 1), (40, 57)])
def test_one_image(model, tmp_path, size):
    pixels = data.astronaut()[: size[0], : size[1]]
    Image.fromarray(pixels).save(tmp_path / "in.png")
    done = turbnet("restore", tmp_path / "in.png", "-o", tmp_path / "out.png", "--model", model, "--quiet")
    assert done.returncode == 0, done.stderr
    np.testing.assert_allclose(np.asarray(Image.open(tmp_path / "out.png")), pixels, atol=1)


def test_window_of_one_frame_is_each_frame_alone(model, tmp_path):
    source = write(tmp_path / "in.tiff", moving_clip(4, 32, 32))
    done = turbnet("restore", source, "-o", tmp_path / "out.tiff", "--model", model, "--window", 1, "--quiet")
    assert done.returncode == 0, done.stderr
    np.testing.assert_array_equal(read(tmp_path / "out.tiff"), read(source))


def test_grey_stays_grey(model, tmp_path):
    Image.fromarray(data.camera()[:64, :64]).save(tmp_path / "in.png")
    done = turbnet("restore", tmp_path / "in.png", "-o", tmp_path / "out.png", "--model", model, "--quiet")
    assert done.returncode == 0, done.stderr
    assert Image.open(tmp_path / "out.png").mode == "L"


@pytest.fixture(scope="module")
def bad_files(model, blend, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("bad")
    write(folder / "good.tiff", moving_clip(3, 32, 40))
    tifffile.imwrite(folder / "nan.tiff", np.full((2, 32, 32, 3), np.nan, np.float32), photometric="rgb")
    (folder / "corrupt.mp4").write_bytes(b"\0\0\0\x20ftypisom" + bytes(2000))
    (folder / "good.onnx").write_bytes(model.read_bytes())
    damaged = bytearray(model.read_bytes())
    damaged[len(damaged) // 3] ^= 1
    (folder / "damaged.onnx").write_bytes(damaged)
    (folder / "foreign.onnx").write_bytes(blend.SerializeToString())
    (folder / "text.onnx").write_text("not a model")
    return folder


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ("none.mp4 -o out.mp4 --model good.onnx", "none.mp4"),
        ("corrupt.mp4 -o out.mp4 --model good.onnx", "corrupt.mp4"),
        ("nan.tiff -o out.tiff --model good.onnx", "NaN"),
        ("good.tiff -o out.tiff --model none.onnx", "no model"),
        ("good.tiff -o out.tiff --model damaged.onnx", "damaged.onnx: the file is damaged or was changed"),
        ("good.tiff -o out.tiff --model foreign.onnx", "foreign.onnx: not a turbnet model"),
        ("good.tiff -o out.tiff --method magic", "there is no method magic; the methods are pipeline"),
        ("good.tiff -o out.tiff --method mean --model good.onnx", "not both"),
        ("good.tiff -o out.tiff --method pipeline --window 1", "a single one"),
        ("nan.tiff -o out.tiff --method mean", "NaN"),
        ("good.tiff -o out.tiff --model text.onnx", "text.onnx: not a turbnet model"),
        ("good.tiff -o none/out.tiff --model good.onnx", "none"),
        ("good.tiff -o out.xyz --model good.onnx", "out.xyz"),
        ("good.tiff -o out.tiff --model good.onnx --tile 8", "tile = 8 pixels is outside"),
        ("good.tiff -o out.tiff --model good.onnx --window 0", "window = 0 frames is outside"),
        ("good.tiff -o out.tiff --model good.onnx --threads -2", "threads = -2 is outside"),
        ("good.tiff -o out.tiff --model good.onnx --crop 0,0,50,50", "crop"),
        ("good.tiff -o out.tiff --model good.onnx --crop 0,0,x", "--crop 0,0,x: give LEFT,TOP,WIDTH,HEIGHT"),
        ("good.tiff --model good.onnx", "--output"),
        ("good.tiff -o out.tiff --model good.onnx --tile many", "--tile"),
    ],
)
def test_bad_input_is_one_line(bad_files, tmp_path, arguments, says):
    words = [
        str((tmp_path if word.startswith(("out.", "none/")) else bad_files) / word) if "." in word else word
        for word in arguments.split()
    ]
    done = turbnet("restore", *words)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("turbnet restore: ")
    assert says in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_an_output_that_exists_survives_a_failure(bad_files, tmp_path):
    (tmp_path / "out.tiff").write_bytes(b"precious")
    done = turbnet("restore", bad_files / "nan.tiff", "-o", tmp_path / "out.tiff", "--model", bad_files / "good.onnx")
    assert done.returncode == 2
    assert (tmp_path / "out.tiff").read_bytes() == b"precious"
    assert len(list(tmp_path.iterdir())) == 1


def test_a_classical_method_in_place_of_a_model(tmp_path):
    frames_THWC = moving_clip(1, 48, 56).repeat(5, axis=0)
    noisy_THWC = frames_THWC + 0.02 * np.random.default_rng(0).standard_normal(frames_THWC.shape)
    source = write(tmp_path / "in.tiff", noisy_THWC.clip(0, 1).astype(np.float32))
    for method in ("mean", "pipeline"):
        target, report = tmp_path / f"{method}.tiff", tmp_path / "report.json"
        done = turbnet("restore", source, "-o", target, "--method", method, "--threads", 2, "--json", report)
        assert done.returncode == 0, done.stderr
        assert "5 frames of 56x48" in done.stdout
        assert {row["name"]: row["value"] for row in json.loads(report.read_text())["rows"]}["window"] == 5
        error = np.abs(read(target) - frames_THWC).mean()
        assert error < 0.7 * np.abs(read(source) - frames_THWC).mean()


def test_starts_without_torch(model, tmp_path):
    source = write(tmp_path / "in.tiff", moving_clip(2, 32, 32))
    words = ["restore", str(source), "-o", str(tmp_path / "out.tiff"), "--model", str(model), "--quiet"]
    code = (
        f"import sys; from turbnet.cli import run; assert run({words}) == 0\n"
        "print([name for name in ('torch', 'onnx', 'lightning', 'scipy', 'matplotlib') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_starts_soon_and_on_the_threads_it_is_given(tmp_path):
    """Counted in processor time and in threads, which other work on the machine does not change."""
    source = write(tmp_path / "in.mp4", moving_clip(12, 64, 64))
    code = f"""
import os, resource
from turbnet.cli import run
from turbnet.deploy.session import Model
threads, used, call = [], [], Model._run
def watched(*arguments):
    threads.append(len(os.listdir("/proc/self/task")))
    used.append(sum(resource.getrusage(resource.RUSAGE_SELF)[:2]))
    return call(*arguments)
Model._run = watched
run(["restore", {str(source)!r}, "-o", {str(tmp_path / "out.mp4")!r}, "--window", "4", "--threads", "1", "--quiet"])
print(used[0], *threads)
"""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    used, *threads = done.stdout.split()
    assert float(used) < 2  # seconds to the first window
    assert len(threads) == 4
    assert {int(count) for count in threads} <= {1, 2}  # onnxruntime keeps one that sleeps


def test_help():
    done = turbnet("restore", "--help")
    assert done.returncode == 0
    for option in (
        "--output",
        "--model",
        "--method",
        "--crop",
        "--window",
        "--tile",
        "--threads",
        "--json",
        "--quiet",
        "--resume",
    ):
        assert option in done.stdout
