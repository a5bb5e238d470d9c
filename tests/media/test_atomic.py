import errno
import os
import subprocess
import sys
from contextlib import nullcontext

import pytest

from turbnet.errors import InputError
from turbnet.media.atomic import atomic_path


def test_file_appears_with_its_content(tmp_path):
    target = tmp_path / "out.txt"
    target.write_text("old")
    with atomic_path(target) as temporary:
        temporary.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert [entry.name for entry in tmp_path.iterdir()] == ["out.txt"]


@pytest.mark.parametrize("make", [lambda path: path.write_text("half"), lambda path: path.mkdir()])
def test_failure_leaves_nothing(tmp_path, make):
    with pytest.raises(ZeroDivisionError), atomic_path(tmp_path / "out") as temporary:  # noqa: PT012
        make(temporary)
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())


def test_folder_replaces_an_empty_folder_only(tmp_path):
    target = tmp_path / "frames"
    target.mkdir()
    for number in range(2):
        with (
            pytest.raises(InputError, match="not empty") if number else nullcontext(),
            atomic_path(target) as temporary,
        ):
            temporary.mkdir()
            (temporary / "new").touch()
    assert [entry.name for entry in target.iterdir()] == ["new"]


@pytest.mark.parametrize(("name", "says"), [("none/out.txt", "does not exist"), ("folder", "cannot write")])
def test_unusable_target(tmp_path, name, says):
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=says), atomic_path(tmp_path / name) as temporary:
        temporary.write_text("a file where a folder is")
    assert [entry.name for entry in tmp_path.iterdir()] == ["folder"]


def test_device_is_not_replaced():
    with pytest.raises(InputError, match="neither a file nor a folder"), atomic_path(os.devnull):
        pass


def test_link_is_followed(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "real.txt")
    with atomic_path(tmp_path / "link") as temporary:
        temporary.write_text("text")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real.txt").read_text() == "text"


def test_failed_read_in_the_body_is_not_called_a_failed_write(tmp_path):
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "out.txt"):
        (tmp_path / "missing").read_text()


def test_full_disk(tmp_path):
    with pytest.raises(InputError, match="No space left"), atomic_path(tmp_path / "out.txt") as temporary:  # noqa: PT012
        temporary.write_text("half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="no file-size limits")
@pytest.mark.parametrize("name", ["out.mkv", "out.mp4", "out.avi", "out.tif", "out.gif", "out.png", "out"])
def test_file_size_limit_stops_every_writer_cleanly(tmp_path, name):
    """A real write error, from the operating system, half-way through the file."""
    script = (
        "import resource, sys, numpy as np\n"
        "from turbnet.errors import InputError\n"
        "from turbnet.media.clip import write_clip\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\n"
        "frames = np.random.default_rng(0).random((1 if sys.argv[1].endswith('png') else 5, 96, 96, 3))\n"
        "try:\n"
        "    write_clip(sys.argv[1], frames)\n"
        "except InputError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", script, tmp_path / name], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"cannot write {tmp_path / name}: "), done.stdout
    assert "File too large" in done.stdout or "disk full" in done.stdout
    assert done.stderr == ""
    assert not list(tmp_path.iterdir())
