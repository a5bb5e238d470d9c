r"""Tilt: every scene point u moves to u + t(u).

Seen from the image, the light at x comes from the point u with u + t(u) = x. With the displacement d(x) = x - u that
solves d(x) = t(x - d(x)), the tilted image of incoherent light is

.. math::
    T(J)(x) = J(x - d(x))\,|\det(I - \nabla d(x))|

where the determinant keeps the energy of a scene that is locally compressed or stretched. Both d and the determinant are
as smooth as t, so they are found on its coarse grid and interpolated.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

_ITERATIONS = 8


def upsample(field_BChw: Tensor, stride: int, height: int, width: int) -> Tensor:
    """A coarse field interpolated bicubically to pixels: point (i, j) of the grid is pixel (i stride, j stride)."""
    *_, h, w = field_BChw.shape
    size = ((h - 1) * stride + 1, (w - 1) * stride + 1)
    if size == (h, w):
        return field_BChw[..., :height, :width]
    fine = F.interpolate(field_BChw, size=size, mode="bicubic", align_corners=True)
    return fine[..., :height, :width]


def sample(image_BCHW: Tensor, shift_B2HW: Tensor, mode: str = "bicubic") -> Tensor:
    """image(x + shift(x)), shift in pixels, x then y; outside the picture its border goes on."""
    *_, height, width = image_BCHW.shape
    x = torch.arange(width, device=shift_B2HW.device, dtype=shift_B2HW.dtype)
    y = torch.arange(height, device=shift_B2HW.device, dtype=shift_B2HW.dtype)[:, None]
    # align_corners=True: pixel centres 0..N-1 map to -1..1, so no shift returns the image.
    grid = torch.stack(
        (
            (x + shift_B2HW[:, 0]) * (2 / max(width - 1, 1)) - 1,
            (y + shift_B2HW[:, 1]) * (2 / max(height - 1, 1)) - 1,
        ),
        dim=-1,
    )
    return F.grid_sample(image_BCHW, grid, mode=mode, padding_mode="border", align_corners=True)


def displacement(tilt_B2hw: Tensor, stride: int) -> Tensor:
    """d(x) of a tilt t(u), both on the coarse grid and in pixels: the fixed point of d(x) = t(x - d(x)).

    The iteration contracts while the tilt changes by less than a pixel a pixel; where neighbouring points cross over it
    settles on one of them.
    """
    shift = tilt_B2hw
    for _ in range(_ITERATIONS):
        shift = sample(tilt_B2hw, -shift / stride, mode="bicubic")
    return shift


def jacobian(shift_B2hw: Tensor, stride: int) -> Tensor:
    """|det(I - grad d)| on the coarse grid, (B, 1, h, w)."""
    padded = F.pad(shift_B2hw, (1, 1, 1, 1), mode="replicate")
    d_dx = (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) / (2 * stride)
    d_dy = (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) / (2 * stride)
    # The replicated border halves its one-sided difference; the margin of a draw keeps it out of the picture.
    determinant = (1 - d_dx[:, 0]) * (1 - d_dy[:, 1]) - d_dx[:, 1] * d_dy[:, 0]
    return determinant.abs()[:, None]


def tilt(image_BCHW: Tensor, tilt_B2hw: Tensor, stride: int) -> Tensor:
    """Move every scene point u of the image to u + t(u).

    Args:
        image_BCHW: linear intensities; differentiable.
        tilt_B2hw: t on the coarse grid whose point (i, j) is pixel (i stride, j stride), pixels, x then y; differentiable.
        stride: step of that grid, pixels.
    """
    if not bool(tilt_B2hw.detach().any()):
        return image_BCHW
    *_, height, width = image_BCHW.shape
    coarse = displacement(tilt_B2hw, stride)
    fine = upsample(torch.cat((coarse, jacobian(coarse, stride)), dim=1), stride, height, width)
    return sample(image_BCHW, -fine[:, :2]) * fine[:, 2:]
