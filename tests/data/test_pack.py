import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from turbnet.data.pack import packed_pictures, write_pack
from turbnet.data.sources import Pictures, folder_paths, load_picture
from turbnet.errors import InputError, ParameterError

TOOL = Path(__file__).parents[2] / "tools" / "pack_pictures.py"


@pytest.fixture
def folder(tmp_path):
    """Smooth pictures, which compress well."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    y, x = np.mgrid[:60, :90] / 90
    for k in range(6):
        planes = [0.5 + 0.4 * np.sin((2 + k) * x + c * y) for c in range(3)]
        Image.fromarray((255 * np.stack(planes, -1)).astype(np.uint8)).save(folder / f"{k}.png")
    return folder


def test_a_pack_gives_back_the_pictures(folder, tmp_path):
    count, size = write_pack(folder_paths([folder]), tmp_path / "p.zip")
    assert count == 6
    assert size == (tmp_path / "p.zip").stat().st_size
    for packed, path in zip(folder_paths([tmp_path / "p.zip"]), folder_paths([folder]), strict=True):
        np.testing.assert_allclose(load_picture(packed), load_picture(path), atol=0.05)
    assert Pictures(folder_paths([tmp_path / "p.zip"]))(np.random.default_rng(0), 32, 40).shape == (32, 40, 3)


def test_the_same_pictures_the_same_file_and_a_longer_side_as_asked(folder, tmp_path):
    for name in ("a.zip", "b.zip"):
        write_pack(folder_paths([folder]), tmp_path / name, side=45)
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()
    assert {p.load().shape for p in packed_pictures(tmp_path / "a.zip")} == {(30, 45, 3)}
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        assert archive.testzip() is None


def test_a_pack_keeps_to_its_limit(folder, tmp_path):
    _, whole = write_pack(folder_paths([folder]), tmp_path / "whole.zip", quality=100)
    limit = 0.6 * whole / 2**20
    count, size = write_pack(folder_paths([folder]), tmp_path / "part.zip", megabytes=limit, quality=100)
    assert 2 <= count < 6
    assert size <= limit * 2**20


def test_what_is_no_pack(folder, tmp_path):
    with pytest.raises(InputError, match=r"cannot read the pack .*none\.zip"):
        folder_paths([tmp_path / "none.zip"])
    (tmp_path / "junk.zip").write_bytes(b"junk" * 100)
    with pytest.raises(InputError, match="cannot read the pack"):
        folder_paths([tmp_path / "junk.zip"])
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("a.txt", "text")
    with pytest.raises(InputError, match=r"is not a pack .* a\.txt"):
        folder_paths([tmp_path / "other.zip"])
    zipfile.ZipFile(tmp_path / "empty.zip", "w").close()
    with pytest.raises(InputError, match="no pictures"):
        folder_paths([tmp_path / "empty.zip"])
    with pytest.raises(ParameterError, match="side"):
        write_pack(folder_paths([folder]), tmp_path / "p.zip", side=0)
    assert not (tmp_path / "p.zip").exists()


def test_a_damaged_picture_in_a_pack(folder, tmp_path):
    pack = tmp_path / "p.zip"
    write_pack(folder_paths([folder]), pack)
    first = packed_pictures(pack)[0]
    data = bytearray(pack.read_bytes())
    data[first.start : first.start + first.size] = bytes(first.size)
    pack.write_bytes(data)
    with pytest.raises(InputError, match=r"cannot read a picture in .*p\.zip"):
        first.load()


def test_the_tool(folder, tmp_path):
    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, TOOL, *map(str, arguments)], capture_output=True, text=True)

    done = run(folder, "-o", tmp_path / "p.zip")
    assert done.returncode == 0, done.stderr
    assert "6 of 6 pictures" in done.stdout
    for wrong in ((folder, "-o", tmp_path / "p.tar"), (tmp_path / "nowhere", "-o", tmp_path / "q.zip")):
        done = run(*wrong)
        assert done.returncode == 2
        assert len(done.stderr.splitlines()) == 1
