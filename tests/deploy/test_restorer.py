"""`turbnet.Restorer`: frames in memory, frames as they come, files; several threads."""

import subprocess
import sys
import threading

import numpy as np
import pytest

import turbnet
from turbnet.deploy.restore import TILE, restore_frames
from turbnet.deploy.tiling import Tiling
from turbnet.errors import InputError
from turbnet.media.clip import read_clip, write_clip


@pytest.fixture
def restorer(model_file) -> turbnet.Restorer:
    return turbnet.Restorer(model_file, threads=1)


@pytest.fixture(scope="module")
def clip() -> np.ndarray:
    return np.random.default_rng(0).random((8, 37, 42, 3), dtype=np.float32)


def test_a_clip_in_memory_is_what_restore_makes_of_it(restorer, clip):
    expected = np.stack(list(restore_frames(clip, restorer.model, Tiling(TILE, 32, 4), 6)))
    restored = restorer(clip)
    assert restored.dtype == np.float32
    np.testing.assert_array_equal(restored, expected)
    np.testing.assert_array_equal(np.stack(list(restorer.stream(iter(clip)))), expected)


@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(np.uint8, 1 / 255), (np.uint16, 1e-4), (np.float64, 1e-6), (np.float16, 2e-3)]
)
def test_what_comes_back_is_of_the_kind_that_was_given(restorer, clip, dtype, tolerance):
    full = np.iinfo(dtype).max if np.issubdtype(dtype, np.integer) else 1
    given = (clip * full).astype(dtype)
    restored = restorer(given)
    assert restored.dtype == dtype
    assert restored.shape == clip.shape
    expected = restorer((given / np.float64(full)).astype(np.float32))
    np.testing.assert_allclose(restored.astype(np.float64) / full, expected, rtol=0, atol=tolerance)


def test_a_still(restorer, clip):
    np.testing.assert_array_equal(restorer(clip[0]), restorer(clip[:1])[0])


def test_a_file(restorer, clip, tmp_path):
    write_clip(tmp_path / "in.mkv", clip)
    done = restorer.restore(tmp_path / "in.mkv", tmp_path / "out.mkv")
    assert done.frames == 8
    assert read_clip(tmp_path / "out.mkv")[0].shape == clip.shape


@pytest.mark.parametrize(
    ("frames", "says"),
    [
        (np.zeros((0, 8, 8, 3), np.float32), "shape"),
        (np.zeros((2, 8, 8, 4), np.float32), "shape"),
        (np.zeros((8, 8), np.float32), "shape"),
        (np.zeros((2, 8, 8, 3), np.int64), "int64"),
        (np.zeros((2, 8, 8, 3), bool), "bool"),
        (np.full((2, 8, 8, 3), np.nan, np.float32), "not numbers"),
        (np.full((2, 8, 8, 3), 255.0, np.float32), "frame 0 holds values up to 255; scale"),
    ],
)
def test_what_cannot_be_restored(restorer, frames, says):
    with pytest.raises(InputError, match=says):
        restorer(frames)


def test_models_and_values_that_cannot_be(model_file):
    with pytest.raises(InputError, match="there is no model nowhere"):
        turbnet.Restorer("nowhere")
    for wrong in ({"window": 1001}, {"window": 0}, {"tile": 8}, {"threads": 0}):
        with pytest.raises(InputError):
            turbnet.Restorer(model_file, **wrong)


def test_several_threads_share_one(restorer, clip):
    results: dict[int, np.ndarray] = {}
    threads = [threading.Thread(target=lambda k=k: results.update({k: restorer(clip[k:])})) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for k in range(4):
        np.testing.assert_array_equal(results[k], restorer(clip[k:]))


def test_importing_turbnet_brings_nothing_along():
    heavy, learning = (
        {"numpy", "torch", "onnxruntime", "lightning", "onnx", "av", "PIL"},
        {"torch", "lightning", "onnx"},
    )
    code = f"""
import sys, turbnet
print({heavy} & set(sys.modules))
turbnet.Restorer
print({learning} & set(sys.modules))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == ["set()", "set()"], done.stdout + done.stderr
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        _ = turbnet.nothing_of_the_kind


def test_files_with_skipping_or_to_be_resumed(restorer, tmp_path):
    clip = np.full((6, 32, 40, 3), 0.5, np.float32)
    write_clip(tmp_path / "in.mkv", clip)
    done = restorer.restore(tmp_path / "in.mkv", tmp_path / "skipped.mkv", skip=True)
    assert done.skipped.saved == 1
    np.testing.assert_allclose(read_clip(tmp_path / "skipped.mkv")[0], clip, atol=0.51 / 255)
    done = restorer.restore(tmp_path / "in.mkv", tmp_path / "out.mkv", resume=True)
    assert (done.frames, done.resumed) == (6, 0)
    with pytest.raises(InputError, match="leave --resume or --skip out"):
        restorer.restore(tmp_path / "in.mkv", tmp_path / "both.mkv", skip=True, resume=True)
