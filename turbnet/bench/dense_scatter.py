"""The simulator's pictures against exact dense scatter: the whole PSF of every pixel by the Fourier transform of a pupil.

The reference takes its PSFs from `turbnet.optics.psf` (a matrix DFT of a pupil twice as fine as the simulator's, tilt as a
phase ramp, 47 x 47 pixels), not from the simulator; coefficients are interpolated to every pixel.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from turbnet.atmosphere.path import OpticalPath
from turbnet.data.sources import embedded_paths, load_picture
from turbnet.media.colour import to_linear
from turbnet.optics.psf import psf
from turbnet.optics.pupil import circular, pupil_grid
from turbnet.optics.superposition import scatter
from turbnet.optics.zernike import zernike_basis
from turbnet.report import Row
from turbnet.simulate.draw import Draw
from turbnet.simulate.phase_to_space import released
from turbnet.simulate.plan import TOLERANCE
from turbnet.simulate.psf_basis import psf_samples, tilt_free_psf
from turbnet.simulate.simulator import Simulator
from turbnet.simulate.tilt import upsample

Track = Callable[[str, int], Iterable[int]]

STRENGTHS = (0.5, 1.0, 2.0, 3.0, 4.5, 6.0)
SIZE, EDGE, WINDOW, POINTS = 120, 24, 47, 32
SEEDS = (0, 1)
PICTURES = ("astronaut.png", "coffee.png", "camera.png", "grass.png")


@lru_cache
def scenes(size: int = SIZE) -> tuple[Tensor, ...]:
    """Crops of pictures inside scikit-image, (H, W), linear."""
    known = {path.name: path for split in ("train", "test") for path in embedded_paths(split)}
    crops = [load_picture(known[name])[60 : 60 + size, 150 : 150 + size, 0].copy() for name in PICTURES]
    return tuple(to_linear(torch.from_numpy(crop)) for crop in crops)


def whole_psfs(draw: Draw, height: int, width: int, points: int = POINTS, window: int = WINDOW) -> Tensor:
    """PSF of every pixel of a draw without margin, (H, W, window, window)."""
    fine = upsample(draw.coefficients[0], draw.stride, height, width)[0].flatten(1).T
    x, y = pupil_grid(points)
    modes = zernike_basis(range(2, fine.shape[1] + 2), np.hypot(x, y), np.arctan2(y, x))
    pupil = torch.from_numpy(circular(points, subsamples=16)).float()
    basis = torch.from_numpy(modes).float()
    parts = [psf(torch.einsum("pn,nyx->pyx", chunk, basis), pupil, window) for chunk in fine.split(512)]
    return torch.cat(parts).view(height, width, window, window)


def exact_pictures(draw: Draw) -> list[Tensor]:
    """The scenes through a draw, a uniform scene kept uniform, (H, W) each."""
    whole = whole_psfs(draw, SIZE, SIZE)
    uniform = scatter(torch.ones(SIZE, SIZE), whole)
    return [scatter(scene, whole) / uniform for scene in scenes()]


def errors(simulator: Simulator, draw: Draw, exact: Iterable[Tensor]) -> list[float]:
    """Mean-square error of each scene, away from the border."""
    inner = (slice(EDGE, -EDGE), slice(EDGE, -EDGE))
    seen = [simulator(scene[None, None, None], draw).frames[0, 0, 0] for scene in scenes()]
    return [float((a - b)[inner].square().mean()) for a, b in zip(seen, exact, strict=True)]


def decibel(error: float) -> float:
    """PSNR of a mean-square error, peak 1."""
    return float(-10 * np.log10(error))


def measure(track: Track, strengths: Sequence[float] = STRENGTHS, seeds: Sequence[int] = SEEDS) -> list[Row]:
    """Rows of the family; `track(name, count)` yields once a strength and may show progress."""
    rows = []
    for index in track("pictures", len(strengths)):
        strength = strengths[index]
        simulator = Simulator(OpticalPath.from_d_over_r0(strength), SIZE, SIZE, margin=0)
        found = []
        for seed in seeds:
            draw = simulator.draw([seed])
            found += errors(simulator, draw, exact_pictures(draw))
        name = f"picture, D/r0 = {strength:g}: PSNR against dense scatter"
        value = decibel(float(np.mean(found)))
        what = f"{len(PICTURES)} pictures, {len(seeds)} draws"
        rows.append(
            Row(f"{name}, {what} together (at least {TOLERANCE:g})", value, "dB", TOLERANCE, 0.0, value >= TOLERANCE)
        )
        rows.append(Row(f"{name}, the worst of them", decibel(max(found)), "dB"))
        rows.append(Row(f"picture, D/r0 = {strength:g}: PSNR that the plan expected", simulator.plan().expected, "dB"))
    return rows + _limits() + _phase_to_space()


def _limits() -> list[Row]:
    """No turbulence, and the energy of points."""
    scene = torch.stack(scenes()[:3])[None, None]
    still = Simulator(OpticalPath.from_d_over_r0(0.0), SIZE, SIZE)
    change = float((still(scene, still.draw([0])).frames - scene).abs().max())
    rows = [Row("no turbulence: largest change of the picture", change, "", 0.0, 1e-6, change <= 1e-6)]
    for strength in (1.0, 3.0, 6.0):
        simulator = Simulator(OpticalPath.from_d_over_r0(strength), SIZE, SIZE, uniform=False)
        points = torch.zeros(1, 1, 1, SIZE, SIZE)
        points[..., SIZE // 2 - 8 : SIZE // 2 + 9 : 8, SIZE // 2 - 8 : SIZE // 2 + 9 : 8] = 1.0
        frames = simulator(points, simulator.draw(range(4))).frames
        worst = float((frames.sum((2, 3, 4)) / points.sum() - 1).abs().max())
        rows.append(
            Row(f"energy of points, D/r0 = {strength:g}: largest relative change", worst, "", 0.0, 1e-4, worst <= 1e-4)
        )
    return rows


def _phase_to_space() -> list[Row]:
    rows = []
    for strength in (0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0):
        high = psf_samples(strength, strength)
        exact = tilt_free_psf(high).flatten(1)
        size = exact.norm(dim=1)
        learned = float(((released()(high).flatten(1) - exact).norm(dim=1) / size).median())
        mean = float(((exact.mean(0) - exact).norm(dim=1) / size).median())
        name = f"phase-to-space, D/r0 = {strength:g}: median relative L2 error of the PSF"
        judged = (0.0, 0.05, learned <= 0.05) if strength <= 4 else (None, None, None)
        rows.append(Row(name, learned, "", *judged))
        rows.append(Row(f"{name}, over the mean PSF's (below 1)", learned / mean, "", 1.0, 0.0, learned < mean))
    return rows
