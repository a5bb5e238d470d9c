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

How much of this a path needs for a given error is the plan's to say (`turbnet.simulate.plan`); channels that are the same
are simulated once, and what lies beyond the reach of anything but a flat surface is left as it is.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbnet.atmosphere.noll import noll_covariance
from turbnet.atmosphere.path import OpticalPath
from turbnet.errors import InputError, ParameterError, check_range
from turbnet.simulate.draw import TILT_PIXELS, Draw
from turbnet.simulate.field import ZernikeField
from turbnet.simulate.look import Colour, Look, Region, busy_region, equal_channels, reflect
from turbnet.simulate.phase_to_space import released
from turbnet.simulate.plan import CONTRAST, TOLERANCE, Plan, Planner, contrast
from turbnet.simulate.psf_basis import kernel_size, psf_basis
from turbnet.simulate.sensor import Sensor, exposed
from turbnet.simulate.tilt import check_precision, upsample

STRONGEST = 100.0
"""Greatest D/r0: at 1000 light comes from a thousand pixels away, and a kernel of 31 pixels shows nothing of its blur."""


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

    def blur_only_at(self, scale: int) -> Tensor:
        """`blur_only` reduced by a whole factor: means over scale x scale pixels, rest cut off, (B, T, C, H', W')."""
        small = F.avg_pool2d(self.blur_only.flatten(0, 1), scale)
        return small.unflatten(0, self.blur_only.shape[:2])

    @cached_property
    def blur_strength(self) -> Tensor:
        """Root-mean-square tilt-free phase of each scene point, (B, T, 1, H, W), rad; of several exposures the mean."""
        height, width = self.tilt.shape[-2:]
        strength = self.draw.blur_strength.flatten(0, 1)
        margin = self.draw.margin
        fine = upsample(strength, self.draw.stride, height + 2 * margin, width + 2 * margin)
        fine = fine[..., margin : margin + height, margin : margin + width]
        clips, frames = self.tilt.shape[:2]
        return fine.view(clips, frames, -1, height, width).mean(2, keepdim=True)


class Simulator(nn.Module):
    """Turbulence of one path on pictures of one size.

    Args:
        path: the turbulent path.
        height, width: size of the picture, pixels.
        modes: highest Noll index; None: as the plan says.
        stride: step of the coarse grid on which the atmosphere is drawn, pixels.
        components: PSF components beyond the mean; None: as the plan says.
        strengths: range of D/r0 for which the PSF basis is made; None: the path's own D/r0.
        sensor: the camera's sensor.
        margin: pixels beyond the picture's edge that are simulated too, rounded up to the stride; None: as far as light
            can come from. With less, what comes from farther is missing, brightness kept (if `uniform`).
        uniform: keep a uniform scene uniform, as extended scenes of incoherent light are. False leaves the plain sum of
            point-spread functions, for scenes of points, whose energy it keeps.
        tolerance: error budget of the plan: PSNR of a frame against the exact one, dB.
        contrast: root-mean-square gradient of the scenes a pixel, linear intensities, which the plan reckons with.
        q: pixel of the picture in Nyquist pixels lambda L / (2 D) of the path: `Camera.sampling`. 1 where no camera is
            known.
        wavelengths: one for each channel, m; None: the path's for all of them.
        exact: find PSF weights by exact pupil transforms, at full resolution.
        outer_scale, boiling, layers, dtype: see `ZernikeField`.

    Raises:
        ParameterError: a value out of range.
    """

    def __init__(
        self,
        path: OpticalPath,
        height: int,
        width: int,
        modes: int | None = None,
        stride: int = 4,
        components: int | None = None,
        strengths: tuple[float, float] | None = None,
        sensor: Sensor | None = None,
        margin: int | None = None,
        uniform: bool = True,
        tolerance: float = TOLERANCE,
        contrast: float = CONTRAST,
        q: float = 1.0,
        wavelengths: Sequence[float] | None = None,
        exact: bool = False,
        outer_scale: float = float("inf"),
        boiling: float = float("inf"),
        layers: int = 16,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        self.path, self.height, self.width, self.uniform = path, height, width, uniform
        self.sensor, self.q, self.wavelengths = sensor or Sensor(), q, wavelengths
        self.strengths = strengths or (path.d_over_r0, path.d_over_r0)
        self._given = (modes, components, exact)
        check_range("stride", stride, 1, 64, "pixels")
        check_range("D/r0", round(self.strengths[1], 9), 0.0, STRONGEST)
        self.stride = stride
        self._rigid = margin is not None
        self.margin = margin or 0
        if not self._rigid:
            self.margin = self._reach(kernel_size(q))
        self._planned = self._plan(tolerance, contrast)
        if not self._rigid:
            self.margin = self._reach(kernel_size(q, self._planned.points))
        self.margin = -(-self.margin // stride) * stride
        self._contrast, self._air = contrast, (layers, outer_scale, boiling)
        self.field = ZernikeField(
            path, height, width, self.margin, self._planned.modes, stride, layers, q, outer_scale, boiling, dtype
        )
        self._colours = self._make_colours()
        self._network = released() if self._planned.network else None

    def _reach(self, kernel: int) -> int:
        """Pixels from which light can come: by blur, and by tilt to four standard deviations."""
        tilts = TILT_PIXELS / self.q * (noll_covariance(2, 2) * self.strengths[1] ** (5 / 3)) ** 0.5
        return kernel // 2 + int(4 * tilts)

    def _plan(self, tolerance: float, contrast: float) -> Plan:
        modes, components, exact = self._given
        size = (self.height + 2 * self.margin, self.width + 2 * self.margin)
        planner = Planner(self.path, self.strengths, size, self.stride, self.q, 3 + self.uniform)
        plan = planner.plan(tolerance, contrast, modes, components, exact)
        return replace(plan, wavelengths=len(self.wavelengths or (0,)))

    def plan(self, scene: Tensor | None = None, tolerance: float | None = None) -> Plan:
        """What this simulator leaves out and what that saves; `print` it.

        Args:
            scene: linear intensities (..., C, H, W): the plan that would do for it alone, with what it lets out besides.
                Make a simulator with that `contrast` to follow it.
            tolerance: of another budget, dB.
        """
        if scene is None and tolerance is None:
            return self._planned
        value = CONTRAST if scene is None else contrast(scene)
        plan = self._plan(self._planned.tolerance if tolerance is None else tolerance, value)
        return plan if scene is None else replace(plan, notes=tuple(self._let_out(scene)))

    def _let_out(self, scene: Tensor) -> list[str]:
        notes = [f"scene: gradient {contrast(scene):.3f} a pixel"]
        if scene.shape[-3] > 1 and equal_channels(scene):
            notes.append(f"scene: its {scene.shape[-3]} channels are the same, one is simulated")
        padded = reflect(scene.reshape(-1, *scene.shape[-3:]), self.margin)
        region = busy_region(padded, self.margin, self.stride * self._planned.grid)
        part = 1 - region.area / (padded.shape[-2] * padded.shape[-1])
        if part > 0:
            notes.append(f"scene: {100 * part:.0f} % of it is flat and left as it is")
        return notes

    def draw(
        self,
        seeds: Sequence[int],
        frames: int = 1,
        wind: Tensor | None = None,
        frame_rate: float = 30.0,
        d_over_r0: Tensor | None = None,
        start: float = 0,
        cn2: Tensor | None = None,
        shutter: float = 1.0,
    ) -> Draw:
        """An atmosphere per seed, at as many moments of each frame as the sensor averages; see `ZernikeField.draw`."""
        return self.field.draw(seeds, frames, wind, frame_rate, d_over_r0, start, cn2, self.sensor.exposures, shutter)

    def at_scale(self, scale: float) -> "Simulator":
        """The same path for pictures of the same scene with `scale` times as many pixels; `draw.at_scale` goes with it.

        Raises:
            ParameterError: sizes, grid or margin would not be whole pixels.
        """
        height, width, stride, margin = (n * scale for n in (self.height, self.width, self.stride, self.margin))
        if any(n != int(n) or n < 1 for n in (height, width, stride)) or margin != int(margin):
            raise ParameterError(
                f"scale = {scale:g} makes {self.height} x {self.width} pixels, grid {self.stride} and margin "
                f"{self.margin} something else than whole pixels"
            )
        _, components, exact = self._given
        layers, outer_scale, boiling = self._air
        return Simulator(
            self.path,
            int(height),
            int(width),
            self._planned.modes,
            int(stride),
            components,
            self.strengths,
            self.sensor,
            int(margin),
            self.uniform,
            self._planned.tolerance,
            self._contrast,
            self.q / scale,
            self.wavelengths,
            exact,
            outer_scale,
            boiling,
            layers,
            self.field.dtype,
        )

    def forward(self, scene_BTCHW: Tensor, draw: Draw, noise_seed: int = 0) -> Turbulent:
        """Look at a scene through an atmosphere.

        Args:
            scene_BTCHW: linear intensities; T is the draw's number of frames, or 1 for a still scene. Differentiable.
            draw: the atmosphere, differentiable in its coefficients.
            noise_seed: of the sensor.

        Raises:
            InputError: the scene is of another size than the simulator, is neither float32 nor float64, or holds values
                that are not finite; the draw was made for another grid.
        """
        self._check(scene_BTCHW, draw)
        (batch, moments), channels = draw.coefficients.shape[:2], scene_BTCHW.shape[2]
        scene = scene_BTCHW
        if channels > 1 and self.wavelengths is None and not scene.requires_grad and equal_channels(scene):
            scene = scene[:, :, :1]
        if scene.shape[1] > 1:
            scene = scene.repeat_interleave(self.sensor.exposures, dim=1)
        scene = scene.expand(batch, moments, *scene.shape[2:]).flatten(0, 1)
        padded = reflect(scene, self.margin)
        tilts, high = draw.tilt.flatten(0, 1), draw.high.flatten(0, 1)

        def finish(x: Tensor) -> Tensor:
            m = self.margin
            return x[..., m : m + self.height, m : m + self.width].unflatten(0, (batch, moments))

        def picture(x: Tensor) -> Tensor:
            return finish(x).expand(-1, -1, channels, -1, -1)

        shift = upsample(tilts, draw.stride, *padded.shape[-2:])
        still_air = not bool(draw.coefficients.detach().any())
        busy = self._busy(padded, tilts)
        if still_air or busy.area == 0:
            # Still air leaves the scene as it is: the aperture's own diffraction is part of every scene.
            frames, tilt_only, blur_only = padded, padded, lambda: padded
        else:
            # What comes from outside the region is flat; from as far as light can come it is simulated with it.
            around = busy.grown(self._far(tilts), self.stride * self._planned.grid, padded)
            look = Look(
                around.of(padded),
                around.of(tilts, self.stride),
                around.of(shift),
                around.of(high, self.stride),
                self.stride,
                self._planned,
                self._colours,
                self._network,
                self.uniform,
            )

            def paste(x: Tensor) -> Tensor:
                if busy == around:
                    return x
                (top, bottom), (left, right) = busy.rows, busy.columns
                y, x0 = top - around.rows[0], left - around.columns[0]
                whole = padded.clone()
                whole[..., top:bottom, left:right] = x[..., y : y + bottom - top, x0 : x0 + right - left]
                return whole

            frames, tilt_only, blur_only = paste(look.frames), paste(look.tilt_only), lambda: paste(look.blur_only)
        exposures = self.sensor.exposures
        return Turbulent(
            frames=self.sensor(picture(frames), noise_seed),
            tilt_only=exposed(picture(tilt_only), exposures),
            tilt=exposed(finish(shift), exposures),
            draw=draw,
            _blur_only=lambda: exposed(picture(blur_only()), exposures),
        )

    def _check(self, scene_BTCHW: Tensor, draw: Draw) -> None:
        if scene_BTCHW.ndim != 5 or scene_BTCHW.shape[-2:] != (self.height, self.width):
            raise InputError(
                f"the scene is {tuple(scene_BTCHW.shape)}; the simulator expects (B, T, C, {self.height}, {self.width})"
            )
        clips, frames = draw.coefficients.shape[0], draw.coefficients.shape[1] // self.sensor.exposures
        if scene_BTCHW.shape[0] not in (1, clips) or scene_BTCHW.shape[1] not in (1, frames):
            raise InputError(
                f"the scene has {scene_BTCHW.shape[0]} clips of {scene_BTCHW.shape[1]} frames, the draw {clips} of {frames}"
            )
        if self.wavelengths is not None and scene_BTCHW.shape[2] != len(self.wavelengths):
            raise InputError(f"the scene has {scene_BTCHW.shape[2]} channels for {len(self.wavelengths)} wavelengths")
        check_precision(scene_BTCHW)
        if not bool(torch.isfinite(scene_BTCHW).all()):
            raise InputError("the scene holds NaN or infinite values")
        if not bool(torch.isfinite(draw.coefficients).all()):
            raise InputError("the draw holds NaN or infinite values")
        grid = (self.field.rows, self.field.columns)
        if (draw.stride, draw.margin, *draw.coefficients.shape[-2:]) != (self.stride, self.margin, *grid):
            raise InputError(
                f"the draw was made for a grid of {tuple(draw.coefficients.shape[-2:])} points {draw.stride} pixels apart "
                f"with a margin of {draw.margin}; this simulator has {grid}, {self.stride}, {self.margin}"
            )

    def _far(self, tilts: Tensor) -> int:
        """Pixels from which light comes, for these tilts."""
        return max(c.basis.size for c in self._colours) // 2 + int(tilts.detach().abs().max()) + 3

    def _busy(self, padded: Tensor, tilts: Tensor) -> Region:
        if not self.uniform or padded.requires_grad:
            return Region.whole(padded)
        return busy_region(padded, self._far(tilts), self.stride * self._planned.grid)

    def _make_colours(self) -> list[Colour]:
        plan, colours = self._planned, []
        for index, wavelength in enumerate(self.wavelengths or (self.path.wavelength,)):
            phase = self.path.wavelength / wavelength
            weakest, strongest = (d * phase ** (6 / 5) for d in self.strengths)
            count = plan.components if strongest > 0 else 0
            basis = psf_basis(count, weakest, strongest, max(plan.modes, 4), self.q * phase, plan.points)
            channels = slice(None) if self.wavelengths is None else slice(index, index + 1)
            colours.append(Colour(channels, basis, phase))
        return colours
