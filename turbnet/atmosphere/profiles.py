"""Profiles of the refractive-index structure parameter Cn2(z), z in metres from the aperture, Cn2 in m^(-2/3).

`GroundLayer`, `HufnagelValley` and `SLCD` give Cn2 by height above the ground. As they stand they are the profile of a
path that rises vertically from the ground; `Slant` lays any of them along a slanted one. A profile may name the places
where it is not smooth as `knots` (m), so that integrals over the path split there.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from turbnet.errors import ParameterError, check_range

Array = NDArray[np.float64]

CN2_MAX = 1e-9
"""Largest accepted Cn2, m^(-2/3); the strongest seen near hot ground is about 1e-12."""


class Profile(Protocol):
    """Anything that answers Cn2 at distances from the aperture."""

    def __call__(self, z: Array) -> Array:
        """Cn2 (m^(-2/3)) at the distances z (m) from the aperture."""
        ...


@dataclass(frozen=True)
class Constant:
    """The same Cn2 (m^(-2/3)) all along the path; 0 is still air."""

    cn2: float

    def __post_init__(self) -> None:
        check_range("Cn2", self.cn2, 0.0, CN2_MAX, "m^(-2/3)")

    def __call__(self, z: Array) -> Array:
        return np.full_like(np.asarray(z, dtype=np.float64), self.cn2)


@dataclass(frozen=True)
class Tabulated:
    """Cn2 linear between the points (z_i, cn2_i), constant outside them.

    Args:
        z: distances from the aperture, strictly increasing, m.
        cn2: Cn2 there, m^(-2/3).
    """

    z: Sequence[float]
    cn2: Sequence[float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "z", tuple(map(float, self.z)))
        object.__setattr__(self, "cn2", tuple(map(float, self.cn2)))
        if len(self.z) != len(self.cn2) or len(self.z) < 2:
            raise ParameterError(
                f"a tabulated profile needs at least two points and as many z ({len(self.z)}) as Cn2 ({len(self.cn2)})"
            )
        for i, (low, high) in enumerate(zip(self.z, self.z[1:], strict=False)):
            if not low < high:
                raise ParameterError(f"z of a tabulated profile must increase: z[{i}] = {low:g}, z[{i + 1}] = {high:g}")
        for i, value in enumerate(self.cn2):
            check_range(f"Cn2[{i}]", value, 0.0, CN2_MAX, "m^(-2/3)")

    @property
    def knots(self) -> tuple[float, ...]:
        """The given distances, between which the profile is straight."""
        return tuple(self.z)

    def __call__(self, z: Array) -> Array:
        return np.interp(z, self.z, self.cn2)


@dataclass(frozen=True)
class GroundLayer:
    """Cn2(h) = cn2 (h / height)^(-exponent): turbulence over warm ground, strongest where the air touches it.

    Args:
        cn2: Cn2 at the reference height, m^(-2/3).
        height: reference height, m.
        exponent: 4/3 for free convection by day, 2/3 for neutral air. Source: J. C. Wyngaard, Y. Izumi and S. A.
            Collins, JOSA 61, 1646 (1971).

    The power law starts `FLOOR` above the ground; below, Cn2 keeps the value it has there.
    """

    cn2: float
    height: float = 1.0
    exponent: float = 4 / 3

    FLOOR = 0.1
    """Lowest height of the power law, m."""

    def __post_init__(self) -> None:
        check_range("height of the ground layer", self.height, self.FLOOR, 1e4, "m")
        check_range("exponent of the ground layer", self.exponent, 0.0, 3.0)
        check_range("Cn2", self.cn2, 0.0, CN2_MAX, "m^(-2/3)")

    @property
    def knots(self) -> tuple[float, ...]:
        """Where the power law starts."""
        return (self.FLOOR,)

    def __call__(self, z: Array) -> Array:
        return self.cn2 * (np.maximum(z, self.FLOOR) / self.height) ** -self.exponent


@dataclass(frozen=True)
class HufnagelValley:
    """Hufnagel-Valley model of the air above a site; with the defaults the "5/7" model.

    Cn2(h) = 0.00594 (v/27)^2 (1e-5 h)^10 exp(-h/1000) + 2.7e-16 exp(-h/1500) + A exp(-h/100).

    Args:
        wind: root-mean-square wind speed v between 5 and 20 km, m/s.
        ground: A, the turbulence at the ground, m^(-2/3).

    Source: R. E. Hufnagel (1974) and G. C. Valley, Appl. Opt. 19, 574 (1980).
    """

    wind: float = 21.0
    ground: float = 1.7e-14

    def __post_init__(self) -> None:
        check_range("wind", self.wind, 0.0, 200.0, "m/s")
        check_range("ground Cn2", self.ground, 0.0, CN2_MAX, "m^(-2/3)")

    def __call__(self, z: Array) -> Array:
        h = np.maximum(z, 0.0)
        high = 0.00594 * (self.wind / 27) ** 2 * (1e-5 * h) ** 10 * np.exp(-h / 1000)
        return high + 2.7e-16 * np.exp(-h / 1500) + self.ground * np.exp(-h / 100)


@dataclass(frozen=True)
class SLCD:
    """Submarine Laser Communication model, day: five power laws of the height, nothing above 20 km.

    Source: R. J. Sasiela, Electromagnetic Wave Propagation in Turbulence (1994), chapter 2.
    """

    knots = (18.5, 240.0, 880.0, 7200.0, 20000.0)

    def __call__(self, z: Array) -> Array:
        h = np.maximum(z, 1.0)
        laws = [
            np.full_like(h, 1.7e-14),
            3.13e-13 * h**-1.05,
            np.full_like(h, 1.3e-15),
            8.87e-7 * h**-3,
            2e-16 * h**-0.5,
        ]
        return np.select([h < knot for knot in self.knots], laws, 0.0)


@dataclass(frozen=True)
class Slant:
    """A model by height, along a straight path between two heights.

    Args:
        model: Cn2 by height above the ground, m^(-2/3).
        aperture_height: of the aperture, m.
        scene_height: of the scene, m.
        distance: from the aperture to the scene, m; that of the `OpticalPath` it goes into.

    Raises:
        ParameterError: a height below the ground, or a difference in height that the distance cannot span.
    """

    model: Profile
    aperture_height: float
    scene_height: float
    distance: float

    def __post_init__(self) -> None:
        check_range("distance", self.distance, 1.0, 1e6, "m")
        check_range("aperture height", self.aperture_height, 0.0, 1e5, "m")
        low, high = max(0.0, self.aperture_height - self.distance), self.aperture_height + self.distance
        check_range("scene height", self.scene_height, low, high, "m")

    @property
    def knots(self) -> tuple[float, ...]:
        """Distances at which the path passes the knots of the model."""
        climb = (self.scene_height - self.aperture_height) / self.distance
        heights = getattr(self.model, "knots", ())
        return tuple(sorted((h - self.aperture_height) / climb for h in heights)) if climb else ()

    def __call__(self, z: Array) -> Array:
        share = np.asarray(z, dtype=np.float64) / self.distance
        return self.model(self.aperture_height + (self.scene_height - self.aperture_height) * share)
