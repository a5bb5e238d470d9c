"""`turbnet export` on checkpoints, in this process: torch is loaded once."""

import json

import numpy as np
import pytest
import torch
from torch import nn

from turbnet.cli import run
from turbnet.deploy.session import Model
from turbnet.nets import build

NET = {
    "name": "restorer",
    "tilt": {"widths": [8, 8, 8]},
    "tcja": {"width": 8, "depth": 1},
    "scene": {"widths": [8, 8, 8], "depths": [1, 1, 1]},
}


@pytest.fixture(scope="module")
def checkpoint() -> dict:
    torch.manual_seed(0)
    network = build(NET)
    for parameter in network.parameters():  # heads start at zero; as if trained
        nn.init.normal_(parameter, std=0.05)
    weights = {f"net.{name}": weight for name, weight in network.state_dict().items()}
    recipe = {"frames": [1, 14], "steps": 100, "data": "/home/someone/photos"}
    return {
        "state_dict": weights | {"pairs.scale": torch.ones(1)},
        "hyper_parameters": {"net": NET, "simulator": {"d_over_r0": [1.0, 4.0]}, "seed": 7, "recipe": recipe},
    }


def test_checkpoint_to_model(checkpoint, tmp_path, capsys):
    torch.save(checkpoint, tmp_path / "last.ckpt")
    report = tmp_path / "report.json"
    assert run(["export", str(tmp_path / "last.ckpt"), "--json", str(report)]) == 0
    assert "largest difference from torch" in capsys.readouterr().out
    rows = json.loads(report.read_text())["rows"]
    assert len(rows) == 10
    assert all(row["ok"] for row in rows)

    model = Model.load(tmp_path / "last.onnx")
    card = model.card
    assert {"name": card.architecture, **card.config} == NET
    assert (card.size_multiple, card.frames, card.seed) == (8, 14, 7)  # of a range of frames the greatest
    assert card.notes == {"simulator": {"d_over_r0": [1.0, 4.0]}, "frames": [1, 14], "steps": 100, "data": "photos"}
    assert json.loads((tmp_path / "last.json").read_text())["sha256"] == card.sha256
    assert card.sha256 in (tmp_path / "last.md").read_text()

    network = build(NET).eval()
    network.load_state_dict({key[4:]: value for key, value in checkpoint["state_dict"].items() if key[:4] == "net."})
    frames_BTCHW = torch.rand(1, 4, 3, 40, 56)
    with torch.no_grad():
        np.testing.assert_allclose(model(frames_BTCHW.numpy()), network(frames_BTCHW).numpy(), atol=2e-5)


def test_streaming_options_out_of_range(checkpoint, tmp_path, capsys):
    torch.save(checkpoint, tmp_path / "last.ckpt")
    says = refused(capsys, tmp_path, str(tmp_path / "last.ckpt"), "--streaming", "--horizon", "0.5")
    assert "horizon = 0.5" in says


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
        ({"hyper_parameters": {"net": {"name": "other"}}}, "there is no network named 'other'"),
        ({"hyper_parameters": {"net": {"name": "restorer"}}}, "do not fit the network it names"),
        ({"hyper_parameters": {"net": {"name": "restorer", "depth": 6}}}, "depth"),
        ({"hyper_parameters": {"model": "resnet"}}, "which network"),
        ({"hyper_parameters": {"net": "restorer"}}, "which network"),
        ({"state_dict": {}}, "do not fit the network it names"),
    ],
)
def test_checkpoints_that_do_not_fit(checkpoint, tmp_path, capsys, change, says):
    torch.save(checkpoint | change, tmp_path / "bad.ckpt")
    assert says in refused(capsys, tmp_path, str(tmp_path / "bad.ckpt"))


def test_files_that_are_no_checkpoints(checkpoint, tmp_path, capsys):
    torch.save(checkpoint, tmp_path / "good.ckpt")
    data = (tmp_path / "good.ckpt").read_bytes()
    torch.save(torch.ones(3), tmp_path / "tensor.ckpt")
    torch.save(build(NET), tmp_path / "module.ckpt")  # a pickled module: code, not data
    (tmp_path / "half.ckpt").write_bytes(data[: len(data) // 2])
    (tmp_path / "text.ckpt").write_text("hello")
    for name in ("tensor", "module", "half", "text"):
        assert f"{name}.ckpt" in refused(capsys, tmp_path, str(tmp_path / f"{name}.ckpt"))
    assert "no checkpoint" in refused(capsys, tmp_path, str(tmp_path / "none.ckpt"))


def test_outputs_that_cannot_be(checkpoint, tmp_path, capsys):
    torch.save(checkpoint, tmp_path / "last.ckpt")
    source = str(tmp_path / "last.ckpt")
    assert "ends in .onnx" in refused(capsys, tmp_path, source, "-o", str(tmp_path / "model.pt"))
    assert "does not exist" in refused(capsys, tmp_path, source, "-o", str(tmp_path / "none" / "model.onnx"))
    assert "frames = 0" in refused(capsys, tmp_path, source, "--frames", "0")


def test_maps_alone(checkpoint, tmp_path, capsys):
    config = {"name": "still", "widths": [4, 6, 8], "depths": [1, 1, 1], "maps": {"widths": [4, 6, 8]}}
    torch.manual_seed(0)
    network = build(config)
    weights = {f"net.{name}": weight for name, weight in network.state_dict().items()}
    torch.save(
        {**checkpoint, "state_dict": weights, "hyper_parameters": {"net": config, "seed": 1}}, tmp_path / "still.ckpt"
    )
    target = tmp_path / "maps.onnx"
    assert run(["export", str(tmp_path / "still.ckpt"), "--maps", "-o", str(target), "--quiet"]) == 0
    model = Model.load(target)
    assert (model.card.architecture, model.card.frames) == ("uncertainty maps", 1)
    assert model(np.zeros((1, 2, 3, 32, 40), np.float32)).shape == (1, 2, 3, 32, 40)

    torch.save(checkpoint, tmp_path / "last.ckpt")
    assert run(["export", str(tmp_path / "last.ckpt"), "--maps"]) == 2
    assert "no uncertainty maps" in capsys.readouterr().err
    assert run(["export", str(tmp_path / "last.ckpt"), "--maps", "--streaming"]) == 2
