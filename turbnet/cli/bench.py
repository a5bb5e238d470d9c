"""turbnet bench SUITE: what is measured, beside what it should be."""

import importlib
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from turbnet.cli.typed import run_typed

SUITES = {
    "physics": "optics, atmosphere and split-step against theory",
    "simulator": "the in-loop simulator: exactness, speed, run time against error",
    "restoration": "methods, models and commands over the frozen benchmark",
    "maps": "uncertainty maps: calibration, and whether they rank errors",
    "deployment": "released networks on this machine: speed, memory, what --skip saves and loses",
    "all": "physics, simulator, restoration and deployment, on one page",
}


def main(arguments: list[str]) -> int:
    """Run one suite."""
    suite = arguments[0] if arguments else "--help"
    if suite in ("--help", "-h"):
        suites = "\n".join(f"  {name:10s}{text}" for name, text in SUITES.items())
        print(f"Usage: turbnet bench SUITE ...\n\nSuites:\n{suites}\n\nturbnet bench SUITE --help   options of a suite")
        return 0
    if suite not in SUITES:
        print(f"turbnet bench: there is no suite {suite!r}; the suites are {', '.join(SUITES)}", file=sys.stderr)
        return 2
    return run_typed(everything if suite == "all" else globals()[suite], arguments[1:], f"bench {suite}")


def physics(
    json: Annotated[Path | None, typer.Option(help="write the rows to this file")] = None,
    figures: Annotated[Path | None, typer.Option(help="write a figure of each family into this folder")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="fewer draws: half a minute, wide error bars")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="no progress bars")] = False,
) -> int:
    """Measure screens, split-step propagation and speed against theory; exit code 1 if a row misses its tolerance."""
    _check_outputs(json, figures)
    bench = importlib.import_module("turbnet.bench.physics")
    return _finish(bench, bench.run(quick=quick, quiet=quiet), json, figures)


def simulator(
    json: Annotated[Path | None, typer.Option(help="write the rows to this file")] = None,
    figures: Annotated[
        Path | None, typer.Option(help="write the figure of run time against error into this folder")
    ] = None,
    only: Annotated[
        str | None, typer.Option(help="families to measure, of field,picture,split-step,speed,curve; comma-separated")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="fewer draws: a minute or two, wide error bars")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="no progress bars")] = False,
) -> int:
    """Measure the in-loop simulator; exit code 1 if a row misses its limit."""
    _check_outputs(json, figures)
    bench = importlib.import_module("turbnet.bench.simulator")
    return _finish(bench, bench.run(_families(bench, only), quick=quick, quiet=quiet), json, figures)


def restoration(
    suite: Annotated[str, typer.Option(help="standard, or quick: one scene of each kind at one strength")] = "standard",
    method: Annotated[list[str] | None, typer.Option(help="classical method; may be given again")] = None,
    model: Annotated[list[str] | None, typer.Option(help="released network or ONNX file; may be given again")] = None,
    external: Annotated[
        list[str] | None, typer.Option(help="command with {in} and {out} where the clips go; may be given again")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="write the rows to this file")] = None,
    markdown: Annotated[Path | None, typer.Option(help="write the tables to this file")] = None,
    figures: Annotated[
        Path | None, typer.Option(help="write the figure of run time against error into this folder")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="no progress bars")] = False,
) -> int:
    """Restore the frozen benchmark with all methods and released models, or with those that are named."""
    from turbnet.errors import InputError
    from turbnet.media.atomic import atomic_path

    _check_outputs(json, figures)
    _check_outputs(markdown, None)
    bench = importlib.import_module("turbnet.bench.restoration")
    if suite not in bench.SUITES:
        raise InputError(f"there is no suite {suite}; the suites are {', '.join(bench.SUITES)}")
    results = bench.run(bench.entrants(method or (), model or (), external or ()), suite, quiet)
    tables = bench.table(results)
    print(tables)
    if markdown is not None:
        with atomic_path(markdown) as temporary:
            temporary.write_text(tables + "\n")
    if figures is not None:
        figures.mkdir(parents=True, exist_ok=True)
        bench.draw_figure(results, figures / "restoration-time-error.png")
    if json is not None:
        bench.report(results).write(json)
    return 0


def maps(
    checkpoint: Annotated[Path, typer.Argument(metavar="CHECKPOINT", help="of a network with uncertainty maps")],
    suite: Annotated[str, typer.Option(help="standard, or quick: one scene of each kind at one strength")] = "standard",
    json: Annotated[Path | None, typer.Option(help="write the rows to this file")] = None,
    figures: Annotated[Path | None, typer.Option(help="write reliability and sparsification into this folder")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="no progress bars")] = False,
) -> int:
    """Restore single frames of the frozen benchmark and compare the errors with the maps."""
    from turbnet.bench.suite import SUITES as suites
    from turbnet.errors import InputError

    _check_outputs(json, figures)
    if suite not in suites:
        raise InputError(f"there is no suite {suite}; the suites are {', '.join(suites)}")
    bench = importlib.import_module("turbnet.bench.maps")
    return _finish(bench, bench.run(checkpoint, suite, quiet), json, figures)


def deployment(
    model: Annotated[list[str] | None, typer.Option(help="released network or ONNX file; may be given again")] = None,
    only: Annotated[
        str | None, typer.Option(help="families to measure, of speed,skip,precision,start,memory; comma-separated")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="write the rows to this file")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="short clips, no memory: a minute or two")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="no progress bars")] = False,
) -> int:
    """Measure what restoring costs, with all released networks or with those that are named."""
    from turbnet.deploy.weights import released_models

    _check_outputs(json, None)
    bench = importlib.import_module("turbnet.bench.deployment")
    report = bench.run(model or list(released_models()), _families(bench, only), quick, quiet)
    print(bench.table(report))
    if json is not None:
        report.write(json)
    return 0


def everything(
    output: Annotated[Path, typer.Option("--output", "-o", help="folder of the page, its figures and the rows")],
    quick: Annotated[bool, typer.Option("--quick", help="fewer draws and clips: some minutes")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="no progress bars")] = False,
) -> int:
    """Measure all of it and write bench.md, bench.json and figures into a folder; exit code 1 if a row misses."""
    from turbnet.errors import InputError

    if output.exists() and not output.is_dir():
        raise InputError(f"cannot write into {output}: it is a file; name a folder")
    output.mkdir(parents=True, exist_ok=True)
    report = importlib.import_module("turbnet.bench.page").write(output, quick, quiet)
    print(output / "bench.md")
    return 0 if report.ok else 1


def _families(bench: Any, only: str | None) -> tuple[str, ...]:
    """The families of a suite that --only names, or all of them."""
    from turbnet.errors import InputError

    families: tuple[str, ...] = bench.FAMILIES if only is None else tuple(only.split(","))
    unknown = [name for name in families if name not in bench.FAMILIES]
    if unknown:
        raise InputError(f"--only {only}: there is no family {unknown[0]!r}; they are {', '.join(bench.FAMILIES)}")
    return families


def _check_outputs(json: Path | None, figures: Path | None) -> None:
    from turbnet.errors import InputError

    if json is not None and not json.parent.is_dir():
        raise InputError(f"cannot write {json}: the folder {json.parent} does not exist; create it first")
    if figures is not None and figures.exists() and not figures.is_dir():
        raise InputError(f"cannot write figures into {figures}: it is a file; name a folder")


def _finish(bench: Any, found: Any, json: Path | None, figures: Path | None) -> int:
    print(found.text)
    if figures is not None:
        bench.draw_figures(found.panels, figures)
    report = found.report
    if json is not None:
        report.write(json)
    return 0 if report.ok else 1
