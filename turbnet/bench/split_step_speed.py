"""A split-step field against the bare FFTs it cannot do without, paired on a subset of its points."""

import time

import numpy as np
import torch

from turbnet.atmosphere.path import OpticalPath
from turbnet.report import Row
from turbnet.simulate.sampling import Sampling
from turbnet.simulate.split_step import SplitStep, point_grid

POINTS, LIMIT = 32, 1.30


def measure(repeats: int, chunk: int = 4) -> list[Row]:
    """Time of a 32 x 32-point, 10-screen, 256^2 field over that of its 20,480 FFTs; allowed: 1.30.

    Both are timed in turn on one chunk of points after the other, `repeats` times, on whatever cores torch uses; the
    ratio of each pair cancels what else the machine is doing, and the median of the pairs is reported.
    """
    path = OpticalPath.from_d_over_r0(3.0)
    split_step = SplitStep(Sampling(path), point_grid(path, POINTS, POINTS))
    air = split_step.draw(torch.Generator().manual_seed(0))
    wave = torch.polar(torch.ones(chunk, 256, 256), torch.rand(chunk, 256, 256))
    pairs = []
    for repeat in range(repeats + 1):
        first = (repeat * chunk) % len(split_step.points)
        start = time.perf_counter()
        split_step.pupil_fields(air, range(first, first + chunk))
        middle = time.perf_counter()
        for _ in range(split_step.sampling.screens):
            torch.fft.ifft2(torch.fft.fft2(wave))
        pairs.append((middle - start, time.perf_counter() - middle))
    field, transforms = np.array(pairs[1:]).T  # the first pair warms up
    ratio = float(np.median(field / transforms))
    seconds = float(np.median(field)) / chunk * len(split_step.points)
    name = "speed: 32 x 32 points, 10 screens, 256^2"
    return [
        Row(f"{name}, time over that of its FFTs (at most {LIMIT:g})", ratio, "", 1.0, LIMIT - 1, ratio <= LIMIT),
        Row(f"{name}, time of the field", seconds, "s"),
    ]
