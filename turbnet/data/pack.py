"""A packed set of clean pictures: one zip archive of WebP files, stored as they are, to carry to another machine.

`data.folders=[pictures.zip]` trains on it as on a folder; `tools/pack_pictures.py` makes it.
"""

import io
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from turbnet.errors import InputError, check_range
from turbnet.media.atomic import atomic_path
from turbnet.media.clip import open_clip
from turbnet.media.guard import reading

SUFFIX = ".zip"
_LOCAL_HEADER = 30  # bytes, before name and extra field


class PackedPicture(NamedTuple):
    """Where a picture lies in a pack, bytes: any process reads it without sharing an open file with another."""

    pack: Path
    start: int
    size: int

    def load(self) -> NDArray[np.float32]:
        """(H, W, 3), float32 sRGB in [0, 1].

        Raises:
            InputError: it is damaged.
        """
        with reading(f"a picture in {self.pack}"):
            with self.pack.open("rb") as file:
                file.seek(self.start)
                data = file.read(self.size)
            with Image.open(io.BytesIO(data), formats=("WEBP",)) as image:
                return np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255)


def packed_pictures(path: Path) -> list[PackedPicture]:
    """The pictures of a pack, in its order.

    Raises:
        InputError: it is missing, damaged, or no pack.
    """
    found = []
    with reading(f"the pack {path}"):
        whole = path.stat().st_size
        with zipfile.ZipFile(path) as archive, path.open("rb") as file:
            for item in archive.infolist():
                if item.compress_type != zipfile.ZIP_STORED or not item.filename.endswith(".webp"):
                    raise InputError(f"{path} is not a pack of tools/pack_pictures.py: it holds {item.filename}")
                if item.file_size > whole:
                    raise InputError(
                        f"cannot read the pack {path}: {item.filename} claims more bytes than the file has"
                    )
                file.seek(item.header_offset)
                header = file.read(_LOCAL_HEADER)
                names = int.from_bytes(header[26:28], "little") + int.from_bytes(header[28:30], "little")
                found.append(PackedPicture(path, item.header_offset + _LOCAL_HEADER + names, item.file_size))
    if not found:
        raise InputError(f"no pictures in {path}")
    return found


def write_pack(
    paths: Sequence[Path], pack: Path, side: int = 512, megabytes: float = 48.0, quality: int = 92
) -> tuple[int, int]:
    """Pack pictures, each reduced to a longer side of at most `side` pixels; return how many, and the bytes of the pack.

    What would exceed `megabytes` (of 2^20 bytes) is thinned out evenly over the list.

    Raises:
        InputError: a picture cannot be read, the pack cannot be written, a value out of range.
    """
    check_range("side", side, 16, 2**14, "pixels")
    check_range("megabytes", megabytes, 1e-3, 2**20)
    check_range("quality", quality, 1, 100)
    encoded = [_encoded(path, side, quality) for path in paths]
    room = int(megabytes * 2**20)
    total = sum(map(_entry, encoded))
    if total > room:  # as many as fit, spread over the list; larger ones may still overflow, so leave off at the end
        count = max(1, int(len(encoded) * room / total))
        encoded = [encoded[i] for i in np.linspace(0, len(encoded) - 1, count).round().astype(int)]
        while len(encoded) > 1 and sum(map(_entry, encoded)) > room:
            encoded.pop()
    with atomic_path(pack) as temporary:
        _write(encoded, temporary)
    return len(encoded), pack.stat().st_size


def _entry(data: bytes) -> int:
    """Bytes that a picture takes in the archive: itself, two headers, its name twice."""
    return len(data) + 30 + 46 + 2 * len(_name(0))


def _name(index: int) -> str:
    return f"{index:06d}.webp"


def _write(encoded: Iterable[bytes], path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for index, data in enumerate(encoded):
            archive.writestr(zipfile.ZipInfo(_name(index)), data)  # without a date: the same pictures, the same file


def _encoded(path: Path, side: int, quality: int) -> bytes:
    with open_clip(path) as clip:
        picture = next(iter(clip))
    image = Image.fromarray((picture * 255 + 0.5).astype(np.uint8))
    image.thumbnail((side, side), Image.Resampling.LANCZOS)
    out = io.BytesIO()
    image.save(out, "WEBP", quality=quality, method=4)
    return out.getvalue()
