import json
import subprocess
import sys

import pytest


def turbnet(*arguments, cwd):
    command = [sys.executable, "-m", "turbnet", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=900, check=False)


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench")
    figures = folder / "figures"
    return turbnet(
        "bench", "physics", "--quick", "--quiet", "--json", "r.json", "--figures", figures, cwd=folder
    ), folder


def test_the_quick_bench_writes_every_family_beside_its_theory(quick):
    done, folder = quick
    assert done.stderr == ""
    assert "| quantity" in done.stdout
    report = json.loads((folder / "r.json").read_text())
    assert set(report) == {"version", "command", "machine", "rows"}
    assert all(set(row) == {"name", "value", "unit", "reference", "tolerance", "ok"} for row in report["rows"])
    names = [row["name"] for row in report["rows"]]
    assert len(names) == len(set(names))
    for family in (
        "Kolmogorov: structure function",
        "von Karman",
        "tilt variance, j = 2, D/r0 = 5",
        "Noll variance, j = 15, D/r0 = 1",
        "long-exposure OTF",
        "short-exposure OTF",
        "r0 from",
        "theta0 from",
        "Z-tilt",
        "D-tilt",
        "lucky probability",
        "speed",
    ):
        assert any(name.startswith(family) for name in names), family


def test_its_verdicts_follow_from_its_numbers(quick):
    done, folder = quick
    rows = json.loads((folder / "r.json").read_text())["rows"]
    judged = [row for row in rows if row["ok"] is not None and not row["name"].startswith("speed")]
    for row in judged:
        assert row["ok"] == (abs(row["value"] - row["reference"]) <= row["tolerance"]), row["name"]
    assert sum(row["ok"] for row in judged) >= 0.95 * len(judged)
    assert done.returncode == (0 if all(row["ok"] is not False for row in rows) else 1)
    held = [row for row in rows if "held by the screens" in row["name"]]
    assert len(held) == 2
    assert all(abs(row["value"] / row["reference"] - 1) < 0.03 for row in held)


@pytest.mark.slow
def test_the_full_bench_passes(tmp_path):
    done = turbnet("bench", "physics", "--quiet", "--json", "r.json", cwd=tmp_path)
    assert done.returncode == 0, [line for line in done.stdout.splitlines() if "FAIL" in line]


def test_it_draws_a_small_figure_of_each_family(quick):
    figures = sorted((quick[1] / "figures").iterdir())
    assert [f.stem for f in figures] == [
        "d-tilt",
        "long-exposure",
        "lucky",
        "noll-variances",
        "short-exposure",
        "structure-function",
        "z-tilt",
    ]
    for figure in figures:
        assert figure.read_bytes().startswith(b"\x89PNG")
        assert figure.stat().st_size < 100_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nonsense"], "there is no suite 'nonsense'"),
        (["physics", "--nonsense"], "No such option"),
        (["physics", "--json", "missing/r.json"], "the folder missing does not exist"),
        (["physics", "--figures", "file"], "it is a file"),
    ],
)
def test_wrong_usage_is_one_line_and_exit_code_2(tmp_path, arguments, message):
    (tmp_path / "file").write_text("")
    done = turbnet("bench", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert message in done.stderr
    assert done.stdout == ""


def test_help_names_the_suites_and_their_options(tmp_path):
    assert "physics" in turbnet("bench", "--help", cwd=tmp_path).stdout
    assert "--quick" in turbnet("bench", "physics", "--help", cwd=tmp_path).stdout
