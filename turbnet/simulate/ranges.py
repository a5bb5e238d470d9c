r"""Ranges of what turbulence a clip is seen through, and one clip's conditions drawn from them.

With a constant Cn2 scaled to D/r0, aperture D, distance L and wavelength act on still air's picture only through

.. math::
    N = \frac{D}{\lambda L / (2 D)} = \frac{2 D^2}{\lambda L}

the aperture in Nyquist pixels (twice its Fresnel number): the scale, in pixels, on which the turbulence changes across the
scene. In a wind D matters once more: air at the speed v travels v / (D frame_rate) apertures from frame to frame. A
simulator takes long to build and little to run, so a few geometries are drawn once, and each clip takes one of them.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from turbnet.atmosphere.path import OpticalPath
from turbnet.errors import ParameterError, check_range
from turbnet.simulate.sensor import Sensor

Range = float | Sequence[float]
"""Two numbers, low <= high, or one number for both."""

_LIMITS = {
    "d_over_r0": (0.0, 100.0, ""),
    "wind": (0.0, 1000.0, "m/s"),
    "read_noise": (0.0, 1.0, ""),
    "full_well": (1.0, float("inf"), "electrons"),
    "aperture": (1e-3, 50.0, "m"),
    "distance": (1.0, 1e6, "m"),
    "wavelength": (1e-7, 2e-5, "m"),
    "defocus": (0.0, 100.0, "pixels"),
    "jpeg": (1, 100, ""),
}


@dataclass(frozen=True)
class Conditions:
    """What one clip is seen through.

    Attributes:
        d_over_r0: strength of the turbulence.
        geometry: which of `Ranges.paths()`.
        wind: velocity of the air across the path, x and y, m/s; None: every frame sees an atmosphere of its own.
        sensor: the camera's noise and compression.
        defocus: RMS width of the blur of the lens along either axis, pixels; 0 for none.
        tails: that blur falls off exponentially, not as a Gaussian.
        draw_seed: of the atmosphere.
        noise_seed: of the sensor.
    """

    d_over_r0: float
    geometry: int
    wind: tuple[float, float] | None
    sensor: Sensor
    defocus: float
    tails: bool
    draw_seed: int
    noise_seed: int


@dataclass(frozen=True)
class Ranges:
    """Where the conditions of clips are drawn from; each range is (low, high) or one number.

    Args:
        d_over_r0: strength, drawn uniformly.
        wind: speed across the path, m/s, drawn uniformly; its direction is uniform on the circle.
        independent: fraction of clips whose frames see independent atmospheres, as lucky imaging assumes.
        frame_rate: frames a second.
        read_noise: fraction of full scale, drawn uniformly.
        full_well: electrons at full scale. The variance of shot noise, 1 / full_well, is drawn uniformly; infinite for none.
        aperture, distance, wavelength: of the path, m, drawn uniformly in the logarithm; see `paths`.
        geometries: how many paths to draw. One stands in the (geometric) middle of the ranges.
        geometry_seed: of that draw.
        defocus: RMS width of a blur of the lens along either axis, the same in all frames, pixels, drawn uniformly.
        blurred: fraction of clips that have it.
        tails: fraction of those whose blur falls off exponentially, not as a Gaussian: see `turbnet.data.pairs.defocused`.
        jpeg: quality of compression, drawn uniformly.
        compressed: fraction of clips that are compressed.
        subframes: atmospheres averaged over the exposure of a frame. Reserved: 1, an instant exposure, is all there is.

    Raises:
        ParameterError: a range that is none or leaves its physical limits, a number out of range.
    """

    d_over_r0: Range = (0.5, 6.0)
    wind: Range = (0.5, 8.0)
    independent: float = 0.5
    frame_rate: float = 30.0
    read_noise: Range = (0.0, 0.02)
    full_well: Range = 20_000.0
    aperture: Range = 0.2034
    distance: Range = 7000.0
    wavelength: Range = 525e-9
    geometries: int = 1
    geometry_seed: int = 0
    defocus: Range = (0.0, 3.0)
    blurred: float = 0.0
    tails: float = 0.0
    jpeg: Range = (40, 95)
    compressed: float = 0.0
    subframes: int = 1

    def __post_init__(self) -> None:
        for name, (low, high, unit) in _LIMITS.items():
            object.__setattr__(self, name, _checked(name, getattr(self, name), low, high, unit))
        for name in ("geometries", "geometry_seed", "subframes"):
            if not isinstance(getattr(self, name), int):
                raise ParameterError(f"{name} = {getattr(self, name)!r} must be a whole number")
        for name in ("independent", "blurred", "tails", "compressed"):
            check_range(name, _number(name, getattr(self, name)), 0, 1)
        check_range("frame_rate", _number("frame_rate", self.frame_rate), 1e-3, 1e6, "frames a second")
        check_range("geometries", self.geometries, 1, 1000)
        check_range("geometry_seed", self.geometry_seed, 0, 2**63)
        check_range("subframes", self.subframes, 1, 1)
        if self.geometries > 1 and all(low == high for low, high in self._geometric()):
            raise ParameterError(
                f"geometries = {self.geometries} needs a range of aperture, distance or wavelength to draw them from"
            )

    @property
    def strengths(self) -> tuple[float, float]:
        """Weakest and strongest D/r0."""
        return self.d_over_r0  # type: ignore[return-value]

    def paths(self) -> list[OpticalPath]:
        """The geometries, each with the Cn2 of the strongest D/r0 (or of 0.001 in still air, whose profile has no shape).

        Several are drawn as a Latin hypercube: each of aperture, distance and wavelength is cut into as many equal parts (of
        its logarithm) as there are geometries, and each part holds one of them.
        """
        rng = np.random.default_rng(self.geometry_seed)
        count = self.geometries
        drawn = []
        for low, high in self._geometric():
            part = (rng.permutation(count) + rng.random(count)) / count if count > 1 else np.array([0.5])
            drawn.append(np.clip(low ** (1 - part) * high**part, low, high))
        strongest = max(self.strengths[1], 1e-3)
        return [OpticalPath.from_d_over_r0(strongest, *map(float, one)) for one in zip(*drawn, strict=True)]

    def sample(self, generator: torch.Generator, hardness: float = 1.0) -> Conditions:
        """The conditions of one clip; the generator decides everything.

        Args:
            hardness: part of the range of D/r0 to draw from, 0 (the weakest alone) to 1 (all of it).
        """

        def uniform(low: float, high: float) -> float:
            return low + (high - low) * float(torch.rand((), generator=generator))

        low, high = self.strengths
        strength = uniform(low, low + hardness * (high - low))
        speed, direction = uniform(*self.wind), uniform(0, 2 * math.pi)  # type: ignore[misc]
        wind = None if uniform(0, 1) < self.independent else (speed * math.cos(direction), speed * math.sin(direction))
        read_noise = uniform(*self.read_noise)  # type: ignore[misc]
        draw_seed, noise_seed = torch.randint(2**62, (2,), generator=generator).tolist()
        geometry = int(torch.randint(self.geometries, (), generator=generator))
        low, high = self.full_well  # type: ignore[misc]
        # A range of one number comes out as that very number, whatever 1 / (1 / x) rounds to.
        full_well = low if low == high else _inverse(uniform(1 / high, 1 / low))
        # Drawn last: clips of ranges without them are what they were before these came.
        defocus, blurred = uniform(*self.defocus), uniform(0, 1) < self.blurred  # type: ignore[misc]
        jpeg, compressed = round(uniform(*self.jpeg)), uniform(0, 1) < self.compressed  # type: ignore[misc]
        tails = uniform(0, 1) < self.tails
        sensor = Sensor(full_well, read_noise, jpeg=jpeg if compressed else None)
        return Conditions(strength, geometry, wind, sensor, defocus if blurred else 0.0, tails, draw_seed, noise_seed)

    def _geometric(self) -> list[tuple[float, float]]:
        return [self.aperture, self.distance, self.wavelength]  # type: ignore[list-item]


def _inverse(value: float) -> float:
    return 1 / value if value else math.inf


def _number(name: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ParameterError(f"{name} = {value!r} must be a number")
    return float(value)


def _checked(name: str, value: object, low: float, high: float, unit: str) -> tuple[float, float]:
    """(low, high) of a range or of one number."""
    pair = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value, value]
    start, end = (_number(name, number) for number in pair) if len(pair) == 2 else (math.nan, math.nan)
    if not low <= start <= end <= high or (math.isinf(start) and name != "full_well"):
        limits = f"{low:g} <= low <= high <= {high:g} {unit}".rstrip()
        raise ParameterError(f"{name} = {value!r} must be a range: two numbers, {limits}")
    return start, end
