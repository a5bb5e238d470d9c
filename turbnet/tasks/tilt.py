"""Stage one: tilt removal alone."""

from collections.abc import Iterable
from typing import Any

from torch import Tensor, nn

from turbnet.data.clips import AnyScene
from turbnet.tasks.losses import psnr, registration_loss, tilt_error, tilt_loss
from turbnet.tasks.simulated import SimulatedTask


class TiltRemoval(SimulatedTask):
    """Trains the tilt net of a restorer: registered frames are compared with the blur-only frames at three scales, the
    estimated tilts and their confidence with the true tilt map, all in the clip's mean geometry.

    Args:
        tilt_weight: weight of the tilt loss against the registration loss (intensity).
        more: see `SimulatedTask`.
    """

    def __init__(self, tilt_weight: float = 0.01, **more: Any) -> None:
        super().__init__(tilt_weight=tilt_weight, **more)

    def trained(self) -> Iterable[nn.Parameter]:
        """Only the tilt net."""
        return self.net.tilt.parameters()

    def step(self, batch: AnyScene, stage: str) -> Tensor:
        pair = self.pair(batch).settled()
        registered = self.net.tilt(pair.frames)
        distance = registration_loss(pair.frames, pair.blur_only, registered.tilts)
        loss = distance + self.hparams["tilt_weight"] * tilt_loss(registered, pair.tilt)
        values = {"loss": loss, "tilt_px": tilt_error(registered, pair.tilt)}
        if stage == "val":
            values["psnr"] = psnr(registered.frames, pair.blur_only)
            values["psnr_input"] = psnr(pair.frames, pair.blur_only)
        self.report(stage, values, len(pair.frames))
        return loss
