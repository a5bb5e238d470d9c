"""A split-step field against the bare FFTs it cannot do without, paired on a subset of its points."""

import time

import numpy as np
import torch

from turbnet.atmosphere.path import OpticalPath
from turbnet.report import Row
from turbnet.simulate.sampling import Sampling
from turbnet.simulate.split_step import SplitStep, point_grid

POINTS, LIMIT = 32, 1.30


def measure(repeats: int, chunk: int = 8) -> list[Row]:
    """Time of a 32 x 32-point, 10-screen, 256^2 field over that of its 20,480 FFTs of 256^2; allowed: 1.30.

    Both are timed in turn on one chunk of points after the other, `repeats` times, on the one thread that the bench
    sets (points and FFTs alike are independent of each other, so cores multiply both); the ratio of each pair cancels
    what else the machine is doing, and the median of the pairs is reported. The FFTs run two at a time, which is when
    they are quickest. The field itself runs on smaller grids where that loses nothing (see
    `turbnet.simulate.sampling.Sampling.grids`); a second row gives its time over that of just the FFTs it runs.
    """
    path = OpticalPath.from_d_over_r0(3.0)
    split_step = SplitStep(Sampling(path), point_grid(path, POINTS, POINTS))
    air = split_step.draw(torch.Generator().manual_seed(0))
    sizes = [int(n) for n in split_step.sampling.grids]
    times = []
    for repeat in range(repeats + 1):
        first = (repeat * chunk) % len(split_step.points)
        start = time.perf_counter()
        split_step.pupil_fields(air, range(first, first + chunk))
        times.append((time.perf_counter() - start, _transforms([256] * len(sizes), chunk), _transforms(sizes, chunk)))
    field, whole, own = np.array(times[1:]).T  # the first round warms up
    ratio, own_ratio = float(np.median(field / whole)), float(np.median(field / own))
    seconds = float(np.median(field)) / chunk * len(split_step.points)
    name = "speed: 32 x 32 points, 10 screens, 256^2, one core"
    return [
        Row(f"{name}, time over that of its FFTs (at most {LIMIT:g})", ratio, "", 1.0, LIMIT - 1, ratio <= LIMIT),
        Row(f"{name}, time over that of the smaller FFTs it runs", own_ratio),
        Row(f"{name}, time of the field", seconds, "s"),
    ]


def _transforms(sizes: list[int], count: int) -> float:
    """Seconds that `count` forward and inverse FFTs of each size take."""
    total = 0.0
    for size in sizes:
        waves = torch.polar(torch.ones(2, size, size), torch.rand(2, size, size))
        start = time.perf_counter()
        for _ in range(count // 2):
            torch.fft.ifft2(torch.fft.fft2(waves))
        total += time.perf_counter() - start
    return total
