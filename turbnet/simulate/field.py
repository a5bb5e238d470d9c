r"""The Zernike space: one vector of Zernike coefficients per scene point, sampled with all its correlations.

For Kolmogorov turbulence and spherical waves (c = (L-z)/L, R the aperture radius)

.. math::
    E[a_i(u) a_j(u')] = \int_0^L dz \int d^2\kappa\; 2\pi k^2\, 0.033\, C_n^2(z)\, \kappa^{-11/3}
        Q_i(\kappa c R)\, Q_j^*(\kappa c R)\, e^{i \kappa \cdot (u-u') z/L}

is stationary in u, so it can be sampled exactly: a white field per layer, shaped by the layer's spectrum on the scene's
FFT grid (scene frequency K, layer frequency kappa = K L / z), multiplied by Q_j for each mode, summed over layers and
transformed once per mode. Q_j factors into a radial part shared by all modes of one order and an angular part shared by
all layers, so layers are summed once per radial order and not once per mode. Frozen flow at the velocity v_l of a layer
is the phase factor e^{-i kappa . v_l t}.

What is below the grid comes from explicit plane waves (`turbnet.simulate.waves`) and, below those, from a tilt common
to all points, drawn with the variance (exact - represented). Source: the layered construction follows from Chimitt & Chan
(2020) without their independence approximation.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from turbnet.atmosphere.noll import noll_covariance
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Array
from turbnet.errors import ParameterError, check_range
from turbnet.optics.zernike import angular, fourier_phase, fourier_radial, noll_to_nm
from turbnet.simulate.tilt import upsample
from turbnet.simulate.waves import grid_weight, low_waves

_PERIOD = 1.65  # of the periodic grid, in widths of the picture: tilts across all of it stay within 2 % of theory
_COARSE = 8  # grid steps between the points at which the waves below the grid are summed

TILT_PIXELS = 4 / np.pi
"""Shift of the image in Nyquist pixels per radian of the coefficients a_2 (x) and a_3 (y)."""


@dataclass(frozen=True)
class Draw:
    """One draw of the atmosphere.

    Attributes:
        coefficients: Zernike coefficients a_2..a_J of B clips of T frames on the coarse grid, (B, T, J-1, h, w), rad.
        stride: step of that grid in pixels; its first point is the corner pixel (-margin, -margin) of the picture.
        margin: pixels by which the grid overlaps the picture on each side.
    """

    coefficients: Tensor
    stride: int
    margin: int

    @property
    def tilt(self) -> Tensor:
        """Displacement of each scene point, (B, T, 2, h, w), x then y, in pixels."""
        return TILT_PIXELS * self.coefficients[:, :, :2]

    @property
    def high(self) -> Tensor:
        """Coefficients a_4..a_J, which blur, (B, T, J-3, h, w), rad."""
        return self.coefficients[:, :, 2:]

    def centred(self) -> "Draw":
        """The same atmosphere seen by a camera that points at the clip's mean position: tilts sum to zero over a clip."""
        tilts = self.coefficients[:, :, :2]
        tilts = tilts - tilts.mean(dim=(1, 3, 4), keepdim=True)
        return replace(self, coefficients=torch.cat((tilts, self.high), dim=2))


class ZernikeField(nn.Module):
    """Samples the Zernike space of a path over a picture of `height` x `width` Nyquist pixels.

    Args:
        path: the turbulent path; a pixel is its Nyquist pixel lambda L / (2 D) in the scene.
        height, width: size of the picture, pixels.
        margin: pixels to cover beyond each edge of the picture.
        modes: highest Noll index J; coefficients 2..J are drawn.
        stride: grid step in pixels. 4 holds the modes to 4..10 within 2 %; larger steps lose their finest parts.
        layers: Gauss-Legendre layers along the path.

    Raises:
        ParameterError: a size, stride, mode or layer count out of range.
    """

    _order: Tensor
    _grid_radial: Tensor
    _grid_angle: Tensor
    _low_radial: Tensor
    _low_angle: Tensor
    _low_y: Tensor
    _low_x: Tensor
    _grid_k: Tensor
    _low_k: Tensor
    _layer_scale: Tensor
    _mirrored: Tensor

    def __init__(
        self,
        path: OpticalPath,
        height: int,
        width: int,
        margin: int = 0,
        modes: int = 36,
        stride: int = 4,
        layers: int = 16,
    ) -> None:
        super().__init__()
        check_range("height", height, 1, 2**15, "pixels")
        check_range("width", width, 1, 2**15, "pixels")
        check_range("modes", modes, 3, 300)
        check_range("stride", stride, 1, 64, "pixels")
        check_range("layers", layers, 1, 256)
        self.path, self.stride, self.margin = path, stride, margin
        self.rows, self.columns = (1 + -(-(n + 2 * margin - 1) // stride) for n in (height, width))
        self.noll = range(2, modes + 1)
        orders = [noll_to_nm(j)[0] for j in self.noll]
        self._size = _fast_even(max(int(_PERIOD * max(self.rows, self.columns)), 16))

        d_k = 2 * np.pi / (self._size * stride * path.pixel)
        z, cn2_dz = path.layers(layers)
        low = low_waves()
        ky, kx = np.meshgrid(
            d_k * np.fft.fftfreq(self._size, 1 / self._size), d_k * np.arange(self._size // 2 + 1), indexing="ij"
        )
        grid_radial = _radial_filters(path, z, cn2_dz, np.hypot(kx, ky), d_k, grid_weight(self._size), max(orders))
        low_radial = _radial_filters(path, z, cn2_dz, d_k * np.hypot(low.x, low.y), d_k, low.weight, max(orders))

        # On the two columns that are their own mirror images, noise without that symmetry has half the energy.
        mirrored = np.ones(self._size // 2 + 1)
        mirrored[[0, -1]] = np.sqrt(2)

        def angles(theta: np.ndarray) -> np.ndarray:
            return np.stack([fourier_phase(j) * angular(j, theta) for j in self.noll])

        def keep(name: str, value: np.ndarray, dtype: torch.dtype) -> None:
            self.register_buffer(name, torch.as_tensor(value).to(dtype), persistent=False)

        keep("_order", np.array(orders), torch.long)
        keep("_grid_radial", grid_radial, torch.float32)  # layer, order, ky, kx
        keep("_grid_angle", angles(np.arctan2(ky, kx)), torch.complex64)  # mode, ky, kx
        keep("_low_radial", low_radial, torch.float32)  # layer, order, wave
        keep("_low_angle", angles(np.arctan2(low.y, low.x)), torch.complex64)  # mode, wave
        step = _COARSE * stride * path.pixel
        coarse_y, coarse_x = (step * np.arange(2 + (n - 1) // _COARSE) for n in (self.rows, self.columns))
        keep("_low_y", np.exp(1j * d_k * np.outer(low.y, coarse_y)), torch.complex64)
        keep("_low_x", np.exp(1j * d_k * np.outer(low.x, coarse_x)), torch.complex64)
        keep("_mirrored", mirrored, torch.float32)
        keep("_grid_k", np.stack((kx, ky)), torch.float32)
        keep("_low_k", d_k * np.stack((low.x, low.y)), torch.float32)
        keep("_layer_scale", path.distance / z, torch.float64)

        self._common_tilt = 0.0
        missing = noll_covariance(2, 2) * path.d_over_r0 ** (5 / 3) - float(self.covariance(2, 2, 0.0))
        self._common_tilt = float(np.sqrt(max(missing, 0.0)))

    def covariance(self, i: int, j: int, x: Array | float, y: Array | float = 0.0) -> Array:
        """E[a_i(u) a_j(u')] that this sampling holds, summed over its waves without drawing any, rad^2.

        Args:
            i, j: Noll indices, 2 .. modes.
            x, y: u - u', pixels; arrays broadcast against each other.
        """
        at_x, at_y = (np.asarray(v, dtype=np.float64)[..., None] * self.path.pixel for v in np.broadcast_arrays(x, y))
        pair = np.full((self._size, self._size // 2 + 1), 2.0)
        pair[:, [0, -1]] = 1.0  # the zero and Nyquist columns are their own mirror images

        def total(radial: Tensor, angle: Tensor, k: Tensor, count: Array | float) -> Array:
            orders = (int(self._order[mode - 2]) for mode in (i, j))
            first, second = (radial[:, order].double() for order in orders)
            energy = (first * second).sum(0).numpy() * (angle[i - 2] * angle[j - 2].conj()).numpy() * count
            k_x, k_y = (v.double().numpy().ravel() for v in k)
            return np.asarray((np.exp(1j * (at_x * k_x + at_y * k_y)) @ energy.ravel()).real)

        held = total(self._grid_radial, self._grid_angle, self._grid_k, pair)
        held = held + total(self._low_radial, self._low_angle, self._low_k, 2.0)
        return held + (self._common_tilt**2 if i == j and i in (2, 3) else 0.0)

    def draw(
        self,
        seeds: Sequence[int],
        frames: int = 1,
        wind: Tensor | None = None,
        frame_rate: float = 30.0,
        d_over_r0: Tensor | None = None,
        start: int = 0,
    ) -> Draw:
        """Draw one atmosphere per seed; the same seed gives the same atmosphere, alone or in any batch.

        Args:
            seeds: one per clip.
            frames: T, frames of a clip.
            wind: velocity of the air across the path, m/s, x then y: (2,), one for all layers, or (B, layers, 2). None
                draws every frame independently.
            frame_rate: frames a second.
            d_over_r0: strength of each clip, (B,); the path's Cn2 profile is scaled to it. None: as the path says.
            start: number of the first frame: a long clip may be drawn piece by piece.

        Raises:
            ParameterError: no seeds, no frames, negative strength, a strength asked of a path of still air.
        """
        check_range("number of clips", len(seeds), 1, 2**20)
        check_range("frames", frames, 1, 2**20)
        gain = self._gain(len(seeds), d_over_r0)
        if not bool(gain.any()):
            shape = (len(seeds), frames, len(self.noll), self.rows, self.columns)
            return Draw(gain.new_zeros(shape), self.stride, self.margin)
        clips = []
        for index, seed in enumerate(seeds):
            if wind is None:
                still = self._layer_scale.new_zeros(len(self._layer_scale), 2)
                drawn = [self._frame(self._noise(seed, frame), still) for frame in range(start, start + frames)]
            else:
                velocity = (wind[index] if wind.ndim == 3 else wind.expand(len(self._layer_scale), 2)) / frame_rate
                noise = self._noise(seed, 0)
                drawn = [self._frame(noise, velocity * frame) for frame in range(start, start + frames)]
            clips.append(torch.stack(drawn))
        return Draw(torch.stack(clips) * gain[:, None, None, None, None], self.stride, self.margin)

    def _gain(self, clips: int, d_over_r0: Tensor | None) -> Tensor:
        own = self.path.d_over_r0
        if d_over_r0 is None:
            return self._grid_k.new_full((clips,), float(own > 0))
        if bool((d_over_r0 < 0).any()) or not bool(torch.isfinite(d_over_r0).all()):
            raise ParameterError(f"D/r0 = {d_over_r0.tolist()} must be finite and not negative")
        if own == 0:
            raise ParameterError("a path of still air has no profile to scale to a D/r0; give it a Cn2 above 0")
        return (d_over_r0.to(self._grid_k) / own) ** (5 / 6)

    def _noise(self, seed: int, frame: int) -> tuple[Tensor, Tensor, Tensor]:
        """White noise of the grid's waves, of the waves below it, and of the common tilt."""
        mixed = np.random.SeedSequence([int(seed), frame]).generate_state(1, np.uint64)[0]
        generator = torch.Generator().manual_seed(int(mixed))
        layers, _, waves = self._low_radial.shape
        grid = torch.randn(layers, self._size, self._size // 2 + 1, dtype=torch.complex64, generator=generator)
        low = torch.randn(layers, waves, dtype=torch.complex64, generator=generator)
        common = torch.randn(2, generator=generator)
        device = self._grid_k.device
        return grid.to(device) * self._mirrored, low.to(device), common.to(device)

    def _frame(self, noise: tuple[Tensor, Tensor, Tensor], travel_L2: Tensor) -> Tensor:
        """Coefficients (modes, rows, columns) when the air of each layer has travelled so far, m."""
        grid, low, common = noise
        if bool(travel_L2.any()):
            # In units of the scene frequency: kappa . v t = K . (v t L / z).
            shift = (travel_L2.to(self._layer_scale) * self._layer_scale[:, None]).to(self._grid_k)
            # The phase factors, and so do the sines and cosines along each axis.
            k_x, k_y = self._grid_k[0, 0], self._grid_k[1, :, 0]
            one = shift.new_ones(())
            grid = grid * torch.polar(one, -shift[:, 1:, None] * k_y[:, None])
            grid = grid * torch.polar(one, -shift[:, :1] * k_x)[:, None]
            low = low * torch.polar(one, -torch.einsum("lc,cw->lw", shift, self._low_k))
        spectrum = _sum_layers(grid, self._grid_radial)[self._order] * self._grid_angle
        field = torch.fft.irfft2(spectrum, s=(self._size, self._size), norm="forward")
        field = field[:, : self.rows, : self.columns]
        waves = _sum_layers(low, self._low_radial)[self._order] * self._low_angle
        # A pair of waves +-K of unit-variance amplitudes adds to 2 Re.
        smooth = 2 * torch.einsum("jw,wy,wx->jyx", waves, self._low_y, self._low_x).real
        field = field + upsample(smooth[None], _COARSE, self.rows, self.columns)[0]
        # Too slow to move within a clip, so the same for all its frames.
        tilts = field[:2] + self._common_tilt * common[:, None, None]
        return torch.cat((tilts, field[2:]))


def _sum_layers(noise_L: Tensor, radial_LN: Tensor) -> Tensor:
    """sum_l noise[l] radial[l, n] over any further axes: complex (orders, ...)."""
    parts = []
    for part in (noise_L.real.contiguous(), noise_L.imag.contiguous()):
        total = part[0] * radial_LN[0]
        for value, radial in zip(part[1:], radial_LN[1:], strict=True):
            total.addcmul_(radial, value)
        parts.append(total)
    return torch.complex(*parts)


def _radial_filters(
    path: OpticalPath,
    z: np.ndarray,
    cn2_dz: np.ndarray,
    k_scene: np.ndarray,
    d_k: float,
    weight: np.ndarray,
    top_order: int,
) -> np.ndarray:
    """sqrt(energy of each wave) times the radial part of Q, for each layer and radial order: (layer, order, ...)."""
    filters = np.zeros((len(z), top_order + 1, *k_scene.shape))
    radius = path.aperture / 2
    safe = np.where(k_scene == 0, 1.0, k_scene)
    for index, (distance, strength) in enumerate(zip(z, cn2_dz, strict=True)):
        scale = path.distance / distance
        spectrum = 2 * np.pi * path.wavenumber**2 * 0.033 * strength * (safe * scale) ** (-11 / 3)
        amplitude = np.sqrt(spectrum * (d_k * scale) ** 2 * weight)
        reach = k_scene * scale * (1 - distance / path.distance) * radius
        for order in range(1, top_order + 1):
            filters[index, order] = amplitude * fourier_radial(order, reach)
    return filters


def _fast_even(size: int) -> int:
    """Smallest even number >= size with no prime factor above 5."""
    size += size % 2
    while True:
        rest = size
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return size
        size += 2
