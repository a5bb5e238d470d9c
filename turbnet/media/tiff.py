"""TIFF: every page but thumbnails is a frame."""

import logging
import lzma
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from turbnet.errors import InputError
from turbnet.media.guard import check_size, reading
from turbnet.media.pictures import open_image, pillow_pixels
from turbnet.media.source import DEFAULT_FPS, ClipInfo, Source, TimedFrame, as_frame


def open_tiff(path: Path) -> Source:
    """A TIFF of one frame a page."""
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
                yield None, as_frame(_tiff_pixels(path, page, index), path)

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
        with open_image(path, ("TIFF",)) as image:
            image.seek(index)
            return pillow_pixels(image)
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
