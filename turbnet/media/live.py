"""What comes once and has no known end: standard input, a named pipe, a camera."""

import os
import select
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av

from turbnet.errors import InputError

STANDARD = Path("-")
"""Standard input where something is read, standard output where something is written."""

_CAMERA = "v4l2"
# Containers of one stream of bytes, and no protocol at all: a playlist that comes through a pipe opens nothing.
_ALONE = {
    "format_whitelist": "mov,avi,matroska,mpeg,mpegvideo,mpegts,asf,flv,ogg,nut,yuv4mpegpipe,mjpeg,png_pipe,jpeg_pipe",
    "protocol_whitelist": "pipe",
}
_PATIENCE = 0.1  # seconds between two looks at whether the end was asked for


def is_live(path: Path) -> bool:
    """Whether `path` is standard input, a named pipe or a camera such as /dev/video0."""
    return path == STANDARD or path.is_fifo() or (path.name.startswith("video") and path.is_char_device())


def open_live(path: Path, ended: Callable[[], bool]) -> Any:
    """The container that comes from `path`, as FFmpeg finds out from its first bytes; `ended` ends a pipe that is silent.

    Raises:
        InputError: standard input is a terminal.
    """
    if path == STANDARD and sys.stdin.isatty():
        raise InputError("standard input is a terminal; pipe a clip into it")
    if path.is_char_device():
        return av.open(str(path.absolute()), format=_CAMERA)
    descriptor = sys.stdin.fileno() if path == STANDARD else os.open(path, os.O_RDONLY)
    return av.open(_Pipe(descriptor, ended), options=_ALONE)


class _Pipe:
    """A file for FFmpeg, which itself would wait for bytes for ever."""

    def __init__(self, descriptor: int, ended: Callable[[], bool]) -> None:
        self._descriptor, self._ended = descriptor, ended

    def read(self, count: int) -> bytes:
        while not self._ended():
            if select.select([self._descriptor], [], [], _PATIENCE)[0]:
                return os.read(self._descriptor, count)
        return b""
