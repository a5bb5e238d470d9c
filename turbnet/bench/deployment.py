"""`turbnet bench deployment`: what restoring costs a user, and what `--skip` saves and loses.

Clips are made from seeds on pictures that come with scikit-image, 256 x 256 pixels: a still camera through which an ellipse
of another picture passes, in clear air and at D/r0 = 2. Every time is the least of a few runs on frames in memory, restored
as `turbnet restore` does; ratios are of runs that take turns, so that what else the machine does hits both.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from turbnet.atmosphere.path import OpticalPath
from turbnet.bench import precision
from turbnet.bench.memory import run_measured
from turbnet.bench.suite import Frames
from turbnet.data.sources import embedded_paths, load_picture
from turbnet.deploy.restore import restore_array, window_of
from turbnet.deploy.session import Model
from turbnet.deploy.skipping import Skipped
from turbnet.deploy.weights import find_model
from turbnet.errors import InputError
from turbnet.media.clip import write_clip
from turbnet.media.colour import to_linear, to_srgb
from turbnet.metrics.fidelity import psnr
from turbnet.progress import progress_bar
from turbnet.report import Report, Row
from turbnet.simulate.sensor import Sensor
from turbnet.simulate.simulator import Simulator

SIZE, STRENGTH, BORDER = 256, 2.0, 8
FAMILIES = ("speed", "skip", "precision", "start", "memory")


@dataclass(frozen=True)
class Scene:
    """What a still camera saw, and the clean clip, (T, H, W, 3)."""

    frames: Frames
    clean: Frames


def run(models: Sequence[str], families: Sequence[str] = FAMILIES, quick: bool = False, quiet: bool = False) -> Report:
    """Measure released networks or ONNX files.

    Args:
        families: of FAMILIES.
        quick: short clips, and no memory at 1920 x 1080, which takes minutes.

    Raises:
        InputError: there is no such model.
    """
    files = {name: find_model(name) for name in models}
    report = Report()
    work = [(name, family) for name in models for family in families if not (quick and family == "memory")]
    with progress_bar(quiet) as progress:
        for name, family in progress.track(work, description="restoring"):
            for row in _MEASURES[family](files[name], quick):
                report.add(Row(f"{name}: {row.name}", row.value, row.unit))
    return report


def table(report: Report) -> str:
    """The rows as Markdown."""
    values = [row.value if isinstance(row.value, str) else f"{row.value:.3g}" for row in report.rows]
    lines = [f"| {row.name} | {value} {row.unit} |" for row, value in zip(report.rows, values, strict=True)]
    return "\n".join(["| figure | value |", "|---|---|", *lines])


def static_camera(frames: int, strength: float) -> Scene:
    """A camera that does not move: an ellipse crosses in the first half of the clip; strength is D/r0, 0 for clear air."""
    ground, other = (load_picture(path)[:SIZE, :SIZE] for path in embedded_paths("test")[:2])
    sprite = other[: SIZE // 4, : SIZE // 4]
    y, x = np.mgrid[: SIZE // 4, : SIZE // 4] - SIZE / 8 + 0.5
    share = np.clip(SIZE / 8 - np.hypot(x, y), 0, 1)[..., None].astype(np.float32)
    clean = np.repeat(ground[None], frames, 0).copy()
    for frame in range(frames // 2):
        left = round(frame * (SIZE * 3 / 4) / max(frames // 2 - 1, 1))
        place = np.s_[frame, SIZE // 2 : SIZE * 3 // 4, left : left + SIZE // 4]
        clean[place] = clean[place] * (1 - share) + sprite * share
    return Scene(through_air(clean, strength), clean)


@torch.no_grad()
def through_air(clean_THWC: Frames, strength: float) -> Frames:
    """A clean clip as a camera sees it through independent air, 8 bits; strength is D/r0, 0 for clear air and no noise."""
    seen = to_linear(torch.from_numpy(clean_THWC).permute(0, 3, 1, 2))[None]
    if strength:
        frames, height, width = clean_THWC.shape[:3]
        simulator = Simulator(OpticalPath.from_d_over_r0(strength), height, width, sensor=Sensor(20_000, 0.005))
        draw = simulator.draw([1], frames, None).centred()
        # All at once would need much memory.
        parts = [simulator(seen[:, k : k + 8], draw.moments(k, k + 8), k).frames for k in range(0, frames, 8)]
        seen = torch.cat(parts, dim=1)
    shown: Frames = ((to_srgb(seen[0].clamp(0, 1)) * 255).round() / 255).permute(0, 2, 3, 1).numpy()
    return shown


def restored(frames_THWC: Frames, model: Model, skipped: Skipped | None = None) -> tuple[Frames, float]:
    """The clip restored window by window, and how long that took, s."""
    begun = time.perf_counter()
    return restore_array(frames_THWC, model, skipped), time.perf_counter() - begun


def _speed(file: Path, quick: bool) -> list[Row]:
    model, rows = Model.load(file), []
    count = window_of(model)
    for side in (256,) if quick else (256, 512):
        # Time does not depend on what the frames show; noise has no denormal numbers.
        frames = np.random.default_rng(0).random((count, side, side, 3), dtype=np.float32)
        best = min(restored(frames, model)[1] for _ in range(1 if quick else 3))
        rows.append(Row(f"{side} x {side}, clip of {count}", count / best, "frames a second"))
    return rows


def _skip(file: Path, quick: bool) -> list[Row]:
    model, rows = Model.load(file), []
    count = 2 * window_of(model) if quick else 5 * window_of(model)
    for name, strength in (("still camera", STRENGTH), ("clear air", 0.0)):
        scene, ratios = static_camera(count, strength), []
        for _ in range(1 if quick else 2):
            skipped = Skipped()
            whole, seconds = restored(scene.frames, model)
            spared, fewer = restored(scene.frames, model, skipped)
            ratios.append(seconds / fewer)
        rows.append(Row(f"--skip, {name}: faster by", float(np.median(ratios)), "x"))
        rows.append(Row(f"--skip, {name}: tiles skipped", skipped.saved))
        if strength:
            scores = [float(psnr(clip, scene.clean, BORDER).mean()) for clip in (scene.frames, whole, spared)]
            for what, score in zip(("input", "all restored", "with --skip"), scores, strict=True):
                rows.append(Row(f"--skip, {name}: PSNR, {what}", score, "dB"))
        else:
            alike = float(-10 * np.log10(np.mean((spared - scene.frames) ** 2) + 1e-10))
            rows.append(Row(f"--skip, {name}: likeness to the input, at most 100", alike, "dB"))
    # Where nothing can be skipped, looking costs something.
    moving = np.random.default_rng(1).random((window_of(model), SIZE, SIZE, 3), dtype=np.float32)
    pairs = [(restored(moving, model)[1], restored(moving, model, Skipped())[1]) for _ in range(1 if quick else 4)]
    slower = min(looked for _, looked in pairs) / min(plain for plain, _ in pairs)
    rows.append(Row("--skip, nothing to skip: time", slower, "of that without"))
    return rows


def _start(file: Path, quick: bool) -> list[Row]:
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "in.png"
        write_clip(source, np.full((1, 64, 64, 3), 0.5, np.float32))
        times = []
        for _ in range(1 if quick else 3):
            begun = time.perf_counter()
            subprocess.run(_command(file, source, Path(folder) / "out.png"), check=True)
            times.append(time.perf_counter() - begun)
    return [Row("turbnet restore of one small picture, from start to end", min(times), "s")]


def _memory(file: Path, quick: bool) -> list[Row]:
    count = window_of(Model.load(file)) + 1
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "in.mkv"
        picture = load_picture(embedded_paths("test")[0])
        large = np.tile(picture, (1080 // picture.shape[0] + 1, 1920 // picture.shape[1] + 1, 1))[:1080, :1920]
        write_clip(source, np.broadcast_to(large, (count, *large.shape)))
        done, peak = run_measured(_command(file, source, Path(folder) / "out.mkv"))
    if done.returncode:
        raise InputError(f"{file}: turbnet restore failed on 1920 x 1080")
    return [Row(f"1920 x 1080, {count} frames: peak memory", peak, "GiB")]


def _command(file: Path, source: Path, target: Path) -> list[str]:
    options = [str(source), "-o", str(target), "--model", str(file), "--quiet"]
    return [sys.executable, "-m", "turbnet", "restore", *options]


_MEASURES: dict[str, Callable[[Path, bool], list[Row]]] = {
    "speed": _speed,
    "skip": _skip,
    "precision": precision.measure,
    "start": _start,
    "memory": _memory,
}
