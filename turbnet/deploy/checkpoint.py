"""From a checkpoint of `turbnet train` to a network and its card."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import nn

from turbnet.deploy.card import MAPS, ModelCard
from turbnet.errors import InputError
from turbnet.nets import build
from turbnet.nets.redegradation import Redegrading
from turbnet.nets.restorer import Restorer
from turbnet.nets.still import StillRestorer
from turbnet.nets.streaming import StreamingRestorer
from turbnet.nets.uncertainty import Maps
from turbnet.tasks.checkpoint import load_net, read_checkpoint


def load_network(path: str | Path) -> tuple[nn.Module, dict[str, Any]]:
    """The network in a checkpoint, or a released one by name, ready to run, and the checkpoint's hyper-parameters.

    Of a network that learned by re-degradation, the restorer: the rest has nothing to do any more.

    Raises:
        InputError: no file, no checkpoint, one of other software, or weights that do not fit the network it names.
    """
    hyper_parameters, state = read_checkpoint(path)["hyper_parameters"], load_net(path)
    try:
        # Without memory first: a few bytes can name a network of any size.
        with torch.device("meta"):
            shapes = {name: value.shape for name, value in build(hyper_parameters["net"]).state_dict().items()}
        wrong = [name for name in {**shapes, **state} if name not in state or state[name].shape != shapes.get(name)]
        if wrong:
            raise InputError(f"its weights do not fit the network it names ({', '.join(sorted(wrong)[:5])})")
        network = build(hyper_parameters["net"])
        network.load_state_dict(state, strict=True)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    if isinstance(network, Redegrading):
        return network.restorer.eval(), {**hyper_parameters, "net": hyper_parameters["net"]["restorer"]}
    return network.eval(), hyper_parameters


def card_of(network: nn.Module, hyper_parameters: dict[str, Any], frames: int) -> ModelCard:
    """The card of a network from a checkpoint; the turbulence it was trained on and the recipe become the notes.

    Args:
        frames: recommended length of the temporal window, frames.
    """
    config = dict(hyper_parameters["net"])
    notes = {"simulator": hyper_parameters.get("simulator"), **(hyper_parameters.get("recipe") or {})}
    return ModelCard(
        architecture=config.pop("name"),
        config=_without_folders(config),
        size_multiple=int(network.size_multiple),  # type: ignore[arg-type]
        frames=frames,
        seed=hyper_parameters.get("seed"),
        notes=_without_folders(notes),
    )


def frame_by_frame(
    network: nn.Module, card: ModelCard, horizon: float, remember: int
) -> tuple[StreamingRestorer, ModelCard]:
    """The same network frame by frame, and its card.

    Args:
        horizon, remember: of `StreamingRestorer`.

    Raises:
        InputError: the network is no restorer, a value out of range.
    """
    if not isinstance(network, Restorer):
        raise InputError(f"only a restorer goes frame by frame; {card.architecture} is none")
    wrapped = StreamingRestorer(network, horizon, remember)
    scales = {"memory": network.tcja.patch, "recent": 2, "dance": 2}
    shapes = wrapped.nothing(1, card.size_multiple, card.size_multiple)
    carried = {
        name: {"shape": list(part.shape[1:-2]), "scale": scales.get(name, 1)} for name, part in shapes._asdict().items()
    }
    notes = {"frame by frame": f"horizon {horizon:g} frames, keys and values of {remember}", **card.notes}
    return wrapped, replace(card, frames=1, notes=notes, carried=carried)


def maps_alone(network: nn.Module, card: ModelCard) -> tuple[Maps, ModelCard]:
    """The part of a network that says what is uncertain, and its card.

    Raises:
        InputError: the network has no maps.
    """
    if not isinstance(network, StillRestorer) or network.maps is None:
        raise InputError(f"{card.architecture} has no uncertainty maps; turbnet train experiment=still makes them")
    notes = {
        "output": "scale of what the tilt has changed, of what the blur has, and the change to expect",
        **card.notes,
    }
    return Maps(network.maps), replace(card, architecture=MAPS, config=card.config["maps"], frames=1, notes=notes)


def _without_folders(value: Any) -> Any:
    """Absolute paths cut to their last part: a card tells nothing of the machine it was made on."""
    if isinstance(value, dict):
        return {key: _without_folders(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_folders(item) for item in value]
    if isinstance(value, str) and Path(value).is_absolute():
        return Path(value).name
    return value
