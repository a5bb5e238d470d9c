"""`turbnet export` on checkpoints, in this process: the registry of networks is replaced by a stand-in."""

import json

import numpy as np
import pytest
import torch
from torch import nn

from turbnet import nets
from turbnet.cli import run
from turbnet.deploy.session import Model
from turbnet.errors import InputError


class Blend(nn.Module):
    """A convolution, plus the mean over time."""

    size_multiple = 2

    def __init__(self, width: int):
        super().__init__()
        self.spread = nn.Conv2d(3, width, 3, padding=1)
        self.gather = nn.Conv2d(width, 3, 1)

    def forward(self, frames_BTCHW):
        y = self.gather(torch.relu(self.spread(frames_BTCHW.flatten(0, 1)))).unflatten(0, frames_BTCHW.shape[:2])
        return y + frames_BTCHW.mean(1, keepdim=True)


@pytest.fixture(autouse=True)
def registry(monkeypatch):
    def build(config):
        config = dict(config)
        if config.pop("name") != "blend":
            raise InputError("there is no such network; the networks are blend")
        return Blend(**config)

    monkeypatch.setattr(nets, "build", build, raising=False)


@pytest.fixture
def checkpoint() -> dict:
    torch.manual_seed(0)
    weights = {f"net.{name}": weight for name, weight in Blend(5).state_dict().items()}
    recipe = {"steps": 100, "data": "/home/someone/photos"}
    return {
        "state_dict": weights | {"loss.scale": torch.ones(1)},
        "hyper_parameters": {"net": {"name": "blend", "width": 5}, "seed": 7, "recipe": recipe},
    }


def test_checkpoint_to_model(checkpoint, tmp_path, capsys):
    torch.save(checkpoint, tmp_path / "last.ckpt")
    report = tmp_path / "report.json"
    assert run(["export", str(tmp_path / "last.ckpt"), "--frames", "8", "--json", str(report)]) == 0
    assert "largest difference from torch" in capsys.readouterr().out
    rows = json.loads(report.read_text())["rows"]
    assert len(rows) == 5
    assert all(row["ok"] for row in rows)

    model = Model.load(tmp_path / "last.onnx")
    card = model.card
    assert (card.architecture, card.config, card.size_multiple, card.frames) == ("blend", {"width": 5}, 2, 8)
    assert (card.seed, card.notes) == (7, {"steps": 100, "data": "photos"})
    assert json.loads((tmp_path / "last.json").read_text())["sha256"] == card.sha256
    assert card.sha256 in (tmp_path / "last.md").read_text()

    network = Blend(5)
    network.load_state_dict({key[4:]: value for key, value in checkpoint["state_dict"].items() if key[:4] == "net."})
    frames_BTCHW = torch.rand(1, 4, 3, 10, 14)
    with torch.no_grad():
        np.testing.assert_allclose(model(frames_BTCHW.numpy()), network(frames_BTCHW).numpy(), atol=1e-5)


def refused(capsys, tmp_path, *arguments: str) -> str:
    before = set(tmp_path.iterdir())
    assert run(["export", *arguments]) == 2
    assert set(tmp_path.iterdir()) == before
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"hyper_parameters": {"net": {"name": "other"}}}, "there is no such network"),
        ({"hyper_parameters": {"net": {"name": "blend", "width": 6}}}, "do not fit the network blend"),
        ({"hyper_parameters": {"net": {"name": "blend", "depth": 6}}}, "depth"),
        ({"hyper_parameters": {"model": "resnet"}}, "other software"),
        ({"hyper_parameters": {"net": "blend"}}, "other software"),
        ({"state_dict": {}}, "do not fit the network blend"),
        ({"state_dict": [1, 2]}, "other software"),
    ],
)
def test_checkpoints_that_do_not_fit(checkpoint, tmp_path, capsys, change, says):
    torch.save(checkpoint | change, tmp_path / "bad.ckpt")
    assert says in refused(capsys, tmp_path, str(tmp_path / "bad.ckpt"))


def test_files_that_are_no_checkpoints(checkpoint, tmp_path, capsys):
    torch.save(checkpoint, tmp_path / "good.ckpt")
    data = (tmp_path / "good.ckpt").read_bytes()
    torch.save(torch.ones(3), tmp_path / "tensor.ckpt")
    torch.save(Blend(3), tmp_path / "module.ckpt")  # a pickled module: code, not data
    (tmp_path / "half.ckpt").write_bytes(data[: len(data) // 2])
    (tmp_path / "text.ckpt").write_text("hello")
    (tmp_path / "empty.ckpt").write_bytes(b"")
    for name in ("tensor", "module", "half", "text", "empty"):
        assert f"{name}.ckpt" in refused(capsys, tmp_path, str(tmp_path / f"{name}.ckpt"))
    assert "No such file" in refused(capsys, tmp_path, str(tmp_path / "none.ckpt"))


def test_outputs_that_cannot_be(checkpoint, tmp_path, capsys):
    torch.save(checkpoint, tmp_path / "last.ckpt")
    source = str(tmp_path / "last.ckpt")
    assert "ends in .onnx" in refused(capsys, tmp_path, source, "-o", str(tmp_path / "model.pt"))
    assert "does not exist" in refused(capsys, tmp_path, source, "-o", str(tmp_path / "none" / "model.onnx"))
    assert "frames = 0" in refused(capsys, tmp_path, source, "--frames", "0")
