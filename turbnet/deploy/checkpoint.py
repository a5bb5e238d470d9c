"""Networks out of the checkpoints that `turbnet train` writes: plain values and tensors, nothing pickled."""

from pathlib import Path
from typing import Any

import torch
from torch import nn

from turbnet import nets
from turbnet.deploy.card import ModelCard
from turbnet.errors import InputError

PREFIX = "net."


def load_network(path: str | Path) -> tuple[nn.Module, dict[str, Any]]:
    """The network in a checkpoint, and the checkpoint's hyper-parameters.

    `hyper_parameters["net"]` says what to build, the entries of `state_dict` under `net.` are its weights.

    Raises:
        InputError: no file, no checkpoint, one of other software, or weights that do not fit the network it names.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            checkpoint = torch.load(file, map_location="cpu", weights_only=True)
    except OSError as error:
        raise InputError(f"cannot read the checkpoint {path}: {error.strerror or error}") from error
    except Exception as error:  # torch.load raises whatever its parsers raise
        raise InputError(f"{path} is not a checkpoint of turbnet train, or it is damaged") from error
    match checkpoint:
        case {
            "hyper_parameters": {"net": {"name": str(name)} as config} as hyper_parameters,
            "state_dict": dict(state),
        }:
            weights = {key.removeprefix(PREFIX): value for key, value in state.items() if key.startswith(PREFIX)}
        case _:
            raise InputError(f"{path} is a checkpoint of other software: it names no network of turbnet")
    try:
        network = nets.build(config)
    except (InputError, TypeError) as error:  # unknown network, unknown argument
        raise InputError(f"{path}: {error}") from error
    try:
        network.load_state_dict(weights, strict=True)
    except RuntimeError as error:
        raise InputError(f"{path}: its weights do not fit the network {name} that it names") from error
    return network.eval(), dict(hyper_parameters)


def card_of(network: nn.Module, hyper_parameters: dict[str, Any], frames: int) -> ModelCard:
    """The card of a network from a checkpoint; its recipe becomes the notes.

    Args:
        frames: recommended length of the temporal window, frames.
    """
    config = dict(hyper_parameters["net"])
    return ModelCard(
        architecture=config.pop("name"),
        config=_without_folders(config),
        size_multiple=int(network.size_multiple),  # type: ignore[arg-type]
        frames=frames,
        seed=hyper_parameters.get("seed"),
        notes=_without_folders(hyper_parameters.get("recipe") or {}),
    )


def _without_folders(value: Any) -> Any:
    """Absolute paths cut to their last part: a card tells nothing of the machine it was made on."""
    if isinstance(value, dict):
        return {key: _without_folders(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_folders(item) for item in value]
    if isinstance(value, str) and Path(value).is_absolute():
        return Path(value).name
    return value
