"""Stage two, or both at once: tilt removal and restoration end to end."""

from collections.abc import Iterable
from typing import Any

from torch import Tensor, nn

from turbnet.data.clips import Scene
from turbnet.tasks.checkpoint import load_net
from turbnet.tasks.losses import charbonnier, psnr, registration_loss, tilt_loss
from turbnet.tasks.simulated import SimulatedTask


class Restoration(SimulatedTask):
    """Trains a restorer: its frames are compared with the clean clip, its registration as in `TiltRemoval`.

    Args:
        tilt_weight: weight of the tilt loss (pixels).
        registration_weight: weight of the registration loss.
        freeze_tilt: keep the tilt net as it is; then its losses have no weight.
        start_from: checkpoint whose network to start from, such as one of `TiltRemoval`.
        more: see `SimulatedTask`.
    """

    def __init__(
        self,
        tilt_weight: float = 0.01,
        registration_weight: float = 0.2,
        freeze_tilt: bool = False,
        start_from: str | None = None,
        **more: Any,
    ) -> None:
        super().__init__(
            tilt_weight=tilt_weight,
            registration_weight=registration_weight,
            freeze_tilt=freeze_tilt,
            **more,
        )
        if start_from is not None:
            self.net.load_state_dict(load_net(start_from, expect=self.hparams["net"]))

    def trained(self) -> Iterable[nn.Parameter]:
        """The network, or its transformer alone."""
        part = self.net.tcja if self.hparams["freeze_tilt"] else self.net
        return part.parameters()

    def step(self, batch: Scene, stage: str) -> Tensor:
        pair = self.pair(batch)
        restored, registered = self.net.stages(pair.frames)
        loss = charbonnier(restored, pair.target)
        values = {"charbonnier": loss}
        if not self.hparams["freeze_tilt"]:
            error = tilt_loss(registered.tilts, pair.tilt)
            distance = registration_loss(pair.frames, pair.blur_only, registered.tilts)
            loss = loss + self.hparams["tilt_weight"] * error + self.hparams["registration_weight"] * distance
            values["tilt_px"] = error
        values["loss"] = loss
        if stage == "val":
            values["psnr"] = psnr(restored, pair.target)
            values["psnr_input"] = psnr(pair.frames, pair.target)
            values["psnr_mean"] = psnr(pair.frames.mean(1, keepdim=True).expand_as(pair.frames), pair.target)
        self.report(stage, values, len(pair.frames))
        return loss
