"""One draw of the atmosphere: a value that can be kept, applied again, and differentiated."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from turbnet.errors import ParameterError

TILT_PIXELS = 4 / np.pi
"""Shift of the image in Nyquist pixels per radian of the coefficients a_2 (x) and a_3 (y)."""


@dataclass(frozen=True)
class Draw:
    """One draw of the atmosphere.

    Attributes:
        coefficients: Zernike coefficients a_2..a_J of B clips of T moments on the coarse grid, (B, T, J-1, h, w), rad.
        stride: step of that grid in pixels; its first point is the corner pixel (-margin, -margin) of the picture.
        margin: pixels by which the grid overlaps the picture on each side.
        q: pixel of the picture in Nyquist pixels.
    """

    coefficients: Tensor
    stride: int
    margin: int
    q: float = 1.0

    @property
    def tilt(self) -> Tensor:
        """Displacement of each scene point, (B, T, 2, h, w), x then y, in pixels."""
        return TILT_PIXELS / self.q * self.coefficients[:, :, :2]

    @property
    def high(self) -> Tensor:
        """Coefficients a_4..a_J, which blur, (B, T, J-3, h, w), rad."""
        return self.coefficients[:, :, 2:]

    @property
    def blur_strength(self) -> Tensor:
        """Root-mean-square tilt-free phase over the aperture, (B, T, 1, h, w), rad: sqrt(a_4^2 + ... + a_J^2)."""
        return self.high.square().sum(2, keepdim=True).sqrt()

    def moments(self, first: int, end: int) -> "Draw":
        """The same atmosphere from one moment up to another."""
        return replace(self, coefficients=self.coefficients[:, first:end])

    def centred(self) -> "Draw":
        """The same atmosphere seen by a camera that points at the clip's mean position: tilts sum to zero over a clip."""
        tilts = self.coefficients[:, :, :2]
        tilts = tilts - tilts.mean(dim=(1, 3, 4), keepdim=True)
        return replace(self, coefficients=torch.cat((tilts, self.high), dim=2))

    def at_scale(self, scale: float) -> "Draw":
        """The same atmosphere for a picture of the same scene with `scale` times as many pixels along each side.

        Raises:
            ParameterError: the grid's step or margin would not be whole pixels.
        """
        stride, margin = self.stride * scale, self.margin * scale
        if stride < 1 or stride != int(stride) or margin != int(margin):
            raise ParameterError(
                f"scale = {scale:g} makes the atmosphere's grid of {self.stride} pixels (margin {self.margin}) one of "
                f"{stride:g} (margin {margin:g}); both must be whole"
            )
        return replace(self, stride=int(stride), margin=int(margin), q=self.q / scale)
