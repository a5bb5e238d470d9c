"""`turbnet restore` in a pipe: clips without a known end, as long as they like."""

import io
import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from fractions import Fraction
from itertools import count

import av
import numpy as np
import pytest

from turbnet.bench.memory import run_measured
from turbnet.media.clip import read_clip, write_clip

HEIGHT, WIDTH = 48, 64


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "turbnet", "restore", *map(str, arguments)]


def y4m(frames) -> bytes:
    """YUV4MPEG2 frames, the k-th of them grey of level k mod 256; the header before the first."""
    for k in frames:
        header = b"YUV4MPEG2 W%d H%d F25:1 Cmono\n" % (WIDTH, HEIGHT) if k == 0 else b""
        yield header + b"FRAME\n" + bytes([k % 256]) * (HEIGHT * WIDTH)


def encoded(container: str, codec: str, pixels: str, frames: np.ndarray, sound: bool = False) -> bytes:
    file = io.BytesIO()
    with av.open(file, "w", format=container) as out:
        video = out.add_stream(codec, rate=25)
        video.height, video.width, video.pix_fmt = *frames.shape[1:3], pixels
        audio = out.add_stream("aac", rate=8000) if sound else None
        for k, pixels_HWC in enumerate(frames):
            frame = av.VideoFrame.from_ndarray((255 * pixels_HWC).astype(np.uint8), "rgb24")
            frame.pts, frame.time_base = k, Fraction(1, 25)
            out.mux(video.encode(frame))
        out.mux(video.encode(None))
        if audio is not None:
            tone = av.AudioFrame.from_ndarray(np.zeros((1, 4096), np.int16), "s16", "mono")
            tone.sample_rate, tone.pts, tone.time_base = 8000, 0, Fraction(1, 8000)
            out.mux([*audio.encode(tone), *audio.encode(None)])
    return file.getvalue()


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    coarse = np.random.default_rng(0).random((20, HEIGHT // 8, WIDTH // 8, 3))
    return np.rint(255 * coarse.repeat(8, 1).repeat(8, 2)).astype(np.float32) / 255


@pytest.mark.parametrize(
    ("container", "codec", "pixels"),
    [
        ("matroska", "ffv1", "bgr0"),
        ("mpegts", "libx264", "yuv420p"),
        ("yuv4mpegpipe", "wrapped_avframe", "yuv444p"),
        ("mjpeg", "mjpeg", "yuvj444p"),
    ],
)
def test_a_pipe_is_restored_as_a_file_is(model, tmp_path, frames, container, codec, pixels):
    stream = encoded(container, codec, pixels, frames)
    done = subprocess.run(
        command("-", "-o", tmp_path / "out.mkv", "--model", model), input=stream, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert b"20 frames of 64x48" in done.stdout
    (tmp_path / "in.mkv").write_bytes(encoded("matroska", "ffv1", "bgr0", frames))
    assert subprocess.run(command(tmp_path / "in.mkv", "-o", tmp_path / "file.mkv", "--model", model)).returncode == 0
    restored, expected = (read_clip(tmp_path / name)[0] for name in ("out.mkv", "file.mkv"))
    assert restored.shape == expected.shape
    error = float(np.abs(restored - expected).mean())
    assert error <= (0 if codec == "ffv1" else 0.05)


def test_from_pipe_to_pipe_with_sound(model, tmp_path, frames):
    stream = encoded("matroska", "ffv1", "bgr0", frames, sound=True)
    done = subprocess.run(command("-", "-o", "-", "--model", model), input=stream, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert b"-: 20 frames of 64x48" in done.stderr
    with av.open(io.BytesIO(done.stdout)) as container:
        assert container.format.name == "matroska,webm"
        assert sum(packet.size > 0 for packet in container.demux(audio=0)) == 5
    (tmp_path / "out.mkv").write_bytes(done.stdout)
    (tmp_path / "in.mkv").write_bytes(stream)
    subprocess.run(command(tmp_path / "in.mkv", "-o", tmp_path / "file.mkv", "--model", model, "--quiet"), check=True)
    np.testing.assert_array_equal(read_clip(tmp_path / "out.mkv")[0], read_clip(tmp_path / "file.mkv")[0])


def test_a_named_pipe(model, tmp_path, frames):
    os.mkfifo(tmp_path / "pipe")
    stream = encoded("matroska", "ffv1", "bgr0", frames)
    writer = threading.Thread(target=(tmp_path / "pipe").write_bytes, args=[stream])
    writer.start()
    done = subprocess.run(command(tmp_path / "pipe", "-o", tmp_path / "out.mkv", "--model", model), check=False)
    writer.join()
    assert done.returncode == 0
    assert len(read_clip(tmp_path / "out.mkv")[0]) == 20


def test_a_pipe_that_breaks_off_ends_the_clip(model, tmp_path, frames):
    """The last picture cannot be decoded and is passed over."""
    stream = b"".join(y4m(range(20)))[:-100]
    target = tmp_path / "out.mkv"
    done = subprocess.run(command("-", "-o", target, "--model", model), input=stream, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr
    assert len(read_clip(target)[0]) == 19


@pytest.mark.parametrize(
    ("arguments", "stream", "says"),
    [
        ("- -o out.mkv", b"", "cannot read standard input"),
        ("- -o out.mkv", b"no video" * 1000, "cannot read standard input: no video that can be read as it comes"),
        ("- -o out.xyz", b"".join(y4m(range(3))), "unknown kind"),
        ("- -o out.mkv --crop 0,0,99,99", b"".join(y4m(range(3))), "does not lie inside -"),
    ],
)
def test_bad_streams_are_one_line(model, tmp_path, arguments, stream, says):
    words = [*arguments.split(), "--model", model]
    done = subprocess.run(command(*words), input=stream, cwd=tmp_path, capture_output=True, check=False)
    assert done.returncode == 2
    assert done.stderr.count(b"\n") == 1, done.stderr
    assert says in done.stderr.decode()
    assert list(tmp_path.iterdir()) == []


def test_an_mp4_whose_index_comes_last_cannot_be_piped(model, tmp_path):
    """But for a short one, that FFmpeg holds whole."""
    write_clip(tmp_path / "clip.mp4", np.random.default_rng(0).random((8, 256, 256, 3), np.float32))
    stream = (tmp_path / "clip.mp4").read_bytes()
    words = command("-", "-o", tmp_path / "out.mkv", "--model", model)
    done = subprocess.run(words, input=stream, capture_output=True, check=False)
    assert done.returncode == 2
    assert done.stderr.decode().endswith("Matroska can, an .mp4 only if its index is first\n")
    assert [path.name for path in tmp_path.iterdir()] == ["clip.mp4"]


def test_ctrl_c_ends_an_endless_clip_and_it_is_whole(model, tmp_path):
    process = subprocess.Popen(
        command("-", "-o", tmp_path / "out.mp4", "--model", model), stdin=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdin
    written = 0
    with suppress(BrokenPipeError), process.stdin as pipe:
        for frame in y4m(count()):
            pipe.write(frame)
            written += 1
            if written == 200:
                process.send_signal(signal.SIGINT)
    assert process.stderr
    with process.stderr as errors:
        assert errors.read() == b""
    assert process.wait(60) == 0
    restored, _ = read_clip(tmp_path / "out.mp4")
    assert 100 < len(restored) <= written
    levels = restored.mean((1, 2, 3))
    np.testing.assert_allclose(levels, np.arange(len(restored)) % 256 / 255, atol=0.35)  # blended where 256 wraps
    np.testing.assert_allclose(levels[:200], np.arange(len(levels[:200])) / 255, atol=0.02)
    assert [entry.name for entry in tmp_path.iterdir()] == ["out.mp4"]


def test_ctrl_c_ends_a_silent_pipe(model, tmp_path):
    process = subprocess.Popen(command("-", "-o", tmp_path / "out.mkv", "--model", model), stdin=subprocess.PIPE)
    assert process.stdin
    with process.stdin as pipe:
        for frame in y4m(range(200)):
            pipe.write(frame)
        pipe.flush()  # returns when all but what the pipe itself holds has been read
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    assert len(read_clip(tmp_path / "out.mkv")[0]) > 100


def peak_memory(model, frames: int, target) -> float:
    """KiB, of a process that restores a pipe of so many frames."""
    words = command("-", "-o", target, "--model", model, "--quiet", "--threads", 1)
    done, peak = run_measured(words, input=b"".join(y4m(range(frames))))
    assert done.returncode == 0
    return peak * 2**20


def test_memory_does_not_depend_on_length(model, tmp_path):
    """1700 frames of 64 x 48 pixels would be 60 MiB."""
    short, long = (peak_memory(model, frames, tmp_path / f"{frames}.mkv") for frames in (300, 2000))
    assert long - short < 8 * 1024


def test_a_pipe_and_a_file_of_the_same_frames(tmp_path, frames):
    """Reading without restoring: times, rate and pixels are those of the file."""
    write_clip(tmp_path / "in.mkv", frames, fps=30)
    os.mkfifo(tmp_path / "pipe")
    writer = threading.Thread(target=lambda: (tmp_path / "pipe").write_bytes((tmp_path / "in.mkv").read_bytes()))
    writer.start()
    piped, info = read_clip(tmp_path / "pipe")
    writer.join()
    expected, declared = read_clip(tmp_path / "in.mkv")
    np.testing.assert_array_equal(piped, expected)
    assert (info.fps, info.tick, info.grey) == (declared.fps, declared.tick, declared.grey)
