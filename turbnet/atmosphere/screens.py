r"""Random phase screens whose structure function is that of the theory, from one sample to the whole screen.

A slab of air of Fried parameter r0 (plane wave) puts on a wave a Gaussian random phase with the spectrum

.. math::
    F(\kappa) = 0.490\, r_0^{-5/3} (\kappa^2 + \kappa_0^2)^{-11/6} e^{-\kappa^2/\kappa_m^2}, \qquad
    D(r) = 2 \int F(\kappa)\,(1 - \cos \kappa \cdot r)\, d^2\kappa

kappa_0 = 2 pi / L0, kappa_m = 5.92 / l0; Kolmogorov: kappa_0 = 0, no kappa_m, D(r) = 6.88 (r/r0)^(5/3). A plain FFT
screen holds no frequency below its own size, where most of the energy lies. Here the spectrum is split smoothly:

- *FFT part*: F g with g = (1 - exp(-kappa^2/kappa_s^2))^3 on a torus 1.5 times the screen. g is so smooth at kappa = 0
  that the correlation dies out within the torus, hence the sum over the grid's frequencies equals the integral. The
  spectrum is folded at the Nyquist frequency, as that of any sampled function is: the samples are those of the
  continuous screen, without loss at small separations.
- *Subharmonics*: F (1 - g), confined to a few lowest grid frequencies, as plane waves at Gauss-Legendre points in
  ln(kappa) times equal angles, fine enough for the screen's diagonal.
- *Ramp*: what lies below the lowest wave is a uniform gradient across the screen, drawn with its exact variance
  per axis, pi int kappa^3 F dkappa.

Source: subharmonics after Lane, Glindemann and Dainty, Waves in Random Media 2, 209 (1992); the smooth splitting, which
makes their weights exact, stands here on its own.
"""

import itertools
import math
from collections.abc import Callable

import numpy as np
import torch
from scipy.fft import next_fast_len
from scipy.interpolate import RectBivariateSpline
from torch import Tensor

from turbnet.atmosphere.profiles import Array
from turbnet.atmosphere.spectra import phase_spectrum
from turbnet.errors import check_range

TORUS = 1.5
"""Size of the periodic FFT part relative to the screen."""
SPLIT = 2.0
"""kappa_s in units of the torus' lowest frequency."""
RINGS = 16
"""Radial Gauss-Legendre points of the subharmonics."""


class PhaseScreen:
    """A source of independent random phase screens.

    Args:
        shape: samples (H, W) of a screen.
        spacing: of the samples, m.
        r0: plane-wave Fried parameter of the slab, m; infinite for still air.
        outer_scale: L0, m; infinite for Kolmogorov.
        inner_scale: l0, m; 0 for Kolmogorov.
        dtype: float32 or float64 of the screens.
        device: where the screens are made.

    Raises:
        ParameterError: a value outside its range.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        spacing: float,
        r0: float,
        outer_scale: float = math.inf,
        inner_scale: float = 0.0,
        *,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        for name, size in zip(("height", "width"), shape, strict=True):
            check_range(f"screen {name}", size, 8, 32768, "samples")
        check_range("spacing", spacing, 1e-7, 10.0, "m")
        check_range("r0", r0, 1e-5, math.inf, "m")
        check_range("outer_scale", outer_scale, 1e-2, math.inf, "m")
        check_range("inner_scale", inner_scale, 0.0, 1.0, "m")
        self.shape, self.spacing, self.dtype, self.device = shape, spacing, dtype, torch.device(device)

        def spectrum(kappa: Array) -> Array:
            return phase_spectrum(kappa, r0, outer_scale, inner_scale)

        self._torus = tuple(next_fast_len(math.ceil(TORUS * size), real=True) for size in shape)
        split = SPLIT * 2 * np.pi / (min(self._torus) * spacing)
        weights = _grid_weights(self._torus, spacing, lambda kappa: spectrum(kappa) * _high_pass(kappa, split))
        diagonal = math.hypot(*shape) * spacing
        lowest = 0.5 / diagonal
        waves = _subharmonics(lowest, 3 * split, diagonal, lambda k: spectrum(k) * (1 - _high_pass(k, split)))
        self._weights = weights
        self._waves = waves
        self._gradient_variance = _gradient_variance(lowest, spectrum)
        self._amplitudes = self._tensor(np.sqrt(weights * weights.shape[0] * self._torus[1]))
        y, x = (np.arange(size) * spacing for size in shape)
        phase_y, phase_x = np.outer(y, waves[:, 0]), np.outer(waves[:, 1], x)
        self._wave_y = self._tensor(np.exp(1j * phase_y) * np.sqrt(waves[:, 2]), complex_=True)
        self._wave_x = self._tensor(np.concatenate([np.cos(phase_x), -np.sin(phase_x)]))
        self._y, self._x = (self._tensor(axis - axis.mean()) for axis in (y, x))

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """`count` independent screens (count, H, W), rad. The same generator state gives the same screens anywhere."""
        height, width = self.shape
        white = self._normal((count, *self._torus), generator)
        screens = torch.fft.irfft2(torch.fft.rfft2(white) * self._amplitudes, s=self._torus)[:, :height, :width]
        cosine, sine = self._normal((2, count, 1, len(self._waves)), generator)
        rows = self._wave_y * torch.complex(cosine, sine)
        slope_y, slope_x = self._normal((2, count, 1, 1), generator) * math.sqrt(self._gradient_variance)
        low = torch.cat([rows.real, rows.imag], dim=-1) @ self._wave_x
        return screens + low + slope_y * self._y[:, None] + slope_x * self._x

    def structure_function(self, rows: Array, columns: Array) -> Array:
        """E[(phi(p) - phi(p + d))^2] of the screens, rad^2, for separations d of whole samples; no random draw.

        The exact expectation of what `draw` makes: a sum over its discrete waves.
        """
        rows, columns = np.asarray(rows).astype(int), np.asarray(columns).astype(int)
        covariance = np.fft.irfft2(self._weights, s=self._torus) * self._torus[0] * self._torus[1]
        high = 2 * (covariance[0, 0] - covariance[rows % self._torus[0], columns % self._torus[1]])
        dy, dx = rows * self.spacing, columns * self.spacing
        waves = 1 - np.cos(dy[..., None] * self._waves[:, 0] + dx[..., None] * self._waves[:, 1])
        return np.asarray(high + 2 * waves @ self._waves[:, 2] + self._gradient_variance * (dy**2 + dx**2))

    def _tensor(self, values: Array, complex_: bool = False) -> Tensor:
        dtype = self.dtype.to_complex() if complex_ else self.dtype
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.device, dtype)

    def _normal(self, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
        return torch.randn(shape, dtype=self.dtype, device=generator.device, generator=generator).to(self.device)


def _high_pass(kappa: Array, split: float) -> Array:
    return np.asarray((-np.expm1(-((kappa / split) ** 2))) ** 3)


def _grid_weights(torus: tuple[int, ...], spacing: float, spectrum: Callable[[Array], Array]) -> Array:
    """Variance of each wave of the FFT part on the half-plane grid of rfft2, folded at the Nyquist frequency."""
    step = [2 * np.pi / (size * spacing) for size in torus]
    ky, kx = np.abs(np.fft.fftfreq(torus[0], 1 / torus[0])) * step[0], np.arange(torus[1] // 2 + 1) * step[1]
    kappa = np.hypot(ky[:, None], kx)
    kappa[0, 0] = 1e-3 * min(step)  # the high pass leaves nothing there
    # The folded orders are smooth in kappa: a spline through 33 x 33 points has them all.
    nyquist, orders = np.pi / spacing, range(-3, 4)
    knots = np.linspace(0, nyquist, 33)
    folded = np.zeros((33, 33))
    for i, j in itertools.product(orders, orders):
        if (i, j) != (0, 0):
            folded += spectrum(np.hypot(knots[:, None] + 2 * nyquist * i, knots + 2 * nyquist * j))
    order = np.argsort(ky)
    aliases = np.empty_like(kappa)
    aliases[order] = np.abs(RectBivariateSpline(knots, knots, folded)(ky[order], kx))
    return np.asarray((spectrum(kappa) + aliases) * step[0] * step[1])


def _subharmonics(lowest: float, highest: float, size: float, spectrum: Callable[[Array], Array]) -> Array:
    """Plane waves (kappa_y, kappa_x, variance), (waves, 3), for the spectrum between two wavenumbers."""
    x, w = np.polynomial.legendre.leggauss(RINGS)
    log_range = np.log(highest / lowest)
    waves = []
    for kappa, weight in zip(lowest * np.exp(log_range * (x + 1) / 2), w * log_range / 2, strict=True):
        # Equal angles over half the circle are exact for waves of up to so many cycles across the screen.
        count = math.ceil(kappa * size / 3) + 6
        angle = np.pi * (np.arange(count) + 0.25) / count
        variance = 2 * spectrum(kappa) * kappa**2 * weight * np.pi / count
        waves.append(np.stack([kappa * np.sin(angle), kappa * np.cos(angle), np.full(count, variance)], axis=1))
    return np.concatenate(waves)


def _gradient_variance(highest: float, spectrum: Callable[[Array], Array]) -> float:
    """Variance of one component of the phase gradient from wavenumbers below `highest`, rad^2/m^2."""
    x, w = np.polynomial.legendre.leggauss(64)
    kappa = highest * ((x + 1) / 2) ** 3  # the cube takes the root singularity of Kolmogorov's kappa^(-2/3) away
    return float(np.pi * np.sum(w / 2 * 3 * highest * ((x + 1) / 2) ** 2 * kappa**3 * spectrum(kappa)))
