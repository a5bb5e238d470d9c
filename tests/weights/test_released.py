import json
from pathlib import Path

import pytest
import torch

from turbnet.errors import InputError
from turbnet.simulate.phase_to_space import PhaseToSpace
from turbnet.weights import released

NAME = "phase_to_space"


@pytest.fixture
def copy(tmp_path, monkeypatch) -> Path:
    """A copy of the released weights in a folder that `read_weights` takes for the package's own."""
    folder = released.resources.files("turbnet.weights")
    for suffix in ("safetensors", "json"):
        (tmp_path / f"{NAME}.{suffix}").write_bytes((folder / f"{NAME}.{suffix}").read_bytes())
    monkeypatch.setattr(released.resources, "files", lambda package: tmp_path)
    return tmp_path


def refused() -> str:
    with pytest.raises(InputError) as caught:
        released.read_weights(NAME)
    message = str(caught.value)
    assert "\n" not in message
    assert NAME in message
    return message


def test_released_weights_are_those_of_the_network(copy):
    weights = released.read_weights(NAME)
    PhaseToSpace().load_state_dict(weights)
    assert all(bool(torch.isfinite(value).all()) for value in weights.values())


def test_a_changed_byte_is_refused(copy):
    file = copy / f"{NAME}.safetensors"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    assert "damaged" in refused()


def test_a_cut_file_is_refused(copy):
    file = copy / f"{NAME}.safetensors"
    file.write_bytes(file.read_bytes()[:1000])
    assert "damaged" in refused()


@pytest.mark.parametrize("suffix", ["safetensors", "json"])
def test_a_missing_file_is_refused(copy, suffix):
    (copy / f"{NAME}.{suffix}").unlink()
    assert "install turbnet again" in refused()


@pytest.mark.parametrize("card", ["{", json.dumps({"architecture": "?"}), json.dumps([1])])
def test_a_card_without_the_hash_is_refused(copy, card):
    (copy / f"{NAME}.json").write_text(card)
    assert "install turbnet again" in refused()


def test_the_card_says_what_the_weights_are(copy):
    card = json.loads((copy / f"{NAME}.json").read_text())
    for key in ("architecture", "data", "seed", "recipe", "version", "sha256", "known failures"):
        assert card[key] not in (None, "")
