"""Spoiled models, checkpoints and datasets give a result or one line; see tools/fuzz.py for longer runs."""

import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[2] / "tools" / "fuzz.py"


@pytest.mark.parametrize("kind", ["model", "checkpoint", "dataset"])
def test_spoiled_files_give_a_result_or_one_line(fuzz, kind):
    found = {number: fuzz.run_case((kind, 0, number)) for number in range(60)}
    assert not any(found.values()), found


def test_a_case_that_kills_its_process_is_found(tmp_path):
    code = TOOL.read_text()
    begin, kind = "# --- running", "KINDS['boxes'] = Kind(_make_boxes, lambda path: os._exit(3))"
    assert code.count(begin) == 1
    (tmp_path / "fuzz.py").write_text(code.replace(begin, f"import os\n{kind}\n\n{begin}"))
    command = [sys.executable, tmp_path / "fuzz.py", "--cases", "2", "boxes"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert done.returncode == 1
    assert done.stdout.count("the process died with exit code 3") == 2
