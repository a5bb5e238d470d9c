r"""The restorer frame by frame: what it carries along is bounded, whatever the length of the clip.

The same weights as in `Restorer`, used recurrently. Of the frames that have passed five things are kept: the reference they
were registered to and the confidence behind it, the mean of the last few, keys and values of the last M for the TCJA
transformer, sums of their tilts, the pictures of the lucky fusion and the weight behind them. Weights fade by

.. math::
    \lambda = 1 - \frac{1}{h}

with every frame, so that what is gone h frames ago counts little: the horizon h is long for a camera that stands still.
"""

import math

import torch
from torch import Tensor, nn

from turbnet.errors import check_range
from turbnet.nets.restorer import Past, Restorer


class StreamingRestorer(nn.Module):
    """A restorer that is given a clip in parts of one frame or more.

    Args:
        restorer: trained on clips.
        horizon: h, frames, at least 1; infinite: nothing fades.
        remember: M, frames whose keys and values are kept.

    Raises:
        ParameterError: a value out of range.
    """

    def __init__(self, restorer: Restorer, horizon: float = 50.0, remember: int = 6) -> None:
        super().__init__()
        self.restorer = restorer
        self.fade = 1 - 1 / check_range("horizon", horizon, 1, math.inf, "frames")
        self.remember = int(check_range("remember", remember, 1, 1000, "frames"))
        self.size_multiple = restorer.size_multiple

    def nothing(self, batch: int, height: int, width: int) -> Past:
        """What is carried before the first frame of clips of this size."""
        net, channels = self.restorer, 3
        patch = net.tcja.patch
        return Past(
            torch.zeros(batch, channels + 1, height, width),
            torch.zeros(batch, channels + 1, height // 2, width // 2),
            torch.zeros(batch, self.remember, net.tcja.memory_channels, height // patch, width // patch),
            torch.zeros(batch, 4, height // 2, width // 2),
            torch.zeros(batch, net.fusion.count, channels + 1, height, width),
        )

    def forward(
        self,
        frames_BTCHW: Tensor,
        reference_BCHW: Tensor,
        recent_BCHW: Tensor,
        memory_BMCHW: Tensor,
        dance_B4HW: Tensor,
        pictures_BKCHW: Tensor,
    ) -> tuple[Tensor, ...]:
        """Restored frames (B, T, C, H, W), and the five parts of `Past` to come back with at the next frame."""
        past = Past(reference_BCHW, recent_BCHW, memory_BMCHW, dance_B4HW, pictures_BKCHW)
        out = self.restorer.stages(frames_BTCHW, past)
        reference, recent, memory, dance, pictures = out.seen
        fade = math.log(self.fade) if self.fade > 0 else -math.inf
        return (
            out.frames,
            torch.cat((reference[:, :-1], self.fade * reference[:, -1:]), dim=1),
            recent,
            torch.cat((memory_BMCHW, memory.float()), dim=1)[:, -self.remember :],
            self.fade * dance,
            torch.cat((pictures[:, :, :-1], (pictures[:, :, -1:] + fade).clamp(min=0)), dim=2),
        )
