"""Outputs that appear whole or not at all."""

import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from turbnet.errors import InputError

# What a write that carries no file name fails with: disk, quota or file-size limit reached, disk read-only.
_WRITE_FAILURES = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}


@contextmanager
def atomic_path(path: str | Path, within: Path | None = None) -> Iterator[Path]:
    """Yield a temporary path (same suffix); rename it to `path` on success, delete it on any failure.

    It lies beside `path`, or in the folder `within`, which is on the same disk.

    What is written under the temporary path may be a file or a folder. A file replaces an existing file; a folder
    replaces only an empty one, so that nobody's pictures are lost. A link is followed, not replaced.

    An OSError of the body becomes an InputError only if it is about the temporary path or says that the disk is full
    or read-only; one that names another file (a failed read, say) passes through as it is.

    Raises:
        InputError: as `check_output`, or the disk is full.
    """
    target = check_output(path)
    temporary = (within or target.parent) / f".{target.stem}.{secrets.token_hex(4)}.partial{target.suffix}"
    try:
        yield temporary
        if temporary.is_dir() and target.is_dir():
            target.rmdir()
        temporary.replace(target)
    except OSError as error:
        if not _is_about(error, temporary):
            raise
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary, ignore_errors=True)
        else:
            temporary.unlink(missing_ok=True)


def check_output(path: str | Path) -> Path:
    """The file or folder that writing to `path` would create, links followed; for a check ahead of long work.

    Raises:
        InputError: its folder does not exist or cannot be written, or it is a folder that is not empty or a device.
    """
    target = Path(os.path.realpath(path))
    parent = target.parent
    if not parent.is_dir():
        raise InputError(f"cannot write {path}: the folder {parent} does not exist; create it first")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(f"cannot write {path}: no permission to write in {parent}")
    try:
        target.exists()
    except OSError as error:  # a name too long
        raise InputError(f"cannot write {path}: {error.strerror}") from error
    if target.is_dir() and any(target.iterdir()):
        raise InputError(f"cannot write {path}: the folder exists and is not empty; remove it or choose another name")
    if target.exists() and not target.is_dir() and not target.is_file():
        raise InputError(f"cannot write {path}: it is neither a file nor a folder")
    return target


def _is_about(error: OSError, temporary: Path) -> bool:
    if error.filename is None:
        return error.errno in _WRITE_FAILURES
    return isinstance(error.filename, str | os.PathLike) and Path(error.filename).is_relative_to(temporary)
