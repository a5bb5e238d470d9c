"""Split-step propagation from one point through independent air: Noll variances, exposures, r0, lucky frames.

The path is short (100 m, Fresnel number 788), so that the phase in the aperture is the sum along the rays that these
theories speak of: at 500 m enough of it has turned into scintillation for lucky frames at D/r0 = 5 to come more often
(0.117 +- 0.007 against 0.091). Every draw is scaled to every D/r0, so rows of different strength share their
luck; each row's standard error is its own.
"""

from collections.abc import Iterable

import numpy as np
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from turbnet.atmosphere.exposure import long_exposure_factor, short_exposure_otf
from turbnet.atmosphere.lucky import lucky_karhunen_loeve, lucky_probability
from turbnet.atmosphere.noll import noll_covariance
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Array
from turbnet.atmosphere.tilt_free import tilt_free_otf
from turbnet.bench.measurement import Index, Measurement, Panel, Series, ratio_and_error
from turbnet.simulate.sampling import Sampling
from turbnet.simulate.split_step import SplitStep, Turbulence
from turbnet.simulate.wavefront import Aperture

STRENGTHS = (1.0, 2.0, 3.0, 4.0, 5.0)
LUCKY = (3.0, 4.0, 5.0)
MODES = range(2, 16)
DISTANCE = 100.0
BATCH = 8
OTF_FLOOR = 0.02
Samples = dict[float, list[Tensor]]


class OnePoint:
    """The sums of a Monte Carlo run, one entry per draw."""

    def __init__(self) -> None:
        self.sampling = Sampling(OpticalPath.from_d_over_r0(max(STRENGTHS), distance=DISTANCE))
        self.split_step = SplitStep(self.sampling)
        self.points = self.sampling.across
        self.aperture = Aperture(self.points, 45)
        self._lattice, self._bins_exact = _lattice(self.points), _radial_bins(self.points)
        self._bins = torch.from_numpy(self._bins_exact).float()
        self._still = tilt_free_otf(self.points, 0.0)
        self.coefficients: Samples = {strength: [] for strength in STRENGTHS}
        self.residuals: Samples = {strength: [] for strength in STRENGTHS}
        self.long: Samples = {strength: [] for strength in STRENGTHS}
        self.short: Samples = {strength: [] for strength in STRENGTHS}

    def run(self, batches: Iterable[int], seed: int) -> None:
        """Propagate BATCH draws for each item of `batches`, at every strength."""
        generator = torch.Generator().manual_seed(seed)
        for _ in batches:
            air = self.split_step.draw(generator, BATCH)
            for strength in STRENGTHS:
                scale = (strength / max(STRENGTHS)) ** (5 / 6)
                self._add(strength, Turbulence([phase * scale for phase in air.phases]))

    def _add(self, strength: float, air: Turbulence) -> None:
        field = self.split_step.pupil_fields(air)[:, 0]
        phase = self.split_step.phase(field, self.split_step.geometric_phase(air)[:, 0])
        coefficients = self.aperture.coefficients(phase)
        tilt_free = phase - self.aperture.phase(coefficients[:, :3])
        inside = self.aperture.inside
        self.coefficients[strength].append(coefficients[:, 1:15])
        self.residuals[strength].append(tilt_free[:, inside].square().mean(-1))
        self.long[strength].append(self._otf(field))
        self.short[strength].append(self._otf(torch.polar(field.abs(), tilt_free)))

    def _otf(self, field: Tensor) -> Tensor:
        """Autocorrelation of the field in the aperture, mean over rings of shifts 0 .. n - 1 samples, (draws, n)."""
        wave = torch.zeros(len(field), 2 * self.points, 2 * self.points, dtype=field.dtype)
        wave[:, : self.points, : self.points] = field * self.aperture.inside
        shifted = torch.fft.ifft2(torch.fft.fft2(wave).abs().square()).real
        return shifted.flatten(1) @ self._bins

    def ring(self, otf: Array) -> Array:
        """A theoretical OTF on the lattice of shifts, over the same rings."""
        return np.asarray(otf.ravel() @ self._bins_exact)

    def long_exposure(self, strength: float) -> Array:
        """Long-exposure OTF of air and sampled aperture, over the rings."""
        return self.ring(self._still * long_exposure_factor(self._lattice, strength))

    def fried_parameter(self, samples: Array, used: Index, strength: float) -> float:
        """r0 whose long-exposure OTF lies closest, in least squares, to the mean of `samples`, m."""
        curve = samples.mean(0)[used] / samples.mean(0)[0]

        def misfit(d_over_r0: float) -> float:
            return float(np.sum((self.long_exposure(d_over_r0)[used] - curve) ** 2))

        found = minimize_scalar(misfit, (0.9 * strength, 1.1 * strength), tol=1e-4).x
        return float(self.sampling.path.aperture / found)


def measure(seed: int, track: Iterable[int]) -> tuple[list[Measurement], list[Panel]]:
    """All rows and figures of the family. `track` yields once for each batch of draws, and may show progress."""
    run = OnePoint()
    run.run(track, seed)
    parts = [_noll(run), _long_exposure(run), _short_exposure(run), _lucky(run)]
    return [m for part, _ in parts for m in part], [panel for _, panel in parts]


def _noll(run: OnePoint) -> tuple[list[Measurement], Panel]:
    measurements, series = [], []
    modes = np.array(MODES)
    theory = np.array([noll_covariance(j, j) for j in MODES])
    series.append(Series("Noll", modes, theory))
    for strength in STRENGTHS:
        scale = strength ** (5 / 3)
        samples = _numpy(run.coefficients[strength])
        variance = (samples**2).mean(axis=0)
        error = theory * scale * np.sqrt(2 / len(samples))  # of the variance of a Gaussian variable
        for j, expected, value, deviation in zip(modes, theory * scale, variance, error, strict=True):
            name = f"{'tilt' if j < 4 else 'Noll'} variance, j = {j}, D/r0 = {strength:g}"
            measurements.append(Measurement(name, expected, value, deviation, unit="rad^2"))
        if strength in (1.0, 5.0):
            shift = 0.12 if strength == 5 else -0.12
            series.append(Series(f"split-step, D/r0 = {strength:g}", modes + shift, variance / scale, error / scale))
    title = "Variance of Zernike coefficients over $(D/r_0)^{5/3}$"
    return measurements, Panel("noll-variances", title, "Noll index j", "variance (rad$^2$)", series, ("linear", "log"))


def _long_exposure(run: OnePoint) -> tuple[list[Measurement], Panel]:
    measurements, series = [], []
    frequency = np.arange(run.points) / run.points
    for strength in STRENGTHS:
        samples = _numpy(run.long[strength])
        measured, error = ratio_and_error(samples, samples[:, :1])
        expected = run.long_exposure(strength)
        used = np.flatnonzero(expected > OTF_FLOOR)[1:]
        measurements += _at_quarters("long-exposure OTF", strength, used, frequency, expected, measured, error)
        groups = np.array_split(np.arange(len(samples)), min(10, len(samples)))
        left_out = [run.fried_parameter(np.delete(samples, group, axis=0), used, strength) for group in groups]
        spread = float(np.std(left_out) * np.sqrt(len(groups) - 1))
        r0, found = run.sampling.path.aperture / strength, run.fried_parameter(samples, used, strength)
        measurements.append(Measurement(f"r0 from the long exposure, D/r0 = {strength:g}", r0, found, spread, unit="m"))
        series += [
            Series(f"theory, D/r0 = {strength:g}", frequency, expected),
            Series("split-step", frequency[used], measured[used], error[used]),
        ]
    return measurements, Panel("long-exposure", "Long-exposure OTF", "frequency / cutoff", "OTF", series)


def _short_exposure(run: OnePoint) -> tuple[list[Measurement], Panel]:
    measurements, series = [], []
    frequency = np.arange(run.points) / run.points
    for strength in STRENGTHS:
        samples = _numpy(run.short[strength])
        measured, error = ratio_and_error(samples, samples[:, :1])
        expected = run.ring(tilt_free_otf(run.points, strength))
        used = np.flatnonzero(expected > OTF_FLOOR)[1:]
        measurements += _at_quarters("short-exposure OTF", strength, used, frequency, expected, measured, error)
        third = used[len(used) // 3]
        fried = short_exposure_otf(frequency, strength)
        name = f"short-exposure OTF, Fried's formula, f = {frequency[third]:.2f}, D/r0 = {strength:g}"
        measurements.append(Measurement(name, fried[third], measured[third], error[third], None))
        if strength in (1.0, 3.0, 5.0):
            series += [
                Series(f"exact, D/r0 = {strength:g}", frequency, expected),
                Series("split-step", frequency[used], measured[used], error[used]),
                Series(f"Fried, D/r0 = {strength:g}", frequency, fried, approximate=True),
            ]
    return measurements, Panel("short-exposure", "Tilt-free (short-exposure) OTF", "frequency / cutoff", "OTF", series)


def _lucky(run: OnePoint) -> tuple[list[Measurement], Panel]:
    measurements = []
    measured, error = [], []
    for strength in LUCKY:
        lucky = (_numpy(run.residuals[strength]) <= 1).astype(float)
        share = float(lucky.mean())
        expected = lucky_karhunen_loeve(strength)
        deviation = float(np.sqrt(expected * (1 - expected) / len(lucky)))
        measurements.append(Measurement(f"lucky probability, D/r0 = {strength:g}", expected, share, deviation))
        if strength >= 3.5:
            name = f"lucky probability, Fried's formula, D/r0 = {strength:g}"
            measurements.append(Measurement(name, float(lucky_probability(strength)), share, deviation, None))
        measured.append(share)
        error.append(deviation)
    axis = np.linspace(2.5, 7, 40)
    series = [
        Series("Karhunen-Loève modes", axis, np.array([lucky_karhunen_loeve(float(d)) for d in axis])),
        Series("split-step", np.array(LUCKY), np.array(measured), np.array(error)),
        Series("Fried", axis[axis >= 3.5], lucky_probability(axis[axis >= 3.5]), approximate=True),
    ]
    return measurements, Panel("lucky", "Probability of a lucky frame", "D/r0", "P", series, ("linear", "log"))


def _at_quarters(
    name: str, strength: float, used: Index, frequency: Array, theory: Array, measured: Array, error: Array
) -> list[Measurement]:
    """The worst frequency of the used ones, by its own tolerance, and three spread over them."""
    deviation = np.abs(measured[used] - theory[used]) / np.maximum(0.05 * theory[used], 3 * error[used])
    worst = used[np.argmax(deviation)]
    spots = [used[(len(used) * k) // 4] for k in (1, 2, 3)]
    label = f"D/r0 = {strength:g}"
    rows = [(f"{name}, worst of {len(used)} frequencies (f = {frequency[worst]:.2f}), {label}", worst)]
    rows += [(f"{name}, f = {frequency[i]:.2f}, {label}", i) for i in dict.fromkeys(spots)]
    return [Measurement(text, theory[i], measured[i], error[i]) for text, i in rows]


def _lattice(points: int) -> Array:
    """Length of each shift of the (2n, 2n) autocorrelation in units of the cutoff; beyond it, the cutoff."""
    axis = np.fft.fftfreq(2 * points, 1 / (2 * points)) / points
    return np.minimum(np.hypot(axis[:, None], axis), 1.0)


def _radial_bins(points: int) -> Array:
    """Averages over rings of shifts 0 .. n - 1 samples, one sample wide, (4 n^2, n)."""
    axis = np.fft.fftfreq(2 * points, 1 / (2 * points))
    ring = np.rint(np.hypot(axis[:, None], axis)).astype(int).ravel()
    bins = (ring[:, None] == np.arange(points)).astype(np.float64)
    return np.asarray(bins / bins.sum(axis=0))


def _numpy(parts: list[Tensor]) -> Array:
    return torch.cat(parts).double().numpy()
