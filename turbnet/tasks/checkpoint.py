"""Networks out of checkpoints, without executing code."""

import math
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from turbnet.errors import InputError
from turbnet.media.guard import reading
from turbnet.weights.released import read_card, read_weights, released_networks


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """A checkpoint of a task, loaded with `weights_only=True`; of a released network's name, its weights in that form.

    Raises:
        InputError: there is no such file, it is no checkpoint, or it is none of ours.
    """
    path = Path(path)
    with reading(path):  # a name may be too long
        found = path.is_file()
    if not found:
        if str(path) in released_networks():
            return _released(str(path))
        names = ", ".join(released_networks()) or "none in this installation"
        raise InputError(f"there is no checkpoint {path}, nor a released network of this name ({names})")
    try:
        _check_stored(path)
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # of bytes that are no pickle, the unpickler raises whatever they lead it to
        why = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{path} is not a checkpoint that can be loaded safely: {why}") from error
    hyper = checkpoint.get("hyper_parameters") if isinstance(checkpoint, dict) else None
    state = checkpoint.get("state_dict") if isinstance(checkpoint, dict) else None
    if not isinstance(hyper, dict) or not isinstance(hyper.get("net"), dict) or not isinstance(state, dict):
        raise InputError(f"{path} is not a checkpoint of turbnet: it does not say which network it holds")
    if not all(isinstance(name, str) and isinstance(value, Tensor) for name, value in state.items()):
        raise InputError(f"{path} is not a checkpoint of turbnet: its state is not tensors by name")
    return checkpoint


def _check_stored(path: Path) -> None:
    """Raise InputError if a checkpoint is not a zip archive of parts as they are: what is packed may grow a thousandfold."""
    with zipfile.ZipFile(path) as archive:
        parts = archive.infolist()
    if any(part.compress_type != zipfile.ZIP_STORED for part in parts):
        raise InputError("its parts are compressed")
    if sum(part.file_size for part in parts) > path.stat().st_size:
        raise InputError("its parts claim more bytes than the file has")


def _released(name: str) -> dict[str, Any]:
    """A released network as the checkpoint it was exported from, as far as its card tells."""
    weights, card = read_weights(name), read_card(name)
    return {
        "hyper_parameters": {
            "net": {"name": card["architecture"], **card["config"]},
            "seed": card["seed"],
            "recipe": {**card["notes"], "frames": card["frames"]},
        },
        "state_dict": {f"net.{key}": value for key, value in weights.items()},
    }


def load_net(path: str | Path, expect: Mapping[str, Any] | None = None) -> dict[str, Tensor]:
    """State of the network in a checkpoint.

    Raises:
        InputError: the checkpoint cannot be used, or holds another network than `expect` describes.
    """
    checkpoint = read_checkpoint(path)
    found = checkpoint["hyper_parameters"]["net"]
    if expect is not None and dict(expect) != found:
        raise InputError(f"{path} holds another network: {found!r:.500}, not {dict(expect)}")
    prefix = "net."
    return {key[len(prefix) :]: value for key, value in checkpoint["state_dict"].items() if key.startswith(prefix)}


def mean_of(paths: Sequence[str | Path], weights: Sequence[float] | None = None) -> dict[str, Any]:
    r"""A checkpoint of the mean of several networks' weights, :math:`\sum_k w_k \theta_k / \sum_k w_k`.

    Trainings that began at the same weights end around a place that is often better than where any of them ended
    (Wortsman et al., Model soups, ICML 2022); between a network and what it became by learning something else lie networks
    that know of both. Of the optimiser nothing is kept; hyper-parameters are those of the last.

    Args:
        paths: checkpoints, or names of released networks, of one and the same network.
        weights: w_k, not negative; None: all alike.

    Raises:
        InputError: a checkpoint cannot be used or holds another network; weights that make no mean.
    """
    shares = [1.0] * len(paths) if weights is None else list(weights)
    if not paths or len(shares) != len(paths) or min(shares) < 0 or not 0 < sum(shares) < math.inf:
        raise InputError(f"weights = {shares} of {len(paths)} networks: give one for each, not negative, not all 0")
    last = read_checkpoint(paths[-1])
    expected = last["hyper_parameters"]["net"]
    mean: dict[str, Tensor] = {}
    for path, share in zip(paths, shares, strict=True):
        for name, value in load_net(path, expected).items():
            part = value.double() * (share / sum(shares))
            mean[name] = mean[name] + part if name in mean else part
    kept = {f"net.{name}": value.to(last["state_dict"][f"net.{name}"].dtype) for name, value in mean.items()}
    return {"state_dict": kept, "hyper_parameters": last["hyper_parameters"], "global_step": 0}
