"""Peak memory of processes. Linux's `ru_maxrss` goes on from what the parent held, through fork and exec: not that."""

import resource
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

# Small itself, so that what it starts goes on from next to nothing.
_LAUNCHER = """
import resource, subprocess, sys
code = subprocess.call(sys.argv[2:])
with open(sys.argv[1], "w") as file:
    file.write(str(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss))
sys.exit(code % 256)
"""


def own_peak() -> float:
    """GiB that this process held at most since its program began."""
    status = Path("/proc/self/status")
    for line in status.read_text().splitlines() if status.is_file() else ():
        name, _, value = line.partition(":")
        if name == "VmHWM":
            return float(value.split()[0]) / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def run_measured(command: Sequence[str], **how: Any) -> tuple["subprocess.CompletedProcess[Any]", float]:
    """`subprocess.run(command, **how)`, and the GiB that the largest process of it held at most."""
    with tempfile.TemporaryDirectory() as folder:
        told = Path(folder) / "peak"
        done = subprocess.run([sys.executable, "-I", "-S", "-c", _LAUNCHER, str(told), *command], **how)
        return done, float(told.read_text()) / 2**20 if told.is_file() else 0.0
