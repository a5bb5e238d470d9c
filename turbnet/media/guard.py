"""What a file from elsewhere may ask of this machine, and its damage told in one line.

Parsers meet damaged files with whatever exception the damage leads to, hence the broad net in `reading`.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from turbnet.errors import InputError

LARGEST = 2**27
"""Pixels of the largest picture that is read, 16384 x 8192: 1.6 GB as float32 RGB."""


@contextmanager
def reading(path: str | Path) -> Iterator[None]:
    """Every error of the body, too little memory among them, becomes an InputError of one line that names `path`."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise InputError(f"cannot read {path}: {' '.join(reason.split())}") from error


def check_size(path: str | Path, height: int, width: int) -> None:
    """Raise InputError if a header declares more pixels than `LARGEST`: a few bytes can claim any size."""
    if height * width > LARGEST:
        raise InputError(f"cannot read {path}: it says {width}x{height} pixels; at most {LARGEST:,} are read")


def read_bytes(path: str | Path, most: int, kind: str = "") -> bytes:
    """A regular file of at most `most` bytes; `kind`, "the model " for instance, stands before its name in errors.

    Raises:
        InputError: it is missing, larger, or not a file.
    """
    path, name = Path(path), f"{kind}{path}"
    with reading(name):
        if not path.is_dir() and path.exists() and not path.is_file():  # a device or a pipe, which may never end
            raise InputError(f"cannot read {name}: it is not a file")
        size = path.stat().st_size
        if size > most:
            raise InputError(f"cannot read {name}: it has {size} bytes; at most {most} are read")
        return path.read_bytes()


def read_json(path: str | Path, most: int = 2**28) -> Any:
    """What a JSON file holds; raises InputError as `read_bytes`, and if it is no JSON."""
    data = read_bytes(path, most)
    with reading(path):  # nesting too deep is a RecursionError
        return json.loads(data)
