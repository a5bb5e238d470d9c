r"""Every frame's own part, and where it counts instead of the still scene: where something moves.

Registration to what most frames show holds still what moves of itself, so the frame's own picture is made from the frame as
it came, I, and as it was registered, R:

.. math::
    O = R + a\, (I - R) + c, \qquad \text{out} = S + g\, (O - S)

with a blend a in 0 to 1, a correction c that deblurs, and a gate g, from a few convolutions at half resolution that see I,
R, the restored still scene S, the drift (`turbnet.nets.tilt`), and what attention made of the frame.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbnet.nets.blocks import ResidualBlock, conv3x3, each_frame, zero_start


class OwnFrame(nn.Module):
    """A light restoration of every frame by itself, and a gate.

    Args:
        known: channels of the frames' features.
        patch: features are at 1/patch of the resolution, a multiple of 2.
        width: channels at half resolution.
        depth: residual blocks.
        channels: of the frames.
    """

    def __init__(self, known: int, patch: int, width: int = 24, depth: int = 2, channels: int = 3) -> None:
        super().__init__()
        self.channels, self.patch = channels, patch
        self.embed = conv3x3((4 * 3 + 1) * channels, width)
        self.know = nn.Conv2d(known, width * (patch // 2) ** 2, 1)
        self.blocks = nn.Sequential(*(ResidualBlock(width) for _ in range(depth)))
        self.head = conv3x3(width, 4 * (channels + 2))
        zero_start(self.head)

    def forward(
        self,
        frames_BTCHW: Tensor,
        registered_BTCHW: Tensor,
        scene_B1CHW: Tensor,
        drift_BTCHW: Tensor,
        features_BTCHW: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """O (B, T, C, H, W) and the logit of the gate (B, T, 1, H, W); the drift comes at half the resolution."""
        seen = torch.cat((frames_BTCHW, registered_BTCHW, scene_B1CHW.expand_as(frames_BTCHW)), dim=2)
        seen = torch.cat((each_frame(lambda f: F.pixel_unshuffle(f, 2), seen), drift_BTCHW.to(seen.dtype)), dim=2)
        x = each_frame(self.embed, seen)
        x = x + each_frame(lambda f: F.pixel_shuffle(self.know(f), self.patch // 2), features_BTCHW)
        out = each_frame(lambda f: F.pixel_shuffle(self.head(self.blocks(f)), 2), x)
        correction, blend, logit = out.split((self.channels, 1, 1), dim=2)
        own = registered_BTCHW + torch.sigmoid(blend) * (frames_BTCHW - registered_BTCHW) + correction
        return own, logit - 2.0  # near the still scene at first
