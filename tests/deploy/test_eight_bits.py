"""Convolutions in eight bits: the file, and the gate before it."""

import numpy as np
import onnx
import pytest
import torch

from turbnet.bench import precision
from turbnet.cli import run
from turbnet.deploy.eight_bits import write_eight_bits
from turbnet.deploy.session import Model
from turbnet.nets import build

STILL = {"name": "still", "widths": [8, 8, 8], "depths": [1, 1, 1]}


@pytest.fixture
def clip() -> np.ndarray:
    return np.random.default_rng(0).random((2, 64, 64, 3), np.float32)


def test_file_in_eight_bits(model_file, clip, tmp_path):
    """Sealed, its card telling what it is, a step or two of 256 away from the whole one; few channels are left exact."""
    write_eight_bits(model_file, tmp_path / "small.onnx", [clip])
    exact, rounded = Model.load(model_file), Model.load(tmp_path / "small.onnx")
    assert "eight bits" in rounded.card.notes["numbers"]
    assert (rounded.card.architecture, rounded.card.seed, rounded.card.notes["data"]) == ("stand-in", 1, "none")
    assert rounded.card.sha256 != exact.card.sha256
    frames_BTCHW = np.random.default_rng(1).random((2, 3, 3, 40, 56), np.float32)  # not the size it was calibrated on
    difference = np.abs(rounded(frames_BTCHW) - exact(frames_BTCHW))
    assert 0 < difference.mean() < 2 / 256
    assert difference.max() < 16 / 256  # 56 where sums of two products overflow sixteen bits, as without VNNI they can
    weights = [x for x in onnx.load(tmp_path / "small.onnx").graph.initializer if len(x.dims) == 4]
    kinds = {x.dims[0]: x.data_type for x in weights}  # by channels of the output
    assert kinds == {8: onnx.TensorProto.FLOAT, 48: onnx.TensorProto.INT8}


def test_same_clips_give_the_same_bytes(model_file, clip, tmp_path):
    for name in ("a.onnx", "b.onnx"):
        write_eight_bits(model_file, tmp_path / name, [clip])
    assert (tmp_path / "a.onnx").read_bytes() == (tmp_path / "b.onnx").read_bytes()


@pytest.mark.parametrize(
    ("faster", "lost", "worth"), [(1.3, 0.05, True), (1.05, 0.05, False), (1.3, 0.15, False), (1.1, 0.1, True)]
)
def test_the_gate(tmp_path, monkeypatch, capsys, faster, lost, worth):
    """What does not pay is not written, and one line says why."""
    network = build(STILL)
    state = {f"net.{name}": value for name, value in network.state_dict().items()}
    torch.save({"state_dict": state, "hyper_parameters": {"net": STILL, "seed": 1}}, tmp_path / "last.ckpt")
    verdict = precision.Verdict(faster, {"static": 0.01, "text": lost})
    monkeypatch.setattr(precision, "judge", lambda exact, rounded: verdict)
    assert run(["export", str(tmp_path / "last.ckpt"), "--eight-bits"]) == (0 if worth else 2)
    said = capsys.readouterr()
    if worth:
        assert "eight bits" in Model.load(tmp_path / "last.onnx").card.notes["numbers"]
        assert "times as fast here" in said.out
    else:
        assert [path.name for path in tmp_path.iterdir()] == ["last.ckpt"]
        assert f"{lost:.3f} dB of text" in said.err
        assert said.err.count("\n") == 1


def test_one_form_at_a_time(tmp_path, capsys):
    assert run(["export", "xs", "-o", str(tmp_path / "a.onnx"), "--eight-bits", "--streaming"]) == 2
    assert "give one of" in capsys.readouterr().err
