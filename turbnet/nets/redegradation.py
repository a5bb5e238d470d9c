r"""Re-degradation: what was restored is degraded again and must give the frames that were observed.

.. math::
    \hat J = R(I), \qquad z_t = E(I)_t, \qquad \hat I_t = D(\hat J, z_t) \approx I_t

The code z is all that D learns of an observed frame, and it is kept low-dimensional on purpose: a few numbers for every cell
of 16 x 16 pixels (768 values). A D that is given I itself, as in published code, can pass it on and teaches R nothing.
From a constant picture nothing can be made but that constant: what I shows has to be in J.

The tilt of the code is found by registration (`turbnet.nets.tilt`, whose closed-form steps know no strongest turbulence),
the blur by a small network. Two forms of D:

- *physical*: the blur is Zernike coefficients a_4 .. a_J, and D the simulator that training uses.
- *linear*: the blur is shares w_k of K learned PSFs, D(J, z) = sum_k w_k (phi_k * J(x - t(x))). After the re-degradation
  network of Mao et al. (ECCV 2022).

A sharp J and a strong blur explain a frame as well as a blurred J and none. Theory tells them apart: how much the frames
dance tells D/r0, and that how strong their blur is (`prior`).
"""

import math
from collections.abc import Mapping
from functools import lru_cache
from math import lcm
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbnet.atmosphere.noll import noll_covariance
from turbnet.atmosphere.path import OpticalPath
from turbnet.errors import ParameterError, check_range
from turbnet.media.colour import to_linear, to_srgb
from turbnet.nets.blocks import ResidualBlock, conv3x3, warp, zero_start
from turbnet.nets.tilt import Registered, TiltNet
from turbnet.simulate.draw import TILT_PIXELS, Draw
from turbnet.simulate.simulator import Simulator
from turbnet.simulate.width import STRONGEST, short_exposure_sigma

CELL = 16
"""Side of the cells that a code describes, pixels."""

_DARKEST = 1e-4  # below it the slope of the sRGB curve's inverse is no help


class Code(NamedTuple):
    """What is known of each frame's turbulence.

    Attributes:
        tilt: pixels, x then y, (B, T, 2, H/16, W/16).
        blur: (B, T, K, H/16, W/16).
    """

    tilt: Tensor
    blur: Tensor

    def strength(self) -> Tensor:
        """D/r0 of each clip from how its frames dance, (B,): E[t^2] = (4/pi)^2 0.4489 (D/r0)^(5/3), without gradient."""
        frames = self.tilt.shape[1]
        moved = (self.tilt - self.tilt.mean(1, keepdim=True)).detach().square().mean((1, 2, 3, 4))
        variance = moved * frames / max(frames - 1, 1)
        one = TILT_PIXELS**2 * float(noll_covariance(2, 2))
        return (variance / one).pow(3 / 5).clamp(max=STRONGEST)


class Redegraded(NamedTuple):
    """What `Redegrading` found.

    Attributes:
        restored: frames (B, T, C, H, W).
        code: of the frames.
        frames: restored frames degraded again, (B, T, C, H, W).
    """

    restored: Tensor
    code: Code
    frames: Tensor


class CodeNet(nn.Module):
    """E: the code of every frame of a clip; before training its blur is zero, its tilt that of an untrained `TiltNet`.

    Args:
        size: K, numbers of the blur.
        tilt: arguments of `TiltNet`.
        width: channels.
        depth: residual blocks at 1/16 of the resolution.
    """

    def __init__(self, size: int, tilt: Mapping[str, Any] | None = None, width: int = 24, depth: int = 2) -> None:
        super().__init__()
        self.tilt = TiltNet(**(tilt or {"widths": (16, 12, 8)}))
        self.embed = conv3x3(3 * 16, width)
        self.first, self.second = ResidualBlock(width), ResidualBlock(2 * width)
        self.down, self.further = nn.Conv2d(width, 2 * width, 2, stride=2), nn.Conv2d(2 * width, 3 * width, 2, stride=2)
        self.blocks = nn.Sequential(*(ResidualBlock(3 * width) for _ in range(depth)))
        self.head = nn.Conv2d(3 * width, size, 1)
        zero_start(self.head)

    def forward(self, frames_BTCHW: Tensor, registered: Registered | None = None) -> Code:
        """The code of each frame; a frame alone has no tilt.

        Args:
            registered: what `self.tilt` made of the frames, where that is known already.
        """
        batch, frames = frames_BTCHW.shape[:2]
        found = (registered or self.tilt(frames_BTCHW)).tilts[-1].flatten(0, 1)
        x = self.first(self.embed(F.pixel_unshuffle(frames_BTCHW.flatten(0, 1), 4)))
        blur = self.head(self.blocks(self.further(self.second(self.down(x)))))
        cells = F.avg_pool2d(found.float(), CELL // 2)
        return Code(cells.unflatten(0, (batch, frames)), blur.float().unflatten(0, (batch, frames)))


class LinearRedegradation(nn.Module):
    """The linear form: positive kernels of sum one and shares of sum one, so that a level is kept.

    Args:
        kernels: K, learned PSFs; they start as Gaussians from a point to 4 pixels wide.
        size: of a kernel, pixels, odd.

    Raises:
        ParameterError: a value out of range.
    """

    def __init__(self, kernels: int = 8, size: int = 17) -> None:
        super().__init__()
        check_range("kernels", kernels, 2, 64)
        check_range("size of a kernel", size, 3, 63, "pixels")
        if size % 2 == 0:
            raise ParameterError(f"size of a kernel = {size} must be odd")
        radius = torch.arange(size) - size // 2
        square = (radius**2 + radius[:, None] ** 2).float()
        sigma = torch.linspace(0.35, 4.0, kernels).view(-1, 1, 1)
        self.logits = nn.Parameter((-square / (2 * sigma**2)).clamp(min=-30.0))
        self.blur_size = kernels

    @property
    def kernels(self) -> Tensor:
        """phi, (K, k, k)."""
        return torch.softmax(self.logits.flatten(1), dim=1).view_as(self.logits)

    def forward(self, picture_BTCHW: Tensor, code: Code) -> Tensor:
        """The picture, or a scene (B, 1, C, H, W) for all frames, degraded as the code says, (B, T, C, H, W)."""
        batch, frames = code.tilt.shape[:2]
        channels, height, width = picture_BTCHW.shape[2:]
        tilt, blur = (at_pixels(part.flatten(0, 1), 0, 1, height, width) for part in code)
        pictures = picture_BTCHW.expand(batch, frames, channels, height, width).flatten(0, 1)
        moved = warp(pictures, -tilt).float()
        reach = self.logits.shape[-1] // 2
        padded = F.pad(moved.flatten(0, 1)[:, None], (reach, reach, reach, reach), mode="replicate")
        blurred = F.conv2d(padded, self.kernels[:, None]).unflatten(0, (batch * frames, channels))
        return (torch.softmax(blur, dim=1)[:, None] * blurred).sum(2).unflatten(0, (batch, frames))

    def prior(self, code: Code) -> Tensor:
        """(log sigma - log sigma_SE(D/r0))^2 where sigma is the less: widths of the mean PSF and of theory; lenses add."""
        shares = torch.softmax(code.blur, dim=2).mean((1, 3, 4))
        mean = torch.einsum("bk,kyx->byx", shares, self.kernels)
        width = -0.5 * (4 * math.pi * mean.square().sum((1, 2))).log()
        wanted = width.new_tensor([math.log(short_exposure_sigma(float(s))) for s in code.strength()])
        return (wanted - width).clamp(min=0).square().mean()


class PhysicalRedegradation(nn.Module):
    """The physical form: the simulator, in linear intensities, driven by Zernike coefficients.

    Args:
        modes: J; the blur is a_4 .. a_J at each cell, rad.
        stride: grid of the simulator, pixels.
        components: of its PSF basis.
        margin: beyond the picture, pixels.

    Raises:
        ParameterError: a value out of range.
    """

    def __init__(self, modes: int = 21, stride: int = 8, components: int = 8, margin: int = 16) -> None:
        super().__init__()
        check_range("modes", modes, 4, 36)
        self.modes, self.stride, self.components, self.margin = modes, stride, components, margin
        self.blur_size = modes - 3

    def forward(self, picture_BTCHW: Tensor, code: Code) -> Tensor:
        """As `LinearRedegradation.forward`."""
        batch, frames = code.tilt.shape[:2]
        height, width = picture_BTCHW.shape[-2:]
        simulator = _simulator(height, width, self.modes, self.stride, self.components, self.margin)
        simulator = simulator.to(picture_BTCHW.device)
        coefficients = torch.cat((code.tilt / TILT_PIXELS, code.blur), dim=2).flatten(0, 1)
        grid = at_pixels(coefficients, -self.margin, self.stride, simulator.field.rows, simulator.field.columns)
        draw = Draw(grid.unflatten(0, (batch, frames)), self.stride, self.margin)
        seen = simulator(to_linear(picture_BTCHW.float().clamp(_DARKEST, 1)), draw).frames
        return to_srgb(seen.clamp(_DARKEST, 1))

    def prior(self, code: Code) -> Tensor:
        """(log E[sum_j a_j^2] - log of what Noll's variances give at D/r0)^2."""
        power = code.blur.square().sum(2).mean((1, 2, 3))
        one = sum(float(noll_covariance(j, j)) for j in range(4, self.modes + 1))
        wanted = one * code.strength().clamp(min=0.1) ** (5 / 3)
        return ((power + 1e-4).log() - wanted.log()).square().mean()


FORMS: dict[str, type[LinearRedegradation] | type[PhysicalRedegradation]] = {
    "linear": LinearRedegradation,
    "physical": PhysicalRedegradation,
}


class Redegrading(nn.Module):
    """A restorer that learns from its own frames degraded again; to run it, only the restorer is needed.

    Args:
        restorer: config of a network that restores frames, see `turbnet.nets.build`.
        form: linear or physical.
        degradation: arguments of the form.
        code: of `CodeNet`, all but its size.

    Raises:
        ParameterError: there is no such form.
    """

    def __init__(
        self,
        restorer: Mapping[str, Any],
        form: str = "linear",
        degradation: Mapping[str, Any] | None = None,
        code: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        from turbnet.nets import build

        if form not in FORMS:
            raise ParameterError(f"there is no form {form!r} of re-degradation; the forms are {', '.join(FORMS)}")
        self.restorer = build(restorer)
        self.degradation = FORMS[form](**(degradation or {}))
        self.code = CodeNet(self.degradation.blur_size, **(code or {}))
        self.size_multiple = lcm(self.restorer.size_multiple, CELL)  # type: ignore[arg-type]

    def stages(self, frames_BTCHW: Tensor) -> Redegraded:
        """Restored, encoded, degraded again."""
        restored, code = self.restorer(frames_BTCHW), self.code(frames_BTCHW)
        return Redegraded(restored, code, self.degradation(restored, code))

    def forward(self, frames_BTCHW: Tensor) -> Tensor:
        """Restored frames (B, T, C, H, W)."""
        return self.restorer(frames_BTCHW)


def at_pixels(cells_NKhw: Tensor, first: int, step: int, rows: int, columns: int) -> Tensor:
    """A code at the pixels first, first + step, ...: bilinear between the middles of cells, constant beyond."""
    height, width = cells_NKhw.shape[-2:]

    def places(count: int, cells: int) -> Tensor:
        pixel = first + step * torch.arange(count, device=cells_NKhw.device, dtype=torch.float32)
        return (pixel + 0.5) * (2 / (CELL * cells)) - 1

    y, x = torch.meshgrid(places(rows, height), places(columns, width), indexing="ij")
    grid = torch.stack((x, y), dim=-1).expand(len(cells_NKhw), -1, -1, -1)
    return F.grid_sample(cells_NKhw.float(), grid, mode="bilinear", padding_mode="border", align_corners=False)


def code_of(draw: Draw, modes: int, height: int, width: int) -> Code:
    """The code of a known atmosphere at the middles of cells, as the physical form takes it."""
    batch, frames = draw.coefficients.shape[:2]
    known = draw.coefficients[:, :, : modes - 1].flatten(0, 1)
    rows, columns = known.shape[-2:]

    def places(cells: int, points: int) -> Tensor:
        pixel = CELL * torch.arange(cells, dtype=torch.float32) + (CELL - 1) / 2
        return (pixel + draw.margin) / draw.stride * (2 / (points - 1)) - 1

    y, x = torch.meshgrid(places(height // CELL, rows), places(width // CELL, columns), indexing="ij")
    grid = torch.stack((x, y), dim=-1).to(known).expand(len(known), -1, -1, -1)
    cells = F.grid_sample(known, grid, mode="bicubic", align_corners=True).unflatten(0, (batch, frames))
    return Code(TILT_PIXELS * cells[:, :, :2], cells[:, :, 2:])


@lru_cache(maxsize=4)
def _simulator(height: int, width: int, modes: int, stride: int, components: int, margin: int) -> Simulator:
    """Of pictures of this size; what a path does to them is in the code, not in the simulator."""
    path = OpticalPath.from_d_over_r0(STRONGEST)
    return Simulator(path, height, width, modes, stride, components, (0.0, STRONGEST), margin=margin)
