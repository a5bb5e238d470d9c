"""Weights that ship inside the package, checked against the hash on their card before anything reads them."""

import hashlib
import json
from importlib import resources
from pathlib import Path
from typing import Any

from safetensors.torch import load
from torch import Tensor

from turbnet.errors import InputError

DIGEST = "sha256_of_safetensors"
"""Where the notes of a card give the digest of the weights beside an ONNX file."""


def read_weights(name: str) -> dict[str, Tensor]:
    """Tensors of `name`.safetensors.

    Raises:
        InputError: the file is missing, or not the one that its card `name`.json describes.
    """
    folder = resources.files("turbnet.weights")
    try:
        data, card = (folder / f"{name}.safetensors").read_bytes(), read_card(name)
        # The card of a network that is released as ONNX as well gives the digest of that file first.
        expected = card.get("notes", {}).get(DIGEST) or card["sha256"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"the weights {name} cannot be read: {error}; install turbnet again") from error
    if hashlib.sha256(data).hexdigest() != expected:
        raise InputError(f"the weights {name} are damaged or were changed: their SHA-256 is not that of their card")
    return load(data)


def read_card(name: str) -> dict[str, Any]:
    """The card of released weights, as plain values."""
    card: dict[str, Any] = json.loads((resources.files("turbnet.weights") / f"{name}.json").read_text())
    return card


def released_networks() -> list[str]:
    """Names of the networks that restore whose weights are here for torch, beside their ONNX files."""
    folder = resources.files("turbnet.weights")
    files = {item.name for item in folder.iterdir()}
    return sorted(
        Path(name).stem for name in files if name.endswith(".onnx") and Path(name).stem + ".safetensors" in files
    )
