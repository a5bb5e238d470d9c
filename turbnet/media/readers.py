"""Every kind of clip as a stream of float32 frames (H, W, 3), RGB in [0, 1], sRGB-encoded as stored, and their times.

A reader gives a `Source`: what the header says, and a function that starts a fresh pass over the frames, one frame in
memory at a time; of a pipe or a camera there is one pass only. Where the kind carries times (a video, a GIF), each frame
comes with its own, exact, in seconds from the start of the clip; with None elsewhere.

Broken files raise InputError, at the latest when the pass comes to the broken place:

- A still, a folder, a GIF or a TIFF that cannot be decoded to its end.
- A stream from a pipe or a camera that FFmpeg does not know. What cannot be decoded later on is passed over, as players do.
- A video whose decoder reports or conceals damage in a frame, or that ends before the frame count (MP4, MOV, AVI) or
  the duration (MKV, WebM, FLV; give or take two frames) that its header declares. A container that declares neither
  (MPEG, TS) is taken as it is.

Damage that decodes to a valid picture, as within uncompressed pixels or VP8, cannot be told from the picture.

A file is what its bytes say and stands for itself alone: playlists and scripts, which FFmpeg would follow to other files and
addresses, are refused, and so is what declares more pixels than `turbnet.media.guard.LARGEST`.
"""

import logging
import lzma
import os
import re
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import Interpolation
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from turbnet.errors import InputError
from turbnet.media.guard import LARGEST, check_size, reading
from turbnet.media.live import STANDARD, is_live, open_live
from turbnet.media.sound import Sound, start_of

Frame = NDArray[np.float32]
TimedFrame = tuple[Fraction | None, Frame]

IMAGES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"}
VIDEOS = {".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".mts", ".wmv", ".flv", ".ogv"}
DEFAULT_FPS = 25.0

# Filtering overshoots white by a little; twice white means that another scale was used.
BRIGHTEST = 2.0
# FFmpeg's fast conversion of subsampled colour darkens a picture by a level; this one is unbiased.
_ACCURATE = (
    Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT | Interpolation.FULL_CHR_H_INP
)
# Containers of one file each, and no protocol but files: a playlist named clip.mp4 reads nothing else.
_ALONE = {
    "format_whitelist": "mov,avi,matroska,mpeg,mpegvideo,mpegts,asf,flv,ogg,png_pipe",
    "protocol_whitelist": "file",
}
_PILLOW = ("PNG", "JPEG", "BMP", "GIF", "WEBP")
_GREY_MODES = {"1", "L", "LA", "La", "F", "I", "I;16", "I;16L", "I;16B", "I;16N"}


@dataclass(frozen=True)
class ClipInfo:
    """What a clip's header says.

    Args:
        frames: how many; None: not declared.
        height, width: pixels.
        fps: frames per second, on average.
        grey: stored in one channel.
        tick: seconds, of which the frames' times are multiples; None: they carry no times.
    """

    frames: int | None
    height: int
    width: int
    fps: float
    grey: bool
    tick: Fraction | None = None


@dataclass(frozen=True)
class Source:
    """A clip's header, a function that starts a pass over its frames and one that opens its sound, None if it has none."""

    info: ClipInfo
    frames: Callable[[], Iterator[TimedFrame]]
    sound: Callable[[], AbstractContextManager[Sound | None]] = nullcontext


def open_source(path: Path, threads: int | None = None, ended: Callable[[], bool] = lambda: False) -> Source:
    """The reader for `path`: live, a folder, a pattern of images, a file known by its first bytes or, a video, by its name.

    Args:
        threads: a video decoder's; None: all cores.
        ended: whether a pipe or a camera is to end, asked again and again.
    """
    with reading(path):  # a name may be too long, a pattern may be none
        if is_live(path):
            return _live(path, threads, ended)
        if path.is_dir():
            return _folder(path)
        if not path.exists():
            if any(sign in path.name for sign in "*?["):
                return _sequence([picture for picture in path.parent.glob(path.name) if picture.is_file()], path)
            raise InputError(f"there is no file or folder {path}")
        if path.stat().st_size == 0:
            raise InputError(f"{path} is empty (0 bytes)")
    kind = _image_kind(path)
    if kind == "tiff":
        return _tiff(path)
    if kind:
        return _pillow(path)
    if path.suffix.lower() in VIDEOS:
        return _video(path, threads)
    if path.suffix.lower() in IMAGES | {".gif"}:
        raise InputError(f"cannot read {path}: its content is not an image")
    raise InputError(
        f"cannot read {path}: not a kind of file turbnet knows; give an image, a folder of images, a GIF, a TIFF "
        f"or a video ({', '.join(sorted(VIDEOS))})"
    )


def _image_kind(path: Path) -> str | None:
    with reading(path):
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
    elif np.abs(pixels).max() > BRIGHTEST:
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
    with reading(path), _open_image(path, _PILLOW) as image:
        turned = image.getexif().get(ExifTags.Base.Orientation, 1) > 4
        height, width = image.size if turned else image.size[::-1]
        moving = image.format in ("GIF", "WEBP", "PNG")
        count = getattr(image, "n_frames", 1) if moving else 1
        # Players show a frame without a duration for a tenth of a second.
        fps = 1000.0 / (image.info.get("duration") or 100) if count > 1 else DEFAULT_FPS
        tick = Fraction(1, 1000) if count > 1 else None
        info = ClipInfo(count, height, width, float(fps), _is_grey(image), tick)
        if image.format == "GIF" and not _bytes_at(path, -64, 64).rstrip(b"\0").endswith(b";"):
            raise InputError(f"{path} is truncated: a GIF's end marker is missing")
        if image.format == "PNG" and count == 1 and _bytes_at(path, 24, 1) == b"\x10":  # bits a channel
            return Source(info, lambda: _deep_png(path))

    def frames() -> Iterator[TimedFrame]:
        milliseconds = 0
        with reading(path), _open_image(path, _PILLOW) as image:
            for index in range(count):
                image.seek(index)
                yield Fraction(milliseconds, 1000), _rgb(_pillow_pixels(ImageOps.exif_transpose(image)), path)
                milliseconds += round(image.info.get("duration") or 100)

    return Source(info, frames)


def _open_image(path: Path, formats: tuple[str, ...]) -> Image.Image:
    # Pillow warns of two thirds of our largest picture: lines beside ours, or none of the caller's.
    warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)
    image = Image.open(path, formats=formats)
    check_size(path, image.height, image.width)
    return image


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


def _deep_png(path: Path) -> Iterator[TimedFrame]:
    """A PNG of 16 bits a channel, which Pillow would cut to 8."""
    with reading(path), _open_video(path) as container:
        frame = next(container.decode(video=0))
        # PyAV hands out every 16-bit format but grey with alpha as it is.
        pixels = frame.to_ndarray(format="rgba64le" if frame.format.name.startswith("ya") else None)
        yield None, _rgb(pixels.astype(np.uint16), path)


# --- TIFF --------------------------------------------------------------------------------------------------------


def _tiff(path: Path) -> Source:
    import tifffile  # a tenth of the start of a command that may never see one

    # Its warnings about a damaged file would stand beside our one line.
    logging.getLogger("tifffile").setLevel(logging.CRITICAL + 1)
    with reading(path), tifffile.TiffFile(path) as tiff:
        pages = [page for _, page in _pages(path, tiff)]
        if not pages:
            raise InputError(f"{path} holds no picture")
        if tiff.series[0].is_truncated or tiff.series[0].keyframe.imagedepth > 1:
            raise InputError(f"cannot read {path}: its frames share one page; save one page a frame")
        first: Any = pages[0].keyframe
        height, width = first.imagelength, first.imagewidth
        info = ClipInfo(len(pages), height, width, DEFAULT_FPS, first.samplesperpixel <= 2 and first.photometric < 2)

    def frames() -> Iterator[TimedFrame]:
        with reading(path), tifffile.TiffFile(path) as tiff:
            for index, page in _pages(path, tiff):
                yield None, _rgb(_tiff_pixels(path, page, index), path)

    return Source(info, frames)


def _pages(path: Path, tiff: Any) -> Iterator[tuple[int, Any]]:
    """Pages that are no thumbnails, by their number. Each says where the next one is, which may be an earlier one."""
    seen: set[int] = set()
    for index, page in enumerate(tiff.pages):
        if page.offset in seen:
            raise InputError(f"cannot read {path}: its pages run in a circle")
        seen.add(page.offset)
        if not page.keyframe.is_reduced:
            yield index, page


def _tiff_pixels(path: Path, page: Any, index: int) -> NDArray[Any]:
    import tifffile

    page = page.aspage()
    check_size(path, page.imagelength, page.imagewidth)
    if page.photometric in (tifffile.PHOTOMETRIC.PALETTE, tifffile.PHOTOMETRIC.YCBCR) or page.compression not in (
        tifffile.COMPRESSION.NONE,
        tifffile.COMPRESSION.ADOBE_DEFLATE,
        tifffile.COMPRESSION.DEFLATE,
        tifffile.COMPRESSION.LZMA,
    ):
        # LZW, JPEG and the like: libtiff through Pillow, which keeps 16 bits in grey only.
        if page.bitspersample > 8 and page.samplesperpixel > 1:
            raise InputError(f"cannot read {path}: save a compressed TIFF of over 8 bits a channel uncompressed")
        with _open_image(path, ("TIFF",)) as image:
            image.seek(index)
            return _pillow_pixels(image)
    _check_inflated(path, page)
    pixels = page.asarray()
    if page.planarconfig == tifffile.PLANARCONFIG.SEPARATE and pixels.ndim == 3:
        pixels = np.moveaxis(pixels, 0, -1)
    if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
        pixels = ~pixels if pixels.dtype.kind in "ub" else 1 - pixels
    return pixels


def _check_inflated(path: Path, page: Any) -> None:
    """Raise InputError if a page has too many channels, or a strip inflates to more than a picture: tifffile lets it."""
    import tifffile

    if page.samplesperpixel > 4 or page.bitspersample > 64:
        raise InputError(f"cannot read {path}: {page.samplesperpixel} channels are neither grey nor RGB")
    height, width = (page.tilelength, page.tilewidth) if page.is_tiled else (page.imagelength, page.imagewidth)
    check_size(path, height, width)
    if page.compression == tifffile.COMPRESSION.NONE:
        return
    most = 1 + height * width * page.samplesperpixel * page.bitspersample // 8
    with path.open("rb") as file:
        for start, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            file.seek(start)
            unpack = lzma.LZMADecompressor() if page.compression == tifffile.COMPRESSION.LZMA else zlib.decompressobj()
            if len(unpack.decompress(file.read(count), most)) == most:
                raise InputError(f"cannot read {path}: it inflates to more than its pixels")


# --- folders -----------------------------------------------------------------------------------------------------


def _natural(path: Path) -> list[str | int]:
    return [int(part) if part.isdigit() else part for part in re.split(r"([0-9]+)", path.name.casefold())]


def _folder(path: Path) -> Source:
    with reading(path):
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

    def frames() -> Iterator[TimedFrame]:
        for picture in pictures:
            for _, frame in _still(picture).frames():
                yield None, frame

    grey = all(info.grey for info in infos)
    return Source(ClipInfo(len(pictures), first.height, first.width, DEFAULT_FPS, grey), frames)


def _still(path: Path) -> Source:
    source = open_source(path)
    if source.info.frames != 1:
        raise InputError(f"{path} holds {source.info.frames} frames; an image of a folder must hold one")
    return source


# --- video -------------------------------------------------------------------------------------------------------


def _video(path: Path, threads: int | None) -> Source:
    with reading(path), _open_video(path) as container:
        stream = _video_stream(container, path, threads)
        frame = next(container.decode(stream), None)
        if frame is None:
            raise InputError(f"{path} holds no video frame")
        height, width = (frame.width, frame.height) if frame.rotation % 180 else (frame.height, frame.width)
        rate = stream.average_rate or stream.guessed_rate
        fps = float(rate or DEFAULT_FPS)
        info = ClipInfo(stream.frames or None, height, width, fps, _is_grey_video(stream), stream.time_base)

    def frames() -> Iterator[TimedFrame]:
        with reading(path), _open_video(path) as container:
            yield from _decode(container, path, threads)

    return Source(info, frames, lambda: _sound(path))


@contextmanager
def _sound(path: Path) -> Iterator[Sound | None]:
    with reading(path):
        container = _open_video(path)
    with container:
        yield Sound(container, _sound_packets(container, path)) if container.streams.audio else None


def _sound_packets(container: Any, path: Path) -> Iterator[Any]:
    with reading(path):
        for packet in container.demux(container.streams.audio):
            if packet.dts is not None:  # but for the empty one at the end
                yield packet


def _live(path: Path, threads: int | None, ended: Callable[[], bool]) -> Source:
    name = Path("standard input") if path == STANDARD else path
    with reading(name):
        container = open_live(path, ended)
        stream = _video_stream(container, name, threads)
        sound = Sound(container) if container.streams.audio else None
        following = _decode_live(container, sound, name, threads, ended)
        first = next(following, None)
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


def _open_video(path: Path) -> Any:
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
    return _rgb(np.rot90(pixels, frame.rotation // 90), path)
