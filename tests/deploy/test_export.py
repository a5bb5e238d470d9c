import json
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from torch import nn

from turbnet.deploy import export
from turbnet.deploy.card import ModelCard
from turbnet.deploy.export import compare, export_onnx, flush_denormals
from turbnet.deploy.session import Model
from turbnet.errors import InputError
from turbnet.nets.deconvolution import RichardsonLucy, tails_kernel, turbulence_kernel


def test_reproduces_torch_on_shapes_it_was_not_exported_with(network, model_file):
    model = Model.load(model_file, threads=1)
    rows = compare(network, model)
    assert len({row.shape for row in rows}) == 10
    assert {row.shape[0] for row in rows} == {1, 2, 3, 4}
    assert 1 in {row.shape[1] for row in rows}
    assert max(row.difference for row in rows) < 1e-5
    frames_BTCHW = np.random.default_rng(0).random((2, 13, 3, 36, 52), np.float32)
    with torch.no_grad():
        expected = network(torch.from_numpy(frames_BTCHW)).numpy()
    np.testing.assert_allclose(model(frames_BTCHW), expected, atol=1e-5)
    assert np.abs(expected - frames_BTCHW).max() > 0.05  # the network does something


def test_the_network_handed_in_is_left_as_it_was(stand_in, card, tmp_path):
    network = stand_in().train()
    weights = {name: weight.clone() for name, weight in network.state_dict().items()}
    export_onnx(network, card, tmp_path / "model.onnx")
    assert network.training
    assert all(torch.equal(weight, weights[name]) for name, weight in network.state_dict().items())


def test_file_tells_nothing_of_the_machine(model_file):
    data = model_file.read_bytes()
    for place in (Path.cwd(), Path(sys.prefix), Path(torch.__file__).parent, Path(__file__).parent):
        assert str(place).encode() not in data
    assert b"stack_trace" not in data
    assert b".py" not in data


def test_file_is_valid_onnx_with_free_sizes(model_file):
    model = onnx.load(model_file)
    onnx.checker.check_model(model, full_check=True)
    for value, name in ((model.graph.input[0], "frames"), (model.graph.output[0], "restored")):
        assert value.name == name
        dims = value.type.tensor_type.shape.dim
        assert [dim.dim_param or dim.dim_value for dim in dims] == ["batch", "frames", 3, "height", "width"]


def test_same_network_gives_the_same_bytes(network, card, model_file, tmp_path):
    export_onnx(network, card, tmp_path / "again.onnx")
    assert (tmp_path / "again.onnx").read_bytes() == model_file.read_bytes()


def test_card_with_a_local_path_is_refused(network, tmp_path):
    card = ModelCard("stand-in", {}, 4, 6, notes={"data": str(Path.cwd() / "photos")})
    with pytest.raises(InputError, match="tell of this machine"):
        export_onnx(network, card, tmp_path / "model.onnx")
    assert list(tmp_path.iterdir()) == []


class Forgetful(nn.Module):
    """A branch on the shape: the exporter keeps the side it saw, and a single frame goes wrong."""

    def forward(self, frames_BTCHW):
        return frames_BTCHW if frames_BTCHW.shape[1] > 1 else 1 - frames_BTCHW


class Solver(nn.Module):
    """No ONNX operator solves linear equations."""

    def forward(self, frames_BTCHW):
        return frames_BTCHW + torch.linalg.solve(torch.eye(3), torch.ones(3))[:, None, None]


@pytest.mark.parametrize(
    ("network", "says"),
    [(Forgetful(), r"cannot export bad: onnxruntime and torch differ by \S+ on frames of shape \(1, 1, 3, 16, 16\)")]
    + [(Solver(), "cannot export bad: ")],
)
def test_network_that_onnx_cannot_hold_leaves_no_file(network, says, tmp_path):
    with pytest.raises(InputError, match=says):
        export_onnx(network, ModelCard("bad", {}, 4, 6), tmp_path / "model.onnx")
    assert list(tmp_path.iterdir()) == []


def test_difference_from_torch_is_found(network, card, tmp_path, monkeypatch):
    monkeypatch.setattr(export, "TOLERANCE", 0.0)
    with pytest.raises(InputError, match="onnxruntime and torch differ by"):
        export_onnx(network, card, tmp_path / "model.onnx")
    assert list(tmp_path.iterdir()) == []


def test_denormal_weights_are_flushed(stand_in):
    network = stand_in()
    with torch.no_grad():
        network.head.weight[0] = 1e-40
        network.head.weight[1] = 2e-38
    flush_denormals(network)
    assert torch.all(network.head.weight[0] == 0)
    assert torch.all(network.head.weight[1] == 2e-38)


class TiltHead(nn.Module):
    """A part of a network: two channels out, not three."""

    def __init__(self):
        super().__init__()
        self.convolve = nn.Conv2d(3, 2, 3, padding=1)

    def forward(self, frames_BTCHW):
        return self.convolve(frames_BTCHW.flatten(0, 1)).unflatten(0, frames_BTCHW.shape[:2])


def test_part_of_a_network_exports_as_well(tmp_path):
    export_onnx(TiltHead(), ModelCard("tilt", {}, 4, 6), tmp_path / "tilt.onnx")
    assert Model.load(tmp_path / "tilt.onnx")(np.zeros((1, 2, 3, 16, 20), np.float32)).shape == (1, 2, 2, 16, 20)


def test_card_beside_the_file(model_file, tmp_path):
    card = Model.load(model_file).card
    card.write_beside(tmp_path / "model.onnx")
    assert json.loads((tmp_path / "model.json").read_text())["sha256"] == card.sha256
    text = (tmp_path / "model.md").read_text()
    assert text.startswith("# model\n")
    assert card.sha256 in text
    assert "multiples of 4" in text


class Deconvolved(nn.Module):
    """The first guess at every frame."""

    def __init__(self):
        super().__init__()
        self.undo = RichardsonLucy([turbulence_kernel(2.0), tails_kernel(3.0, 19)], steps=3)

    def forward(self, frames_BTCHW):
        return self.undo(frames_BTCHW.flatten(0, 1) + 0.01)[:, 1].unflatten(0, frames_BTCHW.shape[:2])


def test_deconvolution_goes_through_in_one_piece(card, tmp_path):
    """What the exporter is told of it computes what torch does, and the network itself stays as it was."""
    network = Deconvolved().eval()
    parity = export_onnx(network, card, tmp_path / "undo.onnx")
    assert max(row.difference for row in parity) < 1e-5
    assert network.undo.iterate is RichardsonLucy.iterate
    kinds = [node.op_type for node in onnx.load(tmp_path / "undo.onnx").graph.node]
    assert kinds.count("Resize") == 2 * 3
