"""A training that the tools start, go on with, or leave as it is once it is finished."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from turbnet.tasks.checkpoint import read_checkpoint


def train(output: Path, epochs: int, pictures: Sequence[Path], threads: int, arguments: Sequence[str]) -> Path:
    """`turbnet train` with these overrides into the folder `output`, for so many epochs in all; the last checkpoint."""
    last: Path = (output / "checkpoints/last.ckpt").resolve()
    if last.is_file() and read_checkpoint(last)["epoch"] + 1 >= epochs:
        return last
    folders = ",".join(str(path.resolve()) for path in pictures)
    common = [f"data.folders=[{folders}]", f"output={output.resolve()}", f"threads={threads}", "callbacks=quiet"]
    common += [f"trainer.max_epochs={epochs}"]
    resume = [f"resume={last}"] if last.is_file() else []
    subprocess.run([sys.executable, "-m", "turbnet", "train", *common, *arguments, *resume], check=True)
    return last
