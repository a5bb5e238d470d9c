"""A network that goes frame by frame, as a file and in `restore`."""

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from turbnet.deploy.card import ModelCard
from turbnet.deploy.checkpoint import frame_by_frame
from turbnet.deploy.eight_bits import write_eight_bits
from turbnet.deploy.export import export_onnx
from turbnet.deploy.restore import restore_array, restore_clip
from turbnet.deploy.session import Model
from turbnet.deploy.tiling import Tiling
from turbnet.errors import InputError
from turbnet.media.clip import read_clip, write_clip
from turbnet.nets.streaming import StreamingRestorer

CONFIG = {
    "name": "restorer",
    "tilt": {"widths": [4, 4, 4]},
    "tcja": {"width": 8, "depth": 2},
    "scene": {"widths": [8, 8, 8], "depths": [1, 1, 1]},
}


@pytest.fixture(scope="module")
def made(trained, tmp_path_factory) -> tuple[StreamingRestorer, Path]:
    wrapped, card = frame_by_frame(trained(CONFIG), ModelCard("restorer", CONFIG, 8, 12), 10.0, 3)
    path = tmp_path_factory.mktemp("model") / "stream.onnx"
    assert max(row.difference for row in export_onnx(wrapped, card, path)) < 1e-4
    assert "carried memory | (batch, 3, 33, height / 4, width / 4)" in card.to_markdown("stream")
    return wrapped, path


@pytest.fixture(scope="module")
def model(made) -> Model:
    return Model.load(made[1])


@torch.no_grad()
def test_what_is_carried_is_that_of_torch(made, model):
    net, _ = made
    clip = torch.rand(2, 4, 3, 40, 48, generator=torch.Generator().manual_seed(0))
    past, carried = net.nothing(2, 40, 48), model.nothing(2, 40, 48)
    for part in clip.split([1, 2, 1], dim=1):  # parts of any length
        expected, *past = net(part, *past)
        restored, carried = model.step(part.numpy(), carried)
        np.testing.assert_allclose(restored, expected.numpy(), rtol=0, atol=1e-4)
    assert list(carried) == ["reference", "recent", "memory", "dance", "pictures"]
    for mine, theirs in zip(carried.values(), past, strict=True):
        # Keys have unit length whatever they are made from, and values no bound, so rounding shows here more than in frames.
        np.testing.assert_allclose(mine, theirs.numpy(), rtol=0, atol=2e-3)


def test_the_sizes_of_the_file_have_names(made):
    file = onnx.load(made[1])
    onnx.checker.check_model(file)
    sizes = {v.name: [d.dim_param or d.dim_value for d in v.type.tensor_type.shape.dim] for v in file.graph.input}
    assert sizes == {
        "frames": ["batch", "frames", 3, "height", "width"],
        "reference": ["batch", 4, "height", "width"],
        "recent": ["batch", 4, "height/2", "width/2"],
        "memory": ["batch", 3, 33, "height/4", "width/4"],
        "dance": ["batch", 4, "height/2", "width/2"],
        "pictures": ["batch", 3, 4, "height", "width"],
    }


@pytest.mark.parametrize("tile", [384, 40])
def test_restoring_a_clip_frame_by_frame_in_tiles(model, tmp_path, tile):
    """Each tile carries its own past: as if every tile were a clip."""
    clip = np.random.default_rng(0).random((5, 40, 72, 3), dtype=np.float32)
    write_clip(tmp_path / "in.tif", clip)
    done = restore_clip(tmp_path / "in.tif", tmp_path / "out.tif", model, tile=tile, overlap=8)
    assert (done.frames, done.window, done.tiles) == (5, 1, 1 if tile == 384 else 2)
    seen, _ = read_clip(tmp_path / "in.tif")
    tiling = Tiling(tile, 8, 8)
    expected = np.moveaxis(np.stack(tiling.apply(model, np.moveaxis(seen, -1, 1))), 1, -1).clip(0, 1)
    np.testing.assert_allclose(read_clip(tmp_path / "out.tif")[0], expected, rtol=0, atol=2e-4)


def test_a_clip_in_memory_is_one_clip(model):
    """What is carried reaches from the first frame to the last; a benchmark or a script sees what `restore` would write."""
    clip = np.random.default_rng(1).random((4, 40, 48, 3), dtype=np.float32)
    expected = np.moveaxis(model(np.moveaxis(clip, -1, 1)[None])[0], 1, -1).clip(0, 1)
    np.testing.assert_allclose(restore_array(clip, model), expected, rtol=0, atol=1e-5)


def test_a_window_has_no_meaning(model, tmp_path):
    write_clip(tmp_path / "in.tif", np.zeros((2, 40, 40, 3), np.float32))
    with pytest.raises(InputError, match="window = 5: the model goes frame by frame"):
        restore_clip(tmp_path / "in.tif", tmp_path / "out.tif", model, window=5)


def test_only_a_restorer_goes_frame_by_frame():
    with pytest.raises(InputError, match="only a restorer"):
        frame_by_frame(torch.nn.Identity(), ModelCard("identity", {}, 1, 1), 10.0, 3)


def test_no_eight_bits_frame_by_frame(made, tmp_path):
    with pytest.raises(InputError, match="goes frame by frame"):
        write_eight_bits(made[1], tmp_path / "small.onnx", [])
    assert not any(tmp_path.iterdir())
