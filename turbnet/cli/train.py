"""`turbnet train`: a training run, configured by Hydra."""

import os
import sys

from turbnet.errors import InputError


def main(arguments: list[str]) -> int:
    """Compose configs/train.yaml with the overrides in `arguments` and train; Hydra's own flags work, `--help` too."""
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # errors come out as exceptions, to be told in one line below
    import hydra
    from hydra.errors import HydraException
    from omegaconf import DictConfig
    from omegaconf.errors import OmegaConfBaseException

    @hydra.main(version_base="1.3", config_path="pkg://turbnet.configs", config_name="train")
    def run(config: DictConfig) -> None:
        from turbnet.tasks.fit import fit

        fit(config)

    sys.argv = ["turbnet train", *arguments]
    try:
        run()
    except (HydraException, OmegaConfBaseException) as error:
        cause = error.__cause__ if isinstance(error.__cause__, InputError) else error
        raise InputError(str(cause).partition("\nfull_key")[0]) from error
    except SystemExit as stop:
        return 2 if stop.code == 2 else int(bool(stop.code))
    return 0
