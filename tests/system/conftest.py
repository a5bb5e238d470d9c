"""A network that blends each frame with the mean of its window, quick and known in closed form."""

from pathlib import Path

import onnx
import pytest
from onnx import TensorProto, helper

from turbnet.deploy.card import ModelCard
from turbnet.deploy.seal import seal

WINDOW = 6


@pytest.fixture(scope="session")
def blend() -> onnx.ModelProto:
    """restored = 0.75 frames + 0.25 mean(frames over time)."""
    shape = ["batch", "frames", 3, "height", "width"]
    graph = helper.make_graph(
        [
            helper.make_node("ReduceMean", ["frames", "time"], ["mean"], keepdims=1),
            helper.make_node("Sub", ["mean", "frames"], ["change"]),
            helper.make_node("Mul", ["change", "weight"], ["step"]),
            helper.make_node("Add", ["frames", "step"], ["restored"]),
        ],
        "blend",
        [helper.make_tensor_value_info("frames", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("restored", TensorProto.FLOAT, shape)],
        [
            helper.make_tensor("time", TensorProto.INT64, [1], [1]),
            helper.make_tensor("weight", TensorProto.FLOAT, [], [0.25]),
        ],
    )
    return helper.make_model(graph, ir_version=10, opset_imports=[helper.make_opsetid("", 20)])


@pytest.fixture(scope="session")
def model(blend, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("model") / "blend.onnx"
    document = onnx.ModelProto()
    document.CopyFrom(blend)
    helper.set_model_props(document, ModelCard("blend", {}, size_multiple=4, frames=WINDOW).to_metadata())
    path.write_bytes(seal(document.SerializeToString()))
    return path
