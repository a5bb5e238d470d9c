"""`turbnet stress` as a user runs it."""

import json
import subprocess
import sys


def turbnet(*arguments, cwd):
    command = [sys.executable, "-m", "turbnet", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=600, check=False)


def test_two_parts(tmp_path):
    done = turbnet("stress", "--quick", "--only", "path,sensor", "--quiet", "--json", "r.json", cwd=tmp_path)
    assert done.stderr == ""
    assert done.returncode == 0, done.stdout
    assert "| path |" in done.stdout
    assert "| sensor |" in done.stdout
    rows = json.loads((tmp_path / "r.json").read_text())["rows"]
    assert len(rows) > 500
    assert all(row["ok"] for row in rows)
    assert any(str(row["value"]).startswith("refused: Cn2") for row in rows)


def test_an_unknown_part_is_one_line(tmp_path):
    done = turbnet("stress", "--only", "path,weather", "--json", "r.json", cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert "weather" in done.stderr
    assert list(tmp_path.iterdir()) == []
