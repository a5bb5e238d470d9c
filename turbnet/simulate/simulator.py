r"""The simulator: draw an atmosphere, tilt, blur, sense. Everything in linear intensities.

.. math::
    I = \mathrm{sensor}\left(\frac{B(T(J))}{B(T(1))}\right)

Tilt first, blur second, both indexed by the source point (see `turbnet.simulate.tilt` and `.blur`): the blur of a point
goes with it to where the tilt takes it. The denominator is
what the same atmosphere makes of a uniform scene. Light from a point reaches the aperture with a brightness of its own
(scintillation), which the phase-only model leaves out: it gives every point-spread function the sum one. But by
reciprocity the sum over scene points of what they send to one image point is the energy that would return from there
through the aperture, which air does not change: a uniform scene looks uniform through any turbulence. Without the
denominator it would flicker by 11 % at D/r0 = 2 and 19 % at 4.5.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbnet.atmosphere.noll import noll_covariance
from turbnet.atmosphere.path import OpticalPath
from turbnet.errors import InputError, check_range
from turbnet.simulate.blur import KERNEL, PSFBasis, blur, blur_weights, psf_basis
from turbnet.simulate.draw import TILT_PIXELS, Draw
from turbnet.simulate.field import ZernikeField
from turbnet.simulate.sensor import Sensor
from turbnet.simulate.tilt import carry, tilt, upsample


@dataclass(frozen=True)
class Turbulent:
    """A simulated clip and the truth about it; all linear intensities, (B, T, C, H, W) unless said otherwise.

    Attributes:
        frames: what the camera sees.
        tilt_only: the scene moved but not blurred.
        tilt: where each scene point moved, (B, T, 2, H, W), pixels, x then y. Sampling `frames` at x + tilt(x) undoes it.
        draw: the atmosphere, to be applied again.
    """

    frames: Tensor
    tilt_only: Tensor
    tilt: Tensor
    draw: Draw
    _blur_only: Callable[[], Tensor]

    @cached_property
    def blur_only(self) -> Tensor:
        """The scene through the same blur without tilt: what a perfect tilt removal would return.

        Half the work of a simulation, done when it is asked for.
        """
        return self._blur_only()


class Simulator(nn.Module):
    """Turbulence of one path on pictures of one size.

    Args:
        path: the turbulent path; a pixel of the picture is its Nyquist pixel in the scene.
        height, width: size of the picture, pixels.
        modes: highest Noll index.
        stride: step of the coarse grid on which the atmosphere is drawn, pixels.
        components: PSF components beyond the mean.
        strengths: range of D/r0 for which the PSF basis is made; None: the path's own D/r0.
        sensor: the camera's noise.
        margin: pixels beyond the picture's edge that are simulated too, rounded up to the stride; None: as far as light
            can come from. With less, what comes from farther is missing, brightness kept (if `uniform`).
        uniform: keep a uniform scene uniform, as extended scenes of incoherent light are. False leaves the plain sum of
            point-spread functions, for scenes of points, whose energy it keeps.
    """

    def __init__(
        self,
        path: OpticalPath,
        height: int,
        width: int,
        modes: int = 36,
        stride: int = 4,
        components: int = 20,
        strengths: tuple[float, float] | None = None,
        sensor: Sensor | None = None,
        margin: int | None = None,
        uniform: bool = True,
    ) -> None:
        super().__init__()
        self.height, self.width, self.sensor, self.uniform = height, width, sensor or Sensor(), uniform
        weakest, strongest = strengths or (path.d_over_r0, path.d_over_r0)
        check_range("stride", stride, 1, 64, "pixels")
        if margin is None:
            # Light from beyond the edge reaches the picture by blur and by tilt: four standard deviations of it.
            margin = KERNEL // 2 + int(4 * TILT_PIXELS * (noll_covariance(2, 2) * strongest ** (5 / 3)) ** 0.5)
        self.margin = -(-margin // stride) * stride
        self.field = ZernikeField(path, height, width, self.margin, modes, stride)
        self.basis: PSFBasis = psf_basis(components if strongest > 0 else 0, weakest, strongest, modes)

    def draw(
        self,
        seeds: Sequence[int],
        frames: int = 1,
        wind: Tensor | None = None,
        frame_rate: float = 30.0,
        d_over_r0: Tensor | None = None,
        start: int = 0,
    ) -> Draw:
        """An atmosphere per seed; see `ZernikeField.draw`."""
        return self.field.draw(seeds, frames, wind, frame_rate, d_over_r0, start)

    def forward(self, scene_BTCHW: Tensor, draw: Draw, noise_seed: int = 0) -> Turbulent:
        """Look at a scene through an atmosphere.

        Args:
            scene_BTCHW: linear intensities; T is the draw's number of frames, or 1 for a still scene. Differentiable.
            draw: the atmosphere, differentiable in its coefficients.
            noise_seed: of the sensor.

        Raises:
            InputError: the scene is of another size than the simulator, or holds values that are not finite.
        """
        batch, frames = draw.coefficients.shape[:2]
        if scene_BTCHW.ndim != 5 or scene_BTCHW.shape[-2:] != (self.height, self.width):
            raise InputError(
                f"the scene is {tuple(scene_BTCHW.shape)}; the simulator expects (B, T, C, {self.height}, {self.width})"
            )
        if not bool(torch.isfinite(scene_BTCHW).all()):
            raise InputError("the scene holds NaN or infinite values")
        scene = scene_BTCHW.expand(batch, frames, *scene_BTCHW.shape[2:]).flatten(0, 1)
        padded = _reflect(scene, self.margin)
        if self.uniform:  # a uniform scene comes along as one more channel
            padded = torch.cat((padded, torch.ones_like(padded[:, :1])), dim=1)
        tilts, high = draw.tilt.flatten(0, 1), draw.high.flatten(0, 1)

        moved = tilt(padded, tilts, draw.stride)
        still_air = not bool(draw.coefficients.detach().any())
        weights = blur_weights(high, self.basis) if not still_air else high[:, :0]

        def blurred(scene: Tensor, carried: Tensor) -> Tensor:
            # Still air leaves the scene as it is: the aperture's own diffraction is part of every scene.
            return picture(scene if still_air else blur(scene, carried, self.basis, draw.stride))

        def crop(x: Tensor) -> Tensor:
            m = self.margin
            return x[..., m : m + self.height, m : m + self.width].unflatten(0, (batch, frames))

        def picture(x: Tensor) -> Tensor:
            x = crop(x)
            return x[:, :, :-1] / x[:, :, -1:].clamp(min=1e-3) if self.uniform else x

        return Turbulent(
            frames=self.sensor(blurred(moved, carry(weights, tilts, draw.stride)), noise_seed),
            tilt_only=picture(moved),
            tilt=crop(upsample(tilts, draw.stride, *padded.shape[-2:])),
            draw=draw,
            _blur_only=lambda: blurred(padded, weights),
        )


def _reflect(image_BCHW: Tensor, margin: int) -> Tensor:
    """Reflect the picture `margin` pixels beyond its edges, as often as a small picture needs."""
    while margin > 0:
        *_, height, width = image_BCHW.shape
        step = min(margin, max(min(height, width) - 1, 1))
        mode = "reflect" if min(height, width) > 1 else "replicate"
        image_BCHW = F.pad(image_BCHW, (step, step, step, step), mode=mode)
        margin -= step
    return image_BCHW
