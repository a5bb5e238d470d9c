"""A split-step field against the bare FFTs it cannot do without, paired on a subset of its points."""

import time
from collections.abc import Callable

import numpy as np
import torch

from turbnet.atmosphere.path import OpticalPath
from turbnet.report import Row
from turbnet.simulate.parallel import on_all_cores
from turbnet.simulate.sampling import Sampling
from turbnet.simulate.split_step import SplitStep, point_grid

POINTS, LIMIT = 32, 1.30


def measure(repeats: int, cores: int, chunk: int = 4) -> list[Row]:
    """Time of a 32 x 32-point, 10-screen, 256^2 field over that of its 20,480 FFTs of 256^2; allowed: 1.30.

    Both are timed in turn on a few chunks of points for each core, `repeats` times, points and FFTs alike on all cores at
    once, one thread each; the ratio of each pair cancels what else the machine is doing, and the median of the pairs is
    reported. The FFTs run two at a time, which is when they are quickest. The field itself runs on smaller grids where
    that loses nothing (see `turbnet.simulate.sampling.Sampling.grids`); a second row gives its time over that of just the
    FFTs it runs.
    """
    path = OpticalPath.from_d_over_r0(3.0)
    split_step = SplitStep(Sampling(path), point_grid(path, POINTS, POINTS))
    air = split_step.draw(torch.Generator().manual_seed(0))
    own = [int(n) for n in split_step.sampling.grids]
    waves = {size: torch.polar(torch.ones(2, size, size), torch.rand(2, size, size)) for size in {256, *own}}
    pieces = range(0, 8 * cores * chunk, chunk)

    def field(start: int) -> None:
        split_step.pupil_fields(air, range(start, start + chunk))

    def transforms(sizes: list[int]) -> None:
        for size in sizes:
            for _ in range(chunk // 2):
                torch.fft.ifft2(torch.fft.fft2(waves[size]))

    def seconds(work: Callable[[int], None]) -> float:
        start = time.perf_counter()
        for _ in on_all_cores(work, pieces, cores):
            pass
        return time.perf_counter() - start

    times = [
        (seconds(field), seconds(lambda _: transforms([256] * len(own))), seconds(lambda _: transforms(own)))
        for _ in range(repeats + 1)
    ]
    of_field, whole, smaller = np.array(times[1:]).T  # the first round warms up
    ratio, own_ratio = float(np.median(of_field / whole)), float(np.median(of_field / smaller))
    total = float(np.median(of_field)) / (len(pieces) * chunk) * len(split_step.points)
    name = f"speed: 32 x 32 points, 10 screens, 256^2, {cores} core{'s' if cores > 1 else ''}"
    return [
        Row(f"{name}, time over that of its FFTs (at most {LIMIT:g})", ratio, "", 1.0, LIMIT - 1, ratio <= LIMIT),
        Row(f"{name}, time over that of the smaller FFTs it runs", own_ratio),
        Row(f"{name}, time of the field", total, "s"),
    ]
