"""`turbnet bench restoration`: any method, model or command over the frozen benchmark (`turbnet.bench.suite`).

Every entrant runs in a process of its own, which also tells its peak memory; an outside command once a clip, on FFV1 files.
PSNR and SSIM are means over the frames of a clip, 8 pixels of border left out; text is read by the built-in recogniser. An
interval is that of the mean over scenes, 1.96 standard errors each way. The entrant `settled` is the clean picture in the
mean geometry of the clip's frames: without fault but for what they cannot tell.
"""

import multiprocessing
import multiprocessing.connection
import shlex
import shutil
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from turbnet.bench.memory import own_peak, run_measured
from turbnet.bench.suite import KINDS, SUITES, Clip, Frames, Restore, make_clip, names
from turbnet.errors import InputError
from turbnet.media.atomic import atomic_path
from turbnet.progress import progress_bar
from turbnet.report import Report, Row

BORDER = 8


@dataclass(frozen=True)
class Entrant:
    """What restores: nothing, the settled scene, a classical method, a model (name or file), a command with {in}, {out}."""

    kind: str
    name: str


@dataclass
class Score:
    """Of one entrant on one clip of some length; what does not apply is NaN."""

    kind: str
    strength: float
    frames: int
    psnr: float
    ssim: float
    psnr_settled: float = float("nan")
    psnr_moving: float = float("nan")
    psnr_still: float = float("nan")
    cer: float = float("nan")
    seconds: float = 0.0


@dataclass
class Result:
    """All scores of one entrant and its peak memory, GiB."""

    entrant: Entrant
    scores: list[Score] = field(default_factory=list)
    memory: float = 0.0


def entrants(methods: Sequence[str], models: Sequence[str], commands: Sequence[str]) -> list[Entrant]:
    """Those asked for, or else all classical methods and all released models; input and settled scene always come first.

    Raises:
        InputError: an unknown method or model, a command without {in} or {out}.
    """
    from turbnet.classical.methods import METHODS, find_method
    from turbnet.deploy.weights import find_model, released_models

    if not methods and not models and not commands:
        methods, models = list(METHODS), list(released_models())
    for name in methods:
        find_method(name)
    for name in models:
        find_model(name)
    for command in commands:
        if "{in}" not in command or "{out}" not in command:
            raise InputError(f"--external {command!r}: say where the files go with {{in}} and {{out}}")
    kinds = (("method", methods), ("model", models), ("external", commands))
    always = [Entrant("input", "input"), Entrant("settled", "settled")]
    return [*always, *(Entrant(kind, name) for kind, those in kinds for name in those)]


def run(wanted: Sequence[Entrant], suite: str = "standard", quiet: bool = False) -> list[Result]:
    """Every entrant over every clip and length of a suite.

    Raises:
        InputError: an entrant that fails, with what it said.
    """
    results = []
    context = multiprocessing.get_context("spawn")
    with progress_bar(quiet) as progress:
        task = progress.add_task("restoring", total=len(wanted) * len(names(SUITES[suite])))
        for entrant in wanted:
            receiver, sender = context.Pipe(duplex=False)
            process = context.Process(target=_work, args=(entrant, suite, sender), daemon=True)
            process.start()
            sender.close()
            try:
                while not isinstance(message := receiver.recv(), Result):
                    if isinstance(message, str):
                        raise InputError(f"{entrant.name}: {message}")
                    progress.advance(task)
            except EOFError as error:
                raise InputError(f"{entrant.name}: its process ended without a result") from error
            finally:
                process.join(timeout=5)
            results.append(message)
    return results


def _work(entrant: Entrant, suite: str, sender: "multiprocessing.connection.Connection") -> None:
    """In the entrant's process: a number for each clip done, then the result, or what went wrong."""
    try:
        peaks: list[float] = []
        restore, result = _restorer(entrant, peaks), Result(entrant)
        for kind, scene, strength in names(SUITES[suite]):
            whole = make_clip(kind, scene, strength, max(SUITES[suite].lengths))
            result.scores += [_score(restore, whole.first(length)) for length in SUITES[suite].lengths]
            sender.send(len(result.scores))
        result.memory = max(peaks) if peaks else own_peak()
        sender.send(result)
    except InputError as error:
        sender.send(str(error))


def _restorer(entrant: Entrant, peaks: list[float]) -> Restore:
    """What restores; of an outside command the memory, GiB, is added to `peaks` each time."""
    if entrant.kind == "input":
        return lambda clip: clip.frames
    if entrant.kind == "settled":
        return Clip.settled
    if entrant.kind == "external":
        return lambda clip: _by_command(entrant.name, clip.frames, peaks)
    from turbnet.deploy.method import ClassicalMethod
    from turbnet.deploy.restore import restore_array
    from turbnet.deploy.session import Model
    from turbnet.deploy.weights import find_model

    model: Model | ClassicalMethod
    model = ClassicalMethod(entrant.name) if entrant.kind == "method" else Model.load(find_model(entrant.name))

    def restore(clip: Clip) -> Frames:
        if entrant.kind == "method" and len(clip.frames) == 1:
            return clip.frames  # a classical method needs more than one: it leaves a still as it is
        return restore_array(clip.frames, model)

    return restore


def _by_command(command: str, frames: Frames, peaks: list[float]) -> Frames:
    from turbnet.media.clip import read_clip, write_clip

    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "in.mkv", Path(folder) / "out.mkv"
        write_clip(source, frames)
        parts = [part.replace("{in}", str(source)).replace("{out}", str(target)) for part in shlex.split(command)]
        if shutil.which(parts[0]) is None:
            raise InputError(f"cannot be run: there is no program {parts[0]}")
        done, peak = run_measured(parts, capture_output=True, text=True, check=False)
        peaks.append(peak)
        if done.returncode:
            said = (done.stderr or done.stdout).strip().splitlines()
            raise InputError(f"ended with {done.returncode}: {said[-1] if said else 'said nothing'}")
        restored, _ = read_clip(target)
    if restored.shape != frames.shape:
        raise InputError(f"gave frames {restored.shape} for {frames.shape}")
    return restored


def _score(restore: Restore, clip: Clip) -> Score:
    from turbnet.metrics.evaluation import text_scorer
    from turbnet.metrics.fidelity import psnr, ssim
    from turbnet.metrics.text import TextScore

    start = time.perf_counter()
    restored = restore(clip)
    seconds = time.perf_counter() - start
    score = Score(
        clip.kind,
        clip.strength,
        len(clip.frames),
        float(np.mean(psnr(restored, clip.target, BORDER))),
        float(np.mean(ssim(restored, clip.target, BORDER))),
        seconds=seconds,
    )
    if clip.kind != "dynamic" and len(clip.frames) > 1:
        score.psnr_settled = float(np.mean(psnr(restored, clip.settled(), BORDER)))
    if clip.kind == "dynamic":
        score.psnr_moving, score.psnr_still = psnr_moving(restored, clip)
    if clip.boxes:
        middle = restored[len(restored) // 2]
        read: TextScore = text_scorer("builtin")(middle, clip.boxes)
        score.cer = read.character_error_rate
    return score


def psnr_moving(restored: Frames, clip: Clip) -> tuple[float, float]:
    """PSNR where something moves and where nothing does, dB, over all frames at once."""
    inner = (slice(None), slice(BORDER, -BORDER), slice(BORDER, -BORDER))
    error, moving = ((restored - clip.target) ** 2).mean(-1)[inner], clip.moving[inner]
    return float(-10 * np.log10(error[moving].mean())), float(-10 * np.log10(error[~moving].mean()))


def _mean(values: Iterable[float]) -> tuple[float, float]:
    """Mean over scenes and half its 95 % interval."""
    found = np.array([v for v in values if np.isfinite(v)])
    if not len(found):
        return float("nan"), float("nan")
    half = 1.96 * found.std(ddof=1) / np.sqrt(len(found)) if len(found) > 1 else float("nan")
    return float(found.mean()), float(half)


FIGURES = {
    "PSNR": ("psnr", "dB"),
    "SSIM": ("ssim", ""),
    "PSNR in the clip's mean geometry": ("psnr_settled", "dB"),
    "PSNR where it moves": ("psnr_moving", "dB"),
    "PSNR where it does not": ("psnr_still", "dB"),
    "character error rate": ("cer", ""),
}


def report(results: Sequence[Result]) -> Report:
    """Means over scenes and their intervals, times, memory, as rows."""
    found = Report()
    for result in results:
        name = result.entrant.name
        cells = sorted({(KINDS.index(s.kind), s.strength, s.frames) for s in result.scores})
        for kind, strength, frames in cells:
            own = [s for s in result.scores if (KINDS.index(s.kind), s.strength, s.frames) == (kind, strength, frames)]
            label = f"{name}, {KINDS[kind]}, D/r0 = {strength:g}, {frames} frames"
            for figure, (attribute, unit) in FIGURES.items():
                mean, half = _mean(getattr(s, attribute) for s in own)
                if np.isfinite(mean):
                    found.add(Row(f"{label}: {figure}", mean, unit))
                    if np.isfinite(half):
                        found.add(Row(f"{label}: {figure}, half its 95 % interval", half, unit))
        frames = sum(s.frames for s in result.scores)
        found.add(Row(f"{name}: time a frame", 1e3 * sum(s.seconds for s in result.scores) / frames, "ms"))
        found.add(Row(f"{name}: peak memory", result.memory, "GiB"))
    return found


def table(results: Sequence[Result]) -> str:
    """One Markdown table a kind and length: strengths across, an entrant a line."""
    parts = []
    for kind in KINDS:
        for length in sorted({s.frames for s in results[0].scores}):
            own = [s for s in results[0].scores if s.kind == kind and s.frames == length]
            strengths = sorted({s.strength for s in own})
            figures: tuple[str, ...] = {
                "static": ("psnr", "ssim"),
                "dynamic": ("psnr_moving", "psnr_still"),
                "text": ("psnr", "cer"),
            }[kind]
            if kind == "static" and length > 1:
                figures = ("psnr", "ssim", "psnr_settled")
            heads = [f"{_short(f)}, D/r0 = {s:g}" for s in strengths for f in figures]
            lines = [f"| {kind}, {length} frame{'s' if length > 1 else ''} | " + " | ".join(heads) + " |"]
            lines.append("|---" * (len(heads) + 1) + "|")
            for result in results:
                cells = [_cell(result, kind, length, s, f) for s in strengths for f in figures]
                lines.append(f"| {result.entrant.name} | " + " | ".join(cells) + " |")
            parts.append("\n".join(lines))
    lines = ["| entrant | time a frame | peak memory |", "|---|---|---|"]
    for result in results:
        time_ms = 1e3 * sum(s.seconds for s in result.scores) / sum(s.frames for s in result.scores)
        lines.append(f"| {result.entrant.name} | {time_ms:.0f} ms | {result.memory:.2f} GiB |")
    return "\n\n".join([*parts, "\n".join(lines)])


def _short(figure: str) -> str:
    return {
        "psnr": "PSNR",
        "ssim": "SSIM",
        "psnr_settled": "settled",
        "psnr_moving": "moving",
        "psnr_still": "rest",
        "cer": "CER",
    }[figure]


def _cell(result: Result, kind: str, length: int, strength: float, figure: str) -> str:
    own = [s for s in result.scores if (s.kind, s.frames, s.strength) == (kind, length, strength)]
    mean, half = _mean(getattr(s, figure) for s in own)
    digits = 1 if figure.startswith("psnr") else 2
    return f"{mean:.{digits}f}" + (f" ± {half:.{digits}f}" if np.isfinite(half) else "")


def draw_figure(results: Sequence[Result], path: Path) -> None:
    """Time of a frame against PSNR of still scenes, the longest clips of the middle strength."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    strengths = sorted({s.strength for s in results[0].scores})
    middle, longest = strengths[len(strengths) // 2], max(s.frames for s in results[0].scores)
    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.subplots()
    for result in results:
        own = [s for s in result.scores if (s.kind, s.strength, s.frames) == ("static", middle, longest)]
        mean, half = _mean(s.psnr for s in own)
        milliseconds = 1e3 * sum(s.seconds for s in own) / sum(s.frames for s in own)
        if result.entrant.kind in ("input", "settled"):
            axes.axhline(mean, color="grey", linewidth=0.8, linestyle="-" if result.entrant.kind == "input" else ":")
            continue
        axes.errorbar([milliseconds], [mean], [np.nan_to_num(half)], fmt="o", markersize=4, elinewidth=0.8)
        axes.annotate(result.entrant.name, (milliseconds, mean), (5, 3), textcoords="offset points", fontsize=7)
    title = f"still scenes, D/r0 = {middle:g}, {longest} frames; grey: the input, dotted: settled"
    axes.set(xscale="log", xlabel="time of a frame (ms)", ylabel="PSNR (dB)", title=title)
    axes.title.set_fontsize(9)
    axes.grid(alpha=0.3)
    with atomic_path(path) as temporary:
        FigureCanvasAgg(figure).print_png(temporary, metadata={"Software": None})
