r"""How far a picture is shifted, as a whole or window by window.

The shift d that brings a picture I to a reference R minimises, over a window with weights w,

.. math::
    E(d) = \sum_x w(x)\,\bigl[I(x + d) - R(x)\bigr]^2

by Gauss-Newton steps with the gradient g of R, :math:`d \leftarrow d - (\sum w\,g g^T)^{-1} \sum w\,g\,[I(x+d) - R]`,
first on smoothed pictures, then on the pictures themselves. With this sign, a picture moved by d to the right and down
has the shift +d. Source: B. D. Lucas & T. Kanade, IJCAI (1981). Windows in which nothing can be seen to move one way or
the other are left out.

The shift of a whole frame is reported beside the scores and never hidden in them: a restoration owes the scene its
place, but a fixed shift is harmless to a viewer, and worth telling from blur.
"""

import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from turbnet.errors import InputError

Picture = NDArray[np.floating[Any]]

WINDOW = 32
"""Width of a window, pixels; windows lie side by side."""

TEXTURE = 0.005
"""Least root-mean-square gradient along a window's weaker direction for it to count, full scale a pixel."""

_SMOOTHING = (2.0, 0.0)  # sigma of the two rounds, pixels
_STEPS = 6
_REACH = 0.25  # greatest shift, fraction of the window


def estimate_shift(picture: Picture, reference: Picture) -> tuple[float, float]:
    """Shift (x, y) in pixels of a whole picture against its reference, both (H, W, C) in [0, 1], H, W >= 8.

    Raises:
        InputError: sizes differ, values are not finite, or neither direction has anything to register.
    """
    image, target = _grey(picture, reference)
    weight = _hann(image.shape[-2])[:, None] * _hann(image.shape[-1])
    shift, textured = _gauss_newton(image, target, weight, torch.zeros(1, 2, dtype=torch.float64))
    if not textured.all():
        raise InputError("the pictures are too flat for a shift to be seen")
    return float(shift[0, 0]), float(shift[0, 1])


def estimate_displacements(picture: Picture, reference: Picture) -> NDArray[np.float64]:
    """Shifts (windows, 2) in pixels, x then y, of the windows that have texture; NaN in those without.

    Pictures (H, W, C) in [0, 1]; of two pictures of one size the windows are the same. Errors as `estimate_shift`,
    but flat pictures give NaN.
    """
    image, target = _grey(picture, reference)
    height, width = image.shape[-2:]
    size = min(WINDOW, height, width)
    corners = torch.cartesian_prod(_starts(width, size), _starts(height, size)).double()
    weight = _hann(size)[:, None] * _hann(size)
    shift, textured = _gauss_newton(image, target, weight, corners)
    shift[~textured] = torch.nan
    return shift.numpy()


def undo_shift(picture: Picture, shift: tuple[float, float]) -> Picture:
    """The picture (H, W, C) moved back by a shift (x, y) in pixels, by cubic splines; edges are mirrored."""
    from scipy.ndimage import shift as move

    moved: Picture = move(picture, (-shift[1], -shift[0], 0), order=3, mode="mirror").astype(picture.dtype)
    return moved


def margin_of(shift: tuple[float, float]) -> int:
    """Pixels at each edge that `undo_shift` had to make up, or that its splines carry from there."""
    return math.ceil(max(map(abs, shift))) + 2


def _gauss_newton(image: Tensor, target: Tensor, weight: Tensor, corners_N2: Tensor) -> tuple[Tensor, Tensor]:
    """Shifts (N, 2) of windows at corners (x, y), and whether they have texture, (N,); `weight` has the window's size."""
    rows, columns = weight.shape
    y, x = torch.meshgrid(torch.arange(rows).double(), torch.arange(columns).double(), indexing="ij")
    points = torch.stack((x, y), -1) + corners_N2[:, None, None]  # (N, rows, columns, 2)
    shift = torch.zeros_like(corners_N2)
    reach = _REACH * min(rows, columns)
    textured = torch.ones(len(corners_N2), dtype=torch.bool)
    for sigma in _SMOOTHING:
        smooth_image, smooth_target = _smooth(image, sigma), _smooth(target, sigma)
        g_y, g_x = torch.gradient(smooth_target[0, 0])
        still = _sample(torch.stack((smooth_target[0, 0], g_x, g_y))[None], points)
        wanted, gx, gy = still[:, 0], still[:, 1], still[:, 2]
        xx, yy, xy = ((weight * a * b).sum((1, 2)) for a, b in ((gx, gx), (gy, gy), (gx, gy)))
        weaker = (xx + yy) / 2 - (((xx - yy) / 2).square() + xy.square()).sqrt()
        textured = weaker / weight.sum() >= TEXTURE**2
        determinant = (xx * yy - xy * xy).clamp(min=1e-12)
        for _ in range(_STEPS):
            error = _sample(smooth_image, points + shift[:, None, None])[:, 0] - wanted
            ex, ey = (weight * gx * error).sum((1, 2)), (weight * gy * error).sum((1, 2))
            step = torch.stack((yy * ex - xy * ey, xx * ey - xy * ex), -1) / determinant[:, None]
            shift = (shift - step.clamp(-2, 2)).clamp(-reach, reach)
    return shift, textured


def _sample(picture_1CHW: Tensor, points_NhwK: Tensor) -> Tensor:
    """Values (N, C, h, w) at points (x, y) in pixels, cubic, the edge continued."""
    height, width = picture_1CHW.shape[-2:]
    count, rows, columns, _ = points_NhwK.shape
    scale = torch.tensor([2 / max(width - 1, 1), 2 / max(height - 1, 1)], dtype=torch.float64)
    grid = (points_NhwK * scale - 1).view(1, count * rows, columns, 2)
    values = F.grid_sample(picture_1CHW, grid, mode="bicubic", padding_mode="border", align_corners=True)
    return values[0].view(-1, count, rows, columns).movedim(1, 0)


def _smooth(picture_11HW: Tensor, sigma: float) -> Tensor:
    if sigma == 0:
        return picture_11HW
    reach = int(3 * sigma)
    kernel = torch.exp(-0.5 * (torch.arange(-reach, reach + 1).double() / sigma) ** 2)
    kernel = kernel / kernel.sum()
    padded = F.pad(picture_11HW, (reach,) * 4, mode="replicate")
    return F.conv2d(F.conv2d(padded, kernel[None, None, None]), kernel[None, None, :, None])


def _grey(picture: Picture, reference: Picture) -> tuple[Tensor, Tensor]:
    if picture.ndim != 3 or picture.shape != reference.shape:
        raise InputError(f"cannot register pictures of shape {picture.shape} and {reference.shape}; both are (H, W, C)")
    if min(picture.shape[:2]) < 8:
        raise InputError(f"a picture of {picture.shape[1]}x{picture.shape[0]} pixels is too small to be registered")
    if not (np.isfinite(picture).all() and np.isfinite(reference).all()):
        raise InputError("cannot register pictures that hold NaN or infinite pixels")
    first, second = (
        torch.from_numpy(np.asarray(p, dtype=np.float64).mean(-1))[None, None] for p in (picture, reference)
    )
    return first, second


def _starts(length: int, size: int) -> Tensor:
    """Where windows begin: from edge to edge, a window apart or a little less."""
    count = math.ceil(length / size)
    return torch.linspace(0, length - size, count).round()


def _hann(size: int) -> Tensor:
    return torch.hann_window(size + 2, periodic=False, dtype=torch.float64)[1:-1]
