"""Clips out, the kind told by the extension; a clip appears whole or not at all, but for standard output.

| extension | what is written |
|---|---|
| .mp4 .mov | H.264, crf 16, BT.709; yuv420p for even sizes, yuv444p for odd ones, so no pixel is lost |
| .mkv .avi | FFV1, lossless at 8 bits; .avi at a constant rate and without sound |
| .gif | 256 colours a frame, chosen anew for each; durations are whole hundredths of a second |
| .tif .tiff | one page a frame, 16 bits a channel, uncompressed |
| .png .jpg .bmp .webp | one frame, 8 bits a channel |
| none | a folder of PNG files, 000000.png, 000001.png, ... |
| the name - | standard output: FFV1 in Matroska, as a stream |

The same frames give the same bytes, each time.
"""

import math
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, Interpolation
from numpy.typing import NDArray
from PIL import GifImagePlugin, Image

from turbnet.errors import InputError, check_range
from turbnet.media.atomic import atomic_path
from turbnet.media.live import STANDARD
from turbnet.media.sound import Sound

Pixels = NDArray[Any]

_BT709 = 1
_TIFF_PAGE = 4096  # bytes a page's directory takes at most
_JPEG = {"quality": 95, "subsampling": 0}
_LUMA = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)


class Encoder(Protocol):
    """Takes float32 frames in [0, 1], (H, W, 3), or (H, W) where grey, and their times, s; None: as the rate says."""

    def write(self, frame: Pixels, time: Fraction | None) -> None: ...

    def close(self) -> None: ...


@dataclass(frozen=True)
class Layout:
    """What a clip's header says, what goes beside its frames and how many threads write it; as in `open_writer`."""

    fps: float
    grey: bool
    threads: int | None
    tick: Fraction | None
    sound: Sound | None


class ClipWriter:
    """Takes the frames of one clip in order."""

    def __init__(self, path: Path, encoder: Encoder, grey: bool) -> None:
        self.path = path
        self.frames = 0
        self._encoder = encoder
        self._grey = grey
        self._shape: tuple[int, ...] | None = None

    def write(self, frame_HWC: NDArray[np.floating[Any]], time: Fraction | None = None) -> None:
        """Append a frame (H, W, 3), clipped to [0, 1], shown from `time` on, s; None: as the rate says.

        Raises:
            InputError: the frame holds NaN, has another size than the first, or cannot be written.
        """
        if frame_HWC.ndim != 3 or frame_HWC.shape[2] != 3:
            raise InputError(f"cannot write {self.path}: a frame of shape {frame_HWC.shape} is not (H, W, 3)")
        self._shape = self._shape or frame_HWC.shape
        if frame_HWC.shape != self._shape:
            raise InputError(
                f"cannot write {self.path}: frame {self.frames} has shape {frame_HWC.shape}, the first {self._shape}"
            )
        if np.isnan(frame_HWC).any():
            raise InputError(f"cannot write {self.path}: frame {self.frames} holds NaN")
        frame = np.clip(frame_HWC, 0.0, 1.0).astype(np.float32, copy=False)
        with _writing(self.path):
            self._encoder.write(frame @ _LUMA if self._grey else frame, time)
        self.frames += 1


@contextmanager
def open_writer(
    path: str | Path,
    fps: float = 25.0,
    grey: bool = False,
    threads: int | None = None,
    tick: Fraction | None = None,
    sound: Sound | None = None,
    within: Path | None = None,
) -> Iterator[ClipWriter]:
    """Write a clip frame by frame: `with open_writer(path) as writer: writer.write(frame)`.

    Args:
        path: the extension tells the kind, see the module; `-` is standard output.
        fps: frames per second, 0.01 to 1000.
        grey: store the Rec. 709 luma in one channel where the kind has one (all but .mp4, .mov and .webp).
        threads: of a video's encoder; None: as many as the encoder likes.
        tick: seconds, of which the times given with the frames are multiples.
        sound: to copy where the kind takes it, see `Sound.left_out`.
        within: folder on the same disk where the clip lies until it is whole; None: beside `path`.

    Raises:
        InputError: unknown extension, an output that cannot be written, no frame, or several frames for a still.
            Whatever is raised inside the with-block, nothing is left behind.
    """
    path = Path(path)
    encoder_of = _encoder_of(path)
    check_range("fps", fps, 0.01, 1000.0)
    if sound and path.suffix.lower() not in _WITH_SOUND and path != STANDARD:
        sound.mute()
        sound = None
    with nullcontext(path) if path == STANDARD else atomic_path(path, within) as temporary:
        with _writing(path):
            encoder = encoder_of(temporary, Layout(fps, grey, threads, tick, sound))
        writer = ClipWriter(path, encoder, grey)
        try:
            yield writer
        except BaseException:
            with suppress(Exception):
                encoder.close()
            raise
        if writer.frames == 0:
            with suppress(Exception):
                encoder.close()
            raise InputError(f"cannot write {path}: there are no frames")
        with _writing(path):
            encoder.close()


def write_clip(
    path: str | Path, frames_THWC: Iterable[NDArray[np.floating[Any]]], fps: float = 25.0, grey: bool = False
) -> None:
    """Write frames (T, H, W, 3), or any iterable of (H, W, 3). Arguments and errors as `open_writer`."""
    with open_writer(path, fps, grey) as writer:
        for frame in frames_THWC:
            writer.write(frame)


def _encoder_of(path: Path) -> Callable[[Path, Layout], Encoder]:
    if path == STANDARD:
        if sys.stdout.isatty():
            raise InputError("standard output is a terminal; pipe it into something, or name a file")
        return _StandardOutput
    extension = path.suffix.lower()
    if extension not in _ENCODERS:
        known = ", ".join(name for name in _ENCODERS if name)
        raise InputError(f"cannot write {path}: unknown kind {extension!r}; use {known}, or no extension for a folder")
    return _ENCODERS[extension]


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, av.FFmpegError) as error:
        # A short write of NumPy's carries no error number.
        raise InputError(f"cannot write {path}: {error.strerror or f'{error}; is the disk full?'}") from error


def _quantised(frame: Pixels) -> NDArray[np.uint8]:
    return np.rint(frame * 255.0).astype(np.uint8)


class _Folder:
    def __init__(self, path: Path, layout: Layout) -> None:
        self.path, self.count = path, 0
        path.mkdir()

    def write(self, frame: Pixels, time: Fraction | None) -> None:
        Image.fromarray(_quantised(frame)).save(self.path / f"{self.count:06d}.png", compress_level=3)
        self.count += 1

    def close(self) -> None:
        pass


class _Still:
    def __init__(self, path: Path, layout: Layout) -> None:
        self.path, self.written = path, False

    def write(self, frame: Pixels, time: Fraction | None) -> None:
        if self.written:
            raise InputError(
                f"a {self.path.suffix} file holds one frame; for several choose a video, or no extension for a folder"
            )
        self.written = True
        options: dict[str, dict[str, Any]] = {".webp": {"lossless": True}, ".jpg": _JPEG, ".jpeg": _JPEG}
        Image.fromarray(_quantised(frame)).save(self.path, **options.get(self.path.suffix.lower(), {}))

    def close(self) -> None:
        pass


class _Tiff:
    def __init__(self, path: Path, layout: Layout) -> None:
        import tifffile  # as in the readers

        self.writer = tifffile.TiffWriter(path)
        self.photometric = "minisblack" if layout.grey else "rgb"
        self.bytes = 0

    def write(self, frame: Pixels, time: Fraction | None) -> None:
        pixels = np.rint(frame * 65535.0).astype(np.uint16)
        self.bytes += pixels.nbytes + _TIFF_PAGE
        if self.bytes >= 2**32:
            raise InputError("a TIFF holds no more than 4 GiB; write .mkv or a folder")
        self.writer.write(pixels, photometric=self.photometric, contiguous=False, metadata=None)

    def close(self) -> None:
        self.writer.close()


class _Gif:
    """Pillow's own multi-frame saving merges equal neighbours and holds the clip in memory; this does neither."""

    def __init__(self, path: Path, layout: Layout) -> None:
        self.file = path.open("wb")
        self.duration = max(1, round(100.0 / layout.fps))  # hundredths of a second, as everything here
        self.shown: Image.Image | None = None
        self.since = 0

    def write(self, frame: Pixels, time: Fraction | None) -> None:
        image = Image.fromarray(_quantised(frame))
        image = image if image.mode == "L" else image.quantize(256)
        if self.shown is None:
            header, _ = GifImagePlugin.getheader(image.copy(), info={"loop": 0, "optimize": False})
            self.file.writelines(header)
            self.since = 0 if time is None else round(100 * time)
        else:
            end = self.since + self.duration if time is None else max(round(100 * time), self.since + 1)
            self._put(self.shown, end)
        self.shown = image

    def _put(self, image: Image.Image, end: int) -> None:
        """A frame's duration comes before its pixels, so it is written when the next one is known."""
        data = GifImagePlugin.getdata(image, duration=10 * (end - self.since), include_color_table=True)
        self.file.writelines(data)
        self.since = end

    def close(self) -> None:
        with self.file:
            if self.shown is not None:
                self._put(self.shown, self.since + self.duration)
                self.file.write(b";")


class _Video(ABC):
    """A codec says how its stream is set up and how a picture becomes its frame."""

    def __init__(self, path: Path, layout: Layout) -> None:
        self.container = self.open_container(path)
        self.rate = Fraction(layout.fps).limit_denominator(60_060)
        self.tick = layout.tick
        self.clock = _clock(1 / self.rate, self.tick)
        self.grey, self.threads, self.sound = layout.grey, layout.threads, layout.sound
        self.pts = -1
        self.stream: Any = None
        self.tracks: dict[int, Any] = {}

    def open_container(self, path: Path) -> Any:
        """Without what differs from one time to the next."""
        return av.open(str(path), "w", container_options={"fflags": "+bitexact"})

    @abstractmethod
    def open_stream(self, height: int, width: int) -> Any:
        """The stream, set up for pictures of this size."""

    @abstractmethod
    def frame(self, pixels: NDArray[np.uint8]) -> av.VideoFrame:
        """A picture as the codec wants it."""

    def write(self, frame: Pixels, time: Fraction | None) -> None:
        if self.stream is None:
            self.stream = self.open_stream(*frame.shape[:2])
            self.stream.codec_context.thread_count = self.threads or 0
            self._open_tracks()
        encoded = self.frame(_quantised(frame))
        interval = round(1 / self.rate / self.clock)
        if time is None:
            self.pts = 0 if self.pts < 0 else self.pts + interval
        else:
            self.pts = max(round(self._regular(time) / self.clock), self.pts + 1)
        encoded.pts, encoded.duration, encoded.time_base = self.pts, interval, self.clock
        self.container.mux(self.stream.encode(encoded))
        self._copy_sound(self.pts * self.clock)

    def _regular(self, time: Fraction) -> Fraction:
        """A container rounds times to its ticks: one within half a tick of a multiple of 1/rate is that multiple."""
        multiple = round(time * self.rate) / self.rate
        exact = self.tick is not None and 2 * abs(multiple - time) < self.tick
        return multiple if exact else time

    def _open_tracks(self) -> None:
        if self.sound is None:
            return
        for stream in self.sound.streams:
            with suppress(ValueError):  # the container does not take the codec
                self.tracks[stream.index] = self.container.add_stream_from_template(stream)
                del self.sound.left_out[stream.index]

    def _copy_sound(self, until: float | Fraction) -> None:
        if self.sound is None:
            return
        for packet in self.sound.until(until):
            if packet.stream_index in self.tracks:
                packet.stream = self.tracks[packet.stream_index]
                self.container.mux(packet)

    def close(self) -> None:
        if self.stream is not None:
            self.container.mux(self.stream.encode(None))
            self._copy_sound(math.inf)
        self.container.close()


def _clock(interval: Fraction, tick: Fraction | None) -> Fraction:
    """The time base, s, in which multiples of the interval and of the tick are whole, as far as 32 bits reach."""
    if tick is None:
        return interval
    common = Fraction(
        math.gcd(interval.numerator * tick.denominator, tick.numerator * interval.denominator),
        interval.denominator * tick.denominator,
    )
    return common if common.denominator < 2**30 else tick


def _x264() -> dict[str, str]:
    """Where there is AVX-512, x264 looks ahead (mb-tree) a little otherwise each time; with AVX2, as fast, it does not."""
    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    return {"x264-params": "asm=avx2"} if any(name.startswith(("AVX512", "X86_V4")) for name in found) else {}


class _H264(_Video):
    def open_stream(self, height: int, width: int) -> Any:
        options = {"crf": "16", **_x264()}
        stream = self.container.add_stream("libx264", rate=self.rate, time_base=self.clock, options=options)
        stream.width, stream.height = width, height
        stream.pix_fmt = "yuv420p" if height % 2 == width % 2 == 0 else "yuv444p"
        context = stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = _BT709
        context.color_range = ColorRange.MPEG
        return stream

    def frame(self, pixels: NDArray[np.uint8]) -> av.VideoFrame:
        rgb = np.repeat(pixels[..., None], 3, axis=-1) if pixels.ndim == 2 else pixels
        return av.VideoFrame.from_ndarray(rgb, "rgb24").reformat(
            format=self.stream.pix_fmt,
            dst_colorspace=Colorspace.ITU709,
            dst_color_range=ColorRange.MPEG,
            interpolation=Interpolation.BICUBIC | Interpolation.ACCURATE_RND,
            threads=1,  # as in the readers
        )


class _Ffv1(_Video):
    def open_stream(self, height: int, width: int) -> Any:
        options = {"level": "3", "slicecrc": "1"}
        stream = self.container.add_stream("ffv1", rate=self.rate, time_base=self.clock, options=options)
        stream.width, stream.height = width, height
        stream.pix_fmt = "gray" if self.grey else "bgr0"
        return stream

    def frame(self, pixels: NDArray[np.uint8]) -> av.VideoFrame:
        if self.grey:
            return av.VideoFrame.from_ndarray(pixels, "gray")
        return av.VideoFrame.from_ndarray(pixels, "rgb24").reformat(format="bgr0", threads=1)


class _Avi(_Ffv1):
    def __init__(self, path: Path, layout: Layout) -> None:
        super().__init__(path, replace(layout, tick=None))

    def write(self, frame: Pixels, time: Fraction | None) -> None:
        super().write(frame, None)


class _StandardOutput(_Ffv1):
    def open_container(self, path: Path) -> Any:
        options = {"fflags": "+bitexact", "flush_packets": "1"}
        return av.open(f"pipe:{sys.stdout.fileno()}", "w", format="matroska", container_options=options)


_WITH_SOUND = {".mp4", ".mov", ".mkv"}
_ENCODERS: dict[str, Callable[[Path, Layout], Encoder]] = {
    ".mp4": _H264,
    ".mov": _H264,
    ".mkv": _Ffv1,
    ".avi": _Avi,
    ".gif": _Gif,
    ".tif": _Tiff,
    ".tiff": _Tiff,
    ".png": _Still,
    ".jpg": _Still,
    ".jpeg": _Still,
    ".bmp": _Still,
    ".webp": _Still,
    "": _Folder,
}
