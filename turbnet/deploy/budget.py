"""Which network, window and views to restore with, for a time or for a quality: points of a measured curve.

`turbnet/weights/curve.json` (tools/measure_curve.py writes it) holds, for each released network, several windows and views,
the gain in PSNR over the input on the benchmark's still scenes at D/r0 = 3, and the time a million pixels of one frame took.
How much faster or slower a machine is, one run of the cheapest point tells.
"""

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources

import numpy as np

from turbnet.deploy.restore import tiling_of, window_overlap
from turbnet.deploy.session import Model
from turbnet.deploy.views import Views
from turbnet.deploy.weights import find_model
from turbnet.errors import InputError, check_range

CURVE = "curve.json"
_PROBE = 128  # side of the frames that tell how fast a machine is, pixels


@dataclass(frozen=True)
class Setting:
    """A point of the curve.

    Attributes:
        model: name of a released network.
        window: frames restored together.
        gain: over the input, dB.
        seconds: of a million pixels of one frame, where it was measured.
        views: of every window, see `turbnet.deploy.views`.
    """

    model: str
    window: int
    gain: float
    seconds: float
    views: int = 1


def curve() -> list[Setting]:
    """The points that no other point beats in both, cheapest first."""
    document = json.loads((resources.files("turbnet.weights") / CURVE).read_text())
    points = sorted((Setting(**point) for point in document["points"]), key=lambda point: (point.seconds, -point.gain))
    best: list[Setting] = []
    for point in points:
        if not best or point.gain > best[-1].gain:
            best.append(point)
    return best


def for_quality(gain: float) -> Setting:
    """The cheapest point that gains so much, dB.

    Raises:
        InputError: none does; says which gains most.
    """
    check_range("quality", gain, 0.0, 100.0, "dB")
    points = curve()
    for point in points:
        if point.gain >= gain:
            return point
    raise InputError(f"--quality {gain:g}: the most is {points[-1].gain:.1f} dB ({points[-1].model})")


def for_budget(
    milliseconds: float,
    height: int,
    width: int,
    threads: int | None = None,
    measure: Callable[[Setting, int | None], float] | None = None,
) -> Setting:
    """The best point that restores a frame of this size within so many milliseconds on this machine.

    Args:
        measure: seconds that a million pixels of a frame take here at a point; None: one is restored.

    Raises:
        InputError: none does; says what the fastest needs.
    """
    check_range("budget-ms", milliseconds, 0.0, 1e7, "ms")
    points = curve()
    slower = (measure or seconds_here)(points[0], threads) / points[0].seconds
    tiling = tiling_of(Model.load(find_model(points[0].model), threads))
    rows, columns = tiling.axes(height, width)
    pixels = rows.length * len(rows.starts) * columns.length * len(columns.starts)
    needs = [1e3 * slower * point.seconds * pixels / 1e6 for point in points]
    within = [point for point, need in zip(points, needs, strict=True) if need <= milliseconds]
    if not within:
        raise InputError(
            f"--budget-ms {milliseconds:g}: frames of {width}x{height} take {needs[0]:.0f} ms here at the least "
            f"({points[0].model}); crop, or shrink the clip"
        )
    return within[-1]


def seconds_here(point: Setting, threads: int | None = None) -> float:
    """What a million pixels of one frame take on this machine, s: the better of two runs after a first."""
    network = Views(Model.load(find_model(point.model), threads), point.views)
    frames = np.random.default_rng(0).random((1, point.window, 3, _PROBE, _PROBE), dtype=np.float32)
    times = []
    for _ in range(3):
        begun = time.perf_counter()
        network(frames)
        times.append(time.perf_counter() - begun)
    # Windows share frames, which are restored more than once.
    own = point.window - window_overlap(point.window)
    return min(times[1:]) / own / _PROBE**2 * 1e6
