"""The released networks that restore: both forms are one network, and both are taken by name."""

import numpy as np
import pytest
import torch

from turbnet.cli import run
from turbnet.deploy.checkpoint import load_network
from turbnet.deploy.session import Model
from turbnet.deploy.weights import DEFAULT, released_models
from turbnet.errors import InputError
from turbnet.tasks.checkpoint import load_net
from turbnet.weights.released import released_networks

NAMES = released_networks()


def test_there_are_some_and_each_has_both_forms():
    assert DEFAULT in NAMES
    assert set(NAMES) == set(released_models())


@torch.no_grad()
@pytest.mark.parametrize("name", NAMES)
def test_weights_and_file_are_one_network(name):
    network, hyper_parameters = load_network(name)
    assert hyper_parameters["net"]["name"] in ("restorer", "still")
    clip = torch.rand(1, 3, 3, 40, 48, generator=torch.Generator().manual_seed(0))
    model = Model.load(released_models()[name])
    np.testing.assert_allclose(model(clip.numpy()), network(clip).numpy(), rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_the_card_says_what_a_user_must_know(name):
    card = Model.load(released_models()[name]).card
    for key in ("data", "recipe", "steps", "history", "measured by", "known failures", "simulator"):
        assert card.notes[key]
    assert any(key.startswith("PSNR, static, D/r0 = 3") for key in card.notes)


def test_export_by_name_goes_frame_by_frame(tmp_path, capsys):
    options = ["--streaming", "--horizon", "9", "--remember", "2"]
    assert run(["export", NAMES[-1], "-o", str(tmp_path / "stream.onnx"), *options]) == 0
    model, whole = Model.load(tmp_path / "stream.onnx"), Model.load(released_models()[NAMES[-1]])
    assert model.card.carried["memory"]["shape"][0] == 2
    assert model.card.notes["frame by frame"] == "horizon 9 frames, keys and values of 2"
    clip = np.random.default_rng(0).random((1, 2, 3, 40, 48), np.float32)
    np.testing.assert_allclose(model(clip)[:, :1], whole(clip[:, :1]), rtol=0, atol=1e-4)  # nothing seen before


def test_a_name_that_is_none():
    with pytest.raises(InputError, match=r"nor a released network of this name \(.*s.*\)"):
        load_net("nowhere")
