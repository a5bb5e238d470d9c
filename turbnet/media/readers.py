"""Every kind of clip as a stream of float32 frames (H, W, 3), RGB in [0, 1], sRGB-encoded as stored.

A reader gives a `Source`: what the header says, and a function that starts a fresh pass over the frames, one frame in
memory at a time. Broken files raise InputError, at the latest when the pass comes to the broken place:

- A still, a folder, a GIF or a TIFF that cannot be decoded to its end.
- A video whose decoder reports or conceals damage in a frame, or that ends before the frame count (MP4, MOV, AVI) or
  the duration (MKV, WebM, FLV; give or take two frames) that its header declares. A container that declares neither
  (MPEG, TS) is taken as it is.

Damage that decodes to a valid picture, as within uncompressed pixels or VP8, cannot be told from the picture.

Decoders meet damaged files with whatever exception the damage leads to, hence the broad net in `_reading`.
"""

import logging
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
import tifffile
from av.video.reformatter import Interpolation
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from turbnet.errors import InputError

Frame = NDArray[np.float32]

IMAGES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"}
VIDEOS = {".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".mts", ".wmv", ".flv", ".ogv"}
DEFAULT_FPS = 25.0

# Filtering overshoots white by a little; twice white means that another scale was used.
LARGEST = 2.0
# FFmpeg's fast conversion of subsampled colour darkens a picture by a level; this one is unbiased.
_ACCURATE = (
    Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT | Interpolation.FULL_CHR_H_INP
)
_GREY_MODES = {"1", "L", "LA", "La", "F", "I", "I;16", "I;16L", "I;16B", "I;16N"}


@dataclass(frozen=True)
class ClipInfo:
    """What a clip's header says: `frames` (None: not declared), pixels, frames per second, stored in one channel."""

    frames: int | None
    height: int
    width: int
    fps: float
    grey: bool


@dataclass(frozen=True)
class Source:
    """A clip's header and a function that starts a pass over its frames."""

    info: ClipInfo
    frames: Callable[[], Iterator[Frame]]


def open_source(path: Path) -> Source:
    """The reader for `path`: a folder or a pattern of images, a file known by its first bytes or, a video, by its name."""
    if path.is_dir():
        return _folder(path)
    if not path.exists() and any(sign in path.name for sign in "*?["):
        return _sequence([picture for picture in path.parent.glob(path.name) if picture.is_file()], path)
    if not path.exists():
        raise InputError(f"there is no file or folder {path}")
    if path.stat().st_size == 0:
        raise InputError(f"{path} is empty (0 bytes)")
    kind = _image_kind(path)
    if kind == "tiff":
        return _tiff(path)
    if kind:
        return _pillow(path)
    if path.suffix.lower() in VIDEOS:
        return _video(path)
    if path.suffix.lower() in IMAGES | {".gif"}:
        raise InputError(f"cannot read {path}: its content is not an image")
    raise InputError(
        f"cannot read {path}: not a kind of file turbnet knows; give an image, a folder of images, a GIF, a TIFF "
        f"or a video ({', '.join(sorted(VIDEOS))})"
    )


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise InputError(f"cannot read {path}: {' '.join(reason.split())}") from error


def _image_kind(path: Path) -> str | None:
    with _reading(path):
        start = _bytes_at(path, 0, 16)
    if start[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return "tiff"
    known = start.startswith((b"\x89PNG", b"\xff\xd8\xff", b"BM", b"GIF8"))
    return "pillow" if known or (start[:4] == b"RIFF" and start[8:12] == b"WEBP") else None


def _rgb(pixels: NDArray[Any], path: Path) -> Frame:
    """Integers scaled by their largest value, floats as they are; one channel repeated, alpha laid over black."""
    if pixels.dtype == np.bool_:
        pixels = pixels.astype(np.float32)
    elif pixels.dtype.kind == "u":
        pixels = pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)
    elif pixels.dtype.kind != "f":
        raise InputError(f"cannot read {path}: pixels of type {pixels.dtype} have no known white level")
    elif not np.isfinite(pixels).all():
        raise InputError(f"{path} holds NaN or infinite pixels")
    elif np.abs(pixels).max() > LARGEST:
        raise InputError(f"{path} holds values up to {np.abs(pixels).max():g}; scale floating-point pixels to 0 to 1")
    pixels = pixels.astype(np.float32, copy=False)
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    if pixels.shape[-1] in (2, 4):
        pixels = pixels[..., :-1] * pixels[..., -1:]
    if pixels.shape[-1] == 1:
        pixels = np.repeat(pixels, 3, axis=-1)
    if pixels.ndim != 3 or pixels.shape[-1] != 3:
        raise InputError(f"cannot read {path}: {pixels.shape[-1]} channels are neither grey nor RGB")
    return np.ascontiguousarray(pixels)


# --- Pillow: PNG, JPEG, BMP, WebP, GIF ---------------------------------------------------------------------------


def _pillow(path: Path) -> Source:
    with _reading(path), Image.open(path) as image:
        turned = image.getexif().get(ExifTags.Base.Orientation, 1) > 4
        height, width = image.size if turned else image.size[::-1]
        moving = image.format in ("GIF", "WEBP", "PNG")
        count = getattr(image, "n_frames", 1) if moving else 1
        # Players show a frame without a duration for a tenth of a second.
        fps = 1000.0 / (image.info.get("duration") or 100) if count > 1 else DEFAULT_FPS
        info = ClipInfo(count, height, width, float(fps), _is_grey(image))
        if image.format == "GIF" and not _bytes_at(path, -64, 64).rstrip(b"\0").endswith(b";"):
            raise InputError(f"{path} is truncated: a GIF's end marker is missing")
        if image.format == "PNG" and count == 1 and _bytes_at(path, 24, 1) == b"\x10":  # bits a channel
            return Source(info, lambda: _deep_png(path))

    def frames() -> Iterator[Frame]:
        with _reading(path), Image.open(path) as image:
            for index in range(count):
                image.seek(index)
                yield _rgb(_pillow_pixels(ImageOps.exif_transpose(image)), path)

    return Source(info, frames)


def _pillow_pixels(image: Image.Image) -> NDArray[Any]:
    if image.mode.startswith("I;16"):
        return np.asarray(image).astype(np.uint16)
    if image.mode == "F":
        return np.asarray(image)
    return np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB"))


def _is_grey(image: Image.Image) -> bool:
    palette = image.getpalette() if image.mode == "P" else None
    return image.mode in _GREY_MODES or (palette is not None and palette[::3] == palette[1::3] == palette[2::3])


def _bytes_at(path: Path, offset: int, count: int) -> bytes:
    """`count` bytes from `offset`, counted from the end if negative."""
    with path.open("rb") as file:
        file.seek(max(offset, -path.stat().st_size), os.SEEK_END if offset < 0 else os.SEEK_SET)
        return file.read(count)


def _deep_png(path: Path) -> Iterator[Frame]:
    """A PNG of 16 bits a channel, which Pillow would cut to 8."""
    with _reading(path), av.open(_ffmpeg_name(path)) as container:
        frame = next(container.decode(video=0))
        # PyAV hands out every 16-bit format but grey with alpha as it is.
        pixels = frame.to_ndarray(format="rgba64le" if frame.format.name.startswith("ya") else None)
        yield _rgb(pixels.astype(np.uint16), path)


# --- TIFF --------------------------------------------------------------------------------------------------------


def _tiff(path: Path) -> Source:
    # Its warnings about a damaged file would stand beside our one line.
    logging.getLogger("tifffile").setLevel(logging.CRITICAL + 1)
    with _reading(path), tifffile.TiffFile(path) as tiff:
        pages = [page for page in tiff.pages if not _is_thumbnail(page)]
        if not pages:
            raise InputError(f"{path} holds no picture")
        if tiff.series[0].is_truncated or tiff.series[0].keyframe.imagedepth > 1:
            raise InputError(f"cannot read {path}: its frames share one page; save one page a frame")
        first: Any = pages[0].keyframe
        height, width = first.imagelength, first.imagewidth
        info = ClipInfo(len(pages), height, width, DEFAULT_FPS, first.samplesperpixel <= 2 and first.photometric < 2)

    def frames() -> Iterator[Frame]:
        with _reading(path), tifffile.TiffFile(path) as tiff:
            for index, page in enumerate(tiff.pages):
                if not _is_thumbnail(page):
                    yield _rgb(_tiff_pixels(path, page, index), path)

    return Source(info, frames)


def _is_thumbnail(page: Any) -> bool:
    return bool(page.keyframe.is_reduced)


def _tiff_pixels(path: Path, page: Any, index: int) -> NDArray[Any]:
    page = page.aspage()
    if page.photometric in (tifffile.PHOTOMETRIC.PALETTE, tifffile.PHOTOMETRIC.YCBCR) or page.compression not in (
        tifffile.COMPRESSION.NONE,
        tifffile.COMPRESSION.ADOBE_DEFLATE,
        tifffile.COMPRESSION.DEFLATE,
        tifffile.COMPRESSION.LZMA,
    ):
        # LZW, JPEG and the like: libtiff through Pillow, which keeps 16 bits in grey only.
        if page.bitspersample > 8 and page.samplesperpixel > 1:
            raise InputError(f"cannot read {path}: save a compressed TIFF of over 8 bits a channel uncompressed")
        with Image.open(path) as image:
            image.seek(index)
            return _pillow_pixels(image)
    pixels = page.asarray()
    if page.planarconfig == tifffile.PLANARCONFIG.SEPARATE and pixels.ndim == 3:
        pixels = np.moveaxis(pixels, 0, -1)
    if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
        pixels = ~pixels if pixels.dtype.kind in "ub" else 1 - pixels
    return pixels


# --- folders -----------------------------------------------------------------------------------------------------


def _natural(path: Path) -> list[str | int]:
    return [int(part) if part.isdigit() else part for part in re.split(r"([0-9]+)", path.name.casefold())]


def _folder(path: Path) -> Source:
    with _reading(path):
        entries = [entry for entry in path.iterdir() if not entry.name.startswith(".")]
    if not entries:
        raise InputError(f"the folder {path} is empty")
    pictures = [entry for entry in entries if entry.suffix.lower() in IMAGES]
    if not pictures:
        raise InputError(f"the folder {path} holds no images ({', '.join(sorted(IMAGES))})")
    return _sequence(pictures, path)


def _sequence(pictures: list[Path], path: Path) -> Source:
    """Stills of one size in natural order of their names, found by the folder or pattern `path`."""
    if not pictures:
        raise InputError(f"no file matches {path}")
    pictures = sorted(pictures, key=_natural)
    infos = [_still(picture).info for picture in pictures]
    first = infos[0]
    for picture, info in zip(pictures, infos, strict=True):
        if (info.height, info.width) != (first.height, first.width):
            raise InputError(
                f"{picture} is {info.width}x{info.height} pixels but {pictures[0].name} is "
                f"{first.width}x{first.height}; the images of a clip must have one size: "
                f"pick them by a pattern such as '{picture.parent}/*{pictures[0].suffix}'"
            )

    def frames() -> Iterator[Frame]:
        for picture in pictures:
            yield from _still(picture).frames()

    grey = all(info.grey for info in infos)
    return Source(ClipInfo(len(pictures), first.height, first.width, DEFAULT_FPS, grey), frames)


def _still(path: Path) -> Source:
    source = open_source(path)
    if source.info.frames != 1:
        raise InputError(f"{path} holds {source.info.frames} frames; an image of a folder must hold one")
    return source


# --- video -------------------------------------------------------------------------------------------------------


def _video(path: Path) -> Source:
    with _reading(path), av.open(_ffmpeg_name(path)) as container:
        stream = _video_stream(container, path)
        context = stream.codec_context
        frame = next(container.decode(stream), None)
        if frame is None:
            raise InputError(f"{path} holds no video frame")
        height, width = (frame.width, frame.height) if frame.rotation % 180 else (frame.height, frame.width)
        rate = stream.average_rate or stream.guessed_rate
        grey = context.pix_fmt is not None and context.pix_fmt.startswith("gray")
        info = ClipInfo(stream.frames or None, height, width, float(rate or DEFAULT_FPS), grey)

    def frames() -> Iterator[Frame]:
        with _reading(path), av.open(_ffmpeg_name(path)) as container:
            yield from _decode(container, path)

    return Source(info, frames)


def _ffmpeg_name(path: Path) -> str:
    """Absolute, so that FFmpeg never takes what precedes a colon for a protocol."""
    return str(path.absolute())


def _video_stream(container: Any, path: Path) -> Any:
    if not container.streams.video:
        raise InputError(f"{path} holds no video")
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    return stream


def _decode(container: Any, path: Path) -> Iterator[Frame]:
    stream = _video_stream(container, path)
    interval = 1 / float(stream.average_rate or DEFAULT_FPS)
    packets, count, end = 0, 0, 0.0
    for packet in container.demux(stream):
        packets += packet.size > 0
        for frame in packet.decode():
            if packet.is_corrupt or frame.is_corrupt:
                raise InputError(f"{path} is damaged near frame {count}")
            count += 1
            end = max(end, (frame.time or 0.0) + interval)
            yield _video_pixels(frame, path)
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


def _video_pixels(frame: Any, path: Path) -> Frame:
    bits = max(component.bits for component in frame.format.components)
    if frame.format.name == "gray":
        pixels = frame.to_ndarray()
    elif bits <= 8:
        pixels = frame.reformat(format="rgb24", interpolation=_ACCURATE).to_ndarray()
    else:
        # FFmpeg brings deep YUV's white to 255 * 256, and n bits of grey by a shift to the upper end of 16.
        yuv = len(frame.format.components) > 1 and not frame.format.is_rgb
        shifted = ((1 << bits) - 1) << (16 - bits) if frame.format.name.startswith("gray") else 65535
        white = np.float32(255 * 256 if yuv else shifted)
        pixels = frame.reformat(format="rgb48le", interpolation=_ACCURATE).to_ndarray()
        pixels = np.minimum(pixels / white, np.float32(1))
    # A display rotation counts anticlockwise, as NumPy's does.
    return _rgb(np.rot90(pixels, frame.rotation // 90), path)
