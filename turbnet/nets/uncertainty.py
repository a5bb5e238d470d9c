r"""Uncertainty maps: where, and how strongly, turbulence has moved and blurred a single frame.

The difference between a frame and the clean picture is what the tilt did plus what the blur did,

.. math::
    J - I = \underbrace{(I_0 - I)}_{\text{tilt}} + \underbrace{(J - I_0)}_{\text{blur}},

with I_0 the frame as it would be without tilt. A small U-Net estimates both parts m_k and says how far off it expects to
be, as the scale b_k of a Laplace distribution (Kendall & Gal, NeurIPS 2017),

.. math::
    -\log p = \frac{|x_k - m_k|}{b_k} + \log 2 b_k, \qquad \log b_k \in [-7, 0] \text{ by construction}.

b_tilt is large where the picture has edges that the air can have moved, b_blur where it can have lost detail. Two ways to
get maps: in one pass, b itself; or by Monte-Carlo dropout, whose scale adds the spread of the estimates over passes,

.. math:: b^2 = E[b_s^2] + \tfrac{1}{2} \mathrm{Var}[m_s]

(a Laplace distribution of scale b has the variance 2 b^2). After Yasarla & Patel (ICIP 2021), who have the maps by
dropout.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbnet.errors import check_range
from turbnet.nets.blocks import each_frame
from turbnet.nets.scene import UBody

LEAST, MOST = -7.0, 0.0
"""Bounds of log b: errors of 0.001 to 1, full scale 1."""


class Uncertainty(NamedTuple):
    """What the network expects, frame by frame.

    Attributes:
        change: expected parts I_0 - I and J - I_0, (B, T, 2, C, H, W).
        log_scale: log b of both, the same for all channels, (B, T, 2, H, W).
    """

    change: Tensor
    log_scale: Tensor

    @property
    def maps(self) -> Tensor:
        """b_tilt and b_blur, (B, T, 2, H, W)."""
        return self.log_scale.exp()


class UncertaintyNet(nn.Module):
    """The two maps of a frame.

    Args:
        widths, depths: of its U-Net, see `UBody`.
        channels: of the frames.
        dropout: probability that a feature is dropped, in training and in Monte-Carlo passes.

    Raises:
        ParameterError: dropout out of range.
    """

    size_multiple = UBody.size_multiple

    def __init__(
        self,
        widths: Sequence[int] = (16, 32, 48),
        depths: Sequence[int] = (1, 1, 1),
        channels: int = 3,
        dropout: float = 0.1,
    ) -> None:
        super().__init__()
        self.channels, self.dropout = channels, check_range("dropout", dropout, 0.0, 0.9)
        self.body = UBody(channels, 2 * channels + 2, widths=widths, depths=depths)

    def forward(self, frames_BTCHW: Tensor, drop: bool | None = None) -> Uncertainty:
        """Both parts and their scales; a pass with dropout if `drop`, by default while training."""
        rate = self.dropout if (self.training if drop is None else drop) else 0.0
        out = each_frame(lambda x: self.body(x, dropout=rate), frames_BTCHW)
        blur, tilt, raw = out.split((self.channels, self.channels, 2), dim=2)
        # A smooth clamp: gradients never vanish altogether, and the middle of the range is where it starts.
        log_scale = LEAST + (MOST - LEAST) * torch.sigmoid(raw.float())
        return Uncertainty(torch.stack((tilt, blur), dim=2), log_scale)

    def monte_carlo(self, frames_BTCHW: Tensor, passes: int = 8) -> Uncertainty:
        """Mean of the parts over passes with dropout, and a scale that holds their spread as well.

        Raises:
            ParameterError: fewer than two passes.
        """
        check_range("passes", passes, 2, 1000)
        drawn = [self(frames_BTCHW, drop=True) for _ in range(passes)]
        changes = torch.stack([one.change.float() for one in drawn])
        own = torch.stack([(2 * one.log_scale).exp() for one in drawn]).mean(0)
        spread = changes.var(0).mean(3) / 2
        log_scale = 0.5 * (own + spread).log()
        return Uncertainty(changes.mean(0), log_scale.clamp(LEAST, MOST))


class Maps(nn.Module):
    """What a frame's maps say, and nothing else: b_tilt, b_blur and the change to be expected, as pictures.

    Args:
        net: whose maps.
    """

    def __init__(self, net: UncertaintyNet) -> None:
        super().__init__()
        self.net, self.size_multiple = net, net.size_multiple

    def forward(self, frames_BTCHW: Tensor) -> Tensor:
        """(B, T, 3, H, W); the change is the mean over channels of |m_tilt + m_blur|."""
        found = self.net(frames_BTCHW, drop=False)
        change = found.change.sum(2).abs().mean(2, keepdim=True)
        return torch.cat((found.maps, change.float()), dim=2)


def laplace_loss(found: Uncertainty, tilt_BTCHW: Tensor, blur_BTCHW: Tensor) -> Tensor:
    """Mean negative log-likelihood of the true parts I_0 - I and J - I_0, without the constant."""
    truth = torch.stack((tilt_BTCHW, blur_BTCHW), dim=2).float()
    error = (truth - found.change.float()).abs().mean(3)
    return (error * (-found.log_scale).exp() + found.log_scale).mean()


def smoothed(map_BTHW: Tensor, size: int = 5) -> Tensor:
    """Mean over `size` x `size` pixels: what a local error is."""
    return F.avg_pool2d(map_BTHW, size, 1, size // 2, count_include_pad=False)
