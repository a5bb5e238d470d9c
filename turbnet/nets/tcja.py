r"""TCJA transformer: temporal-channel joint attention.

At every pixel the tokens are the pairs (frame t, channel group g), each a vector q, k, v of C/G channels. All T G tokens of
a pixel attend to each other jointly:

.. math::
    a_{(t,g),(t',g')} = \mathrm{softmax}_{(t',g')}\left(\tau_g\, \hat q_{t,g} \cdot \hat k_{t',g'}\right)

with normalised q and k and a bounded temperature tau, so that the logits are bounded whatever the input. Turbulence
sharpens and blurs each frame at other places; attention over time picks, pixel by pixel, the frames that saw this place
well. The reference that all frames were registered to takes part as a frame of its own: what it gathers is the still
scene, once for the whole clip. Space is mixed by convolutions only, so the result at a pixel does not depend on how a
picture is tiled beyond their reach, and any number of frames can be given. After TMT (Zhang et al., IEEE TCI 2024), whose
attention is global in space and fixes the number of frames.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbnet.errors import ParameterError
from turbnet.nets.blocks import ChannelNorm, ResidualBlock, conv3x3, each_frame

_LOG_TEMPERATURE_MAX = 3.5  # logits within +-33: softmax stays well conditioned in every dtype


class JointAttention(nn.Module):
    """Temporal-channel joint attention at each pixel.

    Args:
        channels: C of the features.
        groups: G, tokens a frame at each pixel.

    Raises:
        ParameterError: groups that do not divide the channels.
    """

    def __init__(self, channels: int, groups: int = 2) -> None:
        super().__init__()
        if channels % groups:
            raise ParameterError(f"groups = {groups} must divide channels = {channels}")
        self.groups = groups
        self.expand = nn.Conv2d(channels, 3 * channels, 1)
        self.project = nn.Conv2d(channels, channels, 1)
        self.log_temperature = nn.Parameter(torch.full((groups, 1), 1.5))

    def forward(self, x_BTCHW: Tensor) -> Tensor:
        batch, frames, channels, height, width = x_BTCHW.shape
        qkv = self.expand(x_BTCHW.flatten(0, 1)).permute(0, 2, 3, 1)
        # Pixels first; then a token is a (frame, group) of a pixel.
        tokens = qkv.reshape(batch, frames, height * width, 3 * channels).transpose(1, 2)
        tokens = tokens.reshape(batch * height * width, frames, 3, channels)
        q, k, v = (part.reshape(-1, frames * self.groups, channels // self.groups) for part in tokens.unbind(2))
        temperature = self.log_temperature.clamp(max=_LOG_TEMPERATURE_MAX).exp().repeat(frames, 1)
        q, k = _unit(q) * temperature, _unit(k)
        weights = torch.softmax(q @ k.transpose(-2, -1), dim=-1).to(v.dtype)
        out = (weights @ v).reshape(batch, height * width, frames, channels).transpose(1, 2)
        out = out.reshape(batch * frames, height, width, channels).permute(0, 3, 1, 2)
        return self.project(out).unflatten(0, (batch, frames))


def _unit(x: Tensor) -> Tensor:
    """x / |x| along the last axis in float32, safe at zero."""
    x = x.float()
    return x * torch.rsqrt(x.square().sum(-1, keepdim=True) + 1e-8)


class _Block(nn.Module):
    def __init__(self, channels: int, groups: int) -> None:
        super().__init__()
        self.norm = ChannelNorm(channels)
        self.attention = JointAttention(channels, groups)
        self.feed = ResidualBlock(channels)

    def forward(self, x_BTCHW: Tensor) -> Tensor:
        x = x_BTCHW + self.attention(each_frame(self.norm, x_BTCHW))
        return each_frame(self.feed, x)


class TCJATransformer(nn.Module):
    """Features of the reference and of every registered frame, each told by all the others.

    Works on `patch` x `patch` pixels folded into channels.

    Args:
        width: channels of the features.
        depth: attention blocks.
        groups: channel groups that attend as tokens of their own.
        patch: pixels folded into channels along each axis.
        channels: of the frames.
    """

    def __init__(self, width: int = 48, depth: int = 3, groups: int = 2, patch: int = 4, channels: int = 3) -> None:
        super().__init__()
        self.size_multiple = patch
        self.width, self.patch = width, patch
        self.embed = conv3x3((2 * channels + 1) * patch**2, width)
        self.mark = nn.Parameter(torch.zeros(width, 1, 1))  # tells the reference from the frames
        self.blocks = nn.ModuleList(_Block(width, groups) for _ in range(depth))

    def forward(self, reference_B1CHW: Tensor, frames_BTCHW: Tensor, confidence_BT1HW: Tensor) -> tuple[Tensor, Tensor]:
        """Features of the reference (B, C, H/p, W/p) and of the frames (B, T, C, H/p, W/p)."""
        batch, count = frames_BTCHW.shape[:2]
        departure = frames_BTCHW - reference_B1CHW
        frames = torch.cat((frames_BTCHW, departure, confidence_BT1HW.to(departure.dtype)), dim=2)
        still = torch.cat(
            (reference_B1CHW, torch.zeros_like(reference_B1CHW), torch.ones_like(reference_B1CHW[:, :, :1])), dim=2
        )
        clip = F.pixel_unshuffle(torch.cat((still, frames), dim=1).flatten(0, 1), self.patch)
        features = self.embed(clip).unflatten(0, (batch, count + 1))
        features = torch.cat((features[:, :1] + self.mark.to(features.dtype), features[:, 1:]), dim=1)
        for block in self.blocks:
            features = block(features)
        return features[:, 0], features[:, 1:]
