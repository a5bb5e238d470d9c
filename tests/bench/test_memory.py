import subprocess
import sys

from turbnet.bench.memory import own_peak, run_measured

HOLDS = "x = bytearray({} * 2**20); x[::4096] = b'1' * len(x[::4096])"


def test_what_a_parent_held_does_not_count():
    """A process of 300 MiB starts one of 100 MiB, and one that says its own peak."""
    code = f"""
{HOLDS.format(300)}
import sys
from turbnet.bench.memory import own_peak, run_measured
done, peak = run_measured([sys.executable, "-c", {HOLDS.format(100)!r}], check=True)
own = "from turbnet.bench.memory import own_peak; print(own_peak())"
said, _ = run_measured([sys.executable, "-c", own], check=True, capture_output=True, text=True)
print(own_peak(), peak, float(said.stdout))
"""
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    parent, child, idle = (float(word) * 1024 for word in done.stdout.split())
    assert 300 < parent < 400
    assert 100 < child < 200
    assert idle < 100


def test_what_a_command_says_and_how_it_ends_comes_back():
    done, peak = run_measured([sys.executable, "-c", "print(1); exit(3)"], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (3, "1\n")
    assert 0 < peak < own_peak()
