"""The multi-frame restorer: tilt removal, the TCJA transformer, the still scene once a clip, and every frame's own part."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbnet.nets.deconvolution import Deconvolution
from turbnet.nets.own import OwnFrame
from turbnet.nets.scene import LuckyFusion, SceneNet
from turbnet.nets.tcja import TCJATransformer
from turbnet.nets.tilt import RECENT, Registered, TiltNet

_NO_WEIGHT = -50.0  # logarithm of a weight that counts for nothing


class Past(NamedTuple):
    """What a restorer carries from frame to frame; zero everywhere: nothing has been seen.

    Attributes:
        reference: of the registration, and the sum of confidence behind it, (B, C + 1, H, W).
        recent: mean of the last few registered frames at half the resolution, and how many, (B, C + 1, H/2, W/2).
        memory: of the TCJA transformer, (B, M, `TCJATransformer.memory_channels`, H/p, W/p), M frames.
        dance: sums over the frames of 1, of the tilt and of its square, (B, 4, H/2, W/2).
        pictures: of the lucky fusion, and the logarithm of the weight behind each, counted from a weight of nothing,
            (B, K, C + 1, H, W).
    """

    reference: Tensor
    recent: Tensor
    memory: Tensor
    dance: Tensor
    pictures: Tensor


class Restored(NamedTuple):
    """What the stages of a restorer found.

    Attributes:
        frames: restored frames (B, T, C, H, W).
        scene: the still scene (B, 1, C, H, W).
        own: every frame by itself (B, T, C, H, W).
        gate: logit of where a frame is itself and not the still scene, (B, T, 1, H, W).
        registered: what tilt removal made of the clip.
        seen: what there is to carry on of these frames and those before.
    """

    frames: Tensor
    scene: Tensor
    own: Tensor
    gate: Tensor
    registered: Registered
    seen: Past


class Restorer(nn.Module):
    """Registers a clip and restores every frame of it: see `turbnet.nets.own` for the last step.

    Args:
        tilt: arguments of `TiltNet`.
        tcja: arguments of `TCJATransformer`.
        scene: `widths` and `depths` of `SceneNet`.
        own: `width` and `depth` of `OwnFrame`.
        deconvolution: arguments of `Deconvolution`.
        fusions: pictures of the lucky fusion.
    """

    def __init__(
        self,
        tilt: Mapping[str, Any] | None = None,
        tcja: Mapping[str, Any] | None = None,
        scene: Mapping[str, Any] | None = None,
        own: Mapping[str, Any] | None = None,
        deconvolution: Mapping[str, Any] | None = None,
        fusions: int = 3,
    ) -> None:
        super().__init__()
        self.tilt = TiltNet(**(tilt or {}))
        self.tcja = TCJATransformer(**(tcja or {}))
        width, patch = self.tcja.width, self.tcja.patch
        self.fusion = LuckyFusion(width, patch, fusions)
        self.deconvolution = Deconvolution(**(deconvolution or {}))
        guesses = self.deconvolution.count
        self.scene = SceneNet(3 * (fusions + guesses), width, blends=guesses, hints=2, **(scene or {}))
        self.own = OwnFrame(width, patch, **(own or {}))
        self.size_multiple = math.lcm(self.tilt.size_multiple, patch, self.scene.size_multiple)

    def stages(self, frames_BTCHW: Tensor, past: Past | None = None) -> Restored:
        """Restored frames and what led to them.

        Args:
            past: what earlier frames left behind; they take part in registration, attention and fusion.
        """
        registered = self.tilt(frames_BTCHW, past and past.reference, past and past.recent)
        confidence = registered.confidence
        gathered, features, memory = self.tcja(
            registered.reference, registered.frames, confidence, past and past.memory
        )
        earlier = None
        if past is not None:
            earlier = torch.cat((past.pictures[:, :, :-1], past.pictures[:, :, -1:] + _NO_WEIGHT), dim=2)
        pictures, weight = self.fusion(registered.frames, features, confidence, earlier)
        # Of the plain mean: its blur is the mean PSF, which the kernels know; that of a lucky picture is not.
        guesses = self.deconvolution(registered.reference[:, 0])
        sums = _sums(registered.tilts[-1], past)
        seen = torch.cat((pictures, guesses), dim=1).flatten(1, 2)
        scene = self.scene(seen, gathered, hints_BCHW=dance(sums))[:, None]
        own, gate = self.own(frames_BTCHW, registered.frames, scene, registered.drift, features)
        total = confidence.sum(1) if past is None else confidence.sum(1) + past.reference[:, -1:]
        carried = Past(
            torch.cat((registered.reference[:, 0], total), dim=1),
            _recent(registered.neighbours, past),
            memory,
            sums,
            torch.cat((pictures, (weight - _NO_WEIGHT).clamp(min=0)), dim=2),
        )
        return Restored(scene + torch.sigmoid(gate) * (own - scene), scene, own, gate, registered, carried)

    def forward(self, frames_BTCHW: Tensor) -> Tensor:
        """Restored frames (B, T, C, H, W), sRGB-encoded in [0, 1] like the input; H and W multiples of `size_multiple`."""
        return self.stages(frames_BTCHW).frames


def _sums(tilt_BT2hw: Tensor, past: Past | None) -> Tensor:
    """What is carried on as `Past.dance`; what the tilts say of the blur is taken from them as they are."""
    tilt = tilt_BT2hw.detach().float()
    parts = (torch.ones_like(tilt[:, :, :1]), tilt, tilt.square().sum(2, keepdim=True))
    sums = torch.cat(parts, dim=2).sum(1)
    return sums if past is None else sums + past.dance


def dance(sums_B4hw: Tensor) -> Tensor:
    r"""Two maps at full resolution, (B, 2, H, W): how much the frames dance, and how many there are.

    The variance of the tilt of either axis tells D/r0, and D/r0 the blur:

    .. math::
        \tfrac{1}{2} \log(\sigma_t^2 + 0.01), \qquad \sigma_t^2 = \frac{n}{n - 1}\, \frac{1}{2}\left(\overline{|t|^2}
        - |\bar t|^2\right) \quad \text{averaged over } 18 \times 18 \text{ pixels}; \qquad \tfrac{1}{2} \log n.
    """
    number, first, second = sums_B4hw.split((1, 2, 1), dim=1)
    variance = 0.5 * (second - first.square().sum(1, keepdim=True) / number) / (number - 1).clamp(min=1)
    # As many rows and columns on either side of every pixel: a map that does not care where cells begin.
    around = F.avg_pool2d(variance.clamp(min=0), 9, 1, 4, count_include_pad=False)
    maps = torch.cat(((around + 0.01).log(), number.log()), dim=1) / 2
    return F.interpolate(maps, scale_factor=2.0, mode="bilinear", align_corners=False)


def _recent(neighbours_BTCHW: Tensor, past: Past | None) -> Tensor:
    """What is carried on as `Past.recent`: the mean around the last frame."""
    latest = neighbours_BTCHW[:, -1]
    # Not the shape's number: the exporter would take it for a constant, and trace everything once more to free it.
    number = torch.ones_like(neighbours_BTCHW[:, :, :1]).sum(1)
    if past is not None:
        number = number + past.recent[:, -1:]
    return torch.cat((latest, number.clamp(max=float(RECENT - 1))), dim=1)
