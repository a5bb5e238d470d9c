r"""How little work a path and a scene need for a given error of the picture.

An approximation that changes PSFs by delta changes a picture with the power spectrum A / f^2 by the mean square

.. math:: A\, E\|\delta\|^2, \qquad \|\delta\|^2 = \sum_f |\hat\delta(f)|^2 / f^2, \qquad A \approx 0.1\, E|\nabla J|^2

(`turbnet.simulate.psf_basis.in_metric`). The pictures inside scikit-image have 0.1 to 1.7, mostly 1, times this power
between 1/32 and 1/5 cycles a pixel, and 0.1 to 0.55 times beyond 1/4, which counts for half therefore. Every candidate's
delta is measured on the path's own PSFs; the cheapest that fit the budget together are taken.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import torch
from torch import Tensor

from turbnet.atmosphere.noll import noll_covariance
from turbnet.atmosphere.path import OpticalPath
from turbnet.errors import check_range
from turbnet.simulate.blur import blur_weights
from turbnet.simulate.draw import TILT_PIXELS, Draw
from turbnet.simulate.field import ZernikeField
from turbnet.simulate.phase_to_space import MODES, released
from turbnet.simulate.psf_basis import (
    MOST,
    PUPIL,
    PSFBasis,
    in_metric,
    low_band,
    psf_basis,
    psf_samples,
    roll_off,
    tilt_free_psf,
)
from turbnet.simulate.tilt import upsample

TOLERANCE = 45.0
"""Default error budget: PSNR of the frame against the exact one, dB."""
CONTRAST = 0.1
"""Root-mean-square gradient of a picture a pixel, linear intensities; photographs have 0.05 to 0.12, print 0.17."""

_SPECTRUM = 0.1  # A over the mean square of the gradient
_FINE = 0.5  # of that power, what pictures have beyond 1/4 cycle a pixel
_CROSSING = 0.25  # fits what dense scatter shows at D/r0 = 3, 4.5 and 6
_NETWORK = 3.0  # what the network misses lies together, where the air is strongest: dense scatter shows this much more
_RESERVE = 2.0  # dB kept in hand: a frame's own atmosphere is not the average one
_SAMPLES = 300
_FINE_PUPIL = 24
_PATCH = 96  # pixels a side of the field on which the weights' grid is judged
_FULL = 60  # components that a simulation without savings takes
_COMPONENTS = (1, 2, 3, 5, 8, 10, 12, 16, 20, 25, 30, 40, 50, 60, 80, 100, MOST)


@dataclass(frozen=True)
class Plan:
    """What a simulator will do, what that costs in error, and what it saves.

    Attributes:
        tolerance: error budget, dB.
        modes: highest Noll index drawn.
        blur: False where the pixel is so large, or the air so still, that the PSF is one pixel.
        components: of the PSF basis beyond the mean; 0 is one kernel for the whole picture.
        points: samples across the aperture that PSFs are made from; decides the kernel's width.
        network: whether the phase-to-space network finds the weights.
        grid: weights are found on every grid-th point of the field's grid along each axis.
        factor: 2 where the components are summed at half the resolution.
        tilt: False where points move too little to see.
        wavelengths: how many are simulated.
        errors: expected mean-square error of the frame by approximation.
        work: estimated time of a frame by stage, ms, of this plan and of the same without any saving.
        notes: what the scene lets out besides.
    """

    tolerance: float
    modes: int = MODES
    blur: bool = True
    components: int = 20
    points: int = PUPIL
    network: bool = True
    grid: int = 1
    factor: int = 1
    tilt: bool = True
    wavelengths: int = 1
    errors: tuple[tuple[str, float], ...] = ()
    work: tuple[tuple[str, float, float], ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def added(self) -> float:
        """Mean-square error of all approximations together."""
        return sum(error for _, error in self.errors)

    @property
    def expected(self) -> float:
        """PSNR expected of the whole, dB."""
        return math.inf if self.added == 0 else -10 * math.log10(self.added)

    @property
    def saved(self) -> float:
        """Part of the work that is left out."""
        full = sum(full for _, _, full in self.work)
        return 1 - sum(own for _, own, _ in self.work) / full if full else 0.0

    def __str__(self) -> str:
        kernel = "one kernel for the whole picture" if self.components == 0 else f"{self.components} PSF components"
        if not self.blur:
            kernel = "no blur"
        lines = [
            f"budget {self.tolerance:g} dB, expected {self.expected:.1f} dB; {100 * self.saved:.0f} % of the work saved",
            f"  modes        2..{self.modes}",
            f"  tilt         {'yes' if self.tilt else 'left out'}",
            f"  blur         {kernel}",
        ]
        if self.blur and self.components:
            how = "phase-to-space network" if self.network else f"exact, {self.points} samples across the aperture"
            where = "every point" if self.grid == 1 else "every second point"
            lines += [
                f"  weights      {how}, {where} of the field's grid",
                f"  components   summed at {'full' if self.factor == 1 else 'half'} resolution",
            ]
        lines.append(f"  wavelengths  {self.wavelengths}")
        lines += [f"  error of {name:24s}{_decibel(error)}" for name, error in self.errors]
        lines += [f"  work of {name:10s}{own:8.1f} of {full:8.1f} ms" for name, own, full in self.work]
        return "\n".join([*lines, *(f"  {note}" for note in self.notes)])


def _decibel(error: float) -> str:
    return "none" if error == 0 else f"{-10 * math.log10(error):6.1f} dB"


def contrast(scene: Tensor) -> float:
    """Root-mean-square gradient a pixel of a scene (..., H, W), linear intensities, over what of it is not flat."""
    dx, dy = scene[..., :-1, 1:] - scene[..., :-1, :-1], scene[..., 1:, :-1] - scene[..., :-1, :-1]
    energy = dx.square() + dy.square()
    changing = energy > 1e-8
    count = int(changing.sum())
    return float((energy[changing].sum() / count).sqrt()) if count else 0.0


class Planner:
    """Measures candidates for one path; `plan` picks.

    Args:
        path: the path.
        strengths: least and greatest D/r0 it is scaled to.
        size: rows and columns of the picture with its margin, pixels.
        stride: of the field's grid, pixels.
        q: pixel in Nyquist pixels.
        channels: that are tilted and blurred, the uniform scene's among them.
    """

    def __init__(
        self,
        path: OpticalPath,
        strengths: tuple[float, float],
        size: tuple[int, int],
        stride: int,
        q: float,
        channels: int = 4,
    ) -> None:
        self.path, self.size, self.stride, self.q, self.channels = path, size, stride, q, channels
        self.strengths = strengths
        self.high = psf_samples(*strengths, MODES)[:_SAMPLES]
        self.exact = tilt_free_psf(self.high, q)

    def plan(
        self,
        tolerance: float = TOLERANCE,
        contrast: float = CONTRAST,
        modes: int | None = None,
        components: int | None = None,
        exact: bool = False,
    ) -> Plan:
        """The cheapest plan within the budget; what is given is kept.

        Args:
            tolerance: dB.
            contrast: root-mean-square gradient of the scene a pixel, linear intensities.
            modes, components: to keep; None to choose.
            exact: weights by pupil transforms at every point, components at full resolution.

        Raises:
            ParameterError: a tolerance outside 10 to 80 dB.
        """
        check_range("tolerance", tolerance, 10.0, 80.0, "dB")
        self._energy = _SPECTRUM * contrast**2
        budget = 10 ** (-(tolerance + _RESERVE) / 10)
        if self.strengths[1] == 0:
            plan = Plan(tolerance, modes=modes or 3, blur=False, components=0, network=False, tilt=False)
            return self._with_work(plan)
        errors = []
        shift = self._error_of_no_tilt()
        tilt = shift > 0.1 * budget
        if not tilt:
            errors.append(("no tilt", shift))
        still = self._mse(self.exact - _point(self.exact))
        if components is None and not exact and still < 0.3 * budget:
            plan = Plan(tolerance, modes or 3, False, 0, tilt=tilt, network=False, errors=(*errors, ("no blur", still)))
            return self._with_work(plan)

        points, pupil = self._pupil(0.3 * budget)
        errors.append(("the aperture's sampling", pupil))
        if modes is None:
            modes, cut = self._modes(0.05 * budget)
            errors.append(("modes left out", cut))
        basis = psf_basis(min(MOST, self.exact[0].numel() - 1), *self.strengths, max(modes, 4), self.q, points)
        errors.append(("neighbours that cross", self._crossing_error(basis)))
        start = Plan(tolerance, modes, True, 0, points, False, tilt=tilt, errors=tuple(errors))
        candidates = [
            (plan, sum(self._work(plan).values())) for plan in self._candidates(start, basis, components, exact)
        ]
        fitting = [(plan, work) for plan, work in candidates if plan.added <= budget]
        if fitting:
            best, _ = min(fitting, key=lambda pair: pair[1])
        else:
            best, _ = min(candidates, key=lambda pair: pair[0].added)
        return self._with_work(best)

    def _candidates(self, start: Plan, basis: PSFBasis, components: int | None, exact: bool) -> Iterator[Plan]:
        """Every way to find the weights and to sum the components, with the error it adds."""
        variance = basis.variance.double()
        beyond = basis.left + torch.cat((variance.flip(0).cumsum(0).flip(0), variance.new_zeros(1)))
        above = torch.cat((variance.new_zeros(1), (variance * self._above_half(basis)).cumsum(0)))
        network = math.inf if exact else self._network_error(basis, start.modes)
        coarse = math.inf if exact or components == 0 else self._grid_error(basis, start.modes)
        counts = (0, *(m for m in _COMPONENTS if m <= len(variance))) if components is None else (components,)
        for count, learned, grid, factor in product(counts, (True, False), (1, 2), (1, 2)):
            added = [
                ("the network", network if learned else 0.0),
                ("the weights' grid", coarse if grid == 2 else 0.0),
                ("components left out", self._energy * float(beyond[count])),
                ("half the resolution", _FINE * self._energy * float(above[count]) if factor == 2 else 0.0),
            ]
            if (learned or grid > 1 or factor > 1) and (exact or count == 0):
                continue
            if not all(math.isfinite(error) for _, error in added) or (factor == 2 and self.stride * grid % 2):
                continue
            plan = replace(start, components=count, network=learned, grid=grid, factor=factor)
            yield replace(plan, errors=(*start.errors, *added))

    def _mse(self, difference_Pkk: Tensor) -> float:
        return self._energy * float(in_metric(difference_Pkk).square().sum(1).mean())

    def _error_of_no_tilt(self) -> float:
        """A shift t changes every amplitude by 2 pi f t: gradient times shift, both axes."""
        variance = noll_covariance(2, 2) * self.strengths[1] ** (5 / 3) * (TILT_PIXELS / self.q) ** 2
        return float(self._energy / _SPECTRUM * variance)

    def _pupil(self, budget: float) -> tuple[int, float]:
        """Samples across the aperture, judged against twice as many as the finest."""
        some = self.high[:40]
        fine = tilt_free_psf(some, self.q, 2 * _FINE_PUPIL)
        error = math.inf
        for points in (PUPIL, _FINE_PUPIL):
            psf = tilt_free_psf(some, self.q, points)
            room = (fine.shape[-1] - psf.shape[-1]) // 2
            error = self._mse(torch.nn.functional.pad(psf, (room,) * 4) - fine)
            if error <= budget:
                break
        return points, error

    def _modes(self, budget: float) -> tuple[int, float]:
        """Whole radial orders, few enough."""
        for modes in (10, 15, 21, 28):
            cut = self.high.clone()
            cut[:, modes - 3 :] = 0
            error = self._mse(tilt_free_psf(cut, self.q) - self.exact)
            if error <= budget:
                return modes, error
        return MODES, 0.0

    def _network_error(self, basis: PSFBasis, modes: int) -> float:
        if basis.points != PUPIL or modes > MODES:
            return math.inf
        high = self.high[:, : max(modes, 4) - 3]
        missed = (released().weights(high, basis) - basis.project(high)).square().sum(1).mean()
        return _NETWORK * self._energy * float(missed)

    def _grid_error(self, basis: PSFBasis, modes: int) -> float:
        """Of weights interpolated between every second point of the field's grid."""
        if self.stride > 8:
            return math.inf
        high = self._patch.high[0, :, : max(modes, 4) - 3]
        weights = blur_weights(high, basis, released() if basis.points == PUPIL else None)
        weights = weights[..., : (high.shape[-2] - 1) // 2 * 2 + 1, : (high.shape[-1] - 1) // 2 * 2 + 1]
        between = upsample(weights[..., ::2, ::2], 2, *weights.shape[-2:])
        return self._energy * float((between - weights)[..., 4:-4, 4:-4].square().sum(1).mean())

    @cached_property
    def _patch(self) -> Draw:
        """A small piece of the air at its strongest."""
        field = ZernikeField(self.path, _PATCH, _PATCH, 0, MODES, self.stride, q=self.q)
        return field.draw([0], d_over_r0=torch.tensor([self.strengths[1]]))

    def _crossing_error(self, basis: PSFBasis) -> float:
        """Of one weight where points with different ones arrive: the more, the faster the tilt changes."""
        tilts = self._patch.tilt[0]
        slope = [(tilts.diff(dim=axis) / self.stride).square().sum(1).mean() for axis in (-1, -2)]
        return _CROSSING * self._energy * float(basis.variance.sum() + basis.left) * float(sum(slope) / 2)

    @staticmethod
    def _above_half(basis: PSFBasis) -> Tensor:
        """Share of each component's energy that half the resolution cannot hold."""
        components = basis.components.double()
        spectrum = torch.view_as_complex(in_metric(components).view(len(components), -1, 2))
        spectrum = spectrum.view(len(components), _rows(spectrum.shape[1]), -1)
        total = spectrum.abs().square().sum((1, 2))
        rows = spectrum.shape[1]
        passed = roll_off((rows, rows), 2).double() ** 2  # of the way down and back up
        kept = ((2 * passed - passed**2) * low_band(spectrum, 2).abs().square()).sum((1, 2))
        return 1 - kept / total.clamp(min=1e-30)

    def _with_work(self, plan: Plan) -> Plan:
        everything = replace(
            plan,
            modes=max(MODES, plan.modes),
            blur=True,
            components=max(_FULL, plan.components),
            network=False,
            grid=1,
            factor=1,
            tilt=True,
        )
        own, full = self._work(plan), self._work(everything)
        return replace(plan, work=tuple((name, own[name], full[name]) for name in full))

    def _work(self, plan: Plan) -> dict[str, float]:
        """Time of a frame by stage, ms, as two cores of a server of 2024 take it: for choosing, and for orientation."""
        pixels = self.size[0] * self.size[1]
        bins = pixels / self.stride**2 * 1.65**2
        points = pixels / (self.stride * plan.grid) ** 2 if plan.blur and plan.components else 0
        learned = 800 + 6 * plan.components
        exact = (3300 + 25 * plan.components) * (plan.points / PUPIL) ** 2
        component = 3.6 if plan.factor == 1 else 0.6
        nanoseconds = {
            "field": 7 * bins * plan.modes,
            "tilt": 19 * pixels * self.channels * plan.tilt,
            "weights": points * (learned if plan.network else exact),
            "blur": (6 + component * plan.components) * pixels * self.channels * plan.blur,
        }
        return {stage: 1e-6 * value for stage, value in nanoseconds.items()}


def _rows(count: int) -> int:
    """Rows n of a half-plane of n x (n/2 + 1) frequencies."""
    return round(math.sqrt(2 * count + 1)) - 1


def _point(like_Pkk: Tensor) -> Tensor:
    """A PSF of one pixel."""
    point = torch.zeros_like(like_Pkk)
    middle = like_Pkk.shape[-1] // 2
    point[:, middle, middle] = 1
    return point
