import subprocess
import sys
from dataclasses import replace

import numpy as np
import onnx
import pytest

from turbnet.deploy.card import ModelCard
from turbnet.deploy.seal import seal, verify
from turbnet.deploy.session import Model
from turbnet.errors import InputError


def test_card_survives_the_file(card, model_file):
    stored = Model.load(model_file).card
    assert stored == replace(card, sha256=stored.sha256)
    assert stored.sha256 == verify(model_file.read_bytes())
    assert len(set(stored.sha256)) > 1


def test_every_changed_byte_is_noticed(model_file):
    data = model_file.read_bytes()
    positions = np.random.default_rng(0).integers(0, len(data), 200)
    digest_at = data.index(b"turbnet.sha256") + len("turbnet.sha256") + 2
    for position in (0, digest_at, digest_at + 63, len(data) - 1, *positions):
        damaged = bytearray(data)
        damaged[position] ^= 0x10
        with pytest.raises(InputError):
            verify(bytes(damaged))


def test_truncated_file_is_noticed(model_file):
    data = model_file.read_bytes()
    for length in (0, 1, len(data) // 2, len(data) - 1):
        with pytest.raises(InputError):
            Model(data[:length])


def test_damage_is_found_before_the_file_is_parsed(model_file, monkeypatch):
    data = bytearray(model_file.read_bytes())
    data[100] ^= 1
    monkeypatch.setattr("onnxruntime.InferenceSession", lambda *_, **__: pytest.fail("parsed"))
    with pytest.raises(InputError, match="damaged or was changed"):
        Model(bytes(data))


def test_a_file_is_sealed_once(model_file):
    with pytest.raises(ValueError, match="sealed already"):
        seal(model_file.read_bytes())


def foreign_onnx() -> onnx.ModelProto:
    value = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("Identity", ["frames"], ["restored"])],
        "identity",
        [value("frames", onnx.TensorProto.FLOAT, [None, None, 3, None, None])],
        [value("restored", onnx.TensorProto.FLOAT, [None, None, 3, None, None])],
    )
    return onnx.helper.make_model(graph, ir_version=10, opset_imports=[onnx.helper.make_opsetid("", 20)])


def with_metadata(model: onnx.ModelProto, metadata: dict[str, str]) -> bytes:
    onnx.helper.set_model_props(model, metadata)
    return seal(model.SerializeToString())


def test_foreign_files(tmp_path, model_file):
    def message(data: bytes) -> str:
        (tmp_path / "model.onnx").write_bytes(data)
        with pytest.raises(InputError) as caught:
            Model.load(tmp_path / "model.onnx")
        assert "model.onnx" in str(caught.value)
        return str(caught.value)

    assert "not a turbnet model" in message(foreign_onnx().SerializeToString())
    assert "not a turbnet model" in message(b"")
    assert "not a turbnet model" in message(b"\x89PNG\r\n\x1a\n" + bytes(1000))
    assert "not a turbnet model" in message(2 * model_file.read_bytes())
    metadata = ModelCard("identity", {}, 4, 6).to_metadata()
    assert "model card cannot be read" in message(
        with_metadata(foreign_onnx(), {key: value for key, value in metadata.items() if key != "turbnet.frames"})
    )
    assert "model card cannot be read" in message(with_metadata(foreign_onnx(), metadata | {"turbnet.frames": "{"}))
    future = foreign_onnx()
    future.opset_import[0].version = 99
    assert "cannot run the model" in message(with_metadata(future, metadata))


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(InputError, match="No such file"):
        Model.load(tmp_path / "none.onnx")
    with pytest.raises(InputError, match="directory"):
        Model.load(tmp_path)


@pytest.mark.parametrize("shape", [(6, 3, 16, 16), (1, 6, 1, 16, 16), (1, 6, 3, 16, 18), (1, 6, 3, 15, 16)])
def test_wrong_shapes_are_named(model_file, shape):
    with pytest.raises(InputError, match="multiples of 4"):
        Model.load(model_file)(np.zeros(shape, np.float32))


@pytest.mark.parametrize("threads", [-1, 0, 5000])
def test_threads_out_of_range(model_file, threads):
    with pytest.raises(InputError, match="threads"):
        Model.load(model_file, threads=threads)


def test_running_a_model_imports_neither_torch_nor_onnx(model_file):
    code = (
        "import sys, numpy; from turbnet.deploy.session import Model; from turbnet.deploy import restore\n"
        "model = Model(open(sys.argv[1], 'rb').read(), threads=1)\n"
        "model(numpy.zeros((1, 2, 3, 16, 16), numpy.float32))\n"
        "print([name for name in ('torch', 'onnx', 'onnxscript', 'lightning', 'scipy') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code, str(model_file)], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
