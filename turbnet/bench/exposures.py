"""The simulator's point images against split-step propagation: exposure widths and tilt variance.

Both look at a point on the axis through the default path of 7 km. The simulator's images come from its whole pipeline, of a
scene with one bright pixel; split-step PSFs are made at the same Nyquist pixels. A width is the full width at half maximum
of the mean image, read from its radial profile after Fourier interpolation.
"""

from collections.abc import Callable, Iterable

import numpy as np
import torch
from torch import Tensor

from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Array
from turbnet.report import Row
from turbnet.simulate.sampling import Sampling
from turbnet.simulate.simulator import Simulator
from turbnet.simulate.split_step import SplitStep, Turbulence
from turbnet.simulate.wavefront import Aperture

Track = Callable[[str, int], Iterable[int]]

STRENGTHS = (1.5, 3.0, 4.5)
SIZE, BATCH, FINER = 63, 8, 8
GROUPS = 10  # the standard error is that of leaving one out at a time
TILT_PIXELS = 4 / np.pi


def width(image: Tensor) -> float:
    """Full width at half maximum of a round image (n, n), n odd, centred, pixels."""
    n = image.shape[-1]
    spectrum = torch.fft.fftshift(torch.fft.fft2(torch.fft.ifftshift(image.double())))
    room = (FINER - 1) * n // 2
    fine = torch.fft.ifft2(torch.fft.ifftshift(torch.nn.functional.pad(spectrum, (room,) * 4)))
    size = fine.shape[-1]
    fine = torch.fft.fftshift(fine.real)
    axis = (torch.arange(size) - size // 2) * (n / size)
    radius = torch.hypot(axis, axis[:, None])
    bins = torch.arange(0, n / 3, 1 / FINER)
    index = torch.bucketize(radius.flatten(), bins + 0.5 / FINER)
    kept = index < len(bins)
    total = torch.zeros(len(bins), dtype=torch.float64).index_add_(0, index[kept], fine.flatten()[kept])
    profile = total / torch.bincount(index[kept], minlength=len(bins))
    half = float(profile[0]) / 2
    first = int((profile < half).nonzero()[0])
    above, below = float(profile[first - 1]), float(profile[first])
    return 2 * float(bins[first - 1] + (above - half) / (above - below) / FINER)


class _Images:
    """Sums of images and squares of tilts, in groups."""

    def __init__(self) -> None:
        self.long = [torch.zeros(SIZE, SIZE) for _ in range(GROUPS)]
        self.short = [torch.zeros(SIZE, SIZE) for _ in range(GROUPS)]
        self.tilt: list[list[float]] = [[] for _ in range(GROUPS)]

    def add(self, group: int, long: Tensor, short: Tensor, tilts: Tensor) -> None:
        self.long[group % GROUPS] += long.sum(0)
        self.short[group % GROUPS] += short.sum(0)
        self.tilt[group % GROUPS] += tilts.square().flatten().tolist()

    def figures(self, left_out: int | None = None) -> Array:
        """Long-exposure width and short-exposure width in pixels, tilt variance of an axis in pixels^2."""
        kept = [g for g in range(GROUPS) if g != left_out]
        long, short = (sum((images[g] for g in kept), torch.zeros(SIZE, SIZE)) for images in (self.long, self.short))
        tilts = [value for g in kept for value in self.tilt[g]]
        return np.array([width(long), width(short), np.mean(tilts)])

    @property
    def errors(self) -> Array:
        """Standard errors of the figures, by leaving out a group at a time."""
        parts = np.stack([self.figures(g) for g in range(GROUPS)])
        return np.asarray(parts.std(0) * np.sqrt(GROUPS - 1))


def measure(draws: int, track: Track) -> list[Row]:
    """Rows of the family; `track(name, count)` yields once a batch and may show progress."""
    sampling = Sampling(OpticalPath.from_d_over_r0(max(STRENGTHS)))
    split_step = SplitStep(sampling)
    aperture = Aperture(sampling.across, 36)
    reference = {strength: _Images() for strength in STRENGTHS}
    generator = torch.Generator().manual_seed(2026)
    for number in track("split-step", draws // BATCH):
        air = split_step.draw(generator, BATCH)
        for strength, images in reference.items():
            scale = (strength / max(STRENGTHS)) ** (5 / 6)
            _add_split_step(images, number, split_step, aperture, Turbulence([phase * scale for phase in air.phases]))
    rows = []
    for strength in STRENGTHS:
        images = _Images()
        simulator = Simulator(OpticalPath.from_d_over_r0(strength), SIZE, SIZE, uniform=False)
        point = torch.zeros(1, 1, 1, SIZE, SIZE)
        middle = SIZE // 2
        point[..., middle, middle] = 1.0
        for number in track(f"simulator, D/r0 = {strength:g}", 2 * draws // BATCH):
            draw = simulator.draw(range(number * BATCH, (number + 1) * BATCH))
            seen = simulator(point, draw)
            tilts = seen.tilt[:, 0, :, middle, middle]
            images.add(number, seen.frames[:, 0, 0], seen.blur_only[:, 0, 0], tilts)
        names = ("long-exposure width", "short-exposure width", "tilt variance")
        units = ("px", "px", "px^2")
        exact, error = reference[strength].figures(), np.hypot(reference[strength].errors, images.errors)
        for name, unit, value, expected, sigma in zip(names, units, images.figures(), exact, error, strict=True):
            label = f"against split-step, D/r0 = {strength:g}: {name}, {draws} draws"
            rows.append(Row.compared(label, value, expected, max(0.05 * expected, 2 * sigma), unit))
            rows.append(Row(f"{label}: standard error", float(sigma), unit))
    return rows


def _add_split_step(images: _Images, group: int, split_step: SplitStep, aperture: Aperture, air: Turbulence) -> None:
    fields = split_step.pupil_fields(air)[:, 0]
    phase = split_step.phase(fields, split_step.geometric_phase(air)[:, 0])
    tilts = aperture.coefficients(phase)[:, :3] * torch.tensor([0.0, 1.0, 1.0])
    long = aperture.psf(fields, SIZE)
    short = aperture.psf(fields, SIZE, without=tilts)
    images.add(group, long, short, TILT_PIXELS * tilts[:, 1:])
