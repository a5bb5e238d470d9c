"""`turbnet train`: a training run, configured by Hydra."""

import os
import sys
from typing import Any
from unittest.mock import patch

from turbnet.errors import InputError


def main(arguments: list[str]) -> int:
    """Compose configs/train.yaml with the overrides in `arguments` and train; Hydra's own flags work, `--help` too."""
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # errors come out as exceptions, to be told in one line below
    import hydra
    import yaml
    from hydra._internal.hydra import Hydra
    from hydra.errors import HydraException
    from omegaconf import DictConfig, OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    from turbnet.tasks.targets import check_hydra

    refused = (InputError, HydraException, OmegaConfBaseException, OSError)
    command = sys.argv[0]
    if any(argument.startswith("--e") for argument in arguments):  # argparse takes any beginning of the name
        raise InputError("--experimental-rerun would run what a pickle says; give the overrides of the run instead")
    compose = Hydra.compose_config

    def compose_checked(self: Hydra, *positional: Any, **more: Any) -> DictConfig:
        try:
            config = compose(self, *positional, **more)
        except refused:
            raise
        except (yaml.YAMLError, ValueError, RecursionError) as error:  # no YAML, no text, nested without end
            raise InputError(f"a configuration cannot be read: {error}") from error
        check_hydra(OmegaConf.to_container(config.hydra, resolve=False))
        return config

    @hydra.main(version_base="1.3", config_path="pkg://turbnet.configs", config_name="train")
    def run(config: DictConfig) -> None:
        from turbnet.tasks.fit import fit

        sys.argv = [command, "train", *arguments]  # from which further processes are started
        try:
            fit(config)
        except refused as error:
            raise SystemExit(2) from error  # Hydra adds lines of its own to an error, none to an exit

    sys.argv = ["turbnet train", *arguments]
    try:
        with patch.object(
            Hydra, "compose_config", compose_checked
        ):  # before Hydra acts on what a file may have told it
            run()
    except refused as error:
        raise _in_words(error) from error
    except SystemExit as stop:
        if isinstance(stop.__cause__, refused):
            raise _in_words(stop.__cause__) from stop.__cause__
        if isinstance(stop.__context__, KeyboardInterrupt):  # lightning makes an exit of it
            raise KeyboardInterrupt from stop
        return 2 if stop.code == 2 else int(bool(stop.code))
    finally:
        sys.argv = [command, *arguments]
    return 0


def _in_words(error: BaseException) -> InputError:
    cause = error.__cause__ if isinstance(error.__cause__, InputError) else error
    return InputError(str(cause).partition("\nfull_key")[0])
