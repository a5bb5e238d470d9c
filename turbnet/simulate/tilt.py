r"""Tilt: every scene point u moves to u + t(u).

.. math::
    T(J)(x) = \sum_u J(u)\, w(x - u - t(u))

with w a bicubic kernel: each pixel's light is set down at u + t(u), between pixels, and nothing is lost. This is the
adjoint of sampling an image at u + t(u), and its gradient is that sampling. Where neighbours cross over, both arrive.

A field that belongs to scene points, such as their blur, moves along: at x it has the value of the point seen there,
f(x - d(x)), with the displacement d(x) = t(x - d(x)). d is as smooth as t and is found on its coarse grid.
"""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from turbnet.errors import InputError

_ITERATIONS = 12
_SETTLED = 1e-3  # pixels


def check_precision(image: Tensor) -> None:
    """Refuse a picture in whose numbers neither places nor sums of light can be told.

    Raises:
        InputError: it is neither float32 nor float64.
    """
    if image.dtype not in (torch.float32, torch.float64):
        raise InputError(f"pictures of {str(image.dtype)[6:]} cannot be simulated; give float32 or float64")


def upsample(field_BChw: Tensor, stride: int, height: int, width: int) -> Tensor:
    """A coarse field interpolated bicubically to pixels: point (i, j) of the grid is pixel (i stride, j stride)."""
    *_, h, w = field_BChw.shape
    size = ((h - 1) * stride + 1, (w - 1) * stride + 1)
    if size == (h, w):
        return field_BChw[..., :height, :width]
    fine = F.interpolate(field_BChw, size=size, mode="bicubic", align_corners=True)
    return fine[..., :height, :width]


def sample(image_BCHW: Tensor, shift_B2HW: Tensor) -> Tensor:
    """image(x + shift(x)), bicubic, shift in pixels, x then y; outside the picture its border goes on."""
    grid = _grid(shift_B2HW)
    return F.grid_sample(image_BCHW, grid, mode="bicubic", padding_mode="border", align_corners=False)


def displacement(tilt_B2hw: Tensor, stride: int) -> Tensor:
    """d(x) of a tilt t(u), both on the coarse grid and in pixels: the fixed point of d(x) = t(x - d(x)).

    The iteration contracts while the tilt changes by less than a pixel a pixel; where neighbouring points cross over it
    settles on one of them.
    """
    shift = tilt_B2hw
    for _ in range(_ITERATIONS):
        before = shift
        shift = sample(tilt_B2hw, -shift / stride)
        if bool((shift.detach() - before.detach()).abs().max() < _SETTLED):
            break
    return shift


def carry(field_BChw: Tensor, tilt_B2hw: Tensor, stride: int) -> Tensor:
    """A field of the scene points seen where they went: f(x - d(x)), all on the coarse grid."""
    if field_BChw.shape[1] == 0:
        return field_BChw
    return sample(field_BChw, -displacement(tilt_B2hw, stride) / stride)


def tilt(image_BCHW: Tensor, tilt_B2hw: Tensor, stride: int) -> Tensor:
    """Move every scene point u of the image to u + t(u); light that leaves the picture is lost.

    Args:
        image_BCHW: linear intensities; differentiable.
        tilt_B2hw: t on the coarse grid whose point (i, j) is pixel (i stride, j stride), in pixels, x then y;
            differentiable.
        stride: step of that grid, pixels.

    Raises:
        InputError: the tilt holds values that are not finite; the picture is neither float32 nor float64.
    """
    if not bool(tilt_B2hw.detach().any()):
        return image_BCHW
    if not bool(torch.isfinite(tilt_B2hw).all()):
        raise InputError("the tilt holds NaN or infinite values")
    return splat(image_BCHW, upsample(tilt_B2hw, stride, *image_BCHW.shape[-2:]))


def splat(image_BCHW: Tensor, shift_B2HW: Tensor) -> Tensor:
    """`tilt` with the shift of every pixel, (B, 2, H, W).

    Raises:
        InputError: the picture is neither float32 nor float64.
    """
    check_precision(image_BCHW)
    moved: Tensor = _Splat.apply(image_BCHW, _grid(shift_B2HW))
    return moved


class _Splat(torch.autograd.Function):
    """The adjoint of bicubic sampling, as torch has it in the backward pass of `grid_sample`."""

    @staticmethod
    def forward(ctx: Any, image_BCHW: Tensor, grid_BHW2: Tensor) -> Tensor:
        ctx.save_for_backward(image_BCHW, grid_BHW2)
        # Torch gives each picture of a batch to one thread: two halves of the channels keep two threads busy.
        halves = 2 if image_BCHW.shape[1] % 2 == 0 else 1
        pictures = image_BCHW.reshape(-1, image_BCHW.shape[1] // halves, *image_BCHW.shape[2:])
        grids = grid_BHW2.repeat_interleave(halves, dim=0)
        return _sampling_adjoint(pictures, pictures, grids, (True, False))[0].view_as(image_BCHW)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient_BCHW: Tensor) -> tuple[Tensor, Tensor]:
        image_BCHW, grid_BHW2 = ctx.saved_tensors
        sampled = F.grid_sample(gradient_BCHW, grid_BHW2, mode="bicubic", padding_mode="zeros", align_corners=False)
        return sampled, _sampling_adjoint(image_BCHW, gradient_BCHW, grid_BHW2, (False, True))[1]


def _sampling_adjoint(
    gradient: Tensor, image: Tensor, grid: Tensor, wanted: tuple[bool, bool]
) -> tuple[Tensor, Tensor]:
    bicubic, zeros, align_corners = 2, 0, False
    first, second = torch.ops.aten.grid_sampler_2d_backward(
        gradient.contiguous(), image.contiguous(), grid, bicubic, zeros, align_corners, list(wanted)
    )
    return first, second


def _grid(shift_B2HW: Tensor) -> Tensor:
    """x + shift(x) in the coordinates of `grid_sample`: edges of the picture at -1 and 1, in which one pixel has a width."""
    *_, height, width = shift_B2HW.shape
    x = torch.arange(width, device=shift_B2HW.device, dtype=shift_B2HW.dtype)
    y = torch.arange(height, device=shift_B2HW.device, dtype=shift_B2HW.dtype)[:, None]
    columns = (x + shift_B2HW[:, 0] + 0.5) * (2 / width) - 1
    rows = (y + shift_B2HW[:, 1] + 0.5) * (2 / height) - 1
    return torch.stack((columns, rows), dim=-1)
