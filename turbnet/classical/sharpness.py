r"""Sharpness: how much of a frame's detail survived at each pixel, as a mean over the patch around it.

===================== ===================================================================
variance              \overline{Y^2} - \overline{Y}^2
tv1                   \overline{|Y_x| + |Y_y|}, anisotropic total variation
tv2                   \overline{\sqrt{Y_x^2 + Y_y^2}}, isotropic total variation
laplacian             \overline{(Y_{xx} + Y_{yy})^2}
consistency           normalised correlation with a reference, 0 to 1
===================== ===================================================================

The first four grow with detail, and with noise as well; consistency asks whether the frame shows what the reference
shows at the same place, whatever its sharpness, so it finds patches torn or badly registered.
"""

from collections.abc import Callable

import numpy as np

from turbnet.classical.local import Array, local_mean

RADIUS = 7
"""Half the side of a patch, pixels: about how far one point-spread function holds."""


def variance(luminance_HW: Array, radius: int = RADIUS) -> Array:
    """Variance over the patch, (..., H, W)."""
    centred = luminance_HW - luminance_HW.mean(axis=(-2, -1), keepdims=True)  # or float32 loses digits
    mean = local_mean(centred, radius)
    return np.maximum(local_mean(centred**2, radius) - mean**2, 0)


def tv1(luminance_HW: Array, radius: int = RADIUS) -> Array:
    """Anisotropic total variation, (..., H, W), intensity a pixel."""
    along_y, along_x = np.gradient(luminance_HW, axis=(-2, -1))
    return local_mean(np.abs(along_x) + np.abs(along_y), radius)


def tv2(luminance_HW: Array, radius: int = RADIUS) -> Array:
    """Isotropic total variation, (..., H, W), intensity a pixel."""
    along_y, along_x = np.gradient(luminance_HW, axis=(-2, -1))
    return local_mean(np.hypot(along_x, along_y), radius)


def laplacian(luminance_HW: Array, radius: int = RADIUS) -> Array:
    """Energy of the five-point Laplacian, (..., H, W)."""
    from scipy.ndimage import laplace

    return local_mean(laplace(luminance_HW, axes=(-2, -1)) ** 2, radius)


def consistency(luminance_HW: Array, reference_HW: Array, radius: int = RADIUS) -> Array:
    """Normalised correlation with the reference over the patch, negative ones as 0, (..., H, W); 1 where both are flat."""
    mean, reference = local_mean(luminance_HW, radius), local_mean(reference_HW, radius)
    covariance = local_mean((luminance_HW - mean) * (reference_HW - reference), radius)
    energies = local_mean((luminance_HW - mean) ** 2, radius) * local_mean((reference_HW - reference) ** 2, radius)
    floor = np.float32(1e-9)
    return np.clip((covariance + floor) / (np.sqrt(np.maximum(energies, 0)) + floor), 0, 1)


MEASURES: dict[str, Callable[..., Array]] = {"variance": variance, "tv1": tv1, "tv2": tv2, "laplacian": laplacian}
"""Measures of a frame alone, by name."""
