"""What every task shares that learns from simulated pairs: the simulator in the loop, the optimiser, the schedule."""

import math
import time
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any

import lightning as L
import torch
from lightning.pytorch.utilities.rank_zero import rank_zero_warn
from torch import Tensor, nn

from turbnet.data.clips import AnyScene
from turbnet.data.pairs import Pair, PairMaker
from turbnet.errors import InputError, check_range
from turbnet.nets import build
from turbnet.nets.restorer import Restorer


class SimulatedTask(L.LightningModule):
    """A network trained on pairs that the simulator makes at every step.

    Hyper-parameters are plain dicts and numbers, so that a checkpoint loads without executing code and rebuilds its own
    parts.

    Args:
        net: config of the network, see `turbnet.nets.build`.
        simulator: arguments of `turbnet.data.pairs.PairMaker`.
        learning_rate: peak of the schedule: linear warm-up over `warmup` of the steps, then cosine to zero.
        weight_decay: of AdamW.
        warmup: fraction of the steps.
        seed: training seed, for the record.
        recipe: anything else worth recording in the model card.

    Raises:
        InputError: a network of another kind, clips that it cannot take, a value out of range.
    """

    trains: tuple[type[nn.Module], ...] = (Restorer,)
    """Kinds of network that the task knows how to train."""

    def __init__(
        self,
        net: Mapping[str, Any],
        simulator: Mapping[str, Any],
        learning_rate: float = 1e-3,
        weight_decay: float = 1e-4,
        warmup: float = 0.05,
        seed: int = 0,
        recipe: Mapping[str, Any] | None = None,
        **more: Any,
    ) -> None:
        super().__init__()
        check_range("learning_rate", learning_rate, 0, 10)
        check_range("weight_decay", weight_decay, 0, 10)
        check_range("warmup", warmup, 0, 1)
        self.save_hyperparameters(
            {
                "net": dict(net),
                "simulator": dict(simulator),
                "learning_rate": learning_rate,
                "weight_decay": weight_decay,
                "warmup": warmup,
                "seed": seed,
                "recipe": dict(recipe or {}),
                **more,
            }
        )
        restorer = build(net)
        if not isinstance(restorer, self.trains):
            names = " or a ".join(kind.__name__ for kind in self.trains)
            raise InputError(f"this task trains a {names}; the network {net.get('name')!r} is none")
        for side in ("height", "width"):
            if simulator[side] % restorer.size_multiple:
                raise InputError(
                    f"{side} of the clips = {simulator[side]} must be a multiple of {restorer.size_multiple}"
                )
        self.net = restorer.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        PairMaker.check(**simulator)
        self._pairs: list[PairMaker] = []  # built when first needed; a list, so as not to be part of the model
        self._began = self._simulated = 0.0
        self.skipped = 0
        self.net.requires_grad_(False)
        for parameter in self.trained():
            parameter.requires_grad_(True)

    def trained(self) -> Iterable[nn.Parameter]:
        """The parameters that this task learns."""
        return self.net.parameters()

    def pair(self, batch: AnyScene) -> Pair:
        """Turbulent clips for a batch of clean ones, always in float32; those that a worker made pass through."""
        if "frames" in batch:
            return Pair(batch["frames"], batch["target"], batch["blur_only"], batch["tilt"])
        began = time.perf_counter()
        with torch.autocast(self.device.type, enabled=False):
            if not self._pairs:
                self._pairs.append(PairMaker(**self.hparams["simulator"]).to(self.device))
            conditions = batch["seed"].tolist(), batch["hardness"].tolist()
            pair = self._pairs[0](batch["scene"].float(), *conditions, batch.get("coefficients"))
        self._simulated += time.perf_counter() - began
        return pair

    def on_train_batch_start(self, batch: AnyScene, index: int) -> None:
        """The simulator's time is counted anew for each step."""
        self._simulated = 0.0

    def on_train_batch_end(self, outputs: Any, batch: AnyScene, index: int) -> None:
        """Logs clips a second and the simulator's part of the time since the last step ended, in this process."""
        now = time.perf_counter()
        if self._began:
            step = now - self._began
            self.log("speed/clips_per_second", len(batch["seed"]) / step)
            self.log("speed/simulator_share", self._simulated / step)
        self._began = now

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """A step whose gradient is not finite is skipped, and said so: one bad clip must not end a long run."""
        gradients = [p.grad for p in self.trained() if p.grad is not None]
        if gradients and not torch.stack([g.sum() for g in gradients]).isfinite().all():
            optimizer.zero_grad()
            self.skipped += 1
            rank_zero_warn(f"step {self.global_step}: gradient not finite, step skipped ({self.skipped} so far)")
        self.log("train/skipped", float(self.skipped))

    def report(self, stage: str, values: Mapping[str, Tensor], clips: int) -> None:
        """Log values under `stage/`; the progress bar shows the main ones."""
        for name, value in values.items():
            self.log(
                f"{stage}/{name}",
                value.detach(),
                prog_bar=name in ("loss", "psnr"),
                on_step=stage == "train",
                on_epoch=stage != "train",
                batch_size=clips,
                sync_dist=stage != "train",
            )

    @abstractmethod
    def step(self, batch: AnyScene, stage: str) -> Tensor:
        """Loss of one batch; reports what it measures under `stage`, "train" or "val"."""

    def training_step(self, batch: AnyScene, index: int) -> Tensor:
        return self.step(batch, "train")

    def validation_step(self, batch: AnyScene, index: int) -> None:
        self.step(batch, "val")

    def configure_optimizers(self) -> Any:
        """AdamW, linear warm-up, cosine decay to zero at the last step."""
        hyper = self.hparams
        optimiser = torch.optim.AdamW(
            list(self.trained()), lr=hyper["learning_rate"], weight_decay=hyper["weight_decay"], betas=(0.9, 0.99)
        )
        total = int(self.trainer.estimated_stepping_batches)
        rising = max(1, round(hyper["warmup"] * total))

        def factor(step: int) -> float:
            if step < rising:
                return (step + 1) / rising
            return 0.5 * (1 + math.cos(math.pi * min(1.0, (step - rising) / max(1, total - rising))))

        schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, factor)
        return {"optimizer": optimiser, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}
