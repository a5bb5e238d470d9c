r"""The Zernike space: one vector of Zernike coefficients per scene point, sampled with all its correlations.

For turbulence of the spectrum 0.033 Cn2 (kappa^2 + kappa_0^2)^(-11/6), kappa_0 = 2 pi / L0, and spherical waves
(c = (L-z)/L, R the aperture radius)

.. math::
    E[a_i(u) a_j(u')] = \int_0^L dz \int d^2\kappa\; 2\pi k^2\, 0.033\, C_n^2(z)\, (\kappa^2+\kappa_0^2)^{-11/6}
        Q_i(\kappa c R)\, Q_j^*(\kappa c R)\, e^{i \kappa \cdot (u-u') z/L}

is stationary in u, so it can be sampled exactly: a white field per layer, shaped by the layer's spectrum on the scene's
FFT grid (scene frequency K, layer frequency kappa = K L / z), multiplied by Q_j for each mode, summed over layers and
transformed once per mode. Q_j factors into a radial part shared by all modes of one order and an angular part shared by
all layers, so layers are summed once per radial order and not once per mode. Frozen flow at the velocity v_l of a layer
is the phase factor e^{-i kappa . v_l t}, with kappa drawn from the cell that a wave stands for; air that boils changes
its white noise steadily into another.

What is below the grid comes from explicit plane waves (`turbnet.simulate.waves`) and, below those, from a tilt common
to all points, drawn with the variance (exact - represented). Source: the layered construction follows from Chimitt & Chan
(2020) without their independence approximation.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Array
from turbnet.errors import ParameterError, check_range
from turbnet.optics.zernike import angular, fourier_phase, fourier_radial, noll_to_nm
from turbnet.simulate.draw import Draw
from turbnet.simulate.tilt import upsample
from turbnet.simulate.waves import Waves, grid_waves, held, low_waves

_PERIOD = 1.65  # of the periodic grid, in widths of the picture: tilts across all of it stay within 2 % of theory
_COARSE = 8  # grid steps between the points at which the waves below the grid are summed
_CELLS = 2**32 - 1  # the number that marks this draw among a seed's noises
_REACH = 200.0  # beyond kappa c R = 200 no mode to 300 has energy worth drawing


class ZernikeField(nn.Module):
    """Samples the Zernike space of a path over a picture of `height` x `width` pixels.

    Args:
        path: the turbulent path.
        height, width: size of the picture, pixels.
        margin: pixels to cover beyond each edge of the picture.
        modes: highest Noll index J; coefficients 2..J are drawn.
        stride: grid step in pixels. 4 Nyquist pixels hold the modes to 4..10 within 2 %; larger steps lose their finest
            parts.
        layers: Gauss-Legendre layers along the path.
        q: pixel of the picture in Nyquist pixels lambda L / (2 D) of the scene.
        outer_scale: L0 of the von Karman spectrum, m.
        boiling: time in which the air of a layer becomes other air, s; infinite for frozen flow.
        dtype: torch.float32 or torch.float64.

    Raises:
        ParameterError: a size, stride, mode or layer count out of range.
    """

    _grid_radial: Tensor
    _grid_angle: Tensor
    _low_radial: Tensor
    _low_angle: Tensor
    _low_y: Tensor
    _low_x: Tensor
    _grid_k: Tensor
    _low_k: Tensor
    _low_cell: Tensor
    _layer_scale: Tensor
    _mirrored: Tensor
    _common_tilt: Tensor

    def __init__(
        self,
        path: OpticalPath,
        height: int,
        width: int,
        margin: int = 0,
        modes: int = 36,
        stride: int = 4,
        layers: int = 16,
        q: float = 1.0,
        outer_scale: float = math.inf,
        boiling: float = math.inf,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        check_range("height", height, 1, 2**15, "pixels")
        check_range("width", width, 1, 2**15, "pixels")
        check_range("modes", modes, 3, 300)
        check_range("stride", stride, 1, 64, "pixels")
        check_range("layers", layers, 1, 256)
        check_range("q", q, 1e-2, 1e2, "Nyquist pixels")
        check_range("outer scale", outer_scale, 1e-2, math.inf, "m")
        check_range("boiling", boiling, 1e-6, math.inf, "s")
        self.path, self.stride, self.margin, self.q, self.boiling = path, stride, margin, q, boiling
        self.dtype = dtype
        self.pixel = path.pixel * q
        # One step past the last pixel: the same grid holds the picture at any scale.
        self.rows, self.columns = (1 + -(-(n + 2 * margin) // stride) for n in (height, width))
        self.noll = range(2, modes + 1)
        self.orders = [noll_to_nm(j)[0] for j in self.noll]
        # Cells of frequencies stay within 1 : 2.
        longest = int(_PERIOD * max(self.rows, self.columns))
        self._shape = tuple(_fast_even(max(int(_PERIOD * n), longest // 2, 16)) for n in (self.rows, self.columns))
        self._step = tuple(2 * np.pi / (n * stride * self.pixel) for n in reversed(self._shape))  # dK along x, y

        z, cn2_dz = path.layers(layers)
        grid, low = grid_waves(self._shape, self._step), low_waves(self._step)  # type: ignore[arg-type]
        k0 = 2 * np.pi / outer_scale
        # Rows of +ky and -ky are alike: kept once. The block of the lowest bins is the waves'.
        rows = grid_waves(self._shape, self._step, half=True)  # type: ignore[arg-type]
        grid_radial = _radial_filters(path, z, cn2_dz, rows, k0, max(self.orders), dtype).mul_(
            torch.as_tensor(held(rows))
        )
        low_radial = _radial_filters(path, z, cn2_dz, low, k0, max(self.orders), dtype)

        # On the two columns that are their own mirror images, noise without that symmetry has half the energy.
        mirrored = np.ones(self._shape[1] // 2 + 1)
        mirrored[[0, -1]] = np.sqrt(2)

        def angles(waves: Waves) -> Tensor:
            """Q's angular parts without their factor i for odd orders, which is put to the sums of the orders."""
            theta = np.arctan2(waves.y, waves.x)
            parts = torch.empty((len(self.noll), *theta.shape), dtype=dtype)
            known: dict[tuple[int, bool], Tensor] = {}
            for index, (j, n) in enumerate(zip(self.noll, self.orders, strict=True)):
                _, m = noll_to_nm(j)
                kind = (m, m > 0 and j % 2 == 0)
                if kind not in known:
                    known[kind] = torch.from_numpy(angular(j, theta)).to(dtype)
                torch.mul(known[kind], (fourier_phase(j) / 1j ** (n % 2)).real, out=parts[index])
            return parts

        def keep(name: str, value: np.ndarray | Tensor, kind: torch.dtype) -> None:
            self.register_buffer(name, torch.as_tensor(value).to(kind), persistent=False)

        keep("_grid_radial", grid_radial, dtype)  # layer, order, ky >= 0, kx
        keep("_grid_angle", angles(grid), dtype)  # mode, ky, kx
        keep("_low_radial", low_radial, dtype)  # layer, order, wave
        keep("_low_angle", angles(low), dtype)  # mode, wave
        step = _COARSE * stride * self.pixel
        coarse_y, coarse_x = (step * np.arange(2 + (n - 1) // _COARSE) for n in (self.rows, self.columns))
        keep("_low_y", np.exp(1j * np.outer(low.y, coarse_y)), dtype.to_complex())
        keep("_low_x", np.exp(1j * np.outer(low.x, coarse_x)), dtype.to_complex())
        keep("_mirrored", mirrored, dtype)
        keep("_grid_k", np.stack((np.stack((rows.x, rows.x)), np.stack((rows.y, -rows.y)))), torch.float64)
        keep("_low_k", np.stack((low.x, low.y)), torch.float64)
        keep("_low_cell", np.outer(self._step, low.width), torch.float64)
        keep("_layer_scale", path.distance / z, torch.float64)

        exact = _tilt_variance(path, z, cn2_dz, k0)
        drawn = [self._energy("_grid", j, j).sum((1, 2)) + self._energy("_low", j, j).sum(1) for j in (2, 3)]
        missing = exact[:, None] - torch.stack(drawn, 1).numpy()  # not the same for x and y where cells are oblong
        keep("_common_tilt", np.sqrt(np.maximum(missing, 0.0)), dtype)  # layer, mode

    def _energy(self, waves: str, i: int, j: int) -> Tensor:
        """Cross energy of two modes in each wave of each layer, real part and imaginary part as 1 and i: complex."""
        radial, angle = getattr(self, f"{waves}_radial"), getattr(self, f"{waves}_angle")
        n, m = self.orders[i - 2], self.orders[j - 2]
        both = 2.0 * angle[i - 2].double() * angle[j - 2].double()  # of a pair +-K
        if waves == "_grid":
            both[:, [0, -1]] /= 2  # the zero and Nyquist columns are their own mirror images
        common = radial[:, n].double() * radial[:, m]
        energy = (_whole(common, common) if waves == "_grid" else common) * both
        return energy if n % 2 == m % 2 else energy * (1j if n % 2 else -1j)

    def covariance(
        self, i: int, j: int, x: Array | float, y: Array | float = 0.0, travel: tuple[float, float] = (0.0, 0.0)
    ) -> Array:
        """E[a_i(u, t) a_j(u', t')] that this sampling holds, summed over its waves without drawing any, rad^2.

        Args:
            i, j: Noll indices, at most `modes`.
            x, y: u - u' in pixels.
            travel: way of the air from t' to t, the same in all layers, m.
        """
        at_x, at_y = (np.asarray(v, dtype=np.float64)[..., None] * self.pixel for v in np.broadcast_arrays(x, y))
        total = np.zeros(at_x.shape[:-1])
        for waves, k, cell in (("_grid", self._grid_k, self._grid_cell), ("_low", self._low_k, self._low_cell)):
            energy = self._energy(waves, i, j)
            if waves == "_grid":
                k = _whole(k[:, 0], k[:, 1])
            factors = torch.ones_like(energy, dtype=torch.complex128)
            for axis, way in enumerate(travel):
                if way:
                    shift = way * self._layer_scale.view(-1, *[1] * (k.ndim - 1))
                    factors = factors * torch.exp(-1j * shift * k[axis]) * torch.sinc(shift * cell[axis] / (2 * np.pi))
            summed = (energy * factors).sum(0).numpy().ravel()
            k_x, k_y = (v.numpy().ravel() for v in k)
            total = total + (np.exp(1j * (at_x * k_x + at_y * k_y)) @ summed).real
        return total + (float(self._common_tilt[:, i - 2].double().square().sum()) if i == j and i in (2, 3) else 0.0)

    @property
    def _grid_cell(self) -> Tensor:
        # Of k along x and y.
        return torch.tensor(self._step, dtype=torch.float64, device=self._grid_k.device)[:, None, None]

    def draw(
        self,
        seeds: Sequence[int],
        frames: int = 1,
        wind: Tensor | None = None,
        frame_rate: float = 30.0,
        d_over_r0: Tensor | None = None,
        start: float = 0,
        cn2: Tensor | None = None,
        exposures: int = 1,
        shutter: float = 1.0,
    ) -> Draw:
        """Draw one atmosphere per seed; the same seed gives the same atmosphere, alone or in any batch.

        Differentiable in the wind, in `d_over_r0` and in `cn2`: the white noise stays, what shapes it moves.

        Args:
            seeds: one per clip.
            frames: T, frames of a clip.
            wind: velocity of the air across the path, m/s, x then y: (2,), one for all layers, or (B, layers, 2). None
                draws every frame independently.
            frame_rate: frames a second.
            d_over_r0: strength of each clip, (B,); the path's Cn2 profile is scaled to it. None: as the path says.
            start: number of the first frame: a long clip may be drawn piece by piece.
            cn2: Cn2 of each layer over that of the path, (B, layers), before any scaling to `d_over_r0`.
            exposures: moments drawn of each frame, evenly over
            shutter: the part of the frame's time in which it is exposed.

        Raises:
            ParameterError: no seeds, no frames, negative strength, a strength asked of a path of still air.
        """
        check_range("number of clips", len(seeds), 1, 2**20)
        check_range("frames", frames, 1, 2**20)
        check_range("exposures", exposures, 1, 2**16)
        check_range("shutter", shutter, 0, 1)
        gain = self._gain(len(seeds), d_over_r0)
        if not bool(gain.any()):
            shape = (len(seeds), frames * exposures, len(self.noll), self.rows, self.columns)
            return Draw(gain.new_zeros(shape), self.stride, self.margin, self.q)
        layers = len(self._layer_scale)
        still = self._layer_scale.new_zeros(layers, 2)
        clips = []
        for index, seed in enumerate(seeds):
            strength = None if cn2 is None else cn2[index].to(self._mirrored)
            drawn = []
            for moment in range(frames * exposures):
                number = start + moment // exposures + shutter * (moment % exposures) / exposures
                if wind is None:
                    noise, travel = self._noise(seed, int(start) * exposures + moment), still
                else:
                    time = number / frame_rate
                    noise = self._noise_at(seed, time)
                    travel = (wind[index] if wind.ndim == 3 else wind.expand(layers, 2)).to(still) * time
                drawn.append(self._frame(noise, travel, strength, seed))
            clips.append(torch.stack(drawn))
        coefficients = torch.stack(clips) * gain[:, None, None, None, None]
        return Draw(coefficients, self.stride, self.margin, self.q)

    def _gain(self, clips: int, d_over_r0: Tensor | None) -> Tensor:
        own = self.path.d_over_r0
        if d_over_r0 is None:
            return self._mirrored.new_full((clips,), float(own > 0))
        if bool((d_over_r0 < 0).any()) or not bool(torch.isfinite(d_over_r0).all()):
            raise ParameterError(f"D/r0 = {d_over_r0.tolist()} must be finite and not negative")
        if own == 0:
            raise ParameterError("a path of still air has no profile to scale to a D/r0; give it a Cn2 above 0")
        return (d_over_r0.to(self._mirrored) / own) ** (5 / 6)

    def _noise(self, seed: int, number: int) -> tuple[Tensor, Tensor, Tensor]:
        """White noise of the grid's waves, of the waves below it, and of the common tilt of each layer."""
        generator = _generator(seed, number)
        layers, _, waves = self._low_radial.shape
        kind = self._low_y.dtype
        # Rows of +ky, and of -ky in the order of |ky|; the second has no use for its first and last row.
        half = (self._shape[0] // 2 + 1, self._shape[1] // 2 + 1)
        grid = torch.randn(layers, 2, *half, dtype=kind, generator=generator)
        low = torch.randn(layers, waves, dtype=kind, generator=generator)
        common = torch.randn(layers, 2, generator=generator, dtype=self._mirrored.dtype)
        device = self._mirrored.device
        return (grid.to(device) * self._mirrored), low.to(device), common.to(device)

    def _noise_at(self, seed: int, time: float) -> tuple[Tensor, Tensor, Tensor]:
        """Noise that turns from one white noise into the next in each `boiling` time: white at every moment."""
        if math.isinf(self.boiling):
            return self._noise(seed, 0)
        number, part = divmod(time / self.boiling, 1.0)
        old, new = self._noise(seed, int(number)), self._noise(seed, int(number) + 1)
        c, s = math.cos(0.5 * math.pi * part), math.sin(0.5 * math.pi * part)
        grid, low, common = (c * a + s * b for a, b in zip(old, new, strict=True))
        return grid, low, common

    def _frame(
        self, noise: tuple[Tensor, Tensor, Tensor], travel_L2: Tensor, strength_L: Tensor | None, seed: int
    ) -> Tensor:
        """Coefficients (modes, rows, columns) when the air of each layer has travelled so far, m."""
        grid, low, common = noise
        if travel_L2.requires_grad or bool(travel_L2.any()):
            # In units of the scene frequency: kappa . v t = K . (v t L / z).
            shift = travel_L2 * self._layer_scale[:, None]
            grid_cell, low_cell = self._cells(seed)
            grid = grid * self._drift(shift, self._grid_k + grid_cell)
            low = low * self._drift(shift, self._low_k + low_cell)
        common = common * self._common_tilt
        if strength_L is not None:
            amplitude = strength_L.sqrt()
            grid, low = grid * amplitude[:, None, None, None], low * amplitude[:, None]
            common = common * amplitude[:, None]
        halves = _sum_layers(grid, self._grid_radial[:, :, None])
        orders = _whole(halves[:, 0], halves[:, 1])
        low_orders = _sum_layers(low, self._low_radial)
        fields, waves = [], []
        for order in sorted(set(self.orders)):
            modes = [index for index, n in enumerate(self.orders) if n == order]
            part = slice(modes[0], modes[-1] + 1)
            turn = 1j ** (order % 2)
            spectrum = (turn * orders[order]) * self._grid_angle[part]
            field = torch.fft.irfft2(spectrum, s=self._shape, norm="forward")
            fields.append(field[:, : self.rows, : self.columns])
            waves.append((turn * low_orders[order]) * self._low_angle[part])
        # A pair of waves +-K of unit-variance amplitudes adds to 2 Re.
        smooth = 2 * torch.einsum("jw,wy,wx->jyx", torch.cat(waves), self._low_y, self._low_x).real
        field = torch.cat(fields) + upsample(smooth[None], _COARSE, self.rows, self.columns)[0]
        # Too slow to move within a clip, so the same for all its frames.
        return torch.cat((field[:2] + common.sum(0)[:, None, None], field[2:]))

    def _cells(self, seed: int) -> tuple[Tensor, Tensor]:
        """Where in its cell each wave's own frequency lies, rad/m from the middle; the same for all layers."""
        generator = _generator(seed, _CELLS)
        grid = torch.rand(self._grid_k.shape, generator=generator, dtype=torch.float64).to(self._grid_k) - 0.5
        low = torch.rand(self._low_k.shape, generator=generator, dtype=torch.float64).to(self._low_k) - 0.5
        return grid * self._grid_cell[:, None], low * self._low_cell

    def _drift(self, shift_L2: Tensor, k: Tensor) -> Tensor:
        """e^{-i K . shift} of waves (2, ...) for each layer, (L, ...); phases are reduced to +-pi in double precision."""
        phase = torch.einsum("lc,c...->l...", shift_L2, k)
        phase = (phase - 2 * torch.pi * (phase.detach() / (2 * torch.pi)).round()).to(self._mirrored)
        return torch.complex(phase.cos(), -phase.sin())


def _generator(seed: int, number: int) -> torch.Generator:
    mixed = np.random.SeedSequence([int(seed), number]).generate_state(1, np.uint64)[0]
    return torch.Generator().manual_seed(int(mixed))


def _whole(positive: Tensor, negative: Tensor) -> Tensor:
    """Rows ky >= 0 and rows -ky, both by |ky|, in FFT order, (..., rows, columns)."""
    return torch.cat((positive, negative[..., 1:-1, :].flip(-2)), dim=-2)


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
    path: OpticalPath, z: Array, cn2_dz: Array, waves: Waves, k0: float, top_order: int, dtype: torch.dtype
) -> Tensor:
    """sqrt(energy of each wave) times the radial part of Q, for each layer and radial order: (layer, order, ...)."""
    filters = torch.zeros((len(z), top_order + 1, *waves.x.shape), dtype=dtype)
    k2 = torch.from_numpy(waves.x**2 + waves.y**2)
    k_scene = k2.sqrt()
    bessel = _RadialTable(top_order, dtype)
    weight, area = torch.from_numpy(waves.weight()), torch.from_numpy(waves.area)
    for index, (distance, strength) in enumerate(zip(z, cn2_dz, strict=True)):
        scale = path.distance / distance
        if k0:
            weight = torch.from_numpy(waves.weight(k0 / scale))
        # Of the scene's frequencies, in which the outer scale lies at k0 / scale; the waves at 0 have no weight.
        spectrum = (k2 + (k0 / scale) ** 2).clamp(min=1e-30) ** (-11 / 6) * scale ** (-11 / 3)
        energy = 2 * np.pi * path.wavenumber**2 * 0.033 * strength * scale**2 * spectrum * area * weight
        reach = k_scene * (scale * (1 - distance / path.distance) * path.aperture / 2)
        filters[index] = bessel(reach) * energy.sqrt().to(dtype)
    return filters


class _RadialTable:
    """The radial parts sqrt(n+1) 2 J_{n+1}(x) / x of the orders 1..top, tabulated, to 1e-5; zero beyond _REACH."""

    def __init__(self, top: int, dtype: torch.dtype) -> None:
        self._step = 1 / 128
        x = np.asarray(np.arange(int(_REACH / self._step) + 2) * self._step, dtype=np.float64)
        table = np.stack([np.zeros_like(x)] + [fourier_radial(order, x) for order in range(1, top + 1)])
        table[:, -2:] = 0.0
        self._table = torch.from_numpy(table).to(dtype)

    def __call__(self, x: Tensor) -> Tensor:
        """(orders, *x.shape)."""
        place = (x / self._step).clamp(max=self._table.shape[1] - 2)
        below = place.floor()
        part = (place - below).to(self._table)
        index = below.int()
        low = torch.stack([row[index] for row in self._table])
        index += 1
        high = torch.stack([row[index] for row in self._table])
        return low.lerp_(high, part)


def _tilt_variance(path: OpticalPath, z: Array, cn2_dz: Array, k0: float) -> Array:
    """E[a_2^2] that each layer gives to a point, rad^2: the integral of the covariance at u = u'."""
    gauss, weight = np.polynomial.legendre.leggauss(16)
    edges = np.linspace(0, 100 ** (1 / 3), 101)
    half = 0.5 * np.diff(edges)[:, None]
    t = (edges[:-1, None] + half * (gauss + 1)).ravel()
    x, dx = np.asarray(t**3, dtype=np.float64), (half * weight).ravel() * 3 * t**2  # x = kappa c R = t^3 is smooth at 0
    reach = (1 - z / path.distance) * path.aperture / 2
    kappa = x / reach[:, None]
    spectrum = 2 * np.pi * path.wavenumber**2 * 0.033 * cn2_dz[:, None] * (kappa**2 + k0**2) ** (-11 / 6)
    return np.asarray(2 * np.pi * (spectrum * kappa * fourier_radial(1, x) ** 2) @ dx / reach)


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
