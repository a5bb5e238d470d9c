"""What is packaged."""

import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def test_every_folder_of_the_package_is_listed():
    folders = {path.parent for path in (ROOT / "turbnet").rglob("*.py")}
    found = {".".join(folder.relative_to(ROOT).parts) for folder in folders} | {"turbnet.configs"}
    listed = project()["tool"]["setuptools"]["packages"]
    assert sorted(found) == sorted(listed)
    assert all((folder / "__init__.py").is_file() for folder in folders)


@pytest.mark.slow
def test_the_wheel_holds_what_a_run_needs(tmp_path):
    build = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--no-index", "--quiet"]
    copy = tmp_path / "source"  # a build leaves folders behind
    copy.mkdir()
    tracked = subprocess.run(["git", "ls-files", "-z"], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    for name in filter(None, tracked.split("\0")):
        if (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            (copy / name).write_bytes((ROOT / name).read_bytes())
    subprocess.run([*build, "--wheel-dir", str(tmp_path), str(copy)], check=True, cwd=tmp_path)
    (wheel,) = tmp_path.glob("turbnet-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        archive.extractall(tmp_path / "installed")

    assert "turbnet/py.typed" in names
    for path in (copy / "configs").rglob("*.yaml"):
        assert f"turbnet/configs/{path.relative_to(copy / 'configs')}" in names
    for path in (copy / "turbnet").rglob("*"):
        if path.is_file():
            assert str(path.relative_to(copy)) in names, f"{path} is not packaged"
    assert not [name for name in names if name.startswith(("tests/", "tools/", "docs/"))]

    # Run from its own folder, which comes first on the path.
    done = subprocess.run(
        [sys.executable, "-m", "turbnet", "train", "experiment=tiny", "--cfg", "job"],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path / "installed",
    )
    assert done.returncode == 0, done.stderr
    assert "_target_: turbnet.tasks.restoration.Restoration" in done.stdout
