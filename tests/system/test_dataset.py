"""`turbnet simulate --dataset` as a user runs it."""

import json
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import skimage.data
from PIL import Image

import turbnet.cli
from turbnet.data.shards import Shards
from turbnet.media.clip import write_clip

GUIDE = Path(__file__).parents[2] / "docs" / "guide" / "dataset.md"
SMALL = ["--pictures", "pictures", "--frames", 2, "--size", "16x24", "--shard-size", 2, "modes=10", "components=2"]
SEVEN = [*SMALL, "--samples", 7, "--text", 0.2]


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with pictures and clips in it, and an uninterrupted run."""
    folder = tmp_path_factory.mktemp("place")
    (folder / "pictures" / "more").mkdir(parents=True)
    (folder / "clips").mkdir()
    (folder / "empty").mkdir()
    Image.fromarray(skimage.data.astronaut()[:90, 150:250]).save(folder / "pictures" / "a.png")
    Image.fromarray(skimage.data.coffee()[100:180, 200:300]).save(folder / "pictures" / "more" / "b.png")
    moving = skimage.data.astronaut().astype(np.float32) / 255
    write_clip(folder / "clips" / "pan.mkv", np.stack([moving[i : i + 40, i : i + 40] for i in range(5)]))
    done = in_a_process_of_its_own(folder, "--dataset", "whole", *SEVEN, "--json", "run.json")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("samples 7, shards 4")
    return folder


def in_a_process_of_its_own(folder, *arguments, limit=None):
    command = [sys.executable, "-m", "turbnet", "simulate", *map(str, arguments)]
    if limit:
        command = ["bash", "-c", f'ulimit -f {limit}; exec "$@"', "bash", *command]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=300)


@pytest.fixture
def simulate(capfd, monkeypatch, place):
    """Runs the command in this process: simulate(*arguments) gives (code, stdout, stderr)."""

    def run(*arguments):
        monkeypatch.chdir(place)
        capfd.readouterr()
        code = turbnet.cli.run(["simulate", *map(str, arguments)])
        return code, *capfd.readouterr()

    return run


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_figures_in_the_schema_of_the_house(place):
    report = json.loads((place / "run.json").read_text())
    assert set(report) == {"version", "command", "machine", "rows"}
    rows = {row["name"]: row for row in report["rows"]}
    assert rows["samples"]["value"] == 7
    assert rows["size"]["value"] == sum(len(data) for name, data in contents(place / "whole").items() if name[0] == "s")
    assert set(rows["time"]) == {"name", "value", "unit", "reference", "tolerance", "ok"}


def test_the_command_in_the_manifest_makes_the_same_files(place, simulate):
    manifest = json.loads((place / "whole" / "manifest.json").read_text())
    words = manifest["command"].split()
    assert words[:4] == ["turbnet", "simulate", "--dataset", "OUT"]
    code, out, err = simulate("--dataset", "again", *words[4:], "--workers", 0, "--quiet")
    assert (code, out, err) == (0, "", "")
    assert contents(place / "again") == contents(place / "whole")


def test_killed_and_resumed_the_files_are_the_same(place, simulate):
    arguments = [*SMALL, "--samples", 80, "--simulator", "weak"]
    code, _, err = simulate("--dataset", "unbroken", *arguments, "--workers", 0)
    assert code == 0, err
    command = [
        sys.executable,
        "-m",
        "turbnet",
        "simulate",
        "--dataset",
        "killed",
        *map(str, arguments),
        "--workers",
        "2",
    ]
    with subprocess.Popen(command, cwd=place, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        try:
            until = time.monotonic() + 120
            while process.poll() is None and time.monotonic() < until:
                if (place / "killed" / "shard-00001.safetensors").exists():
                    break
                time.sleep(0.002)
        finally:
            process.send_signal(signal.SIGKILL)
    begun = json.loads((place / "killed" / "manifest.json").read_text())
    assert not begun["complete"]
    assert 1 <= len(begun["shards"]) < 40
    code, out, err = simulate("--dataset", "killed", "--verify")
    assert (code, out, err) == (1, f"shards: {len(begun['shards'])} of 40\n", "")
    code, _, err = simulate("--dataset", "killed", *arguments, "--workers", 1)
    assert code == 0, err
    assert contents(place / "killed") == contents(place / "unbroken")


def test_verify(place, simulate):
    assert simulate("--dataset", "whole", "--verify", "--json", "check.json") == (0, "shards: 4 of 4\n", "")
    rows = json.loads((place / "check.json").read_text())["rows"]
    assert [row["ok"] for row in rows] == [True] * 5
    (place / "harmed").mkdir()
    for name, data in contents(place / "whole").items():
        (place / "harmed" / name).write_bytes(
            data.replace(b"F16", b"I16") if name == "shard-00002.safetensors" else data
        )
    code, out, err = simulate("--dataset", "harmed", "--verify", "--quiet")
    assert (code, out, err) == (1, "shard-00002.safetensors: damaged or missing\n", "")
    assert simulate("--dataset", "harmed", *SEVEN)[0] == 0
    assert contents(place / "harmed") == contents(place / "whole")


def test_pictures_and_clips_take_turns(place, simulate):
    both = ["--dataset", "both", *SMALL, "--clips", "clips", "--samples", 6, "--moving", 0, "--simulator", "wide"]
    code, _, err = simulate(*both, "geometries=2", "stride=8")
    assert code == 0, err
    samples = Shards(place / "both")
    moves = [bool((sample["target"][0] != sample["target"][1]).any()) for sample in (samples[i] for i in range(6))]
    assert moves == [False, True] * 3
    assert len(samples.manifest["geometries"]) == 2
    assert samples.manifest["simulator"]["stride"] == 8


def test_a_full_disk_is_one_line_and_leaves_nothing(place):
    done = in_a_process_of_its_own(place, "--dataset", "huge", *SEVEN, "--quiet", limit=8)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1, done.stderr
    assert "cannot write huge" in done.stderr
    assert not (place / "huge").exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--dataset", "bad"], "--pictures"),
        (["--dataset", "bad", "--pictures", "empty"], "no pictures in empty"),
        (["--dataset", "bad", "--pictures", "absent"], "there is no folder absent"),
        (["--dataset", "bad", "--clips", "empty"], "no clips in empty"),
        (["--dataset", "bad", "--clips", "clips", "--frames", 6], "pan.mkv holds 5 frames"),
        (["--dataset", "bad", *SMALL, "d_over_r0=[3,1]"], "d_over_r0 = [3, 1] must be a range"),
        (["--dataset", "bad", *SMALL, "d_over_r0=[3"], "[3"),
        (["--dataset", "bad", *SMALL, "independent=2"], "independent = 2"),
        (["--dataset", "bad", *SMALL, "strength=2"], "its keys are d_over_r0"),
        (["--dataset", "bad", *SMALL, "height=2"], "its keys are d_over_r0"),
        (["--dataset", "bad", *SMALL, "--simulator", "huge"], "path7km recipe weak wide"),
        (["--dataset", "bad", *SMALL, "--size", "wide"], "--size wide"),
        (["--dataset", "bad", *SMALL, "--size", "0x8"], "height = 0"),
        (["--dataset", "bad", *SMALL, "--samples", 0], "samples = 0"),
        (["--dataset", "bad", *SMALL, "--frames", 0], "frames = 0"),
        (["--dataset", "bad", *SMALL, "--moving", 2], "moving = 2"),
        (["--dataset", "bad", *SMALL, "--text", -1], "text = -1"),
        (["--dataset", "bad", *SMALL, "--seed", -1], "seed = -1"),
        (["--dataset", "bad", *SMALL, "--workers", -1], "workers = -1"),
        (["--dataset", "bad", *SMALL, "--json", "no/such/file"], "no/such"),
        (["--dataset", "bad", *SMALL, "--frobnicate"], "--frobnicate"),
        (["--dataset", "bad", "--verify"], "there is no dataset in bad"),
        (["--dataset", "no/such/folder", *SMALL], "does not exist"),
        (["--dataset", "pictures", *SMALL], "is not empty"),
        (["--dataset", "run.json", *SMALL], "run.json"),
        (["--dataset", "whole", *SEVEN, "--seed", 1], "its seed is 0, not 1"),
        (["--dataset", "whole", *SEVEN, "wind=3"], "its simulator is"),
    ],
)
def test_bad_input_is_one_line(place, simulate, arguments, says):
    before = contents(place / "whole")
    code, out, err = simulate(*arguments)
    assert code == 2
    assert out == ""
    assert err.count("\n") == 1, err
    assert err.startswith("turbnet simulate: ")
    assert says in err
    assert not (place / "bad").exists()
    assert contents(place / "whole") == before


def test_a_damaged_picture_is_one_line(place, simulate):
    (place / "damaged").mkdir()
    (place / "damaged" / "a.png").write_bytes((place / "pictures" / "a.png").read_bytes()[:300])
    code, _, err = simulate("--dataset", "bad", "--pictures", "damaged", *SMALL[2:], "--workers", 2)
    assert code == 2
    assert err.count("\n") == 1, err
    assert "a.png" in err
    assert not (place / "bad").exists()


def test_it_never_imports_lightning(place):
    code = (
        "import sys; from turbnet.cli import run; "
        f"code = run(['simulate', '--dataset', 'light', *{[str(a) for a in SMALL]!r}, '--samples', '1', '--quiet']); "
        "assert not any(name.split('.')[0] == 'lightning' for name in sys.modules); sys.exit(code)"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=place, check=False).returncode == 0


def test_the_guide_reads_a_dataset_without_turbnet(place, tmp_path):
    (example,) = re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(example.splitlines()) <= 15
    (tmp_path / "pairs").symlink_to(place / "whole")
    check = "\nimport sys; assert not {'turbnet', 'torch'} & set(sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", example + check], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    table = json.loads((place / "whole" / "manifest.json").read_text())["samples"]
    lines = done.stdout.splitlines()
    assert len(lines) == len(table)
    for line, row in zip(lines, table, strict=True):
        assert line.startswith(f"{row['index']}: D/r0 = {row['d_over_r0']:.2f}")
        sample = Shards(place / "whole")[row["index"]]
        psnr = -10 * np.log10(float((sample["frames"] - sample["target"]).double().square().mean()))
        assert float(re.search(r"([\d.]+) dB", line)[1]) == pytest.approx(psnr, abs=0.006)
