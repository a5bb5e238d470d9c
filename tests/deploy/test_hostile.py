"""Models and checkpoints made to harm: nothing in them is executed, no other file is read, one line comes back."""

import json
import os
import zipfile
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper

from turbnet.cli import run
from turbnet.deploy.card import ModelCard
from turbnet.deploy.checkpoint import load_network
from turbnet.deploy.seal import seal
from turbnet.deploy.session import Model
from turbnet.errors import InputError
from turbnet.nets import build
from turbnet.tasks.checkpoint import read_checkpoint

NET = {"name": "dncnn", "width": 4, "depth": 3}


def refused(capsys, *arguments: object) -> str:
    """What the command says; it says so in one line and exits with 2."""
    assert run([str(argument) for argument in arguments]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1, said.err
    return said.err


# --- models -------------------------------------------------------------------------------------------------------


def graph_of(nodes, initializers=(), shape=("batch", "frames", 3, "height", "width"), kind=TensorProto.FLOAT):
    ends = [helper.make_tensor_value_info(name, kind, shape) for name in ("frames", "restored")]
    graph = helper.make_graph(nodes, "hostile", ends[:1], ends[1:], initializers)
    return helper.make_model(graph, ir_version=10, opset_imports=[helper.make_opsetid("", 20)])


def sealed(model: onnx.ModelProto, **card: object) -> bytes:
    metadata = ModelCard("hostile", {}, size_multiple=4, frames=2).to_metadata()
    metadata |= {f"turbnet.{name}": json.dumps(value) for name, value in card.items()}
    helper.set_model_props(model, metadata)
    return seal(model.SerializeToString())


def elsewhere(location: str) -> onnx.ModelProto:
    """A model that adds a weight from another file to its frames."""
    weight = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[1], data_location=TensorProto.EXTERNAL)
    weight.external_data.add(key="location", value=location)
    weight.external_data.add(key="length", value="4")
    return graph_of([helper.make_node("Add", ["frames", "w"], ["restored"])], [weight])


@pytest.fixture
def picture(tmp_path):
    from PIL import Image

    Image.new("RGB", (32, 32), (90, 90, 90)).save(tmp_path / "in.png")
    return tmp_path / "in.png"


@pytest.mark.parametrize("location", ["../../../../../etc/passwd", "/etc/passwd", "secret.bin", "./a/../secret.bin"])
def test_a_model_that_reads_another_file(tmp_path, capsys, monkeypatch, picture, location):
    (tmp_path / "secret.bin").write_bytes(np.float32(0.25).tobytes())
    (tmp_path / "a").mkdir()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "model.onnx").write_bytes(sealed(elsewhere(location)))
    says = refused(capsys, "restore", picture, "-o", tmp_path / "out.png", "--model", tmp_path / "model.onnx")
    assert "keeps weights in other files" in says
    assert not (tmp_path / "out.png").exists()


def test_external_data_is_found_however_it_is_written(tmp_path):
    """A protobuf takes a length in more bytes than needed, and key and value in either order."""
    data = elsewhere("secret.bin").SerializeToString()
    plain = b"\x0a\x08location"
    for longer in (b"\x0a\x88\x00location", b"\x0a\x88\x80\x00location"):
        assert plain in data
        with pytest.raises(InputError, match="other files"):
            Model(_with_seal(data.replace(plain, longer)))


def _with_seal(data: bytes) -> bytes:
    entry = helper.make_model(helper.make_graph([], "g", [], []))
    del entry.metadata_props[:]
    props = onnx.ModelProto()
    helper.set_model_props(props, {"turbnet.sha256": "0" * 64})
    return seal(data + props.SerializeToString())


def test_a_model_with_a_node_of_its_own(tmp_path, capsys, picture):
    model = graph_of([helper.make_node("Execute", ["frames"], ["restored"], domain="evil", command="touch marker")])
    model.opset_import.append(helper.make_opsetid("evil", 1))
    (tmp_path / "model.onnx").write_bytes(sealed(model))
    says = refused(capsys, "restore", picture, "-o", tmp_path / "out.png", "--model", tmp_path / "model.onnx")
    assert "cannot run the model" in says


def test_a_file_of_another_format_with_a_seal():
    """onnxruntime would take a flatbuffer of its own, which knows other ways to read files."""
    with pytest.raises(InputError, match="cannot run the model"):
        Model(_with_seal(b"\x1c\x00\x00\x00ORTM" + bytes(64)))


IDENTITY = helper.make_node("Identity", ["frames"], ["restored"])


@pytest.mark.parametrize(
    ("card", "says"),
    [
        ({"size_multiple": 0}, "size_multiple = 0"),
        ({"size_multiple": "4"}, "size_multiple = '4' is of the wrong kind"),
        ({"frames": 10**12}, "frames = 1e+12"),
        ({"frames": 1.5}, "frames = 1.5 is of the wrong kind"),
        ({"channels": -3}, "channels = -3"),
        ({"data_range": [0, "x"]}, "wrong kind"),
        ({"data_range": 3}, "model card cannot be read"),
        ({"config": []}, "config = [] is of the wrong kind"),
        ({"carried": {"memory": {"shape": [10**9], "scale": 1}}}, "shape of memory"),
        ({"carried": {"memory": {"shape": [60000, 60000], "scale": 1}}}, "values a pixel of memory"),
        ({"carried": {"memory": {"shape": [4], "scale": 0}}}, "scale of memory = 0"),
        ({"carried": {"memory": 3}}, "memory = 3"),
        ({"carried": {"memory": {"shape": [4], "scale": 1}}}, "does not take and return what its card says"),
        ({"version": "\x1b[2J"}, ""),
    ],
)
def test_cards_with_odd_values(tmp_path, capsys, picture, card, says):
    (tmp_path / "model.onnx").write_bytes(sealed(graph_of([IDENTITY]), **card, **({} if says else {"frames": 0})))
    said = refused(capsys, "restore", picture, "-o", tmp_path / "out.png", "--model", tmp_path / "model.onnx")
    assert says in said
    assert "\x1b" not in said


def test_a_card_nested_without_end(tmp_path):
    model = graph_of([IDENTITY])
    helper.set_model_props(model, ModelCard("x", {}, 4, 2).to_metadata() | {"turbnet.notes": "[" * 10**5})
    with pytest.raises(InputError, match="model card cannot be read"):
        Model(seal(model.SerializeToString()))


def test_models_that_do_other_than_they_say(tmp_path):
    frames = np.zeros((1, 2, 3, 16, 16), np.float32)
    half = [helper.make_node("AveragePool", ["frames"], ["restored"], kernel_shape=[1, 2, 2], strides=[1, 2, 2])]
    with pytest.raises(InputError, match="made frames of shape"):
        Model(sealed(graph_of(half)))(frames)
    with pytest.raises(InputError, match="does not take and return"):
        Model(sealed(graph_of([IDENTITY], kind=TensorProto.DOUBLE)))


# --- checkpoints --------------------------------------------------------------------------------------------------


class Runs:
    """What a pickle would run: it makes a file."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


@pytest.fixture(scope="module")
def checkpoint() -> dict:
    weights = {f"net.{name}": value for name, value in build(NET).state_dict().items()}
    return {"state_dict": weights, "hyper_parameters": {"net": NET, "simulator": {}, "seed": 1, "recipe": {}}}


@pytest.mark.parametrize("place", ["whole", "state_dict", "hyper_parameters", "callbacks"])
@pytest.mark.parametrize("zipped", [True, False])
def test_a_pickle_runs_nothing(tmp_path, capsys, checkpoint, place, zipped):
    marker = tmp_path / "marker"
    content = Runs(marker) if place == "whole" else {**checkpoint, place: Runs(marker)}
    path = tmp_path / "last.ckpt"
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    for arguments in (["export", path], ["bench", "maps", path, "--quiet"]):
        assert "last.ckpt is not a checkpoint that can be loaded safely" in refused(capsys, *arguments)
    assert not marker.exists()
    torch.load(path, weights_only=False)  # so would it be without care
    assert marker.exists()


@pytest.mark.parametrize(
    ("net", "says"),
    [
        ({"_target_": "os.mkdir", "path": "marker"}, "there is no network named None"),
        ({**NET, "_target_": "os.mkdir"}, "_target_"),
        ({"name": "os.mkdir"}, "there is no network named 'os.mkdir'"),
        ({"name": ["dncnn"]}, "there is no network named"),
        ({"name": "restorer", "tilt": {"_target_": "os.mkdir", "path": "marker"}}, "_target_"),
        ({**NET, "width": 10**9}, "width = 1e+09"),
        ({**NET, "width": 4096}, "weights do not fit"),
        ({**NET, "width": -1}, "width = -1"),
        ({**NET, "depth": "x"}, "dncnn"),
        ({"name": "restorer", "tcja": {"groups": 0}}, "restorer"),
        ({"name": "restorer", "fusions": 10**6}, "weights do not fit"),
        ({"name": "unet", "widths": [4] * 10**5}, "longer than"),
    ],
)
def test_a_checkpoint_names_no_class_and_no_size_of_its_own(tmp_path, capsys, monkeypatch, checkpoint, net, says):
    monkeypatch.chdir(tmp_path)
    hyper_parameters = {**checkpoint["hyper_parameters"], "net": net}
    torch.save({**checkpoint, "hyper_parameters": hyper_parameters}, "last.ckpt")
    assert says in refused(capsys, "export", "last.ckpt")
    assert [path.name for path in tmp_path.iterdir()] == ["last.ckpt"]


def test_weights_that_are_none(tmp_path, checkpoint):
    for state in ([], {3: torch.ones(1)}, {"net.x": "y"}):
        torch.save({**checkpoint, "state_dict": state}, tmp_path / "last.ckpt")
        with pytest.raises(InputError, match="not a checkpoint of turbnet"):
            load_network(tmp_path / "last.ckpt")


def test_a_checkpoint_that_inflates(tmp_path, checkpoint):
    torch.save(checkpoint, tmp_path / "good.ckpt")
    with (
        zipfile.ZipFile(tmp_path / "good.ckpt") as good,
        zipfile.ZipFile(tmp_path / "bad.ckpt", "w", zipfile.ZIP_DEFLATED) as bad,
    ):
        for part in good.infolist():
            bad.writestr(part.filename, good.read(part))
        bad.writestr("archive/data/99", bytes(10**7))
    assert (tmp_path / "bad.ckpt").stat().st_size < 10**6
    with pytest.raises(InputError, match="its parts are compressed"):
        read_checkpoint(tmp_path / "bad.ckpt")
    assert load_network(tmp_path / "good.ckpt")


def test_names_and_places_that_are_no_files(tmp_path, capsys, picture):
    for name in ("a" * 300, tmp_path, "/dev/zero"):
        refused(capsys, "export", name)
        refused(capsys, "restore", picture, "-o", tmp_path / "out.png", "--model", name)
    assert "too long" in refused(capsys, "simulate", picture, "-o", tmp_path / ("a" * 300 + ".mp4"), "--quiet")
