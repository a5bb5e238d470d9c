"""One training run from a resolved configuration."""

import logging
import platform
import warnings
from pathlib import Path
from typing import Any

import lightning as L
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from turbnet.errors import InputError
from turbnet.media.guard import reading
from turbnet.tasks.checkpoint import read_checkpoint
from turbnet.tasks.interruption import Interruption
from turbnet.tasks.simulated import SimulatedTask
from turbnet.tasks.targets import check_targets


def check_resume(path: str, task: SimulatedTask) -> None:
    """Raise InputError if `task` cannot go on from a checkpoint."""
    checkpoint = read_checkpoint(path)
    found, wanted = checkpoint["hyper_parameters"]["net"], task.hparams["net"]
    if found != wanted:
        raise InputError(f"cannot resume from {path}: it holds another network: {found!r:.500}, not {wanted}")
    with reading(path):
        learned = [len(group["params"]) for state in checkpoint["optimizer_states"] for group in state["param_groups"]]
        _check_own_files(path, checkpoint.get("callbacks", {}))
    if learned != [len(list(task.trained()))]:
        raise InputError(f"cannot resume from {path}: it was training other parts of the network; see task.start_from")


def _check_own_files(path: str, callbacks: dict[str, Any]) -> None:
    """Raise InputError if a callback remembers files outside its own folder: lightning deletes what it no longer keeps."""
    for state in callbacks.values():
        if not isinstance(state, dict) or not state.get("dirpath"):
            continue
        folder = Path(state["dirpath"]).resolve()
        names = [state.get(name) for name in ("best_model_path", "kth_best_model_path", "last_model_path")]
        for name in filter(None, [*names, *state.get("best_k_models", {})]):
            if not Path(name).resolve().is_relative_to(folder):
                raise InputError(f"cannot resume from {path}: it names {name}, which does not lie in {folder}")


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
    """On most processors float32 is faster than bfloat16, up to ten times: do that instead, and say so.

    Of those of Intel and AMD, bfloat16 pays where there are tiles (AMX); with AVX-512 alone a step takes a quarter longer.
    """
    if not str(trainer.get("precision")).startswith("bf16") or trainer.get("accelerator") != "cpu":
        return
    tiles = torch.cpu._is_amx_tile_supported() or platform.machine() not in ("x86_64", "AMD64")
    if not (tiles and torch.ops.mkldnn._is_mkldnn_bf16_supported()):
        print("bfloat16 is slow on this processor: trainer.precision=32-true", flush=True)
        trainer["precision"] = "32-true"


def _quieten() -> None:
    """Leave of lightning's messages the warnings that a user can act on."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message=".*LeafSpec.*is deprecated")
