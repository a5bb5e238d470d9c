"""One training run from a resolved configuration."""

from pathlib import Path
from typing import Any

import lightning as L
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from turbnet.errors import InputError
from turbnet.tasks.checkpoint import read_checkpoint

ALLOWED = ("turbnet.", "lightning.pytorch.")
"""Prefixes of what a configuration may instantiate: a config file is data and must not become a way to run any code."""


def check_targets(config: Any, where: str = "config") -> None:
    """Raise InputError if any `_target_` in the configuration lies outside `ALLOWED`."""
    if isinstance(config, dict):
        target = config.get("_target_")
        if target is not None and not str(target).startswith(ALLOWED):
            raise InputError(f"{where}._target_ = {target!r}: a configuration may only name {' or '.join(ALLOWED)}*")
        for key, value in config.items():
            check_targets(value, f"{where}.{key}")
    elif isinstance(config, list):
        for index, value in enumerate(config):
            check_targets(value, f"{where}[{index}]")


def fit(config: DictConfig) -> L.Trainer:
    """Train as `config` says (see configs/train.yaml); returns the trainer when it has finished.

    Raises:
        InputError: a value that cannot be used.
    """
    plain: dict[str, Any] = OmegaConf.to_container(config, resolve=True)  # type: ignore[assignment]
    check_targets(plain)
    if plain["threads"]:
        torch.set_num_threads(plain["threads"])
    L.seed_everything(plain["seed"], workers=True, verbose=False)
    if plain["resume"]:
        read_checkpoint(plain["resume"])
    data = instantiate(plain["data"], _convert_="all")
    task = instantiate(plain["task"], _convert_="all")
    trainer: L.Trainer = instantiate(
        plain["trainer"],
        callbacks=[instantiate(c, _convert_="all") for c in plain["callbacks"].values() if c],
        logger=[instantiate(g, _convert_="all") for g in plain["logger"].values() if g],
        _convert_="all",
    )
    if trainer.is_global_zero:
        folder = Path(plain["output"])
        folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(config, folder / "config.yaml", resolve=True)
    trainer.fit(task, data, ckpt_path=plain["resume"], weights_only=True)
    return trainer
