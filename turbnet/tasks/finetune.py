"""Self-supervised fine-tuning: a restorer learns from clips that nobody knows the truth of."""

from typing import Any

from torch import Tensor

from turbnet.data.clips import AnyScene
from turbnet.nets.redegradation import Code
from turbnet.tasks.losses import charbonnier, frequency_loss
from turbnet.tasks.redegradation import Redegradation


class Finetuning(Redegradation):
    r"""Goes on from `Redegradation` on unlabelled clips of still scenes.

    Every restored frame J_t, degraded by the code z_s of a frame s of the same clip, must give that frame:

    .. math::
        L = d(D(J_t, z_t), I_t) + d(D(J_t, z_s), I_s) + \lambda_f\, d(J_t, F) + \lambda_p\, \mathrm{prior}(z)

    What is particular to frame t, its noise and its tilt, is not in frame s. All frames must agree on F, what a classical
    method makes of the whole clip, where these frames show it (`turbnet.data.unlabelled`): many frames know what one does
    not. A restorer of clips can hold its frames still, so what they differ by, |J_t - mean J|, is added to the distance to
    F: noise and dance of its own that a restored frame keeps explain its frame, and would pay in the first term. The prior
    ties the blur to the dance of the frames. Beside it the old lessons go on, on simulated pairs, so that nothing is
    forgotten.

    Args:
        agree_weight: lambda_f, of the distance of restored frames to F, which is that of the supervised loss.
        prior_weight: lambda_p.
        rehearsal_weight: of the supervised loss on simulated pairs.
        more: see `Redegradation`.
    """

    def __init__(
        self, agree_weight: float = 1.0, prior_weight: float = 0.02, rehearsal_weight: float = 1.0, **more: Any
    ) -> None:
        super().__init__(
            agree_weight=agree_weight, prior_weight=prior_weight, rehearsal_weight=rehearsal_weight, **more
        )

    def unsupervised(self, frames_BTCHW: Tensor, fused_BCHW: Tensor, shift: int) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of clips without truth, and what it is made of; frame t is compared with frame t + shift as well."""
        net = self.net
        (restored, scene), code = self.restored(frames_BTCHW), net.code(frames_BTCHW)
        own = charbonnier(net.degradation(restored, code), frames_BTCHW)
        other = Code(*(part.roll(-shift, dims=1) for part in code))
        cross = charbonnier(net.degradation(restored, other), frames_BTCHW.roll(-shift, dims=1))
        still = fused_BCHW[:, None].expand_as(restored)
        agree = charbonnier(restored, still) + self.hparams["frequency_weight"] * frequency_loss(restored, still)
        if scene is not None:
            agree = agree + self.hparams["scene_weight"] * charbonnier(scene, still[:, :1])
            # Absolute: Charbonnier's epsilon is as large as what frames of a clip still differ by.
            agree = agree + (restored - restored.mean(1, keepdim=True)).abs().mean()
        prior = net.degradation.prior(code)
        loss = own + cross + self.hparams["agree_weight"] * agree + self.hparams["prior_weight"] * prior
        return loss, {"redegraded": own, "cross": cross, "agree": agree, "prior": prior}

    def step(self, batch: dict[str, AnyScene], stage: str) -> Tensor:  # type: ignore[override]
        cuts: dict[str, Tensor] = batch["clips"]  # type: ignore[assignment]
        clips = cuts["scene"].float()
        shift = 1 + int(cuts["seed"][0]) % max(clips.shape[1] - 1, 1)
        loss, values = self.unsupervised(clips, cuts["fused"].float(), shift)
        values["unsupervised"] = loss
        old, known, _ = self.supervised(self.pair(batch["scenes"]))
        loss = loss + self.hparams["rehearsal_weight"] * old
        values |= {f"old_{name}": value for name, value in known.items()} | {"loss": loss}
        self.report(stage, values, len(clips))
        return loss

    def on_train_batch_end(self, outputs: Any, batch: Any, index: int) -> None:
        super().on_train_batch_end(outputs, batch["scenes"], index)
