r"""TCJA transformer: temporal-channel joint attention.

At every pixel the tokens are the pairs (frame t, channel group g), each a vector q, k, v of C/G channels. All T G tokens of
a pixel attend to each other jointly:

.. math::
    a_{(t,g),(t',g')} = \mathrm{softmax}_{(t',g')}\left(\tau_g\, \hat q_{t,g} \cdot \hat k_{t',g'}\right)

with normalised q and k and a bounded temperature tau, so that the logits are bounded whatever the input. Turbulence
sharpens and blurs each frame at other places; attention over time picks, pixel by pixel, the frames that saw this place
well. The reference that all frames were registered to takes part as a frame of its own: what it gathers is the still
scene, once for the whole clip. Space is mixed by convolutions only, so the result at a pixel does not depend on how a
picture is tiled beyond their reach, and any number of frames can be given. Keys and values of earlier frames can
be remembered and attended to by later ones. After TMT (Zhang et al., IEEE TCI 2024), whose
attention is global in space and fixes the number of frames.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbnet.errors import ParameterError
from turbnet.nets.blocks import ChannelNorm, ResidualBlock, conv3x3, each_frame

_LOG_TEMPERATURE_MAX = 3.5  # logits within +-33: softmax stays well conditioned in every dtype
_NOWHERE = -1e4  # added to the logit of a token that is not there


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

    def forward(
        self, x_BTCHW: Tensor, memory_BMCHW: Tensor | None = None, held_BM1HW: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """What each frame gathers (B, T, C, H, W), and keys and values of the frames (B, T, 2C, H, W).

        Args:
            memory_BMCHW: keys and values of earlier frames, (B, M, 2C, H, W), which are attended to as well.
            held_BM1HW: 1 where the memory holds something, 0 where not.
        """
        frames, channels = x_BTCHW.shape[1], x_BTCHW.shape[2]
        qkv = each_frame(self.expand, x_BTCHW)
        q, k, v = (self._tokens(part) for part in qkv.split(channels, dim=2))
        temperature = self.log_temperature.clamp(max=_LOG_TEMPERATURE_MAX).exp().repeat(frames, 1)
        q, k = _unit(q) * temperature, _unit(k)
        seen = torch.cat((self._frames(k, x_BTCHW).to(v.dtype), qkv[:, :, 2 * channels :]), dim=2)
        bias = None
        if memory_BMCHW is not None and held_BM1HW is not None:
            earlier, values = (self._tokens(part) for part in memory_BMCHW.split(channels, dim=2))
            k, v = torch.cat((earlier.float(), k), dim=1), torch.cat((values.to(v.dtype), v), dim=1)
            held = held_BM1HW.repeat_interleave(self.groups, dim=2)
            bias = _NOWHERE * (1 - self._tokens(held).transpose(1, 2).float())
        logits = q @ k.transpose(-2, -1)
        if bias is not None:
            logits = logits + F.pad(bias, (0, frames * self.groups))
        out = self._frames(torch.softmax(logits, dim=-1).to(v.dtype) @ v, x_BTCHW)
        return each_frame(self.project, out), seen

    def _tokens(self, x_BTCHW: Tensor) -> Tensor:
        """(B, T, C, H, W) -> (B H W, T G, C / G): pixels first, then a token for each frame and group."""
        frames, channels = x_BTCHW.shape[1], x_BTCHW.shape[2]
        tokens = x_BTCHW.permute(0, 3, 4, 1, 2)
        return tokens.reshape(-1, frames * self.groups, channels // self.groups)

    def _frames(self, tokens: Tensor, like_BTCHW: Tensor) -> Tensor:
        """The inverse of `_tokens`."""
        batch, frames, channels, height, width = like_BTCHW.shape
        return tokens.reshape(batch, height, width, frames, channels).permute(0, 3, 4, 1, 2)


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

    def forward(
        self, x_BTCHW: Tensor, memory_BMCHW: Tensor | None = None, held_BM1HW: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        gathered, seen = self.attention(each_frame(self.norm, x_BTCHW), memory_BMCHW, held_BM1HW)
        return each_frame(self.feed, x_BTCHW + gathered), seen


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

    def forward(
        self,
        reference_B1CHW: Tensor,
        frames_BTCHW: Tensor,
        confidence_BT1HW: Tensor,
        memory_BMCHW: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Features of the reference (B, C, H/p, W/p), of the frames (B, T, C, H/p, W/p), and what to remember of them.

        Args:
            memory_BMCHW: of earlier frames, (B, M, `memory_channels`, H/p, W/p), as returned for them; zero: nothing.
        """
        batch, count = frames_BTCHW.shape[:2]
        departure = frames_BTCHW - reference_B1CHW
        frames = torch.cat((frames_BTCHW, departure, confidence_BT1HW.to(departure.dtype)), dim=2)
        still = torch.cat(
            (reference_B1CHW, torch.zeros_like(reference_B1CHW), torch.ones_like(reference_B1CHW[:, :, :1])), dim=2
        )
        clip = F.pixel_unshuffle(torch.cat((still, frames), dim=1).flatten(0, 1), self.patch)
        features = self.embed(clip).unflatten(0, (batch, count + 1))
        features = torch.cat((features[:, :1] + self.mark.to(features.dtype), features[:, 1:]), dim=1)
        memories, held = self._recall(memory_BMCHW)
        remember = [torch.ones_like(features[:, 1:, :1])]
        for block, memory in zip(self.blocks, memories, strict=True):
            features, seen = block(features, memory, held)
            remember.append(seen[:, 1:])
        return features[:, 0], features[:, 1:], torch.cat(remember, dim=2)

    @property
    def memory_channels(self) -> int:
        """Channels of what is remembered of a frame: one that says it is there, keys and values of every block."""
        return 1 + 2 * self.width * len(self.blocks)

    def _recall(self, memory_BMCHW: Tensor | None) -> tuple[list[Tensor | None], Tensor | None]:
        if memory_BMCHW is None:
            return [None] * len(self.blocks), None
        return list(memory_BMCHW[:, :, 1:].split(2 * self.width, dim=2)), memory_BMCHW[:, :, :1]
