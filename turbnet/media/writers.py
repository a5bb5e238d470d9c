"""Clips out, the kind told by the extension; a clip appears whole or not at all.

| extension | what is written |
|---|---|
| .mp4 .mov | H.264, crf 16, BT.709; yuv420p for even sizes, yuv444p for odd ones, so no pixel is lost |
| .mkv .avi | FFV1, lossless at 8 bits |
| .gif | 256 colours a frame, chosen anew for each; durations are whole hundredths of a second |
| .tif .tiff | one page a frame, 16 bits a channel, uncompressed |
| .png .jpg .bmp .webp | one frame, 8 bits a channel |
| none | a folder of PNG files, 000000.png, 000001.png, ... |
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
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

Pixels = NDArray[Any]

_BT709 = 1
_TIFF_PAGE = 4096  # bytes a page's directory takes at most
_JPEG = {"quality": 95, "subsampling": 0}
_LUMA = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)


class Encoder(Protocol):
    """Takes float32 frames in [0, 1], (H, W, 3), or (H, W) where grey."""

    def write(self, frame: Pixels) -> None: ...

    def close(self) -> None: ...


@dataclass(frozen=True)
class Layout:
    """What a clip's header says, and how many threads write it; as in `open_writer`."""

    fps: float
    grey: bool
    threads: int | None


class ClipWriter:
    """Takes the frames of one clip in order."""

    def __init__(self, path: Path, encoder: Encoder, grey: bool) -> None:
        self.path = path
        self.frames = 0
        self._encoder = encoder
        self._grey = grey
        self._shape: tuple[int, ...] | None = None

    def write(self, frame_HWC: NDArray[np.floating[Any]]) -> None:
        """Append a frame (H, W, 3), clipped to [0, 1].

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
            self._encoder.write(frame @ _LUMA if self._grey else frame)
        self.frames += 1


@contextmanager
def open_writer(
    path: str | Path, fps: float = 25.0, grey: bool = False, threads: int | None = None
) -> Iterator[ClipWriter]:
    """Write a clip frame by frame: `with open_writer(path) as writer: writer.write(frame)`.

    Args:
        path: the extension tells the kind, see the module.
        fps: frames per second, 0.01 to 1000.
        grey: store the Rec. 709 luma in one channel where the kind has one (all but .mp4, .mov and .webp).
        threads: of a video's encoder; None: as many as the encoder likes.

    Raises:
        InputError: unknown extension, an output that cannot be written, no frame, or several frames for a still.
            Whatever is raised inside the with-block, nothing is left behind.
    """
    path = Path(path)
    encoder_of = _encoder_of(path)
    check_range("fps", fps, 0.01, 1000.0)
    with atomic_path(path) as temporary:
        with _writing(path):
            encoder = encoder_of(temporary, Layout(fps, grey, threads))
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

    def write(self, frame: Pixels) -> None:
        Image.fromarray(_quantised(frame)).save(self.path / f"{self.count:06d}.png", compress_level=3)
        self.count += 1

    def close(self) -> None:
        pass


class _Still:
    def __init__(self, path: Path, layout: Layout) -> None:
        self.path, self.written = path, False

    def write(self, frame: Pixels) -> None:
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

    def write(self, frame: Pixels) -> None:
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
        self.duration = max(10, 10 * round(100.0 / layout.fps))
        self.started = False

    def write(self, frame: Pixels) -> None:
        image = Image.fromarray(_quantised(frame))
        image = image if image.mode == "L" else image.quantize(256)
        if not self.started:
            header, _ = GifImagePlugin.getheader(image.copy(), info={"loop": 0, "optimize": False})
            self.file.writelines(header)
            self.started = True
        data = GifImagePlugin.getdata(image, duration=self.duration, include_color_table=True)
        self.file.writelines(data)

    def close(self) -> None:
        with self.file:
            if self.started:
                self.file.write(b";")


class _Video(ABC):
    """A codec says how its stream is set up and how a picture becomes its frame."""

    def __init__(self, path: Path, layout: Layout) -> None:
        self.container = av.open(str(path), "w")
        self.rate = Fraction(layout.fps).limit_denominator(60_060)
        self.grey, self.threads = layout.grey, layout.threads
        self.count = 0
        self.stream: Any = None

    @abstractmethod
    def open_stream(self, height: int, width: int) -> Any:
        """The stream, set up for pictures of this size."""

    @abstractmethod
    def frame(self, pixels: NDArray[np.uint8]) -> av.VideoFrame:
        """A picture as the codec wants it."""

    def write(self, frame: Pixels) -> None:
        if self.stream is None:
            self.stream = self.open_stream(*frame.shape[:2])
            self.stream.codec_context.thread_count = self.threads or 0
        encoded = self.frame(_quantised(frame))
        encoded.pts, encoded.time_base = self.count, 1 / self.rate
        self.count += 1
        self.container.mux(self.stream.encode(encoded))

    def close(self) -> None:
        if self.stream is not None:
            self.container.mux(self.stream.encode(None))
        self.container.close()


class _H264(_Video):
    def open_stream(self, height: int, width: int) -> Any:
        stream = self.container.add_stream("libx264", rate=self.rate, options={"crf": "16"})
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
        stream = self.container.add_stream("ffv1", rate=self.rate, options={"level": "3", "slicecrc": "1"})
        stream.width, stream.height = width, height
        stream.pix_fmt = "gray" if self.grey else "bgr0"
        return stream

    def frame(self, pixels: NDArray[np.uint8]) -> av.VideoFrame:
        if self.grey:
            return av.VideoFrame.from_ndarray(pixels, "gray")
        return av.VideoFrame.from_ndarray(pixels, "rgb24").reformat(format="bgr0", threads=1)


_ENCODERS: dict[str, Callable[[Path, Layout], Encoder]] = {
    ".mp4": _H264,
    ".mov": _H264,
    ".mkv": _Ffv1,
    ".avi": _Ffv1,
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
