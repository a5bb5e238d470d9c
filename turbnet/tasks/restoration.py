"""Stage two, or both at once: tilt removal and restoration end to end."""

from collections.abc import Iterable, Sequence
from typing import Any

from torch import Tensor, nn

from turbnet.data.clips import AnyScene
from turbnet.errors import InputError, check_range
from turbnet.nets.complex_unet import ComplexUNet
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
    scene_loss,
    tilt_error,
    tilt_loss,
)
from turbnet.tasks.simulated import SimulatedTask


class Restoration(SimulatedTask):
    """Trains a restorer: its frames are compared with the clean clip, its registration, if it has any, as in `TiltRemoval`.

    Args:
        tilt_weight, registration_weight, frequency_weight, own_weight, scene_weight, gate_weight: of the tilt, registration
            and frequency losses, of the distance of the frames restored by themselves and of the scene where it is still, of
            the gate's loss. Without losses of their own the one that is behind is shut out by the gate and learns no more.
        moving_weight: of pixels that move of themselves, against those that do not: they are few.
        map_weight: of the likelihood of uncertainty maps, where the network has them.
        settled: clips of this many frames or more are restored in their mean geometry (`turbnet.data.pairs.Pair.settled`),
            where tilts are compared anyway. From fewer a picture scores more that is blurred by what cannot be known.
        freeze: names of parts of the network that stay as they are, such as [tilt]; then its losses have no weight.
        start_from: checkpoint whose network to start from, such as one of `TiltRemoval`.
        more: see `SimulatedTask`.
    """

    trains = (Restorer, StillRestorer, UNet, ComplexUNet, DnCNN)

    def __init__(
        self,
        tilt_weight: float = 0.003,
        registration_weight: float = 0.2,
        frequency_weight: float = 0.1,
        own_weight: float = 0.4,
        scene_weight: float = 0.6,
        gate_weight: float = 0.1,
        moving_weight: float = 6.0,
        map_weight: float = 0.01,
        settled: int = 4,
        freeze: Sequence[str] = (),
        start_from: str | None = None,
        **more: Any,
    ) -> None:
        super().__init__(
            tilt_weight=tilt_weight,
            registration_weight=registration_weight,
            frequency_weight=frequency_weight,
            own_weight=own_weight,
            scene_weight=scene_weight,
            gate_weight=gate_weight,
            moving_weight=moving_weight,
            map_weight=map_weight,
            settled=int(check_range("settled", settled, 1, 10_000, "frames")),
            freeze=list(freeze),
            **more,
        )
        if start_from is not None:
            self.net.load_state_dict(load_net(start_from, expect=self.hparams["net"]))

    def trained(self) -> Iterable[nn.Parameter]:
        """The network, but for the parts that are frozen."""
        parts = dict(self.net.named_children())
        for name in self.hparams["freeze"]:
            if name not in parts:
                raise InputError(f"freeze: the network has no part {name!r}, but {', '.join(parts)}")
        frozen = {parameter for name in self.hparams["freeze"] for parameter in parts[name].parameters()}
        return [parameter for parameter in self.net.parameters() if parameter not in frozen]

    @property
    def _registers(self) -> bool:
        return isinstance(self.net, Restorer)

    def step(self, batch: AnyScene, stage: str) -> Tensor:
        pair = self.pair(batch)
        enough = pair.frames.shape[1] >= self.hparams["settled"]
        seen = pair.settled() if enough or self._registers else pair
        pair = seen if enough else pair
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
            values["scene"] = scene_loss(stages.scene, pair.target)
            values["gate"] = gate_loss(stages, pair.target)
            for name in ("own", "scene", "gate"):
                loss = loss + self.hparams[f"{name}_weight"] * values[name]
        if stages and "tilt" not in self.hparams["freeze"]:
            registered = stages.registered
            astray = registration_loss(seen.frames, seen.blur_only, registered.tilts)
            loss = loss + self.hparams["tilt_weight"] * tilt_loss(registered, seen.tilt)
            loss = loss + self.hparams["registration_weight"] * astray
            values["tilt_px"] = tilt_error(registered, seen.tilt)
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
