"""`turbnet restore`: a turbulent clip to a clear one."""

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Annotated

import typer

from turbnet.cli.typed import run_typed


def main(arguments: list[str]) -> int:
    """Run the verb."""
    return run_typed(restore, arguments, "restore")


def restore(
    source: Annotated[
        Path, typer.Argument(metavar="INPUT", help="image, folder of frames, video, TIFF, camera; - reads a pipe")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="where to write; the ending says what, - is a pipe")],
    model: Annotated[
        str | None, typer.Option(help="a released model by name, or an ONNX file of turbnet export; default: s")
    ] = None,
    method: Annotated[
        str | None, typer.Option(metavar="NAME", help="a method without learning in place of a model: pipeline, ...")
    ] = None,
    budget_ms: Annotated[
        float | None,
        typer.Option("--budget-ms", metavar="MS", help="the best network, window, views for so long a frame"),
    ] = None,
    quality: Annotated[
        float | None, typer.Option(metavar="DB", help="the cheapest ones that gain so much on the benchmark")
    ] = None,
    crop: Annotated[str | None, typer.Option(metavar="L,T,W,H", help="part of the frame to restore, pixels")] = None,
    window: Annotated[int | None, typer.Option(help="frames restored together; default: as the model asks")] = None,
    passes: Annotated[int, typer.Option(help="how often; a second pass for blur stronger than one can undo")] = 1,
    views: Annotated[
        int | None, typer.Option(help="1 to 8: the clip turned and mirrored as well, and averaged; so much slower")
    ] = None,
    skip: Annotated[
        bool, typer.Option("--skip/--no-skip", help="leave out what needs no restoration or has not changed")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="keep restored frames until the clip is whole, and go on with those there")
    ] = False,
    tile: Annotated[int, typer.Option(help="greatest side of a tile, pixels; less needs less memory")] = 320,
    threads: Annotated[int | None, typer.Option(help="processor threads; default: all cores")] = None,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="write what was measured as JSON")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="no progress bar, no summary")] = False,
) -> None:
    """Restore a clip or an image seen through turbulence."""
    from turbnet.cli.options import parse_crop
    from turbnet.deploy.method import ClassicalMethod
    from turbnet.deploy.restore import restore_clip
    from turbnet.deploy.session import Model
    from turbnet.deploy.weights import DEFAULT, find_model, released_maps
    from turbnet.errors import InputError
    from turbnet.media.atomic import check_output
    from turbnet.media.live import STANDARD, is_live
    from turbnet.report import Report, Row

    if model and method:
        raise InputError("give --model or --method, not both")
    if json:
        check_output(json)
    if budget_ms is not None or quality is not None:
        model, window, views = _chosen(source, crop, budget_ms, quality, threads, (model, method, window, views))
    network = ClassicalMethod(method, threads) if method else Model.load(find_model(model or DEFAULT), threads)
    with _ended_by_interrupt() if is_live(source) else nullcontext(lambda: False) as ended:
        done = restore_clip(
            source,
            output,
            network,
            crop=parse_crop(crop),
            tile=tile,
            window=window,
            passes=passes,
            views=1 if views is None else views,
            skip=skip,
            maps=Model.load(released_maps(), threads) if skip and released_maps().is_file() else None,
            resume=resume,
            quiet=quiet,
            ended=ended,
        )
    if json:
        report = Report()
        report.add(Row("frames", done.frames))
        report.add(Row("frames restored by an earlier run", done.resumed))
        report.add(Row("height", done.height, "pixel"))
        report.add(Row("width", done.width, "pixel"))
        report.add(Row("window", done.window, "frame"))
        report.add(Row("tiles of a frame", done.tiles))
        report.add(Row("time a frame", done.milliseconds_a_frame, "ms"))
        report.add(Row("share of the network", done.network_seconds / done.seconds))
        report.add(Row("tiles of windows that were clean", done.skipped.clean))
        report.add(Row("tiles of windows that had not changed", done.skipped.still))
        report.write(json)
    if done.left_out and not quiet:
        codecs = ", ".join(done.left_out)
        print(f"turbnet restore: the sound ({codecs}) was left out, {output} does not take it", file=sys.stderr)
    if not quiet:
        frames = "1 frame" if done.frames == 1 else f"{done.frames} frames"
        resumed = f", {done.resumed} of them by an earlier run" if done.resumed else ""
        spared = f", {done.skipped.saved:.0%} of the tiles skipped" if done.skipped.saved else ""
        print(
            f"{output}: {frames} of {done.width}x{done.height}, {done.milliseconds_a_frame:.0f} ms a frame{spared}{resumed}",
            file=sys.stderr if output == STANDARD else sys.stdout,
        )


def _chosen(
    source: Path,
    crop: str | None,
    budget_ms: float | None,
    quality: float | None,
    threads: int | None,
    fixed: tuple[object, ...],
) -> tuple[str, int, int]:
    """Network, window and views for a time or a quality."""
    from turbnet.cli.options import parse_crop
    from turbnet.deploy.budget import for_budget, for_quality
    from turbnet.errors import InputError
    from turbnet.media.clip import open_clip
    from turbnet.media.live import is_live

    if budget_ms is not None and quality is not None:
        raise InputError("give --budget-ms or --quality, not both")
    if any(value is not None for value in fixed):
        raise InputError("--budget-ms and --quality choose the rest: leave --model, --method, --window and --views out")
    if quality is not None:
        point = for_quality(quality)
    elif budget_ms is not None:
        if is_live(source):
            raise InputError("--budget-ms needs to know the size of the frames beforehand: not of a pipe or a camera")
        with open_clip(source, parse_crop(crop)) as clip:
            point = for_budget(budget_ms, clip.info.height, clip.info.width, threads)
    return point.model, point.window, point.views


@contextmanager
def _ended_by_interrupt() -> Iterator[Callable[[], bool]]:
    """Ctrl-C tells a source to end; a second one interrupts the command."""
    ended = False

    def end(number: int, frame: object) -> None:
        nonlocal ended
        ended = True
        signal.signal(signal.SIGINT, before)

    before = signal.signal(signal.SIGINT, end)
    try:
        yield lambda: ended
    finally:
        signal.signal(signal.SIGINT, before)
