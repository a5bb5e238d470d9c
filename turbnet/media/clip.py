"""Clips in and out: `open_clip` and `open_writer` stream frames, `read_clip` and `write_clip` take a whole clip.

A frame is float32 (H, W, 3), RGB in [0, 1], sRGB-encoded as stored; `turbnet.media.colour` makes it linear.
"""

from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

from turbnet.errors import InputError
from turbnet.media.readers import open_source
from turbnet.media.sound import Sound
from turbnet.media.source import ClipInfo, Frame, Source, TimedFrame
from turbnet.media.writers import ClipWriter, open_writer, write_clip

__all__ = ["ClipInfo", "ClipReader", "ClipWriter", "open_clip", "open_writer", "read_clip", "write_clip"]


class ClipReader:
    """A clip to iterate over, one frame in memory at a time; every iteration starts from the first frame, where it can."""

    def __init__(self, path: Path, source: Source, crop: tuple[int, int, int, int] | None) -> None:
        self.path = path
        self._source = source
        self._pass: Generator[TimedFrame, None, None] | None = None
        whole = source.info
        left, top, width, height = crop or (0, 0, whole.width, whole.height)
        inside = left >= 0 and top >= 0 and left + width <= whole.width and top + height <= whole.height
        if not inside or width < 1 or height < 1:
            raise InputError(
                f"the crop {left},{top},{width},{height} (left, top, width, height) does not lie inside {path}, "
                f"which is {whole.width}x{whole.height} pixels"
            )
        self._window = slice(top, top + height), slice(left, left + width)
        self.info = replace(whole, height=height, width=width)

    def __iter__(self) -> Iterator[Frame]:
        return (frame for _, frame in self.timed())

    def timed(self) -> Iterator[TimedFrame]:
        """The frames, each after its time: seconds from the start of the clip, None where the kind carries none."""
        self._pass = self._frames()
        return self._pass

    def sound(self) -> AbstractContextManager[Sound | None]:
        """The sound of the clip, opened; None if it has none."""
        return self._source.sound()

    def _frames(self) -> Generator[TimedFrame, None, None]:
        whole = self._source.info
        for index, (time, frame) in enumerate(self._source.frames()):
            if frame.shape[:2] != (whole.height, whole.width):
                raise InputError(
                    f"frame {index} of {self.path} is {frame.shape[1]}x{frame.shape[0]} pixels but the first is "
                    f"{whole.width}x{whole.height}; all frames must have one size"
                )
            yield time, np.ascontiguousarray(frame[self._window])

    def __enter__(self) -> "ClipReader":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._pass is not None:
            self._pass.close()


def open_clip(
    path: str | Path,
    crop: tuple[int, int, int, int] | None = None,
    threads: int | None = None,
    ended: Callable[[], bool] = lambda: False,
) -> ClipReader:
    """Open an image, a folder of images, a GIF, a multi-page TIFF, a video, a pipe or a camera for reading.

    Args:
        path: file, folder, or pattern of image files such as `frames/*.tif`. Stills and TIFFs, which carry no rate, get
            25 frames per second; a GIF's rate is that of its first frame. Or `-` for standard input, a named pipe, or a
            camera such as /dev/video0, which can be passed over once only.
        crop: (left, top, width, height) in pixels; None: the whole picture.
        threads: of a video's decoder; None: all cores.
        ended: whether a pipe or a camera is to end, asked again and again.

    Raises:
        InputError: the path is missing, empty, damaged or not a clip, its frames differ in size, or the crop does not
            lie inside the picture. Damage further on in the clip is raised when the iteration comes to it.
    """
    return ClipReader(Path(path), open_source(Path(path), threads, ended), crop)


def read_clip(path: str | Path, crop: tuple[int, int, int, int] | None = None) -> tuple[NDArray[np.float32], ClipInfo]:
    """The whole clip (T, H, W, 3) and its header, `frames` being T. Raises as `open_clip`."""
    with open_clip(path, crop) as clip:
        frames_THWC = np.stack(list(clip))
        info = clip.info
    return frames_THWC, replace(info, frames=len(frames_THWC))
