"""Networks as pure modules, and the one table that names them."""

from collections.abc import Mapping
from typing import Any

from torch import nn

from turbnet.errors import InputError
from turbnet.nets.dncnn import DnCNN
from turbnet.nets.redegradation import Redegrading
from turbnet.nets.restorer import Restorer
from turbnet.nets.still import StillRestorer
from turbnet.nets.unet import UNet

NETS: dict[str, type[nn.Module]] = {
    "restorer": Restorer,
    "still": StillRestorer,
    "redegrading": Redegrading,
    "unet": UNet,
    "dncnn": DnCNN,
}
"""Every network that a config or a checkpoint can name."""


def build(config: Mapping[str, Any]) -> nn.Module:
    """Build the network that `config["name"]` names from the other entries.

    Raises:
        InputError: there is no such network, or it does not take these arguments.
    """
    arguments = dict(config)
    name = arguments.pop("name", None)
    if name not in NETS:
        raise InputError(f"there is no network named {name!r}; the networks are {', '.join(NETS)}")
    try:
        return NETS[name](**arguments)
    except TypeError as error:
        raise InputError(f"network {name!r}: {error}") from error
