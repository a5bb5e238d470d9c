"""`turbnet stress`: what the library makes of input that is hard on arithmetic."""

from pathlib import Path
from typing import Annotated

import typer

from turbnet.cli.typed import run_typed


def main(arguments: list[str]) -> int:
    """Run the verb."""
    return run_typed(stress, arguments, "stress")


def stress(
    only: Annotated[
        str | None, typer.Option(metavar="PART,...", help="parts to try, comma-separated; default: all")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="fewer cells: about a minute")] = False,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="write the rows to this file")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="no progress bar")] = False,
) -> int:
    """Try to break every part numerically; exit code 1 if anything happens that is neither right nor refused."""
    from turbnet.bench.stress import PARTS, run
    from turbnet.errors import InputError
    from turbnet.media.atomic import check_output

    if json is not None:
        check_output(json)
    names = list(PARTS) if only is None else only.split(",")
    unknown = [name for name in names if name not in PARTS]
    if unknown:
        raise InputError(f"--only {only}: there is no part {unknown[0]!r}; the parts are {', '.join(PARTS)}")
    found = run({name: PARTS[name] for name in names}, quick, quiet)
    print(found.text)
    report = found.report
    if json is not None:
        report.write(json)
    return 0 if report.ok else 1
