import numpy as np
import pytest

from turbnet.deploy.restore import restore_clip, restore_frames
from turbnet.deploy.session import Model
from turbnet.deploy.tiling import Tiling
from turbnet.deploy.weights import find_model, released_models
from turbnet.errors import InputError
from turbnet.media.clip import open_clip, open_writer

TILING = Tiling(32, 8, 4)


def noise(frames, height=45, width=70):
    return np.random.default_rng(0).random((frames, height, width, 3), np.float32)


def test_identity_returns_the_clip():
    clip_THWC = noise(17)
    restored = list(restore_frames(clip_THWC, lambda frames: frames, TILING, window=6))
    np.testing.assert_allclose(restored, clip_THWC, atol=1e-6)


def test_whole_clip_in_one_tile_and_window_is_the_network_alone(model_file):
    clip_THWC = noise(5, 36, 52)
    model = Model.load(model_file)
    (expected_TCHW,) = model(clip_THWC.transpose(0, 3, 1, 2)[None])
    restored = list(restore_frames(clip_THWC, model, Tiling(64, 8, 4), window=6))
    np.testing.assert_allclose(restored, expected_TCHW.transpose(0, 2, 3, 1).clip(0, 1), atol=1e-6)


def test_values_stay_in_range():
    restored = np.stack(list(restore_frames(noise(3), lambda frames: 4 * frames - 1.5, TILING, window=6)))
    assert (restored.min(), restored.max()) == (0, 1)


def test_pixels_that_are_not_numbers():
    clip_THWC = noise(9)
    clip_THWC[7, 3, 4, 1] = np.nan
    with pytest.raises(InputError, match="frame 7 holds values that are not numbers"):
        list(restore_frames(clip_THWC, lambda frames: frames, TILING, window=6))
    with pytest.raises(InputError, match="the network returned values that are not finite for frame 0"):
        list(restore_frames(noise(2), lambda frames: frames * np.float32(np.inf), TILING, window=6))


def test_report_of_a_clip(model_file, tmp_path):
    with open_writer(tmp_path / "in.tiff") as writer:
        for frame_HWC in noise(8):
            writer.write(frame_HWC)
    model = Model.load(model_file)
    done = restore_clip(tmp_path / "in.tiff", tmp_path / "out.tiff", model, tile=32, overlap=8, crop=(3, 2, 50, 40))
    assert (done.frames, done.height, done.width, done.window) == (8, 40, 50, 6)
    assert done.tiles == Tiling(32, 8, 4).count(40, 50) == 4
    assert 0 < done.network_seconds < done.seconds
    assert done.milliseconds_a_frame == pytest.approx(1e3 * done.seconds / 8)
    with open_clip(tmp_path / "out.tiff") as clip:
        assert sum(1 for _ in clip) == 8


def test_a_second_pass_restores_what_the_first_left(model_file, tmp_path):
    with open_writer(tmp_path / "in.tiff") as writer:
        for frame_HWC in noise(8):
            writer.write(frame_HWC)
    model = Model.load(model_file)
    done = restore_clip(tmp_path / "in.tiff", tmp_path / "twice.tiff", model, passes=2)
    assert done.frames == 8
    with open_clip(tmp_path / "in.tiff") as clip:
        tiling = Tiling(384, 32, 4)
        once = restore_frames(clip, model, tiling, 6)
        expected = np.stack(list(restore_frames(once, model, tiling, 6)))
    with open_clip(tmp_path / "twice.tiff") as clip:
        np.testing.assert_allclose(np.stack(list(clip)), expected, rtol=0, atol=1 / 255)
    with pytest.raises(InputError, match="passes = 0"):
        restore_clip(tmp_path / "in.tiff", tmp_path / "none.tiff", model, passes=0)
    assert not (tmp_path / "none.tiff").exists()


def test_models_by_name_and_by_path(model_file, tmp_path, monkeypatch):
    assert find_model(model_file) == model_file
    for name, path in released_models().items():
        assert find_model(name) == path
    with pytest.raises(InputError, match="neither a file nor a released model"):
        find_model("nonesuch")
    (tmp_path / "small.onnx").write_bytes(b"")
    monkeypatch.setattr("turbnet.deploy.weights.resources.files", lambda _: tmp_path)
    assert find_model("small") == tmp_path / "small.onnx"
    with pytest.raises(InputError, match=r"\(small\)"):
        find_model("nonesuch")
