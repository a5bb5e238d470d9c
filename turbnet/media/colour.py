"""The sRGB transfer curve (IEC 61966-2-1), for NumPy arrays and torch tensors alike.

With v the encoded value of a file and l the linear intensity, both with white at 1:

    l = v / 12.92                      v <= 0.04045        v = 12.92 l                      l <= 0.0031308
    l = ((v + 0.055) / 1.055)^2.4      v >  0.04045        v = 1.055 l^(1/2.4) - 0.055      l >  0.0031308

Values above 1 follow the power, values below 0 the straight line, so both directions hold on the whole axis and their
gradients are finite everywhere, at 0 too.
"""

from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

Values = TypeVar("Values", "NDArray[np.floating[Any]]", "Tensor")


def to_linear(encoded: Values) -> Values:
    """Linear intensities of sRGB-encoded values: floating point, any shape; the type and precision stay."""
    return _select(encoded > 0.04045, ((_at_least(encoded, 0.04045) + 0.055) / 1.055) ** 2.4, encoded / 12.92)


def to_srgb(linear: Values) -> Values:
    """sRGB-encoded values of linear intensities: floating point, any shape; the type and precision stay."""
    power = 1.055 * _at_least(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return _select(linear > 0.0031308, power, linear * 12.92)


def _at_least(values: Any, bound: float) -> Any:
    """Keeps the branch that is not taken away from the root's infinite slope, which would turn gradients into NaN."""
    return values.clip(min=bound)


def _select(condition: Any, chosen: Any, other: Any) -> Any:
    return np.where(condition, chosen, other) if isinstance(chosen, np.ndarray) else chosen.where(condition, other)
