"""Pictures, GIFs and animated WebP, by Pillow: PNG, JPEG, BMP, WebP, GIF."""

import os
import warnings
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from turbnet.errors import InputError
from turbnet.media.guard import check_size, reading
from turbnet.media.source import DEFAULT_FPS, ClipInfo, Source, TimedFrame, as_frame
from turbnet.media.video import open_container

_PILLOW = ("PNG", "JPEG", "BMP", "GIF", "WEBP")
_GREY_MODES = {"1", "L", "LA", "La", "F", "I", "I;16", "I;16L", "I;16B", "I;16N"}


def open_pictures(path: Path) -> Source:
    """A picture, or the frames of a GIF, an animated WebP or PNG."""
    with reading(path), open_image(path, _PILLOW) as image:
        turned = image.getexif().get(ExifTags.Base.Orientation, 1) > 4
        height, width = image.size if turned else image.size[::-1]
        moving = image.format in ("GIF", "WEBP", "PNG")
        count = getattr(image, "n_frames", 1) if moving else 1
        # Players show a frame without a duration for a tenth of a second.
        fps = 1000.0 / (image.info.get("duration") or 100) if count > 1 else DEFAULT_FPS
        tick = Fraction(1, 1000) if count > 1 else None
        info = ClipInfo(count, height, width, float(fps), _is_grey(image), tick)
        if image.format == "GIF" and not bytes_at(path, -64, 64).rstrip(b"\0").endswith(b";"):
            raise InputError(f"{path} is truncated: a GIF's end marker is missing")
        if image.format == "PNG" and count == 1 and bytes_at(path, 24, 1) == b"\x10":  # bits a channel
            return Source(info, lambda: _deep_png(path))

    def frames() -> Iterator[TimedFrame]:
        milliseconds = 0
        with reading(path), open_image(path, _PILLOW) as image:
            for index in range(count):
                image.seek(index)
                yield Fraction(milliseconds, 1000), as_frame(pillow_pixels(ImageOps.exif_transpose(image)), path)
                milliseconds += round(image.info.get("duration") or 100)

    return Source(info, frames)


def open_image(path: Path, formats: tuple[str, ...]) -> Image.Image:
    """A picture of no more pixels than are allowed, in one of these formats; not decoded yet."""
    # Pillow warns of two thirds of our largest picture: lines beside ours, or none of the caller's.
    warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)
    image = Image.open(path, formats=formats)
    check_size(path, image.height, image.width)
    return image


def pillow_pixels(image: Image.Image) -> NDArray[Any]:
    """The pixels of a picture as an array, 16 bits and floats as they are."""
    if image.mode.startswith("I;16"):
        return np.asarray(image).astype(np.uint16)
    if image.mode == "F":
        return np.asarray(image)
    return np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB"))


def _is_grey(image: Image.Image) -> bool:
    palette = image.getpalette() if image.mode == "P" else None
    return image.mode in _GREY_MODES or (palette is not None and palette[::3] == palette[1::3] == palette[2::3])


def bytes_at(path: Path, offset: int, count: int) -> bytes:
    """`count` bytes from `offset`, counted from the end if negative."""
    with path.open("rb") as file:
        file.seek(max(offset, -path.stat().st_size), os.SEEK_END if offset < 0 else os.SEEK_SET)
        return file.read(count)


def _deep_png(path: Path) -> Iterator[TimedFrame]:
    """A PNG of 16 bits a channel, which Pillow would cut to 8."""
    with reading(path), open_container(path) as container:
        frame = next(container.decode(video=0))
        # PyAV hands out every 16-bit format but grey with alpha as it is.
        pixels = frame.to_ndarray(format="rgba64le" if frame.format.name.startswith("ya") else None)
        yield None, as_frame(pixels.astype(np.uint16), path)
