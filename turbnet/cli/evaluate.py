"""`turbnet evaluate`: PSNR and SSIM of a restored clip against its reference, beside those of its input."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from turbnet.cli.typed import run_typed
from turbnet.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.progress import Progress
    from rich.table import Table

    from turbnet.media.clip import ClipReader
    from turbnet.report import Row

    Frame = NDArray[np.float32]


def main(arguments: list[str]) -> int:
    return run_typed(evaluate, arguments, "evaluate")


def evaluate(
    restored: Annotated[Path, typer.Option(metavar="CLIP", help="The clip to score.")],
    reference: Annotated[Path, typer.Option(metavar="CLIP", help="What it should be: a clip or one still.")],
    input: Annotated[Path | None, typer.Option(metavar="CLIP", help="What it was restored from: scored too.")] = None,
    border: Annotated[int, typer.Option(metavar="PIXELS", help="Left out at each edge.")] = 0,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the figures to this file as well.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar.")] = False,
) -> None:
    """Score a restored clip: PSNR and SSIM of the values in the files, mean over the frames and worst frame.

    CLIP is an image, a folder of images, a video, a GIF or a multi-page TIFF. With --input, the input's frames and
    their mean over time, taken in linear light, are scored beside the restored ones.
    """
    from rich.console import Console

    from turbnet.media.atomic import check_output
    from turbnet.media.clip import open_clip
    from turbnet.progress import progress_bar
    from turbnet.report import Report

    if json:
        check_output(json)
    clips = [open_clip(path) for path in (restored, reference, input) if path]
    target = clips[1]
    for clip in clips:
        if (clip.info.height, clip.info.width) != (target.info.height, target.info.width):
            raise InputError(f"{_size(clip)} but {_size(target)}; both must have one size")

    scores = []
    with progress_bar(quiet) as progress:
        scores.append(_score("restored", _pairs(clips[0], target), border, clips[0], progress))
        if input:
            mean = _TemporalMean()
            scores.append(_score("input", mean.watch(_pairs(clips[2], target)), border, clips[2], progress))
            still = mean.frame()
            scores.append(_score("temporal mean", ((still, frame) for frame in target), border, target, progress))

    Console().print(_table(scores))
    if json:
        Report([row for score in scores for row in score.rows()]).write(json)


@dataclass
class _Scores:
    """The figures of one clip, frame by frame."""

    name: str
    psnr: list[float] = field(default_factory=list)
    ssim: list[float] = field(default_factory=list)

    def measures(self) -> Iterator[tuple[str, str, float, float, int]]:
        """Measure, unit, mean over the frames, the worst frame's value and its index."""
        for measure, unit, values in (("psnr", "dB", self.psnr), ("ssim", "", self.ssim)):
            worst = min(values)
            yield measure, unit, sum(values) / len(values), worst, values.index(worst)

    def rows(self) -> "Iterator[Row]":
        from turbnet.report import Row

        yield Row(f"{self.name} frames", len(self.psnr))
        for measure, unit, mean, worst, index in self.measures():
            yield Row(f"{self.name} {measure}", mean, unit)
            yield Row(f"{self.name} {measure} worst", worst, unit)
            yield Row(f"{self.name} {measure} worst frame", index)


class _TemporalMean:
    """Mean over time of the frames that pass by, in linear light, as a long exposure would take it."""

    def __init__(self) -> None:
        self._sum: Any = 0.0
        self._count = 0

    def watch(self, pairs: "Iterable[tuple[Frame, Frame]]") -> "Iterator[tuple[Frame, Frame]]":
        from turbnet.media.colour import to_linear

        for frame, reference in pairs:
            self._sum = self._sum + to_linear(frame.astype("float64"))
            self._count += 1
            yield frame, reference

    def frame(self) -> "Frame":
        from turbnet.media.colour import to_srgb

        return to_srgb(self._sum / self._count).astype("float32")


def _pairs(clip: "ClipReader", target: "ClipReader") -> "Iterator[tuple[Frame, Frame]]":
    """Each frame with its reference; a reference of one frame stands beside every frame."""
    if target.info.frames == 1:
        still = next(iter(target))
        yield from ((frame, still) for frame in clip)
        return
    for index, (frame, reference) in enumerate(zip_longest(clip, target)):
        if frame is None or reference is None:
            shorter, longer = (clip, target) if frame is None else (target, clip)
            raise InputError(f"{shorter.path} ends after {index} frames but {longer.path} has more; cut one to match")
        yield frame, reference


def _score(
    name: str, pairs: "Iterable[tuple[Frame, Frame]]", border: int, clip: "ClipReader", progress: "Progress"
) -> _Scores:
    from turbnet.metrics.fidelity import psnr, ssim

    scores = _Scores(name)
    for frame, reference in progress.track(pairs, total=clip.info.frames, description=name):
        scores.psnr.append(float(psnr(frame, reference, border)))
        scores.ssim.append(float(ssim(frame, reference, border)))
    return scores


def _size(clip: "ClipReader") -> str:
    return f"{clip.path} is {clip.info.width}x{clip.info.height} pixels"


def _table(scores: list[_Scores]) -> "Table":
    from rich.table import Table

    table = Table()
    table.add_column("")
    for heading in ("frames", "PSNR dB", "worst", "frame", "SSIM", "worst", "frame"):
        table.add_column(heading, justify="right")
    for score in scores:
        (_, _, psnr, psnr_worst, psnr_at), (_, _, ssim, ssim_worst, ssim_at) = score.measures()
        figures = [f"{psnr:.2f}", f"{psnr_worst:.2f}", str(psnr_at), f"{ssim:.4f}", f"{ssim_worst:.4f}", str(ssim_at)]
        table.add_row(score.name, str(len(score.psnr)), *figures)
    return table
