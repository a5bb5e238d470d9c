"""What comes with the frames goes with them: their times, and the sound, packet by packet."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from turbnet.deploy.restore import restore_clip
from turbnet.deploy.session import Model
from turbnet.media.clip import open_clip, write_clip

UNEVEN = [0, 1, 2, 4, 5, 9, 10, 11, 15, 16, 17, 20, 26]  # thirtieths of a second


def record(path: Path, times=UNEVEN, sound="aac", late=0) -> Path:
    """A clip whose frames differ and come at `times`/30 s, with a tone of 440 Hz that begins `late`/30 s after them."""
    with av.open(str(path), "w") as container:
        video = container.add_stream("libx264", rate=30, time_base=Fraction(1, 90000), options={"crf": "10"})
        video.width, video.height, video.pix_fmt = 64, 48, "yuv420p"
        audio = container.add_stream(sound, rate=8000) if sound else None
        if audio is not None:
            audio.layout = "mono"
        for index, time in enumerate(times):
            picture = np.full((48, 64, 3), 255 * index // len(times), np.uint8)
            frame = av.VideoFrame.from_ndarray(picture, "rgb24")
            frame.pts, frame.time_base = 3000 * time, Fraction(1, 90000)
            container.mux(video.encode(frame))
        container.mux(video.encode(None))
        if audio is not None:
            wave = 0.3 * np.sin(2 * np.pi * 440 * np.arange(8192) / 8000)
            for start in range(0, len(wave), 1024):
                samples = (32767 * wave[None, start : start + 1024]).astype(np.int16)
                frame = av.AudioFrame.from_ndarray(samples, "s16", "mono")
                frame.sample_rate, frame.pts, frame.time_base = 8000, start + 8000 * late // 30, Fraction(1, 8000)
                container.mux(audio.encode(frame))
            container.mux(audio.encode(None))
    return path


def frame_times(path: Path) -> list[Fraction]:
    with open_clip(path) as clip:
        return [time for time, _ in clip.timed()]


def packets(path: Path) -> list[tuple[bytes, float]]:
    with av.open(str(path)) as container:
        return [
            (bytes(packet), float(packet.pts * packet.time_base))
            for packet in container.demux(audio=0)
            if packet.size > 0
        ]


@pytest.fixture
def model(model_file) -> Model:
    return Model.load(model_file, threads=1)


@pytest.mark.parametrize("source", ["in.mp4", "in.mkv", "in.ts"])
@pytest.mark.parametrize("target", ["out.mp4", "out.mov", "out.mkv"])
def test_uneven_times_and_sound_are_kept(model, tmp_path, source, target):
    record(tmp_path / source)
    done = restore_clip(tmp_path / source, tmp_path / target, model)
    assert (done.frames, done.left_out) == (len(UNEVEN), [])
    times = np.array(frame_times(tmp_path / target)) - frame_times(tmp_path / target)[0]
    tick = 1e-3 if ".mkv" in source + target else 1e-6
    np.testing.assert_allclose(30 * times.astype(float), UNEVEN, atol=30 * tick)
    before, after = packets(tmp_path / source), packets(tmp_path / target)
    if not source.endswith(".ts"):  # whose packets have headers of their own, which other containers do without
        assert [data for data, _ in before] == [data for data, _ in after]
    assert len(before) == len(after)
    sooner, later = (frame_times_and_sound_begin(tmp_path / name) for name in (source, target))
    assert sooner == pytest.approx(later, abs=2e-3)


def frame_times_and_sound_begin(path: Path) -> float:
    """Seconds from the first frame to the first packet of sound."""
    with av.open(str(path)) as container:
        first = next(container.decode(video=0))
        return packets(path)[0][1] - float(first.pts * first.time_base)


@pytest.mark.parametrize("late", [-15, 15])
def test_sound_that_begins_before_or_after_the_pictures(model, tmp_path, late):
    times = [time + max(-late, 0) for time in UNEVEN]
    source = record(tmp_path / "in.mkv", times, late=max(late, 0))
    restore_clip(source, tmp_path / "out.mp4", model)
    offsets = [frame_times_and_sound_begin(tmp_path / name) for name in ("in.mkv", "out.mp4")]
    assert offsets[0] == pytest.approx(offsets[1], abs=2e-3)
    assert len(packets(tmp_path / "out.mp4")) == len(packets(source))


def test_frames_are_neither_dropped_nor_doubled_nor_out_of_order(model, tmp_path):
    restore_clip(record(tmp_path / "in.mp4"), tmp_path / "out.mkv", model, window=1)
    with open_clip(tmp_path / "in.mp4") as before, open_clip(tmp_path / "out.mkv") as after:
        means = [[frame.mean() for frame in clip] for clip in (before, after)]
    assert np.diff(means[1]).min() > 0
    assert len(means[0]) == len(means[1])


def test_a_constant_rate_stays_exact(model, tmp_path):
    """Though a Matroska file keeps its times in whole milliseconds."""
    write_clip(tmp_path / "in.mkv", np.random.default_rng(0).random((9, 32, 32, 3)), fps=30000 / 1001)
    restore_clip(tmp_path / "in.mkv", tmp_path / "out.mp4", model)
    assert frame_times(tmp_path / "out.mp4") == [Fraction(1001 * k, 30000) for k in range(9)]
    with open_clip(tmp_path / "out.mp4") as clip:
        assert clip.info.fps == pytest.approx(30000 / 1001, abs=1e-9)


def test_what_takes_no_sound_says_so(model, tmp_path):
    record(tmp_path / "in.mp4")
    record(tmp_path / "in.mkv", sound="wavpack")
    assert restore_clip(tmp_path / "in.mp4", tmp_path / "out.gif", model).left_out == ["aac"]
    assert restore_clip(tmp_path / "in.mp4", tmp_path / "out.avi", model).left_out == ["aac"]
    assert restore_clip(tmp_path / "in.mp4", tmp_path / "frames", model).left_out == ["aac"]
    assert restore_clip(tmp_path / "in.mkv", tmp_path / "out.mp4", model).left_out == ["wavpack"]
    assert restore_clip(record(tmp_path / "silent.mp4", sound=None), tmp_path / "out.mp4", model).left_out == []


def test_a_gif_keeps_its_durations(model, tmp_path):
    pictures = [Image.fromarray(np.full((32, 32), 25 * k, np.uint8)) for k in range(4)]
    pictures[0].save(tmp_path / "in.gif", save_all=True, append_images=pictures[1:], duration=[100, 300, 50, 200])
    for target in ("out.gif", "out.mp4"):
        restore_clip(tmp_path / "in.gif", tmp_path / target, model)
        assert [round(1000 * time) for time in frame_times(tmp_path / target)] == [0, 100, 400, 450]
    with Image.open(tmp_path / "out.gif") as image:
        assert image.info["duration"] == 100


def test_the_same_frames_give_the_same_bytes(model, tmp_path):
    source = record(tmp_path / "in.mp4")
    for ending in ("mp4", "mkv", "gif", "tif"):
        for name in ("once", "again"):
            restore_clip(source, tmp_path / f"{name}.{ending}", model)
        assert (tmp_path / f"once.{ending}").read_bytes() == (tmp_path / f"again.{ending}").read_bytes()
