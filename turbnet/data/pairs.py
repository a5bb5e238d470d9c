"""The pair maker: clean clips in, turbulent clips with their truth out, inside the training loop."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from turbnet.atmosphere.path import OpticalPath
from turbnet.errors import ParameterError, check_range
from turbnet.media.colour import to_linear, to_srgb
from turbnet.simulate.sensor import Sensor
from turbnet.simulate.simulator import Simulator


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


class PairMaker(nn.Module):
    """Draws a fresh atmosphere for every clip; the clip's seed decides everything.

    Args:
        height, width: of the clips, pixels.
        d_over_r0: range of the strength, drawn uniformly.
        wind: range of the wind's speed across the path, m/s, its direction is random; frames are `frame_rate` apart.
        independent: fraction of clips whose frames see independent atmospheres, as lucky imaging assumes.
        frame_rate: frames a second.
        read_noise: range of the read noise, fraction of full scale.
        full_well: electrons at full scale, for shot noise.
        aperture, distance, wavelength: of the path, m; its Cn2 is constant and scaled to the strength.
        modes, stride, components, margin: of the simulator.

    Raises:
        ParameterError: a range or a number that is out of range.
    """

    def __init__(
        self,
        height: int,
        width: int,
        d_over_r0: Sequence[float] = (0.5, 4.5),
        wind: Sequence[float] = (0.5, 8.0),
        independent: float = 0.5,
        frame_rate: float = 30.0,
        read_noise: Sequence[float] = (0.0, 0.02),
        full_well: float = 20_000.0,
        aperture: float = 0.2034,
        distance: float = 7000.0,
        wavelength: float = 525e-9,
        modes: int = 36,
        stride: int = 8,
        components: int = 8,
        margin: int | None = 8,
    ) -> None:
        super().__init__()
        for name, bounds, most in (("d_over_r0", d_over_r0, 100), ("wind", wind, 1000), ("read_noise", read_noise, 1)):
            if len(bounds) != 2 or not 0 <= bounds[0] <= bounds[1] <= most:
                raise ParameterError(
                    f"{name} = {list(bounds)} must be a range: two numbers, 0 <= low <= high <= {most}"
                )
        check_range("independent", independent, 0, 1)
        check_range("frame_rate", frame_rate, 1e-3, 1e6, "frames a second")
        check_range("full_well", full_well, 1, float("inf"), "electrons")
        self.strengths = (float(d_over_r0[0]), float(d_over_r0[1]))
        self.wind, self.independent, self.frame_rate = wind, independent, frame_rate
        self.read_noise, self.full_well = read_noise, full_well
        path = OpticalPath.from_d_over_r0(max(self.strengths[1], 1e-3), aperture, distance, wavelength)
        self.simulator = Simulator(path, height, width, modes, stride, components, self.strengths, margin=margin)

    @torch.no_grad()
    def forward(self, scene_BTCHW: Tensor, seeds: Sequence[int]) -> Pair:
        """Look at each clean sRGB clip through an atmosphere of its own.

        The camera points at the clip's mean position: a shift common to all frames cannot be told from another aim.
        """
        clean = to_linear(scene_BTCHW)
        made = [self._clip(scene, seed) for scene, seed in zip(clean.split(1), seeds, strict=True)]
        frames, blur_only, tilt = (torch.cat(parts) for parts in zip(*made, strict=True))
        return Pair(to_srgb(frames.clamp(0, 1)), scene_BTCHW, to_srgb(blur_only.clamp(0, 1)), tilt)

    def _clip(self, scene_1TCHW: Tensor, seed: int) -> tuple[Tensor, Tensor, Tensor]:
        generator = torch.Generator().manual_seed(int(seed))

        def uniform(low: float, high: float) -> float:
            return low + (high - low) * float(torch.rand((), generator=generator))

        strength = uniform(*self.strengths)
        speed, direction = uniform(*self.wind), uniform(0, 2 * math.pi)
        velocity = torch.tensor((speed * math.cos(direction), speed * math.sin(direction)))
        wind = None if uniform(0, 1) < self.independent else velocity
        sensor = Sensor(self.full_well, uniform(*self.read_noise))
        draw_seed, noise_seed = torch.randint(2**62, (2,), generator=generator).tolist()
        frames = scene_1TCHW.shape[1]
        draw = self.simulator.draw([draw_seed], frames, wind, self.frame_rate, torch.tensor([strength])).centred()
        seen = self.simulator(scene_1TCHW, draw)
        return sensor(seen.frames, noise_seed), seen.blur_only, seen.tilt
