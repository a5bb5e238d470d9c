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

import re
from collections.abc import Callable, Iterator
from pathlib import Path

from turbnet.errors import InputError
from turbnet.media.guard import reading
from turbnet.media.live import is_live
from turbnet.media.pictures import bytes_at, open_pictures
from turbnet.media.source import DEFAULT_FPS, ClipInfo, Source, TimedFrame
from turbnet.media.tiff import open_tiff
from turbnet.media.video import open_live_video, open_video

IMAGES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"}
VIDEOS = {".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".mts", ".wmv", ".flv", ".ogv"}


def open_source(path: Path, threads: int | None = None, ended: Callable[[], bool] = lambda: False) -> Source:
    """The reader for `path`: live, a folder, a pattern of images, a file known by its first bytes or, a video, by its name.

    Args:
        threads: a video decoder's; None: all cores.
        ended: whether a pipe or a camera is to end, asked again and again.
    """
    with reading(path):  # a name may be too long, a pattern may be none
        if is_live(path):
            return open_live_video(path, threads, ended)
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
        return open_tiff(path)
    if kind:
        return open_pictures(path)
    if path.suffix.lower() in VIDEOS:
        return open_video(path, threads)
    if path.suffix.lower() in IMAGES | {".gif"}:
        raise InputError(f"cannot read {path}: its content is not an image")
    raise InputError(
        f"cannot read {path}: not a kind of file turbnet knows; give an image, a folder of images, a GIF, a TIFF "
        f"or a video ({', '.join(sorted(VIDEOS))})"
    )


def _image_kind(path: Path) -> str | None:
    with reading(path):
        start = bytes_at(path, 0, 16)
    if start[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return "tiff"
    known = start.startswith((b"\x89PNG", b"\xff\xd8\xff", b"BM", b"GIF8"))
    return "pillow" if known or (start[:4] == b"RIFF" and start[8:12] == b"WEBP") else None


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
