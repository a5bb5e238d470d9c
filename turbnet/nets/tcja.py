r"""TCJA transformer: temporal-channel joint attention.

At every pixel the tokens are the pairs (frame t, channel group g), each a vector q, k, v of C/G channels. All T G tokens of
a pixel attend to each other jointly:

.. math::
    a_{(t,g),(t',g')} = \mathrm{softmax}_{(t',g')}\left(\tau_g\, \hat q_{t,g} \cdot \hat k_{t',g'}\right)

with normalised q and k and a bounded temperature tau, so that the logits are bounded whatever the input. Turbulence
sharpens and blurs each frame at other places; attention over time picks, pixel by pixel, the frames that saw this place
well. Space is mixed by convolutions only, so the result at a pixel does not depend on how a picture is tiled beyond their
reach, and any number of frames can be given. After TMT (Zhang et al., IEEE TCI 2024), whose attention is global in space
and fixes the number of frames.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbnet.errors import ParameterError
from turbnet.nets.blocks import ChannelNorm, GatedConv, each_frame, zero_start

_LOG_TEMPERATURE_MAX = 3.5  # logits within +-33: softmax stays well conditioned in every dtype


class JointAttention(nn.Module):
    """Temporal-channel joint attention at each pixel.

    Args:
        channels: C of the features.
        groups: G, tokens a frame at each pixel.
    """

    def __init__(self, channels: int, groups: int = 2) -> None:
        super().__init__()
        if channels % groups:
            raise ParameterError(f"groups = {groups} must divide channels = {channels}")
        self.groups = groups
        self.expand = nn.Conv2d(channels, 3 * channels, 1)
        self.mix = nn.Conv2d(3 * channels, 3 * channels, 3, padding=1, groups=3 * channels)
        self.project = nn.Conv2d(channels, channels, 1)
        self.log_temperature = nn.Parameter(torch.full((groups, 1), 1.5))

    def forward(self, x_BTCHW: Tensor) -> Tensor:
        batch, frames, channels, height, width = x_BTCHW.shape
        qkv = self.mix(self.expand(x_BTCHW.flatten(0, 1)))
        # Pixels first, channels last, in one cheap transpose; then a token is a (frame, group) of a pixel.
        tokens = qkv.reshape(batch, frames * 3 * channels, height * width).transpose(1, 2)
        tokens = tokens.reshape(batch * height * width, frames, 3, channels)
        q, k, v = (part.reshape(-1, frames * self.groups, channels // self.groups) for part in tokens.unbind(2))
        temperature = self.log_temperature.clamp(max=_LOG_TEMPERATURE_MAX).exp().repeat(frames, 1)
        q, k = _unit(q) * temperature, _unit(k)
        weights = torch.softmax(q @ k.transpose(-2, -1), dim=-1).to(v.dtype)
        out = (weights @ v).reshape(batch, height * width, frames * channels).transpose(1, 2)
        return each_frame(self.project, out.reshape(batch, frames, channels, height, width))


def _unit(x: Tensor) -> Tensor:
    """x / |x| along the last axis in float32, safe at zero."""
    x = x.float()
    return x * torch.rsqrt(x.square().sum(-1, keepdim=True) + 1e-8)


class _Block(nn.Module):
    def __init__(self, channels: int, groups: int, expansion: float) -> None:
        super().__init__()
        self.norm1, self.norm2 = ChannelNorm(channels), ChannelNorm(channels)
        self.attention = JointAttention(channels, groups)
        self.feed = GatedConv(channels, expansion)

    def forward(self, x_BTCHW: Tensor) -> Tensor:
        x = x_BTCHW + self.attention(each_frame(self.norm1, x_BTCHW))
        batch, frames = x.shape[:2]
        flat = x.flatten(0, 1)
        return (flat + self.feed(self.norm2(flat))).unflatten(0, (batch, frames))


class TCJATransformer(nn.Module):
    """Restores every frame of a registered clip from all of them.

    Works on `patch` x `patch` pixels folded into channels. The result is a correction to a blend of the frame and the
    temporal mean; the blend is decided per pixel, so that what moves is kept from the mean.

    Args:
        width: channels of the features.
        depth: attention blocks.
        groups: channel groups that attend as tokens of their own.
        patch: pixels folded into channels along each axis.
        expansion: of the feed-forward parts.
        channels: of the frames.
    """

    def __init__(
        self,
        width: int = 48,
        depth: int = 4,
        groups: int = 2,
        patch: int = 4,
        expansion: float = 2.0,
        channels: int = 3,
    ) -> None:
        super().__init__()
        self.size_multiple = patch
        self.patch = patch
        folded = channels * patch**2
        self.embed = nn.Conv2d(2 * folded, width, 3, padding=1, padding_mode="replicate")
        self.blocks = nn.ModuleList(_Block(width, groups, expansion) for _ in range(depth))
        self.correct = nn.Conv2d(width, folded, 3, padding=1, padding_mode="replicate")
        self.gate = nn.Conv2d(width, patch**2, 3, padding=1, padding_mode="replicate")
        zero_start(self.correct)
        zero_start(self.gate, bias=-1.5)  # near the temporal mean

    def forward(self, frames_BTCHW: Tensor) -> Tensor:
        batch, count = frames_BTCHW.shape[:2]
        mean = frames_BTCHW.mean(dim=1, keepdim=True)
        departure = frames_BTCHW - mean
        pair = torch.cat((frames_BTCHW, departure), dim=2).flatten(0, 1)
        features = self.embed(F.pixel_unshuffle(pair, self.patch)).unflatten(0, (batch, count))
        for block in self.blocks:
            features = block(features)
        flat = features.flatten(0, 1)
        correction = F.pixel_shuffle(self.correct(flat), self.patch).unflatten(0, (batch, count))
        gate = torch.sigmoid(F.pixel_shuffle(self.gate(flat), self.patch)).unflatten(0, (batch, count))
        return mean + gate * departure + correction
