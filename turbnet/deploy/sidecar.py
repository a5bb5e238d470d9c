"""Restored frames kept beside a clip that is not whole yet, so that a run that was killed can be gone on with.

The folder `.NAME.part` beside the destination NAME holds a manifest, which says what is restored and how, and chunks:
clips of a fixed number of restored frames, lossless at the destination's depth, each of which appears whole or not at all.
A chunk holds a whole number of the steps by which windows go on, so a run can start again at the window after it.
"""

import json
import shutil
from collections.abc import Generator, Iterable, Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from turbnet.errors import InputError
from turbnet.media.atomic import atomic_path, check_output
from turbnet.media.clip import open_clip, open_writer

_LEAST = 24  # frames of a chunk: fewer would be many files


class _Unfinished(Exception):
    pass


class Sidecar:
    """The folder of one destination, made or gone on with.

    Args:
        destination: of the whole clip.
        settings: what decides about the restored frames, JSON values by name.
        step: frames by which windows go on.
        grey: the clip is stored in one channel.

    Raises:
        InputError: the folder holds frames that were restored otherwise; says what differs.
    """

    def __init__(self, destination: Path, settings: dict[str, Any], step: int, grey: bool) -> None:
        target = check_output(destination)
        self.folder = target.parent / f".{target.name}.part"
        self._size = step * -(-_LEAST // step)
        self._grey = grey
        self._suffix = ".tif" if target.suffix.lower() in (".tif", ".tiff") else ".mkv"
        manifest = json.loads(json.dumps(settings | {"frames of a chunk": self._size}))
        file = self.folder / "manifest.json"
        if file.exists():
            _compare(json.loads(file.read_text()), manifest, destination, self.folder)
            for leftover in self.folder.glob(".*.partial*"):
                shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
        else:
            self.folder.mkdir(exist_ok=True)
            with atomic_path(file) as temporary:
                temporary.write_text(json.dumps(manifest, indent=2) + "\n")
        chunks = 0
        while self._chunk(chunks).exists():
            chunks += 1
        self.frames = chunks * self._size
        """Frames that are restored already."""

    def kept(self) -> Iterator[np.ndarray]:
        """The frames that are restored already, (H, W, C)."""
        for number in range(self.frames // self._size):
            with open_clip(self._chunk(number)) as clip:
                yield from clip

    def keep(self, frames: Iterable[np.ndarray]) -> Generator[np.ndarray, None, None]:
        """Frames that follow those kept, passed on as they come; all but the last few are kept."""
        frames, number = iter(frames), self.frames // self._size
        with suppress(_Unfinished):
            while True:
                with open_writer(self._chunk(number), grey=self._grey) as writer:
                    for frame_HWC in islice(frames, self._size):
                        writer.write(frame_HWC)
                        yield frame_HWC
                    if writer.frames < self._size:
                        raise _Unfinished
                number += 1

    def __enter__(self) -> "Sidecar":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """The folder goes when the clip is whole, or when work broke off before anything was kept."""
        if kind is None or not self._chunk(0).exists():
            shutil.rmtree(self.folder)

    def _chunk(self, number: int) -> Path:
        return self.folder / f"{number:06d}{self._suffix}"


def _compare(found: dict[str, Any], wanted: dict[str, Any], destination: Path, folder: Path) -> None:
    for name, value in wanted.items():
        if found.get(name) != value:
            raise InputError(
                f"cannot resume {destination}: {folder} holds frames of another restoration, its {name} differs "
                f"({found.get(name)}, not {value}); repeat that command, or delete the folder to start over"
            )


def identity(source: Path) -> list[list[Any]]:
    """Name, size in bytes and time of change, ns, of the file `source`, or of all files of the folder or pattern."""
    files = [source]
    if source.is_dir():
        files = sorted(source.iterdir())
    elif not source.exists():
        files = sorted(source.parent.glob(source.name))
    return [[str(file.absolute()), file.stat().st_size, file.stat().st_mtime_ns] for file in files]
