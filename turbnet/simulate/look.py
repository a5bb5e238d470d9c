"""A drawn atmosphere applied to a padded scene: tilt, then blur, where there is anything to see."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor

from turbnet.simulate.blur import blur, blur_weights
from turbnet.simulate.phase_to_space import PhaseToSpace
from turbnet.simulate.plan import Plan
from turbnet.simulate.psf_basis import PSFBasis
from turbnet.simulate.tilt import carry, splat

FLAT = 1e-6
"""A scene whose neighbours differ by less is flat."""
_WORTH = 0.8  # part of the picture below which cutting out what is not flat pays


@dataclass(frozen=True)
class Colour:
    """Channels seen in one wavelength.

    Attributes:
        channels: which.
        basis: of their PSFs.
        phase: of this wavelength over that of the path's: coefficients times this, tilts in pixels as they are.
    """

    channels: slice
    basis: PSFBasis
    phase: float = 1.0


@dataclass(frozen=True)
class Region:
    """Rows and columns [from, to) of a padded scene."""

    rows: tuple[int, int]
    columns: tuple[int, int]

    @classmethod
    def whole(cls, picture: Tensor) -> "Region":
        """All of a picture (..., H, W)."""
        return cls((0, picture.shape[-2]), (0, picture.shape[-1]))

    @property
    def area(self) -> int:
        """Pixels."""
        return (self.rows[1] - self.rows[0]) * (self.columns[1] - self.columns[0])

    def of(self, picture: Tensor, step: int = 1) -> Tensor:
        """The part of a picture (..., H, W), or of a grid of every `step`-th pixel."""
        (top, bottom), (left, right) = self.rows, self.columns
        return picture[
            ..., top // step : -(-bottom // step) + (step > 1), left // step : -(-right // step) + (step > 1)
        ]

    def grown(self, reach: int, step: int, within: Tensor) -> "Region":
        """With `reach` pixels more on each side, beginning at a multiple of `step`, inside a picture (..., H, W)."""
        sides = zip((self.rows, self.columns), within.shape[-2:], strict=True)
        first, second = ((max(0, a - reach) // step * step, min(n, b + reach)) for (a, b), n in sides)
        return Region(first, second)


def busy_region(padded_BCHW: Tensor, reach: int, step: int) -> Region:
    """The smallest rectangle outside of which nothing but flat surfaces lies within `reach` pixels of a pixel.

    The whole picture where cutting would save little.
    """
    whole = Region.whole(padded_BCHW)
    flat = padded_BCHW.detach()
    across = (flat[..., :, 1:] - flat[..., :, :-1]).abs().amax((0, 1)) > FLAT
    down = (flat[..., 1:, :] - flat[..., :-1, :]).abs().amax((0, 1)) > FLAT
    rows = across.any(1)
    rows[:-1] |= down.any(1)
    columns = down.any(0)
    columns[:-1] |= across.any(0)
    if not bool(rows.any()) and not bool(columns.any()):
        return Region((0, 0), (0, 0))
    spans = []
    for line in (rows, columns):
        where = line.nonzero()[:, 0]
        first, last = (int(where[0]), int(where[-1]) + 2) if len(where) else (0, len(line))
        spans.append((first, last))
    region = Region(spans[0], spans[1]).grown(reach, step, padded_BCHW)
    return region if region.area < _WORTH * whole.area else whole


class Look:
    """What one draw makes of one padded scene.

    Args:
        padded_BCHW: scene with its margin, linear intensities.
        tilt_B2hw: on the grid of `stride` pixels, pixels.
        shift_B2HW: the same at every pixel.
        high_BNhw: a_4..a_J on it, rad.
        stride: pixels.
        plan: what to do and what to leave out.
        colours: wavelengths.
        network: phase-to-space network; None for exact weights.
        uniform: divide by what becomes of a uniform scene.
    """

    def __init__(
        self,
        padded_BCHW: Tensor,
        tilt_B2hw: Tensor,
        shift_B2HW: Tensor,
        high_BNhw: Tensor,
        stride: int,
        plan: Plan,
        colours: Sequence[Colour],
        network: PhaseToSpace | None,
        uniform: bool,
    ) -> None:
        self.tilts, self.shift, self.high, self.stride = tilt_B2hw, shift_B2HW, high_BNhw, stride
        self.plan, self.uniform = plan, uniform
        self.colours, self.network = colours, network
        scenes = [padded_BCHW[:, colour.channels] for colour in colours]
        if uniform:  # a uniform scene comes along as one more channel
            scenes = [torch.cat((scene, torch.ones_like(scene[:, :1])), dim=1) for scene in scenes]
        self.scenes = scenes

    @cached_property
    def _moved(self) -> list[Tensor]:
        if not self.plan.tilt:
            return self.scenes
        return [splat(scene, self.shift) for scene in self.scenes]

    @cached_property
    def _weights(self) -> list[Tensor]:
        g = self.plan.grid
        high = self.high[..., ::g, ::g]
        return [blur_weights(high * c.phase if c.phase != 1 else high, c.basis, self.network) for c in self.colours]

    @property
    def tilt_only(self) -> Tensor:
        """(B, C, H, W)."""
        return self._pictures(self._moved)

    @cached_property
    def frames(self) -> Tensor:
        """(B, C, H, W)."""
        if not self.plan.tilt:
            return self._blurred(self._moved, self._weights)
        g = self.plan.grid
        tilts = self.tilts[..., ::g, ::g]
        return self._blurred(self._moved, [carry(weights, tilts, self.stride * g) for weights in self._weights])

    @property
    def blur_only(self) -> Tensor:
        """(B, C, H, W)."""
        return self._blurred(self.scenes, self._weights)

    def _blurred(self, scenes: list[Tensor], weights: list[Tensor]) -> Tensor:
        if not self.plan.blur:
            return self._pictures(scenes)
        step, factor = self.stride * self.plan.grid, self.plan.factor
        parts = zip(scenes, weights, self.colours, strict=True)
        return self._pictures([blur(scene, w, colour.basis, step, factor) for scene, w, colour in parts])

    def _pictures(self, scenes: list[Tensor]) -> Tensor:
        if self.uniform:
            scenes = [scene[:, :-1] / scene[:, -1:].clamp(min=1e-3) for scene in scenes]
        return scenes[0] if len(scenes) == 1 else torch.cat(scenes, 1)


def reflect(image_BCHW: Tensor, margin: int) -> Tensor:
    """Reflect the picture `margin` pixels beyond its edges, as often as a small picture needs."""
    while margin > 0:
        *_, height, width = image_BCHW.shape
        step = min(margin, max(min(height, width) - 1, 1))
        mode = "reflect" if min(height, width) > 1 else "replicate"
        image_BCHW = F.pad(image_BCHW, (step, step, step, step), mode=mode)
        margin -= step
    return image_BCHW


def equal_channels(scene: Tensor) -> bool:
    """Whether all channels of a scene (..., C, H, W) are the same."""
    return not bool((scene[..., 1:, :, :] != scene[..., :1, :, :]).any())
