"""Video files, pipes and cameras, decoded by FFmpeg."""

import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import Interpolation

from turbnet.errors import InputError
from turbnet.media.guard import LARGEST, check_size, reading
from turbnet.media.live import STANDARD, open_live
from turbnet.media.sound import Sound, start_of
from turbnet.media.source import DEFAULT_FPS, ClipInfo, Frame, Source, TimedFrame, as_frame

# FFmpeg's fast conversion of subsampled colour darkens a picture by a level; this one is unbiased.
_ACCURATE = (
    Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT | Interpolation.FULL_CHR_H_INP
)
# Containers of one file each, and no protocol but files: a playlist named clip.mp4 reads nothing else.
_ALONE = {
    "format_whitelist": "mov,avi,matroska,mpeg,mpegvideo,mpegts,asf,flv,ogg,png_pipe",
    "protocol_whitelist": "file",
}


def open_video(path: Path, threads: int | None) -> Source:
    """A video file."""
    with reading(path), open_container(path) as container:
        stream = _video_stream(container, path, threads)
        frame = next(container.decode(stream), None)
        if frame is None:
            raise InputError(f"{path} holds no video frame")
        height, width = (frame.width, frame.height) if frame.rotation % 180 else (frame.height, frame.width)
        rate = stream.average_rate or stream.guessed_rate
        fps = float(rate or DEFAULT_FPS)
        info = ClipInfo(stream.frames or None, height, width, fps, _is_grey_video(stream), stream.time_base)

    def frames() -> Iterator[TimedFrame]:
        with reading(path), open_container(path) as container:
            yield from _decode(container, path, threads)

    return Source(info, frames, lambda: _sound(path))


@contextmanager
def _sound(path: Path) -> Iterator[Sound | None]:
    with reading(path):
        container = open_container(path)
    with container:
        yield Sound(container, _sound_packets(container, path)) if container.streams.audio else None


def _sound_packets(container: Any, path: Path) -> Iterator[Any]:
    with reading(path):
        for packet in container.demux(container.streams.audio):
            if packet.dts is not None:  # but for the empty one at the end
                yield packet


def open_live_video(path: Path, threads: int | None, ended: Callable[[], bool]) -> Source:
    """A pipe or a camera, which can be passed over once."""
    name = Path("standard input") if path == STANDARD else path
    try:
        with reading(name):
            container = open_live(path, ended)
            stream = _video_stream(container, name, threads)
            sound = Sound(container) if container.streams.audio else None
            following = _decode_live(container, sound, name, threads, ended)
            first = next(following, None)
    except InputError as error:
        if isinstance(error.__cause__, av.InvalidDataError):
            raise InputError(
                f"cannot read {name}: no video that can be read as it comes; "
                "Matroska can, an .mp4 only if its index is first"
            ) from error
        raise
    if first is None:
        raise InputError(f"{name} holds no video frame")
    height, width = first[1].shape[:2]
    rate = stream.average_rate or stream.guessed_rate
    info = ClipInfo(None, height, width, float(rate or DEFAULT_FPS), _is_grey_video(stream), stream.time_base)
    heard = False

    def listen() -> AbstractContextManager[Sound | None]:
        nonlocal heard
        heard = True
        return nullcontext(sound)

    def frames() -> Iterator[TimedFrame]:
        if sound and not heard:
            sound.mute()
        yield first
        yield from following

    return Source(info, frames, listen)


def _decode_live(
    container: Any, sound: Sound | None, path: Path, threads: int | None, ended: Callable[[], bool]
) -> Iterator[TimedFrame]:
    stream, start = _video_stream(container, path, threads), start_of(container)
    with reading(path), container:
        for packet in container.demux([stream, *container.streams.audio]):
            if ended():
                return
            if sound and packet.stream_index != stream.index:
                if packet.dts is not None:  # but for the empty one at the end
                    sound.waiting.append(packet)
                continue
            with suppress(av.FFmpegError):
                for frame in packet.decode():
                    yield _video_time(frame, start), _video_pixels(frame, path)


def _is_grey_video(stream: Any) -> bool:
    return (stream.codec_context.pix_fmt or "").startswith("gray")


def open_container(path: Path) -> Any:
    """A container of one file, by FFmpeg."""
    # An absolute name, so that FFmpeg never takes what precedes a colon for a protocol.
    return av.open(str(path.absolute()), options=_ALONE)


def _video_stream(container: Any, path: Path, threads: int | None) -> Any:
    if not container.streams.video:
        raise InputError(f"{path} holds no video")
    stream = container.streams.video[0]
    check_size(path, stream.height, stream.width)
    stream.codec_context.options = {"max_pixels": str(LARGEST)}  # pictures may be larger than the container says
    stream.thread_type = "AUTO"
    stream.codec_context.thread_count = threads or 0  # FFmpeg's 0 is all cores
    return stream


def _decode(container: Any, path: Path, threads: int | None) -> Iterator[TimedFrame]:
    stream, start = _video_stream(container, path, threads), start_of(container)
    interval = 1 / float(stream.average_rate or DEFAULT_FPS)
    packets, count, end = 0, 0, 0.0
    for packet in container.demux(stream):
        packets += packet.size > 0
        for frame in packet.decode():
            if packet.is_corrupt or frame.is_corrupt:
                raise InputError(f"{path} is damaged near frame {count}")
            count += 1
            end = max(end, (frame.time or 0.0) + interval)
            yield _video_time(frame, start), _video_pixels(frame, path)
    if packets < stream.frames:
        raise InputError(f"{path} is truncated: its header says {stream.frames} frames, {packets} are there")
    duration = _declared_duration(container, stream)
    if not stream.frames and end < duration - max(2 * interval, 0.1):
        raise InputError(f"{path} is truncated: its header says {duration:.1f} s, its frames end at {end:.1f} s")


def _declared_duration(container: Any, stream: Any) -> float:
    """Seconds of video the header declares; 0 if it declares none, or only one that other streams share."""
    tag = re.fullmatch(r"(\d+):(\d+):(\d+\.?\d*)", stream.metadata.get("DURATION", ""))
    if tag:
        return int(tag[1]) * 3600 + int(tag[2]) * 60 + float(tag[3])
    if stream.duration:
        return float(stream.duration * stream.time_base)
    return container.duration / av.time_base if container.duration and len(container.streams) == 1 else 0.0


def _video_time(frame: Any, start: Fraction) -> Fraction | None:
    return None if frame.pts is None else frame.pts * frame.time_base - start


def _video_pixels(frame: Any, path: Path) -> Frame:
    # On one thread: PyAV would start new ones for each frame.
    bits = max(component.bits for component in frame.format.components)
    if frame.format.name == "gray":
        pixels = frame.to_ndarray()
    elif bits <= 8:
        pixels = frame.reformat(format="rgb24", interpolation=_ACCURATE, threads=1).to_ndarray()
    else:
        # FFmpeg brings deep YUV's white to 255 * 256, and n bits of grey by a shift to the upper end of 16.
        yuv = len(frame.format.components) > 1 and not frame.format.is_rgb
        shifted = ((1 << bits) - 1) << (16 - bits) if frame.format.name.startswith("gray") else 65535
        white = np.float32(255 * 256 if yuv else shifted)
        pixels = frame.reformat(format="rgb48le", interpolation=_ACCURATE, threads=1).to_ndarray()
        pixels = np.minimum(pixels / white, np.float32(1))
    # A display rotation counts anticlockwise, as NumPy's does.
    return as_frame(np.rot90(pixels, frame.rotation // 90), path)
