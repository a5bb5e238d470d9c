"""How fast the simulator is, what memory it takes, and run time against error.

Every time is the least of several, on the threads torch has; the error that belongs to it is that of the same settings
against dense scatter (`turbnet.bench.dense_scatter`). Where a limit is asked for it is on two cores of a server of 2024;
the ratios hold anywhere.
"""

import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from turbnet.atmosphere.path import OpticalPath
from turbnet.bench.dense_scatter import SIZE, decibel, errors, exact_pictures
from turbnet.bench.measurement import Panel, Series
from turbnet.report import Row
from turbnet.simulate.draw import Draw
from turbnet.simulate.simple import WarpBlur
from turbnet.simulate.simulator import Simulator

Track = Callable[[str, int], Iterable[int]]

FRAME_MS = {3.0: 140.0, 1.0: 60.0}
LARGE_S, LARGE_GIB, TRAINING_FPS, BACKWARD, SETUP_S = 7.0, 4.0, 40.0, 3.0, 2.0
TOLERANCES = (25.0, 30.0, 35.0, 40.0, 45.0, 50.0, 55.0)
CURVES = (1.0, 3.0, 4.5)


def least(work: Callable[[int], object], repeats: int) -> float:
    """Seconds of the quickest of so many calls, after one to warm up."""
    work(0)
    times = []
    for number in range(1, repeats + 1):
        start = time.perf_counter()
        work(number)
        times.append(time.perf_counter() - start)
    return min(times)


def _frames(simulator: Simulator | WarpBlur, scene: Tensor) -> Callable[[int], object]:
    """One frame of each scene of a batch, of a new atmosphere each."""
    count = len(scene)

    def work(number: int) -> object:
        return simulator(scene, simulator.draw(range(count * number, count * (number + 1))))

    return work


def _at_most(name: str, value: float, limit: float, unit: str) -> Row:
    return Row(f"{name} (at most {limit:g})", value, unit, limit, 0.0, value <= limit)


def measure(repeats: int, track: Track, large: bool = True) -> list[Row]:
    """Rows of the family; `large` also measures a 3840 x 2160 frame in a process of its own."""
    cores = torch.get_num_threads()
    rows = []
    for strength, limit in FRAME_MS.items():
        start = time.perf_counter()
        simulator = Simulator(OpticalPath.from_d_over_r0(strength), 512, 512)
        setup = time.perf_counter() - start
        scene = torch.rand(1, 1, 3, 512, 512)
        frame = least(_frames(simulator, scene), repeats)
        label = f"512 x 512 colour, D/r0 = {strength:g}, new draw every frame, {cores} threads"
        rows.append(_at_most(label, 1e3 * frame, limit, "ms"))
        rows.append(_at_most(f"{label}: set-up", setup, SETUP_S, "s"))
        rows.append(
            _at_most(f"{label}: forward and backward over forward", _backward(simulator, repeats), BACKWARD, "")
        )
    for strength in (0.5, 1.5, 3.0):
        simulator = Simulator(OpticalPath.from_d_over_r0(strength), 256, 256)
        scene = torch.rand(4, 1, 1, 256, 256)
        batch = least(_frames(simulator, scene), repeats)
        name = f"256 x 256 grey in batches of 4, D/r0 = {strength:g}, {cores} threads (at least {TRAINING_FPS:g})"
        rows.append(Row(name, 4 / batch, "frames/s", TRAINING_FPS, 0.0, 4 / batch >= TRAINING_FPS))
    if large:
        seconds, gib = _large(cores)
        rows.append(
            _at_most(f"3840 x 2160 colour, D/r0 = 3, new draw every frame, {cores} threads", seconds, LARGE_S, "s")
        )
        rows.append(_at_most("3840 x 2160 colour: peak memory of the process", gib, LARGE_GIB, "GiB"))
    return rows + _sound(cores)


def _backward(simulator: Simulator, repeats: int) -> float:
    """Time of forward and backward, to the picture and to the draw, over that of the forward without gradients."""
    scene = torch.rand(1, 1, 3, simulator.height, simulator.width)
    draw = simulator.draw([0])

    def both(_: int) -> None:
        picture, coefficients = scene.clone().requires_grad_(), draw.coefficients.clone().requires_grad_()
        own = Draw(coefficients, draw.stride, draw.margin, draw.q)
        with torch.enable_grad():
            simulator(picture, own).frames.square().mean().backward()

    return least(both, repeats) / least(lambda _: simulator(scene, draw), repeats)


def _large(cores: int) -> tuple[float, float]:
    """Seconds of a 3840 x 2160 frame and GiB of its process, which does nothing else."""
    code = (
        "import time, torch; torch.set_grad_enabled(False); from turbnet.bench.memory import own_peak; "
        f"torch.set_num_threads({cores}); "
        "from turbnet.atmosphere.path import OpticalPath; from turbnet.simulate.simulator import Simulator; "
        "s = Simulator(OpticalPath.from_d_over_r0(3.0), 2160, 3840); x = torch.rand(1, 1, 3, 2160, 3840); t = []\n"
        "for seed in range(3):\n"
        "    start = time.perf_counter(); s(x, s.draw([seed])); t.append(time.perf_counter() - start)\n"
        "print(min(t), own_peak())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    seconds, gib = (float(value) for value in done.stdout.split())
    return seconds, gib


def _sound(cores: int) -> list[Row]:
    """One clip on any number of threads; no number so small that arithmetic on it is slow."""
    simulator = Simulator(OpticalPath.from_d_over_r0(3.0), 256, 256)
    scene = torch.rand(1, 1, 3, 256, 256, generator=torch.Generator().manual_seed(0))
    frames = []
    for threads in (1, max(cores, 2)):
        torch.set_num_threads(threads)
        frames.append(simulator(scene, simulator.draw([5], 2, torch.tensor([2.0, 0.0]))).frames)
    torch.set_num_threads(cores)
    change = float((frames[0] - frames[1]).abs().max())
    tiny = torch.finfo(torch.float32).tiny
    draw = simulator.draw([5])
    held = [draw.coefficients, *simulator.buffers(), frames[0]]
    count = sum(int(((v.abs() < tiny) & (v != 0)).sum()) for v in held if v.is_floating_point())
    return [
        Row(
            "same seed on one thread and on several: largest difference of a clip",
            change,
            "",
            0.0,
            1e-6,
            change <= 1e-6,
        ),
        Row("denormal numbers in filters, draw and frames", float(count), "", 0.0, 0.0, count == 0),
    ]


@dataclass(frozen=True)
class Point:
    """One setting of the run-time-against-error figure."""

    strength: float
    name: str
    milliseconds: float
    psnr: float


def curve(repeats: int, track: Track) -> list[Point]:
    """Run time of a 512 x 512 colour frame against measured error: plans of several tolerances, and warp plus Gaussian."""
    points = []
    for index in track("time against error", len(CURVES)):
        strength = CURVES[index]
        path = OpticalPath.from_d_over_r0(strength)
        # One draw with all modes for all plans; each takes what it uses.
        reference = Simulator(path, SIZE, SIZE, modes=36, margin=0)
        draw = reference.draw([0])
        exact = exact_pictures(draw)
        scene = torch.rand(1, 1, 3, 512, 512)
        for tolerance in TOLERANCES:
            small = Simulator(path, SIZE, SIZE, margin=0, tolerance=tolerance)
            whole = Simulator(path, 512, 512, tolerance=tolerance)
            used = Draw(draw.coefficients[:, :, : small.plan().modes - 1], draw.stride, draw.margin)
            error = float(np.mean(errors(small, used, exact)))
            seconds = least(_frames(whole, scene), repeats)
            points.append(Point(strength, f"plan for {tolerance:g} dB", 1e3 * seconds, decibel(error)))
        warp = WarpBlur(path, 512, 512)
        seconds = least(_frames(warp, scene), repeats)
        points.append(Point(strength, "warp and Gaussian", 1e3 * seconds, float("nan")))
    return points


def panel(points: list[Point]) -> Panel:
    """The figure."""
    series = []
    for strength in CURVES:
        own = [p for p in points if p.strength == strength and np.isfinite(p.psnr)]
        time_ms, psnr = np.array([p.milliseconds for p in own]), np.array([p.psnr for p in own])
        series.append(Series(f"$D/r_0$ = {strength:g}", time_ms, psnr))
    title = "512 x 512 colour frame, new draw every frame"
    return Panel(
        "simulator-time-error",
        title,
        "time of a frame (ms)",
        "PSNR against dense scatter (dB)",
        series,
        ("log", "linear"),
    )


def rows(points: list[Point]) -> list[Row]:
    """The figure's numbers."""
    found = []
    for p in points:
        label = f"time against error, D/r0 = {p.strength:g}, {p.name}"
        found.append(Row(f"{label}: time", p.milliseconds, "ms"))
        if np.isfinite(p.psnr):
            found.append(Row(f"{label}: PSNR", p.psnr, "dB"))
    return found
