"""Stage two, or both at once: tilt removal and restoration end to end."""

from collections.abc import Iterable
from typing import Any

from torch import Tensor, nn

from turbnet.data.clips import Scene, SimulatedScene
from turbnet.nets.dncnn import DnCNN
from turbnet.nets.restorer import Restorer
from turbnet.nets.still import StillRestorer
from turbnet.nets.uncertainty import laplace_loss
from turbnet.nets.unet import UNet
from turbnet.tasks.checkpoint import load_net
from turbnet.tasks.losses import (
    charbonnier,
    frequency_loss,
    gate_loss,
    moving_weights,
    psnr,
    registration_loss,
    tilt_error,
    tilt_loss,
)
from turbnet.tasks.simulated import SimulatedTask


class Restoration(SimulatedTask):
    """Trains a restorer: its frames are compared with the clean clip, its registration, if it has any, as in `TiltRemoval`.

    Args:
        tilt_weight, registration_weight, frequency_weight, own_weight, gate_weight: of the tilt, registration and frequency
            losses, of the distance of the frames restored by themselves, of the gate's loss.
        moving_weight: of pixels that move of themselves, against those that do not: they are few.
        map_weight: of the likelihood of uncertainty maps, where the network has them.
        freeze_tilt: keep the tilt net as it is; then its losses have no weight.
        start_from: checkpoint whose network to start from, such as one of `TiltRemoval`.
        more: see `SimulatedTask`.
    """

    trains = (Restorer, StillRestorer, UNet, DnCNN)

    def __init__(
        self,
        tilt_weight: float = 0.003,
        registration_weight: float = 0.2,
        frequency_weight: float = 0.1,
        own_weight: float = 0.4,
        gate_weight: float = 0.1,
        moving_weight: float = 6.0,
        map_weight: float = 0.01,
        freeze_tilt: bool = False,
        start_from: str | None = None,
        **more: Any,
    ) -> None:
        super().__init__(
            tilt_weight=tilt_weight,
            registration_weight=registration_weight,
            frequency_weight=frequency_weight,
            own_weight=own_weight,
            gate_weight=gate_weight,
            moving_weight=moving_weight,
            map_weight=map_weight,
            freeze_tilt=freeze_tilt,
            **more,
        )
        if start_from is not None:
            self.net.load_state_dict(load_net(start_from, expect=self.hparams["net"]))

    def trained(self) -> Iterable[nn.Parameter]:
        """The network, or all of it but the tilt net."""
        frozen = set(self.net.tilt.parameters()) if self.hparams["freeze_tilt"] and self._registers else set()
        return [parameter for parameter in self.net.parameters() if parameter not in frozen]

    @property
    def _registers(self) -> bool:
        return isinstance(self.net, Restorer)

    def step(self, batch: Scene | SimulatedScene, stage: str) -> Tensor:
        pair = self.pair(batch)
        stages = self.net.stages(pair.frames) if self._registers else None
        still = self.net.stages(pair.frames) if isinstance(self.net, StillRestorer) else None
        found = stages or still
        restored = found.frames if found else self.net(pair.frames)
        counts = moving_weights(pair.target, self.hparams["moving_weight"])
        distance = charbonnier(restored, pair.target, weight=counts)
        loss = distance + self.hparams["frequency_weight"] * frequency_loss(restored, pair.target)
        values = {"charbonnier": distance}
        if stages:
            values["own"] = charbonnier(stages.own, pair.target, weight=counts)
            values["gate"] = gate_loss(stages, pair.target)
            loss = loss + self.hparams["own_weight"] * values["own"] + self.hparams["gate_weight"] * values["gate"]
        if stages and not self.hparams["freeze_tilt"]:
            registered = stages.registered
            astray = registration_loss(pair.frames, pair.blur_only, registered.tilts)
            loss = loss + self.hparams["tilt_weight"] * tilt_loss(registered, pair.tilt)
            loss = loss + self.hparams["registration_weight"] * astray
            values["tilt_px"] = tilt_error(registered, pair.tilt)
        if still and still.uncertainty:
            tilt, blur = pair.blur_only - pair.frames, pair.target - pair.blur_only
            values["maps"] = laplace_loss(still.uncertainty, tilt, blur)
            loss = loss + self.hparams["map_weight"] * values["maps"]
        values["loss"] = loss
        if stage == "val":
            values["psnr"] = psnr(restored, pair.target)
            values["psnr_input"] = psnr(pair.frames, pair.target)
            values["psnr_mean"] = psnr(pair.frames.mean(1, keepdim=True).expand_as(pair.frames), pair.target)
        self.report(stage, values, len(pair.frames))
        return loss
