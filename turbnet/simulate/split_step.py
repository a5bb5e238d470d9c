r"""Split-step propagation of light from many points of a scene through the same turbulent air: the slow reference.

From each object point u a spherical wave runs through thin phase screens phi_l at z_l and still air between them, in a
frame that follows the straight line from u to the middle of the aperture, x = u z/L + m(z) x'. With V the wave relative
to the grid's own cone (see `turbnet.simulate.sampling`):

.. math::
    V_{l+1} = \mathcal{F}^{-1}\{ e^{-i\pi\lambda\tau_l |f|^2 + 2\pi i f\cdot\Delta_l}\,
              \mathcal{F}\{ A_l\, e^{i\phi_l}\, V_l \} \}

Neighbouring points see overlapping windows of the same screens. A window starts at a whole sample; the part of a sample
left over is the shift Delta_l, put into the transfer function, so that the points stand exactly where they should. A_l
absorbs what reaches the grid's edge. The wave starts as a band-limited point source and is collimated by dividing by
what the same source gives in still air. Source, transfer function and absorber are each a product of two vectors.

Source: J. D. Schmidt, Numerical Simulation of Optical Wave Propagation (2010), ch. 9; the windows after J. P. Bos and
M. C. Roggemann, Opt. Eng. 51, 101705 (2012).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Array
from turbnet.atmosphere.screens import PhaseScreen
from turbnet.errors import ParameterError
from turbnet.optics.propagation import frequencies
from turbnet.simulate.sampling import Cost, Sampling

LIT_TO_ABSORB = 0.6
"""From this share of the grid's width on, light nears the edge and the screen's plane absorbs there."""
CACHED, RESIDENT = 2**18, 2**24
"""Samples propagated together on a processor, where they should stay in its cache, and on an accelerator."""


@dataclass(frozen=True)
class Turbulence:
    """One or more draws of the air: for each screen, in the order of the light, its phase and e^{i phase}.

    Attributes:
        phases: (draws, H_l, W_l) each, rad.
        transmissions: the same, complex.
    """

    phases: list[Tensor]
    transmissions: list[Tensor] = field(init=False)

    def __post_init__(self) -> None:
        waves = [torch.complex(phase.cos(), phase.sin()).contiguous() for phase in self.phases]
        object.__setattr__(self, "transmissions", waves)


class SplitStep:
    """Propagation from object points to the aperture.

    Args:
        sampling: path, grid and screens.
        points: object points (y, x) in the scene, (P, 2), m from the axis.
        outer_scale, inner_scale: of the screens, m; Kolmogorov by default.
        dtype: torch.float32 or torch.float64.
        device: where everything runs.

    Raises:
        ParameterError: points of another shape or not finite.
    """

    def __init__(
        self,
        sampling: Sampling,
        points: Array | Sequence[tuple[float, float]] = ((0.0, 0.0),),
        outer_scale: float = math.inf,
        inner_scale: float = 0.0,
        *,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
    ) -> None:
        self.points = np.asarray(points, dtype=np.float64)
        if self.points.ndim != 2 or self.points.shape[1] != 2 or not np.isfinite(self.points).all():
            raise ParameterError(f"points must be finite and of shape (P, 2), not {self.points.shape}")
        self.sampling, self.dtype, self.device = sampling, dtype, torch.device(device)
        self.scales = outer_scale, inner_scale
        # Where each point's line of sight crosses each screen, in samples of that screen: (screens, P, 2).
        crossing = self.points * (sampling.slabs.z / sampling.path.distance / sampling.spacing)[:, None, None]
        start = np.round(crossing).astype(int)
        remainder = np.concatenate([crossing - start, np.zeros((1, *self.points.shape))])
        self._window = start - start.min(axis=1, keepdims=True)
        self._centre = self._window + remainder[:-1] + (sampling.grids[:, None, None] - 1) / 2
        shapes = self._window.max(axis=1) + sampling.grids[:, None]
        self.screens = [
            PhaseScreen((int(h), int(w)), float(step), float(r0), outer_scale, inner_scale, dtype=dtype, device=device)
            for (h, w), step, r0 in zip(shapes, sampling.spacing, sampling.slabs.r0, strict=True)
        ]
        self._axes = [_Axis(sampling, remainder[:, :, a], dtype.to_complex(), self.device) for a in (0, 1)]
        self._absorbers = [None if edge is None else self._complex(np.outer(edge, edge)) for edge in _edges(sampling)]
        still = _still_air(sampling)[self._middle]
        self._still = self._complex(np.outer(still, still))

    @property
    def cost(self) -> Cost:
        """What propagating every point once takes."""
        samples = sum(math.prod(screen.shape) for screen in self.screens)
        size = torch.finfo(self.dtype).bits // 8
        return Cost(len(self.points), tuple(int(n) for n in self.sampling.grids), samples, size)

    def draw(self, generator: torch.Generator, count: int = 1) -> Turbulence:
        """`count` independent draws of the air that all points share."""
        return Turbulence([screen.draw(count, generator) for screen in self.screens])

    def pupil_fields(self, turbulence: Turbulence, points: Sequence[int] = (0,)) -> Tensor:
        """Collimated field over the aperture's square, (draws, points, n, n), n = `sampling.across`; 1 in still air.

        The grid is that of `turbnet.optics.pupil.pupil_grid(n)`; the aperture itself is not yet applied.

        Args:
            turbulence: from `draw`.
            points: which of the points.

        Raises:
            ParameterError: the air was drawn for other points or another sampling.
        """
        if [tuple(phase.shape[1:]) for phase in turbulence.phases] != [screen.shape for screen in self.screens]:
            raise ParameterError(
                "turbulence was drawn for other points or another sampling: its screens differ in size"
            )
        draws = len(turbulence.transmissions[0])
        pairs = [(draw, point) for draw in range(draws) for point in points]
        batch = max(1, (CACHED if self.device.type == "cpu" else RESIDENT) // self.sampling.grid**2)
        parts = [self._propagate(turbulence, pairs[i : i + batch]) for i in range(0, len(pairs), batch)]
        return (torch.cat(parts) / self._still).unflatten(0, (draws, len(points)))

    def geometric_phase(self, turbulence: Turbulence, points: Sequence[int] = (0,)) -> Tensor:
        """Sum of the screens' phases along straight rays from each point, (draws, points, n, n), rad."""
        sampling = self.sampling
        n = sampling.across
        axis = (np.arange(n) - (n - 1) / 2) * sampling.spacing_aperture
        total = torch.zeros((), dtype=self.dtype, device=self.device)
        for layer, phase in enumerate(turbulence.phases):
            nearness = 1 - sampling.slabs.z[layer] / sampling.path.distance
            # Where the rays cross the screen, in the units of grid_sample: -1 and 1 at the outermost samples.
            centre = self._centre[layer, list(points)]
            ray = axis * nearness / sampling.spacing[layer]
            y, x = (2 * (centre[:, a, None] + ray) / (phase.shape[1 + a] - 1) - 1 for a in (0, 1))
            crossings = np.stack(np.broadcast_arrays(x[:, None, :], y[:, :, None]), axis=-1).reshape(1, -1, n, 2)
            grid = torch.from_numpy(crossings).to(self.device, self.dtype)
            rays = F.grid_sample(phase[:, None], grid.expand(len(phase), -1, -1, -1), "bilinear", align_corners=True)
            total = total + rays.view(len(phase), len(points), n, n)
        return total

    def phase(self, fields: Tensor, geometric: Tensor) -> Tensor:
        """Phase of `pupil_fields` on the branch nearest to `geometric_phase`, rad: unwrapped where diffraction is weak.

        Of no use where the field has zeros in the aperture (D/r0 well above the Fresnel number's square root).
        """
        return geometric + torch.angle(fields * torch.complex(geometric.cos(), -geometric.sin()))

    def _propagate(self, turbulence: Turbulence, pairs: list[tuple[int, int]]) -> Tensor:
        """Field in the aperture's square for each (draw, point), (pairs, n, n)."""
        (source_y, steps_y), (source_x, steps_x) = (axis.select([p for _, p in pairs]) for axis in self._axes)
        wave = source_y[:, :, None] * source_x[:, None, :]
        for layer, transmission in enumerate(turbulence.transmissions):
            grid = int(self.sampling.grids[layer])
            wave = _resized(wave, grid)
            height, width = transmission.shape[1:]
            for one, (draw, point) in zip(wave, pairs, strict=True):
                top, left = self._window[layer, point]
                # One view where slicing makes three: this loop is most of the overhead.
                start = int((draw * height + top) * width + left)
                one *= transmission.as_strided((grid, grid), (width, 1), start)
            absorber = self._absorbers[layer]
            if absorber is not None:
                wave *= absorber
            wave = torch.fft.fft2(wave)
            wave *= steps_y[layer][:, :, None]
            wave *= steps_x[layer][:, None, :]
            wave = torch.fft.ifft2(wave)
        return wave[:, self._middle, self._middle]

    def _complex(self, values: Array | NDArray[np.complex128]) -> Tensor:
        return torch.from_numpy(values).to(self.device, self.dtype.to_complex())

    @property
    def _middle(self) -> slice:
        start = (int(self.sampling.grids[-1]) - self.sampling.across) // 2
        return slice(start, start + self.sampling.across)


def point_grid(path: OpticalPath, rows: int, columns: int, step: float = 1.0) -> Array:
    """Object points of an image's pixels, row by row, (rows * columns, 2), m; `step` Nyquist pixels apart, centred."""
    y, x = ((np.arange(count) - (count - 1) / 2) * step * path.pixel for count in (rows, columns))
    return np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1).reshape(-1, 2)


class _Axis:
    """One axis of the separable source and transfer functions, for every distinct coordinate of the points.

    Args:
        sampling: of the propagation.
        remainder: part of a sample between each point's line of sight and its window, (screens + 1, P).
    """

    def __init__(self, sampling: Sampling, remainder: Array, dtype: torch.dtype, device: torch.device) -> None:
        distinct, self._which = np.unique(remainder, axis=1, return_inverse=True)
        self._source = torch.from_numpy(_source(sampling, distinct[0])).to(device, dtype)
        self._steps = []
        for layer, shift in enumerate(distinct[:-1] - distinct[1:]):
            transfer, f = _transfer(sampling, layer)
            self._steps.append(torch.from_numpy(transfer * np.exp(2j * np.pi * np.outer(shift, f))).to(device, dtype))

    def select(self, points: list[int]) -> tuple[Tensor, list[Tensor]]:
        """Source (B, N) and the transfer function of each step (B, N_l) of the points."""
        which = torch.from_numpy(self._which[points]).to(self._source.device)
        return self._source[which], [step[which] for step in self._steps]


def _transfer(sampling: Sampling, layer: int) -> tuple[NDArray[np.complex128], Array]:
    """exp(-i pi lambda tau f^2) of the step from screen `layer` on, and f in cycles per sample, (N_l,) each."""
    f = frequencies(int(sampling.grids[layer]), 1.0).numpy()
    return np.exp(-1j * np.pi * sampling.chirps[layer + 1] * f**2), f


def _source(sampling: Sampling, remainder: Array) -> NDArray[np.complex128]:
    """The band-limited point source's wave at the first screen, along one axis, (len(remainder), N_0)."""
    grid = sampling.grid
    f = np.arange(grid) / grid - (grid // 2) / grid
    spectrum = _taper(2 * np.abs(f), 0.7, 0.95) * np.exp(-1j * np.pi * sampling.chirps[0] * f**2) / math.sqrt(grid)
    first = int(sampling.grids[0])
    samples = np.arange(first) - (first - 1) / 2 - remainder[:, None]
    return np.asarray(np.exp(2j * np.pi * samples[:, :, None] * f) @ spectrum)


def _still_air(sampling: Sampling) -> NDArray[np.complex128]:
    """What the source gives at the aperture without turbulence, along one axis, (N,)."""
    wave: NDArray[np.complex128] = _source(sampling, np.zeros(1))[0]
    for layer, edge in enumerate(_edges(sampling)):
        wave = _resized(torch.from_numpy(wave), int(sampling.grids[layer]), axes=1).numpy()
        wave = np.fft.ifft(np.fft.fft(wave if edge is None else wave * edge) * _transfer(sampling, layer)[0])
    return np.asarray(wave)


def _edges(sampling: Sampling) -> list[Array | None]:
    """Absorber of each screen along one axis, (N_l,): 1 over the middle 4/5; None where light is far from the edge."""
    lit = sampling.lit * sampling.grid / sampling.grids
    positions = [np.abs(2 * np.arange(n) - n + 1) / n for n in sampling.grids]
    return [_taper(p, 0.8, 1.0) if share > LIT_TO_ABSORB else None for p, share in zip(positions, lit, strict=True)]


def _taper(position: Array, flat: float, end: float) -> Array:
    """1 up to `flat`, falling like a squared cosine to 0 at `end`."""
    return np.asarray(np.cos(np.pi / 2 * np.clip((position - flat) / (end - flat), 0, 1)) ** 2)


def _resized(field: Tensor, grid: int, axes: int = 2) -> Tensor:
    """The field on `grid` samples about its middle along the last axes, zero beyond what it holds."""
    margin = (grid - field.shape[-1]) // 2
    return F.pad(field, (margin,) * 2 * axes) if margin else field
