"""Networks as pure modules, and the one table that names them."""

from collections.abc import Mapping
from typing import Any

from torch import nn

from turbnet.errors import InputError, check_range
from turbnet.nets.complex_unet import ComplexUNet
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
    "complex-unet": ComplexUNet,
    "dncnn": DnCNN,
}
"""Every network that a config or a checkpoint can name."""

_SIZES = {"width": (1, 4096), "widths": (1, 4096), "depth": (0, 100), "depths": (0, 100)}
_LONGEST = 4096  # characters of a config


def build(config: Mapping[str, Any]) -> nn.Module:
    """Build the network that `config["name"]` names from the other entries.

    Raises:
        InputError: there is no such network, or it does not take these arguments.
    """
    arguments = dict(config)
    name = arguments.pop("name", None)
    if not isinstance(name, str) or name not in NETS:
        raise InputError(f"there is no network named {name!r:.100}; the networks are {', '.join(NETS)}")
    if len(str(arguments)) > _LONGEST:
        raise InputError(f"network {name!r}: its description is longer than {_LONGEST} characters")
    try:
        _check_sizes(arguments)
        return NETS[name](**arguments)
    except InputError:
        raise
    except Exception as error:  # arguments may come from any file, and so may what a constructor makes of them
        raise InputError(f"network {name!r}: {error}") from error


def _check_sizes(arguments: Mapping[str, Any]) -> None:
    """Raise ParameterError if blocks or channels are too many to be meant."""
    for name, value in arguments.items():
        if isinstance(value, Mapping):
            _check_sizes(value)
        elif name in _SIZES:
            for size in [value] if isinstance(value, int) else value:
                check_range(name, size, *_SIZES[name])
