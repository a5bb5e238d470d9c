"""What a configuration may name: a config file is data and must not become a way to run any code."""

import re
from pydoc import locate
from typing import Any

from turbnet.errors import InputError

_PACKAGES = ("turbnet.", "lightning.pytorch.")  # what is looked up, and so imported, at all
_LIGHTNING = ("callbacks", "loggers", "plugins", "profilers", "strategies", "trainer")
ALLOWED = ("turbnet.data.", "turbnet.tasks.", *(f"lightning.pytorch.{part}." for part in _LIGHTNING))
"""Where a class that a configuration instantiates has to be defined."""

_HYDRA = ("hydra.", "hydra_plugins.")
_LAUNCHER = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
_LOGGING = re.compile(
    r"logging\.(handlers\.)?\w*Handler|logging\.Formatter|colorlog\.ColoredFormatter|ext://sys\.std(out|err)"
)


def check_targets(config: Any, where: str = "config") -> None:
    """Raise InputError if any `_target_` in the configuration is not a class that is defined inside `ALLOWED`."""
    for name, value in _entries(config, where):
        if name.endswith("._target_") and value is not None and not _is_allowed(str(value)):
            raise InputError(
                f"{name} = {value!r}: a configuration may only name classes of turbnet.data, turbnet.tasks and "
                f"lightning.pytorch ({', '.join(_LIGHTNING)})"
            )


def check_hydra(config: Any) -> None:
    """Raise InputError if the part of a configuration that Hydra acts on itself names code other than Hydra's, or variables.

    Hydra makes callbacks, launcher, sweeper and log handlers of it before a run begins, and sets the environment.
    """
    for name, value in _entries(config, "hydra"):
        if name.endswith("._target_") and not str(value).startswith(_HYDRA):
            raise InputError(f"{name} = {value!r}: Hydra may only be given classes of its own and of its plugins")
        names_code = name.endswith((".class", ".()")) or str(value).startswith("ext://")
        if "_logging." in name and names_code and not _LOGGING.fullmatch(str(value)):
            raise InputError(f"{name} = {value!r}: a log is written by handlers of Python's logging")
        if ".job.env_set." in name:
            raise InputError(f"{name}: a configuration sets no variables; set them where the command is started")
        # What a cluster's launcher runs before a job stands in its settings.
        asked = any(override.startswith("hydra/launcher=") for override in config["overrides"]["hydra"])
        if name == "hydra.launcher._target_" and value != _LAUNCHER and not asked:
            raise InputError(
                f"{name} = {value!r}: ask for another launcher on the command line, by hydra/launcher=NAME"
            )


def _entries(config: Any, where: str) -> Any:
    """Name and value of everything in nested dicts and lists that is neither."""
    if isinstance(config, dict):
        for key, value in config.items():
            # A target that is a list or a dict is named as a whole.
            yield from [(f"{where}._target_", value)] if key == "_target_" else _entries(value, f"{where}.{key}")
    elif isinstance(config, list):
        for index, value in enumerate(config):
            yield from _entries(value, f"{where}[{index}]")
    else:
        yield where, config


def _is_allowed(target: str) -> bool:
    if not target.startswith(_PACKAGES):
        return False
    found = locate(target)
    # A name such as turbnet.x.os.system can be reached, and is not ours.
    return isinstance(found, type) and found.__module__.startswith(ALLOWED)
