"""Split-step propagation from several points through the same air: tilts, isoplanatic angle, log-amplitude.

The path is the default one (7 km), where neighbouring pixels see different air. Z-tilt is E[alpha(u) alpha(u')], D-tilt
E[(alpha(u) - alpha(u'))^2], alpha = 2 lambda a / (pi D), along the separation and across it. The Fresnel number is 11
only, so the theory is the one with diffraction; the near-field one stands beside it. That theory is of first order,
hence D/r0 = 1; and 10 screens put 4 % too much into the relative tilt of adjacent pixels, 20 screens 1 %.
"""

from collections.abc import Iterable

import numpy as np
import torch

from turbnet.atmosphere.covariance import zernike_covariance
from turbnet.atmosphere.diffraction import diffracted_covariance
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Array
from turbnet.bench.measurement import Measurement, Panel, Series, mean_and_error, ratio_and_error
from turbnet.simulate.sampling import Sampling
from turbnet.simulate.split_step import SplitStep
from turbnet.simulate.wavefront import Aperture

STRENGTH, SCREENS = 1.0, 20
SEPARATIONS = np.array([1, 2, 4, 8, 16, 32, 64])
BATCH = 4


def measure(seed: int, track: Iterable[int]) -> tuple[list[Measurement], list[Panel]]:
    """All rows and figures of the family. `track` yields once for each batch of draws, and may show progress."""
    path = OpticalPath.from_d_over_r0(STRENGTH)
    columns = np.concatenate([[0], SEPARATIONS]) * path.pixel
    split_step = SplitStep(Sampling(path, screens=SCREENS), np.stack([0 * columns, columns], axis=1))
    aperture = Aperture(split_step.sampling.across, 45)
    generator = torch.Generator().manual_seed(seed)
    points = range(len(columns))
    tilts, squares, overlaps, logs = [], [], [], []
    for _ in track:
        air = split_step.draw(generator, BATCH)
        field = split_step.pupil_fields(air, points)
        rays = split_step.geometric_phase(air, points)
        wave = aperture.coefficients(split_step.phase(field, rays))
        tilts.append(wave[..., 1:3])
        squares.append(torch.stack([wave[:, 0], aperture.coefficients(rays[:, 0])], dim=-1).square())
        inner = field[..., aperture.inside]
        overlaps.append((inner[:, 1:] * inner[:, :1].conj()).mean(-1).real)
        amplitude = inner[:, 0].abs().log()
        logs.append(torch.stack([amplitude.mean(-1), amplitude.square().mean(-1)], dim=-1))
    measurements, panels = _tilts(path, torch.cat(tilts).double().numpy())
    measurements += _diffraction(path, torch.cat(squares).double().numpy())
    measurements.append(_isoplanatic_angle(path, torch.cat(overlaps).double().numpy()))
    measurements.append(_log_amplitude(path, torch.cat(logs).double().numpy()))
    return measurements, panels


def _tilts(path: OpticalPath, tilts: Array) -> tuple[list[Measurement], list[Panel]]:
    """tilts: (draws, points, 2). Standard errors are those of products of Gaussian variables."""
    micro = 1e12 * (2 * path.wavelength / (np.pi * path.aperture)) ** 2  # (microradian / rad of coefficient)^2
    measurements, z_series, d_series = [], [], []
    fine = np.concatenate([[0.0], np.geomspace(0.5, 100, 60)])
    every = np.concatenate([[0], SEPARATIONS])
    for axis, (j, direction) in enumerate([(2, "along"), (3, "across")]):
        theory, curve = (micro * diffracted_covariance(path, j, j, s * path.pixel) for s in (every, fine))
        near = micro * zernike_covariance(path, j, j, fine * path.pixel)
        z = micro * (tilts[:, :, axis] * tilts[:, :1, axis]).mean(axis=0)
        d = micro * ((tilts[:, :, axis] - tilts[:, :1, axis]) ** 2).mean(axis=0)
        d_theory = 2 * (theory[0] - theory)
        z_error = np.sqrt((theory[0] ** 2 + theory**2) / len(tilts))
        d_error = d_theory * np.sqrt(2 / len(tilts))
        for i in (0, 1, 3, 5, 7):
            at = f"{direction} the separation, {every[i]} pixels"
            measurements.append(Measurement(f"Z-tilt {at}", theory[i], z[i], z_error[i], unit="urad^2"))
            if i:
                measurements.append(Measurement(f"D-tilt {at}", d_theory[i], d[i], d_error[i], unit="urad^2"))
        for i in (1, 3):
            geometric = 2 * micro * (zernike_covariance(path, j, j, np.array([0, every[i]]) * path.pixel) @ [1, -1])
            name = f"D-tilt {direction} the separation, {every[i]} pixels, near-field theory"
            measurements.append(Measurement(name, float(geometric), d[i], d_error[i], None, "urad^2"))
        bars = slice(1, None)
        z_series += [
            Series(f"theory, {direction}", fine[bars], curve[bars]),
            Series("split-step", every[bars], z[bars], z_error[bars]),
        ]
        d_series += [
            Series(f"theory, {direction}", fine[bars], 2 * (curve[0] - curve[bars])),
            Series("split-step", every[bars], d[bars], d_error[bars]),
            Series(f"near field, {direction}", fine[bars], 2 * (near[0] - near[bars]), approximate=True),
        ]
    title, x_label = f"L = {path.distance / 1e3:g} km, D/r0 = {STRENGTH:g}", "separation (Nyquist pixels)"
    return measurements, [
        Panel("z-tilt", f"Z-tilt, {title}", x_label, "covariance ($\\mu$rad$^2$)", z_series, ("log", "linear")),
        Panel("d-tilt", f"D-tilt, {title}", x_label, "structure function ($\\mu$rad$^2$)", d_series, ("log", "log")),
    ]


def _diffraction(path: OpticalPath, squares: Array) -> list[Measurement]:
    """Variance of the wave's coefficients over that of straight rays through the same screens, (draws, modes, 2)."""
    ratio, error = ratio_and_error(squares[..., 0], squares[..., 1])
    measurements = []
    for j in (2, 4, 7, 11, 14):
        theory = float(diffracted_covariance(path, j, j, 0.0) / zernike_covariance(path, j, j, 0.0))
        name = f"variance of the wave over that of rays, j = {j}"
        measurements.append(Measurement(name, theory, ratio[j - 1], error[j - 1]))
    return measurements


def _isoplanatic_angle(path: OpticalPath, overlaps: Array) -> Measurement:
    """theta0 from the coherence of two points' waves, E[U U'*] = exp(-(theta/theta0)^(5/3) / 2), any strength."""
    angle = SEPARATIONS * path.pixel / path.distance

    def fit(samples: Array) -> float:
        coherence = samples.mean(axis=0)
        used = (coherence > 0.1) & (coherence < 0.9)
        return float(np.mean(angle[used] * (-2 * np.log(coherence[used])) ** (-3 / 5)))

    groups = np.array_split(np.arange(len(overlaps)), min(10, len(overlaps)))
    left_out = [fit(np.delete(overlaps, group, axis=0)) for group in groups]
    error = float(np.std(left_out) * np.sqrt(len(groups) - 1))
    name = f"theta0 from the coherence of two points, D/r0 = {STRENGTH:g}"
    return Measurement(name, 1e6 * path.theta0, 1e6 * fit(overlaps), 1e6 * error, unit="urad")


def _log_amplitude(path: OpticalPath, logs: Array) -> Measurement:
    """Variance of ln|U| against Rytov's for a spherical wave; a first-order theory, hence only compared."""
    mean = logs[:, 0].mean()
    variance, error = mean_and_error(logs[:, 1] - 2 * mean * logs[:, 0] + mean**2)
    name = f"log-amplitude variance, D/r0 = {STRENGTH:g}"
    return Measurement(name, path.rytov_spherical / 4, float(variance), float(error), None)
