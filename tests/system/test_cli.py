import subprocess
import sys

import pytest

import turbnet
import turbnet.cli
from turbnet.cli import VERBS


def turbnet_command(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "turbnet", *map(str, arguments)], capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("arguments", [["--help"], ["-h"], []])
def test_help_names_every_command(arguments):
    done = turbnet_command(*arguments)
    assert done.returncode == 0
    assert all(f"  {verb} " in done.stdout for verb in VERBS)
    assert done.stderr == ""


def test_version():
    done = turbnet_command("--version")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"turbnet {turbnet.__version__}\n", "")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["improve"], "there is no command 'improve'"),
        (["--frobnicate"], "there is no command '--frobnicate'"),
        (["evaluate", "--frobnicate"], "--frobnicate"),
        (["evaluate", "--reference", "a.png"], "--restored"),
        (["evaluate", "--restored", "a.png", "--reference", "b.png", "--border", "wide"], "--border"),
        (["evaluate", "--restored", "a.png", "--reference", "b.png", "c.png"], "c.png"),
        (["evaluate", "--restored"], "--restored"),
    ],
)
def test_wrong_usage_is_one_line(arguments, says):
    done = turbnet_command(*arguments)
    assert done.returncode == 2
    assert done.stdout == ""
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("turbnet")


def test_help_of_a_command():
    done = turbnet_command("evaluate", "--help")
    assert done.returncode == 0
    assert "Usage: turbnet evaluate" in done.stdout
    assert "--border" in done.stdout


def test_importing_the_package_is_quick():
    script = "import sys, turbnet.cli; print([m for m in ('torch', 'numpy', 'typer', 'lightning') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize("arguments", [["--version"], ["restore", "--help"], ["simulate", "--help"]])
def test_help_costs_no_library(arguments):
    heavy = "torch lightning onnxruntime av numpy scipy"
    script = (
        "import sys, turbnet.cli; turbnet.cli.run(sys.argv[2:])\n"
        "print([name for name in sys.argv[1].split() if name in sys.modules], file=sys.stderr)"
    )
    command = [sys.executable, "-c", script, heavy, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stderr.splitlines()[-1] == "[]"


def test_an_error_steers_no_terminal(capsys):
    assert turbnet.cli.run(["restore", "\x1b[2Jx.png", "-o", "out.png"]) == 2
    assert "\x1b" not in capsys.readouterr().err
