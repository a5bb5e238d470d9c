"""`turbnet export`: a checkpoint to an ONNX file."""

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from turbnet.cli.typed import run_typed

if TYPE_CHECKING:
    from turbnet.report import Row


def main(arguments: list[str]) -> int:
    """Run the verb."""
    return run_typed(export, arguments, "export")


def export(
    checkpoint: Annotated[
        Path, typer.Argument(metavar="CHECKPOINT", help="written by turbnet train, or a released network's name")
    ],
    output: Annotated[Path | None, typer.Option("--output", "-o", help="default: beside the checkpoint, .onnx")] = None,
    frames: Annotated[
        int | None,
        typer.Option(help="frames to restore together, as recommended to users; default: as in training, or 12"),
    ] = None,
    streaming: Annotated[
        bool, typer.Option("--streaming", help="frame by frame, carrying what was seen along, in place of windows")
    ] = False,
    maps: Annotated[
        bool,
        typer.Option("--maps", help="the uncertainty maps of a network that has them, in place of what it restores"),
    ] = False,
    horizon: Annotated[float, typer.Option(help="with --streaming: frames after which what was seen has faded")] = 50.0,
    remember: Annotated[int, typer.Option(help="with --streaming: frames whose keys and values are kept")] = 6,
    eight_bits: Annotated[
        bool, typer.Option("--eight-bits", help="convolutions in eight bits, if that pays on this machine (minutes)")
    ] = False,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="write what was measured as JSON")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="no summary")] = False,
) -> int:
    """Write the network of a checkpoint as an ONNX file with its model card, proven against torch.

    With --eight-bits the rounded network is judged on the benchmark: nothing is written unless it is a tenth faster on
    this machine and loses 0.1 dB at most in scenes of every kind.
    """
    from turbnet.deploy.checkpoint import card_of, frame_by_frame, load_network, maps_alone
    from turbnet.deploy.export import TOLERANCE, export_onnx
    from turbnet.deploy.session import Model
    from turbnet.errors import InputError, check_range
    from turbnet.media.atomic import atomic_path, check_output
    from turbnet.report import Report, Row

    path = output or checkpoint.with_suffix(".onnx")
    if path.suffix != ".onnx":
        raise InputError(f"cannot write {path}: the name of a model ends in .onnx")
    network, hyper_parameters = load_network(checkpoint)
    if frames is None:
        trained = (hyper_parameters.get("recipe") or {}).get("frames", 12)
        frames = trained if isinstance(trained, int) else trained[-1]  # of a range the most
    card = card_of(network, hyper_parameters, int(check_range("frames", frames, 1, 1000)))
    if maps + streaming + eight_bits > 1:
        raise InputError("give one of --maps, --streaming and --eight-bits")
    check_output(path)
    if maps:
        network, card = maps_alone(network, card)
    if streaming:
        network, card = frame_by_frame(network, card, horizon, remember)
    report = Report()
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / path.name if eight_bits else path
        for row in export_onnx(network, card, whole):
            shape = "x".join(str(size) for size in row.shape)
            report.add(Row.compared(f"difference from torch, {shape}", row.difference, 0.0, TOLERANCE))
            if not quiet:
                print(f"frames {shape:18s}  largest difference from torch {row.difference:.1e}")
        if eight_bits:
            with atomic_path(path) as temporary:
                report.rows += _rounded(whole, temporary, quiet)
    Model.load(path).card.write_beside(path)
    if json:
        report.write(json)
    if not quiet:
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
    return 0


def _rounded(whole: Path, target: Path, quiet: bool) -> "list[Row]":
    """Write the model of the file `whole` in eight bits, if that pays."""
    from turbnet.bench import precision
    from turbnet.errors import InputError

    verdict = precision.judge(whole, precision.calibrated(whole, target))
    if not quiet:
        print(f"eight bits: {verdict}")
    if not verdict.worth_it:
        raise InputError(
            f"not written, as eight bits do not pay: {verdict}; they are worth it from {precision.FASTER:g} times on, "
            f"if at most {precision.LOSS:g} dB is lost"
        )
    return verdict.rows()
