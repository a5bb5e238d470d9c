"""`turbnet bench simulator` as a user runs it."""

import json
import subprocess
import sys


def turbnet(*arguments, cwd):
    command = [sys.executable, "-m", "turbnet", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=600, check=False)


def test_pictures_against_dense_scatter(tmp_path):
    done = turbnet("bench", "simulator", "--quick", "--only", "picture", "--quiet", "--json", "r.json", cwd=tmp_path)
    assert done.stderr == ""
    assert done.returncode == 0, done.stdout
    rows = {row["name"]: row for row in json.loads((tmp_path / "r.json").read_text())["rows"]}
    psnr = [row for name, row in rows.items() if "against dense scatter" in name and row["ok"] is not None]
    assert len(psnr) == 2
    assert all(45 <= row["value"] < 60 for row in psnr)
    learned = [row for name, row in rows.items() if name.endswith("L2 error of the PSF")]
    assert [row["value"] for row in learned] == sorted(row["value"] for row in learned)


def test_an_unknown_family_is_one_line(tmp_path):
    done = turbnet("bench", "simulator", "--only", "weather", cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert "weather" in done.stderr
