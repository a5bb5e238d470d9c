r"""The still scene, restored once for a whole clip.

First a learned lucky fusion: K pictures, each a mean of the registered frames with weights of its own at every pixel,

.. math::
    F_k(x) = \sum_t w_{k,t}(x)\, I_t(x), \qquad w_{k,t} = \mathrm{softmax}_t\, (\ell_{k,t} + \log c_t)

from logits l that the frames' features give and the confidence c of the registration. Then a U-Net on half, a quarter and
an eighth of the resolution sharpens the first of them, knowing the others, what deconvolution (`turbnet.nets.deconvolution`)
makes of the mean of the registered frames, and what the reference gathered. However many frames a clip has, this part runs
once: a deep network at a small cost a frame.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbnet.nets.blocks import ResidualBlock, conv3x3, zero_start


class LuckyFusion(nn.Module):
    """K weighted means over time.

    Args:
        width: channels of the frames' features.
        patch: features are at 1/patch of the resolution.
        count: K.
    """

    def __init__(self, width: int, patch: int, count: int = 3) -> None:
        super().__init__()
        self.patch, self.count = patch, count
        self.logits = conv3x3(width, count * patch**2)
        zero_start(self.logits)

    def forward(
        self,
        frames_BTCHW: Tensor,
        features_BTCHW: Tensor,
        confidence_BT1HW: Tensor,
        past_BKCHW: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The pictures (B, K, C, H, W) and the logarithm of the weight behind each, (B, K, 1, H, W).

        Args:
            past_BKCHW: both for earlier frames, (B, K, C + 1, H, W): they count as one more frame of that weight.
        """
        logits = F.pixel_shuffle(self.logits(features_BTCHW.flatten(0, 1)).float(), self.patch)
        logits = logits.unflatten(0, features_BTCHW.shape[:2]) + confidence_BT1HW.float().clamp(min=1e-4).log()
        if past_BKCHW is not None:
            logits = torch.cat((past_BKCHW[:, None, :, -1], logits), dim=1)
        # Not softmax: onnxruntime transposes for any axis but the last.
        peak = logits.amax(1, keepdim=True)
        weights = (logits - peak).exp()
        total = weights.sum(1)
        now = weights[:, -frames_BTCHW.shape[1] :]
        fused = [(now[:, :, k : k + 1] * frames_BTCHW).sum(1) for k in range(self.count)]
        pictures = torch.stack(fused, dim=1)
        if past_BKCHW is not None:
            pictures = pictures + weights[:, 0, :, None] * past_BKCHW[:, :, :-1]
        pictures = pictures / total[:, :, None]
        return pictures.to(frames_BTCHW.dtype), (peak[:, 0] + total.log())[:, :, None]


class UBody(nn.Module):
    """U-Net over half, a quarter and an eighth of the resolution; its output starts at zero.

    Args:
        inner, outer: channels of input and output at full resolution.
        known: channels of further features at a quarter of the resolution; 0: none.
        widths: channels at the three scales.
        depths: residual blocks at each scale, on the way down; on the way up as many but at the coarsest.
    """

    size_multiple = 8

    def __init__(
        self,
        inner: int,
        outer: int,
        known: int = 0,
        widths: Sequence[int] = (32, 64, 96),
        depths: Sequence[int] = (1, 2, 4),
    ) -> None:
        super().__init__()
        self.embed: nn.Module = conv3x3(4 * inner, widths[0])
        self.down = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in zip(widths, widths[1:], strict=False))
        self.know = nn.Conv2d(known, widths[1], 1) if known else None
        self.encode = nn.ModuleList(_blocks(w, d) for w, d in zip(widths, depths, strict=True))
        self.up = nn.ModuleList(nn.Conv2d(b, 4 * a, 1) for a, b in zip(widths, widths[1:], strict=False))
        self.decode = nn.ModuleList(_blocks(w, d) for w, d in zip(widths[:-1], depths, strict=False))
        self.correct = conv3x3(widths[0], 4 * outer)
        zero_start(self.correct)

    def forward(self, x_BCHW: Tensor, known_BCHW: Tensor | None = None, dropout: float = 0.0) -> Tensor:
        """(B, outer, H, W); H and W multiples of `size_multiple`.

        Args:
            dropout: probability that a channel is dropped at each scale, whatever the mode.
        """
        x = self.embed(F.pixel_unshuffle(x_BCHW, 2))
        passed = []
        for scale, encode in enumerate(self.encode):
            if scale:
                passed.append(x)
                x = self.down[scale - 1](x)
            if scale == 1 and self.know is not None and known_BCHW is not None:
                x = x + self.know(known_BCHW)
            if dropout:
                x = F.dropout2d(x, dropout, training=True)
            x = encode(x)
        for scale in reversed(range(len(passed))):
            x = self.decode[scale](passed[scale] + F.pixel_shuffle(self.up[scale](x), 2))
        return F.pixel_shuffle(self.correct(x), 2)


class SceneNet(UBody):
    """Corrects the first of the pictures it is given.

    The last of them can be blended in with weights of their own at every pixel: F_1 + sum_k a_k (P_k - F_1) + c.

    Args:
        inner: channels of all pictures.
        known, widths, depths: see `UBody`.
        channels: of the picture corrected.
        blends: pictures that are blended in.
        hints: channels of maps that come with the pictures.
    """

    def __init__(
        self,
        inner: int,
        known: int = 0,
        widths: Sequence[int] = (32, 64, 96),
        depths: Sequence[int] = (1, 2, 4),
        channels: int = 3,
        blends: int = 0,
        hints: int = 0,
    ) -> None:
        super().__init__(inner + hints, channels + blends, known, widths, depths)
        self.channels, self.blends = channels, blends

    def forward(
        self,
        pictures_BCHW: Tensor,
        known_BCHW: Tensor | None = None,
        dropout: float = 0.0,
        hints_BCHW: Tensor | None = None,
    ) -> Tensor:
        """(B, channels, H, W); H and W multiples of `size_multiple`."""
        seen = pictures_BCHW if hints_BCHW is None else torch.cat((pictures_BCHW, hints_BCHW), dim=1)
        first, change = pictures_BCHW[:, : self.channels], super().forward(seen, known_BCHW, dropout)
        out = first + change[:, : self.channels]
        if self.blends:
            others = pictures_BCHW[:, -self.blends * self.channels :].unflatten(1, (self.blends, self.channels))
            out = out + (change[:, self.channels :, None] * (others - first[:, None])).sum(1)
        return out


def _blocks(width: int, depth: int) -> nn.Sequential:
    return nn.Sequential(*(ResidualBlock(width) for _ in range(depth)))
