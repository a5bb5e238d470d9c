"""`turbnet export`: a checkpoint to an ONNX file."""

from pathlib import Path
from typing import Annotated

import typer

from turbnet.cli.typed import run_typed


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
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="write what was measured as JSON")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="no summary")] = False,
) -> int:
    """Write the network of a checkpoint as an ONNX file with its model card, proven against torch."""
    from turbnet.deploy.checkpoint import card_of, frame_by_frame, load_network, maps_alone
    from turbnet.deploy.export import TOLERANCE, export_onnx
    from turbnet.deploy.session import Model
    from turbnet.errors import InputError, check_range
    from turbnet.report import Report, Row

    path = output or checkpoint.with_suffix(".onnx")
    if path.suffix != ".onnx":
        raise InputError(f"cannot write {path}: the name of a model ends in .onnx")
    network, hyper_parameters = load_network(checkpoint)
    if frames is None:
        trained = (hyper_parameters.get("recipe") or {}).get("frames", 12)
        frames = trained if isinstance(trained, int) else trained[-1]  # of a range the most
    card = card_of(network, hyper_parameters, int(check_range("frames", frames, 1, 1000)))
    if maps and streaming:
        raise InputError("give --maps or --streaming, not both")
    if maps:
        network, card = maps_alone(network, card)
    if streaming:
        network, card = frame_by_frame(network, card, horizon, remember)
    report = Report()
    for row in export_onnx(network, card, path):
        shape = "x".join(str(size) for size in row.shape)
        report.add(Row.compared(f"difference from torch, {shape}", row.difference, 0.0, TOLERANCE))
        if not quiet:
            print(f"frames {shape:18s}  largest difference from torch {row.difference:.1e}")
    Model.load(path).card.write_beside(path)
    if json:
        report.write(json)
    if not quiet:
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")
    return 0
