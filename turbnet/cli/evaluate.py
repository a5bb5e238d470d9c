"""`turbnet evaluate`: how good a restored clip is, by its reference, by itself, by the text in it."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from turbnet.cli.typed import run_typed
from turbnet.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table

    from turbnet.media.clip import ClipReader
    from turbnet.metrics.evaluation import ClipScores, Watch


def main(arguments: list[str]) -> int:
    return run_typed(evaluate, arguments, "evaluate")


def evaluate(
    restored: Annotated[Path | None, typer.Option(metavar="CLIP", help="The clip to score.")] = None,
    reference: Annotated[
        Path | None, typer.Option(metavar="CLIP", help="What it should be: a clip or one still.")
    ] = None,
    input: Annotated[Path | None, typer.Option(metavar="CLIP", help="What it was restored from: scored too.")] = None,
    boxes: Annotated[
        Path | None,
        typer.Option("--boxes", "--transcripts", metavar="TSV", help="Text in the clips: boxes and transcripts."),
    ] = None,
    ocr: Annotated[
        str, typer.Option(metavar="READER", help="Who reads it: builtin, rapidocr, rapidocr-find or proxy.")
    ] = "builtin",
    border: Annotated[int, typer.Option(metavar="PIXELS", help="Left out at each edge.")] = 0,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the figures to this file as well.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar.")] = False,
) -> None:
    """Score a restored clip: mean over the frames and worst frame.

    With --reference: PSNR, SSIM and MS-SSIM of the values in the files, and how far the whole is shifted. Without:
    jitter, flicker, sharpness, noise, as for real clips of still scenes. With --boxes: how much of the text is read. The
    table has the columns file, left, top, width, height, text, with tabs between; it may be given alone, for the files
    it names (relative to its folder), or with clips, whose names then need not agree if it names a single file.

    CLIP is an image, a folder of images, a video, a GIF or a multi-page TIFF. With --input, the input's frames and
    their mean over time, taken in linear light, are scored beside the restored ones.
    """
    from rich.console import Console

    from turbnet.media.atomic import check_output
    from turbnet.media.clip import open_clip
    from turbnet.media.live import is_live
    from turbnet.progress import progress_bar
    from turbnet.report import Report

    if json:
        check_output(json)
    if restored is None and (boxes is None or reference or input):
        raise InputError("give --restored, the clip to score, or --boxes, a table of the files to read text in")
    for path in (restored, reference, input):
        if path is not None and is_live(path):
            raise InputError("a clip is passed over more than once; save the pipe or camera to a file first")
    clips = {name: open_clip(path) for name, path in (("restored", restored), ("input", input)) if path}
    target = open_clip(reference) if reference else None
    for clip in clips.values():
        if target and (clip.info.height, clip.info.width) != (target.info.height, target.info.width):
            raise InputError(f"{_size(clip)} but {_size(target)}; both must have one size")

    scores: list[ClipScores] = []
    with progress_bar(quiet) as progress:

        def watch(total: int | None) -> "Watch":
            def track(items: Iterable[Any], description: str) -> Iterable[Any]:
                return progress.track(items, total=total, description=description)

            return track

        for name, clip in clips.items():
            scores += _scores(name, clip, target, border, watch(clip.info.frames))
        if boxes:
            scores += _texts(clips, boxes, ocr, watch)

    Console().print(_table(scores))
    if json:
        Report([row for score in scores for row in score.rows()]).write(json)


def _scores(
    name: str, clip: "ClipReader", target: "ClipReader | None", border: int, watch: "Watch"
) -> "list[ClipScores]":
    from turbnet.metrics.evaluation import TemporalMean, against_reference, pairs, without_reference

    if target is None:
        return [without_reference(name, clip, watch)]
    scores = [against_reference(name, lambda: pairs(clip, target), border, watch)]
    if name == "input":
        mean = TemporalMean()
        for frame in clip:
            mean.add(frame)
        still = mean.frame()
        scores.append(against_reference("temporal mean", lambda: ((still, frame) for frame in target), border, watch))
    return scores


def _texts(
    clips: "dict[str, ClipReader]", table: Path, ocr: str, watch: "Callable[[int | None], Watch]"
) -> "list[ClipScores]":
    """What is read in the clips, or in the files that the table names."""
    from turbnet.data.boxes import read_boxes
    from turbnet.media.clip import open_clip
    from turbnet.metrics.evaluation import read_texts, text_scorer

    boxes = read_boxes(table)
    if clips:
        for clip in clips.values():
            if len(boxes) > 1 and clip.path.name not in map(_name, boxes):
                raise InputError(f"{table} has no boxes for {clip.path.name}")
        named = {_name(file): rows for file, rows in boxes.items()}
        only = next(iter(named.values()))
        work = [(name, clip, named.get(clip.path.name, only)) for name, clip in clips.items()]
    else:
        work = [(_name(file), open_clip(table.parent / file), rows) for file, rows in boxes.items()]
    scorer = text_scorer(ocr)
    read = {name: read_texts(name, clip, rows, scorer, watch(clip.info.frames)) for name, clip, rows in work}
    scores = [figures.scores(f"{name} text") for name, figures in read.items()]
    if not clips and len(read) > 1:
        first, *others = read.values()
        scores.append(sum(others, first).scores("all text"))
    return scores


def _name(file: str) -> str:
    return Path(file).name


def _size(clip: "ClipReader") -> str:
    return f"{clip.path} is {clip.info.width}x{clip.info.height} pixels"


def _table(scores: "list[ClipScores]") -> "Table":
    from rich.table import Table

    table = Table("", "frames", "measure", "mean", "worst", "frame")
    for column in table.columns[3:]:
        column.justify = "right"
    for score in scores:
        for index, figure in enumerate(score.figures):
            digits = 2 if figure.unit == "dB" else 4
            worst, frame = figure.worst
            table.add_row(
                "" if index else score.name,
                "" if index else str(score.frames),
                f"{figure.measure} {figure.unit}".strip(),
                f"{figure.mean:.{digits}f}",
                *((f"{worst:.{digits}f}", str(frame)) if figure.per_frame else ("", "")),
                end_section=index == len(score.figures) - 1,
            )
    return table
