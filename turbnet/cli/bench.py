"""turbnet bench SUITE: what is measured, beside what it should be."""

import importlib
import sys
from pathlib import Path
from typing import Annotated

import typer

from turbnet.cli.typed import run_typed

SUITES = {"physics": "optics, atmosphere and split-step against theory"}


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
    return run_typed(globals()[suite], arguments[1:], f"bench {suite}")


def physics(
    json: Annotated[Path | None, typer.Option(help="write the rows to this file")] = None,
    figures: Annotated[Path | None, typer.Option(help="write a figure of each family into this folder")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="fewer draws: half a minute, wide error bars")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="no progress bars")] = False,
) -> int:
    """Measure screens, split-step propagation and speed against theory; exit code 1 if a row misses its tolerance."""
    from turbnet.errors import InputError

    if json is not None and not json.parent.is_dir():
        raise InputError(f"cannot write {json}: the folder {json.parent} does not exist; create it first")
    if figures is not None and figures.exists() and not figures.is_dir():
        raise InputError(f"cannot write figures into {figures}: it is a file; name a folder")
    bench = importlib.import_module("turbnet.bench.physics")
    found = bench.run(quick=quick, quiet=quiet)
    print(found.text)
    if figures is not None:
        bench.draw_figures(found.panels, figures)
    report = found.report
    if json is not None:
        report.write(json)
    return 0 if report.ok else 1
