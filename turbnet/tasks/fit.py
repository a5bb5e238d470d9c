"""One training run from a resolved configuration."""

import logging
import warnings
from pathlib import Path
from pydoc import locate
from typing import Any

import lightning as L
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from turbnet.errors import InputError
from turbnet.tasks.checkpoint import read_checkpoint
from turbnet.tasks.interruption import Interruption
from turbnet.tasks.simulated import SimulatedTask

ALLOWED = ("turbnet.", "lightning.pytorch.")
"""Prefixes of what a configuration may instantiate: a config file is data and must not become a way to run any code."""


def check_targets(config: Any, where: str = "config") -> None:
    """Raise InputError if any `_target_` in the configuration is not a class that is defined inside `ALLOWED`."""
    if isinstance(config, dict):
        target = config.get("_target_")
        if target is not None and not _is_allowed(str(target)):
            raise InputError(
                f"{where}._target_ = {target!r}: a configuration may only name classes of {' or '.join(ALLOWED)}*"
            )
        for key, value in config.items():
            check_targets(value, f"{where}.{key}")
    elif isinstance(config, list):
        for index, value in enumerate(config):
            check_targets(value, f"{where}[{index}]")


def _is_allowed(target: str) -> bool:
    if not target.startswith(ALLOWED):
        return False
    found = locate(target)
    # A name such as turbnet.x.os.system can be reached, and is not ours.
    return isinstance(found, type) and found.__module__.startswith(ALLOWED)


def check_resume(path: str, task: SimulatedTask) -> None:
    """Raise InputError if `task` cannot go on from a checkpoint."""
    checkpoint = read_checkpoint(path)
    found, wanted = checkpoint["hyper_parameters"]["net"], task.hparams["net"]
    if found != wanted:
        raise InputError(f"cannot resume from {path}: it holds another network: {found}, not {wanted}")
    learned = [len(group["params"]) for state in checkpoint["optimizer_states"] for group in state["param_groups"]]
    if learned != [len(list(task.trained()))]:
        raise InputError(f"cannot resume from {path}: it was training other parts of the network; see task.start_from")


def _check_whole(config: dict[str, Any], name: str, low: int, high: int) -> None:
    value: Any = config
    for part in name.split("."):
        value = value[part]
    if not isinstance(value, int) or not low <= value <= high:
        raise InputError(f"{name} = {value!r} must be a whole number from {low} to {high}")


def fit(config: DictConfig) -> L.Trainer:
    """Train as `config` says (see configs/train.yaml); returns the trainer when it has finished.

    Raises:
        InputError: a value that cannot be used.
    """
    plain: dict[str, Any] = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)  # type: ignore[assignment]
    check_targets(plain)
    _check_whole(plain, "seed", 0, 2**32 - 1)
    _check_whole(plain, "trainer.max_epochs", -1, 2**31)
    _check_whole(plain, "trainer.max_steps", -1, 2**62)
    _quieten()
    if plain["threads"] is not None:
        _check_whole(plain, "threads", 1, 2**10)
        torch.set_num_threads(plain["threads"])
    _check_precision(plain["trainer"])
    L.seed_everything(plain["seed"], workers=True, verbose=False)
    data = instantiate(plain["data"], _convert_="all")
    task = instantiate(plain["task"], _convert_="all")
    if plain["resume"]:
        check_resume(plain["resume"], task)
    trainer: L.Trainer = instantiate(
        plain["trainer"],
        callbacks=[Interruption(), *(instantiate(c, _convert_="all") for c in plain["callbacks"].values() if c)],
        logger=[instantiate(g, _convert_="all") for g in plain["logger"].values() if g],
        _convert_="all",
    )
    if trainer.is_global_zero:
        folder = Path(plain["output"])
        folder.mkdir(parents=True, exist_ok=True)
        OmegaConf.save(OmegaConf.create(plain), folder / "config.yaml")
        print(f"outputs: {folder}", flush=True)
    trainer.fit(task, data, ckpt_path=plain["resume"], weights_only=True)
    return trainer


def _check_precision(trainer: dict[str, Any]) -> None:
    """Processors without instructions for bfloat16 convolve in float32 ten times as fast: do that instead, and say so."""
    if (
        str(trainer.get("precision")).startswith("bf16")
        and trainer.get("accelerator") == "cpu"
        and not torch.ops.mkldnn._is_mkldnn_bf16_supported()
    ):
        print("this processor knows no bfloat16: trainer.precision=32-true", flush=True)
        trainer["precision"] = "32-true"


def _quieten() -> None:
    """Leave of lightning's messages the warnings that a user can act on."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message=".*LeafSpec.*is deprecated")
