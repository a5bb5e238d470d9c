"""Re-degradation with ground truth: restorer, code and degradation learn from simulated pairs."""

from typing import Any

from torch import Tensor

from turbnet.data.clips import AnyScene
from turbnet.data.pairs import Pair
from turbnet.nets.redegradation import Redegraded, Redegrading
from turbnet.nets.restorer import Restorer
from turbnet.tasks.checkpoint import load_net, read_checkpoint
from turbnet.tasks.losses import charbonnier, frequency_loss, psnr, scene_loss, tilt_error, tilt_loss
from turbnet.tasks.simulated import SimulatedTask


class Redegradation(SimulatedTask):
    """Trains all of `Redegrading`: the restored frames are compared with the clean clip, the clean clip degraded by the code
    of the frames, and the restored frames so degraded, with the frames, the code's tilt with the true one.

    Args:
        frequency_weight, redegradation_weight, tilt_weight, scene_weight: of the frequency loss, of both distances to the
            frames, of the tilt's likelihood, of the distance of the still scene that a restorer of clips makes. Without a
            loss of its own a scene that falls behind is shut out by the gate and learns no more.
        start_from: checkpoint of the same network, or of its restorer alone, to start from; or a released network's name.
        more: see `SimulatedTask`.
    """

    trains = (Redegrading,)

    def __init__(
        self,
        frequency_weight: float = 0.1,
        redegradation_weight: float = 0.5,
        tilt_weight: float = 0.01,
        scene_weight: float = 0.6,
        start_from: str | None = None,
        **more: Any,
    ) -> None:
        super().__init__(
            frequency_weight=frequency_weight,
            redegradation_weight=redegradation_weight,
            tilt_weight=tilt_weight,
            scene_weight=scene_weight,
            **more,
        )
        if start_from is not None:
            whole = read_checkpoint(start_from)["hyper_parameters"]["net"].get("name") == self.hparams["net"]["name"]
            part = self.net if whole else self.net.restorer
            part.load_state_dict(
                load_net(start_from, self.hparams["net"] if whole else self.hparams["net"]["restorer"])
            )

    def supervised(self, pair: Pair) -> tuple[Tensor, dict[str, Tensor], Redegraded]:
        """Loss of a pair, what it is made of, what the network found.

        Codes tell the tilt from a clip's mean geometry, so that is where clips are compared.
        """
        pair = pair.settled() if pair.frames.shape[1] > 1 else pair  # of a frame alone no tilt is seen
        net, weight = self.net, self.hparams["redegradation_weight"]
        registered = net.code.tilt(pair.frames)
        restored, scene = self.restored(pair.frames)
        code = net.code(pair.frames, registered)
        found = Redegraded(restored, code, net.degradation(restored, code))
        distance = charbonnier(restored, pair.target)
        truly = charbonnier(net.degradation(pair.target, code), pair.frames)
        again = charbonnier(found.frames, pair.frames)
        loss = distance + self.hparams["frequency_weight"] * frequency_loss(restored, pair.target)
        loss = loss + weight * (truly + again)
        values = {"charbonnier": distance, "true_redegraded": truly, "redegraded": again}
        if scene is not None:
            values["scene"] = scene_loss(scene, pair.target)
            loss = loss + self.hparams["scene_weight"] * values["scene"]
        if pair.frames.shape[1] > 1:
            loss = loss + self.hparams["tilt_weight"] * tilt_loss(registered, pair.tilt)
            values["tilt_px"] = tilt_error(registered, pair.tilt)
        return loss, values, found

    def restored(self, frames_BTCHW: Tensor) -> tuple[Tensor, Tensor | None]:
        """The restored frames and, of a restorer of clips, the still scene that they share."""
        if not isinstance(self.net.restorer, Restorer):
            return self.net.restorer(frames_BTCHW), None
        stages = self.net.restorer.stages(frames_BTCHW)
        return stages.frames, stages.scene

    def step(self, batch: AnyScene, stage: str) -> Tensor:
        pair = self.pair(batch)
        loss, values, found = self.supervised(pair)
        values["loss"] = loss
        if stage == "val":
            values["psnr"] = psnr(found.restored, pair.target)
            values["psnr_input"] = psnr(pair.frames, pair.target)
            values["psnr_redegraded"] = psnr(found.frames, pair.frames)
        self.report(stage, values, len(pair.frames))
        return loss
