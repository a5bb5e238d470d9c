"""Profiles of the refractive-index structure parameter Cn2(z), z in metres from the aperture, Cn2 in m^(-2/3)."""

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

    def __call__(self, z: Array) -> Array:
        return np.interp(z, self.z, self.cn2)
