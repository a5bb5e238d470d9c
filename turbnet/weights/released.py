"""Weights that ship inside the package, checked against the hash on their card before anything reads them."""

import hashlib
import json
from importlib import resources

from safetensors.torch import load
from torch import Tensor

from turbnet.errors import InputError


def read_weights(name: str) -> dict[str, Tensor]:
    """Tensors of `name`.safetensors.

    Raises:
        InputError: the file is missing, or not the one that its card `name`.json describes.
    """
    folder = resources.files("turbnet.weights")
    try:
        data = (folder / f"{name}.safetensors").read_bytes()
        expected = json.loads((folder / f"{name}.json").read_text())["sha256"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"the weights {name} cannot be read: {error}; install turbnet again") from error
    if hashlib.sha256(data).hexdigest() != expected:
        raise InputError(f"the weights {name} are damaged or were changed: their SHA-256 is not that of their card")
    return load(data)
