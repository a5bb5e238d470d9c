"""Sensor: what the camera adds after the optics: shot and read noise, then quantisation.

A signal of intensity I collects `full_well` I electrons: shot noise has the variance I / full_well, read noise the
standard deviation `read_noise` (both in units of full scale). Shot noise is drawn as a Gaussian, right from about ten
electrons on, so that frames stay differentiable.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from turbnet.errors import check_range


@dataclass(frozen=True)
class Sensor:
    """A camera's noise.

    Args:
        full_well: electrons at full scale; infinite for no shot noise.
        read_noise: standard deviation, fraction of full scale.
        bits: depth of quantisation; 0 for none. Rounding passes gradients straight through.
    """

    full_well: float = float("inf")
    read_noise: float = 0.0
    bits: int = 0

    def __post_init__(self) -> None:
        check_range("full_well", self.full_well, 1.0, float("inf"), "electrons")
        check_range("read_noise", self.read_noise, 0.0, 1.0)
        check_range("bits", self.bits, 0, 16)

    def __call__(self, frames: Tensor, seed: int = 0) -> Tensor:
        """Linear intensities of any shape, with noise; values below 0 or above 1 saturate where there is noise or depth."""
        out = frames
        if self.read_noise > 0 or self.full_well != float("inf"):
            generator = torch.Generator().manual_seed(seed)
            noise = torch.randn(frames.shape, generator=generator).to(frames)
            variance = self.read_noise**2 + frames.clamp(min=0) / self.full_well
            # The floor keeps the square root's gradient finite in black pixels.
            out = (frames + noise * variance.clamp(min=1e-12).sqrt()).clamp(0, 1)
        if self.bits:
            steps = 2**self.bits - 1
            rounded = (out.clamp(0, 1) * steps).round() / steps
            out = out + (rounded - out).detach()
        return out
