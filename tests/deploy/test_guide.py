"""The loader in docs/guide/export.md, run as it stands there."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from turbnet.deploy.session import Model
from turbnet.deploy.tiling import Tiling

GUIDE = Path(__file__).parents[2] / "docs" / "guide" / "export.md"


@pytest.fixture
def example() -> str:
    (code,) = re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    return code


@pytest.mark.parametrize("size", [(37, 50), (32, 40), (5, 70)])
def test_loader_without_turbnet(example, model_file, tmp_path, size):
    frames_THWC = np.random.default_rng(0).random((7, *size, 3), np.float32)
    np.save(tmp_path / "frames.npy", frames_THWC)
    shutil.copy(model_file, tmp_path / "model.onnx")
    subprocess.run([sys.executable, "-c", example], cwd=tmp_path, check=True)
    expected_TCHW = np.stack(Tiling(128, 16, 4).apply(Model.load(model_file), frames_THWC.transpose(0, 3, 1, 2)))
    expected_THWC = expected_TCHW.transpose(0, 2, 3, 1).clip(0, 1)
    np.testing.assert_allclose(np.load(tmp_path / "restored.npy"), expected_THWC, atol=1e-6)


def test_loader_notices_damage(example, model_file, tmp_path):
    data = bytearray(model_file.read_bytes())
    data[200] ^= 1
    (tmp_path / "model.onnx").write_bytes(data)
    done = subprocess.run([sys.executable, "-c", example], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 1
    assert "damaged or was changed" in done.stderr
