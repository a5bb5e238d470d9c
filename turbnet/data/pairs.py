"""The pair maker: clean clips in, turbulent clips with their truth out, inside the training loop."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, cast

import torch
import torch.nn.functional as F
from kornia.filters import gaussian_blur2d
from torch import Tensor, nn

from turbnet.atmosphere.path import OpticalPath
from turbnet.errors import ParameterError, check_range
from turbnet.media.colour import to_linear, to_srgb
from turbnet.optics.psf import convolve, exponential_psf
from turbnet.simulate.draw import Draw
from turbnet.simulate.ranges import Conditions, Ranges
from turbnet.simulate.simple import DirectToImage, GaussianDraw, WarpBlur
from turbnet.simulate.simulator import Simulator
from turbnet.simulate.tilt import displacement, sample

SIMPLE = {"direct-to-image": DirectToImage, "warp-blur": WarpBlur}
"""Simple models of turbulence that can stand in for the exact simulator."""


@dataclass(frozen=True)
class Pair:
    """A batch to learn from; sRGB-encoded in [0, 1], (B, T, 3, H, W).

    Attributes:
        frames: what the camera saw.
        target: the clean clip.
        blur_only: the clean clip through the same blur, without tilt.
        tilt: where each scene point moved, (B, T, 2, H, W), pixels.
    """

    frames: Tensor
    target: Tensor
    blur_only: Tensor
    tilt: Tensor

    def settled(self) -> "Pair":
        r"""The same frames, and the truth in the mean geometry of each clip.

        A clip shows the scene point u at :math:`u + \bar t(u)` on average, and nobody can know :math:`\bar t`. A network
        that is compared with the scene at u learns to blur by what it cannot know; compared with

        .. math::
            S'(u + \bar t(u)) = S(u), \qquad t'(u + \bar t(u)) = t(u) - \bar t(u)

        it does not.
        """
        mean = self.tilt.mean(1, keepdim=True)
        back = -displacement(mean[:, 0], 1)[:, None].expand_as(self.tilt).flatten(0, 1)

        def moved(clip_BTCHW: Tensor) -> Tensor:
            return sample(clip_BTCHW.flatten(0, 1), back).unflatten(0, clip_BTCHW.shape[:2])

        target, blur_only = (moved(clip).clamp(0, 1) for clip in (self.target, self.blur_only))
        return Pair(self.frames, target, blur_only, moved(self.tilt - mean))


class PairMaker(nn.Module):
    """Draws a fresh atmosphere for every clip; the clip's seed decides everything.

    Args:
        height, width: of the clips, pixels.
        modes, stride, components, margin: of the simulators, one for each geometry.
        model: zernike, the exact simulator; or one of the simple ones, direct-to-image and warp-blur, which know nothing of
            modes, components and margin (`turbnet.simulate.simple`).
        ranges: fields of `turbnet.simulate.ranges.Ranges`.

    Raises:
        ParameterError: a range or a number that is out of range.
    """

    def __init__(
        self,
        height: int,
        width: int,
        modes: int = 36,
        stride: int = 8,
        components: int = 8,
        margin: int | None = 8,
        model: str = "zernike",
        **ranges: Any,
    ) -> None:
        super().__init__()
        self.ranges = self.check(height, width, modes, stride, components, margin, model, **ranges)

        def simulator(path: OpticalPath) -> nn.Module:
            if model == "zernike":
                return Simulator(path, height, width, modes, stride, components, self.ranges.strengths, margin=margin)
            return SIMPLE[model](path, height, width, stride)

        self.simulators = nn.ModuleList(simulator(path) for path in self.ranges.paths())

    @staticmethod
    def check(
        height: int,
        width: int,
        modes: int = 36,
        stride: int = 8,
        components: int = 8,
        margin: int | None = 8,
        model: str = "zernike",
        **ranges: Any,
    ) -> Ranges:
        """The ranges of these arguments, the simulators not built; raises what the constructor raises."""
        whole = {"height": height, "width": width, "modes": modes, "stride": stride, "components": components}
        for name, value in {**whole, "margin": margin or 0}.items():
            if not isinstance(value, int):
                raise ParameterError(f"{name} = {value!r} must be a whole number")
        if model != "zernike" and model not in SIMPLE:
            raise ParameterError(f"there is no model {model!r} of turbulence; they are zernike, {', '.join(SIMPLE)}")
        return Ranges(**ranges)

    def conditions(self, seed: int, hardness: float = 1.0) -> Conditions:
        """What the clip of this seed is seen through."""
        return self.ranges.sample(torch.Generator().manual_seed(int(seed)), check_range("hardness", hardness, 0, 1))

    def draw(self, through: Conditions, frames: int) -> Draw | GaussianDraw:
        """The atmosphere of one clip, seen by a camera that points at the clip's mean position: a shift common to all frames
        cannot be told from another aim.
        """
        wind = None if through.wind is None else torch.tensor(through.wind)
        strength = torch.tensor([through.d_over_r0])
        simulator = self._simulator(through.geometry)
        return simulator.draw([through.draw_seed], frames, wind, self.ranges.frame_rate, strength).centred()

    @torch.no_grad()
    def forward(
        self,
        scene_BTCHW: Tensor,
        seeds: Sequence[int],
        hardness: Sequence[float] | None = None,
        coefficients: Tensor | None = None,
    ) -> Pair:
        """Look at each clean sRGB clip through an atmosphere of its own.

        A GPU, which many clips at once keep busy, simulates those of one geometry together; a processor each by itself, so
        that it is the same to the last bit in any batch.

        Args:
            coefficients: those of `draw`, if the atmospheres have been drawn elsewhere, (B, T, J-1, h, w).
        """
        clean, hardness = to_linear(scene_BTCHW), hardness or [1.0] * len(seeds)
        conditions = [self.conditions(*drawn) for drawn in zip(seeds, hardness, strict=True)]
        parts: dict[int, tuple[Tensor, Tensor, Tensor]] = {}
        for clips in self._batches(conditions, clean.is_cuda):
            simulator = self._simulator(conditions[clips[0]].geometry)
            if coefficients is None:
                air = _together([self.draw(conditions[k], scene_BTCHW.shape[1]) for k in clips])
            else:
                air = Draw(coefficients[clips], simulator.stride, simulator.margin)
            seen = simulator(clean[clips], air)
            for place, k in enumerate(clips):
                one = slice(place, place + 1)
                parts[k] = self._sensed(seen.frames[one], seen.blur_only[one], conditions[k]) + (seen.tilt[one],)
        frames, blur_only, tilt = (torch.cat(part) for part in zip(*(parts[k] for k in sorted(parts)), strict=True))
        return Pair(to_srgb(frames.clamp(0, 1)), scene_BTCHW, to_srgb(blur_only.clamp(0, 1)), tilt)

    def _simulator(self, geometry: int) -> Simulator | DirectToImage | WarpBlur:
        return cast(Simulator | DirectToImage | WarpBlur, self.simulators[geometry])

    @staticmethod
    def _batches(conditions: Sequence[Conditions], together: bool) -> list[list[int]]:
        """Numbers of the clips that are simulated at once."""
        if not together:
            return [[clip] for clip in range(len(conditions))]
        batches: dict[int, list[int]] = {}
        for clip, through in enumerate(conditions):
            batches.setdefault(through.geometry, []).append(clip)
        return list(batches.values())

    @staticmethod
    def _sensed(frames: Tensor, blur_only: Tensor, seen_through: Conditions) -> tuple[Tensor, Tensor]:
        if seen_through.defocus > 0:
            lens = (seen_through.defocus, seen_through.tails)
            frames, blur_only = (defocused(clip, *lens) for clip in (frames, blur_only))
        return seen_through.sensor(frames, seen_through.noise_seed), blur_only


def _together(draws: Sequence[Any]) -> Any:
    """Draws of one clip each as one of several."""
    tensors = [field.name for field in fields(draws[0]) if isinstance(getattr(draws[0], field.name), Tensor)]
    return replace(draws[0], **{name: torch.cat([getattr(draw, name) for draw in draws]) for name in tensors})


def defocused(clip_BTCHW: Tensor, sigma: float, tails: bool = False) -> Tensor:
    """Every frame through a blur of RMS width `sigma` pixels along either axis; no wider than the frame allows.

    A Gaussian, or with `tails` one that falls off exponentially (`turbnet.optics.psf.exponential_psf`).
    """
    reach = min(math.ceil((4 if tails else 3) * sigma), min(clip_BTCHW.shape[-2:]) - 1)
    size, flat = 2 * reach + 1, clip_BTCHW.flatten(0, 1)
    if tails:
        padded = F.pad(flat, (reach, reach, reach, reach), mode="reflect")
        seen = convolve(padded, exponential_psf(sigma, size).to(flat))
        flat = seen[..., reach : reach + flat.shape[-2], reach : reach + flat.shape[-1]]
    else:
        flat = gaussian_blur2d(flat, (size, size), (sigma, sigma))
    return flat.unflatten(0, clip_BTCHW.shape[:2])
