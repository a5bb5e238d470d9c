"""A typer function run as a verb of the command line."""

import sys
from collections.abc import Callable
from typing import Any

import typer
import typer.main

# typer's own base of "unknown option" and "bad value"; its module has moved between releases.
_UsageError: Any = typer.BadParameter.__mro__[1]


def run_typed(function: Callable[..., object], arguments: list[str], name: str) -> int:
    """Parse `arguments` for `function` and call it; wrong usage is one line on standard error and exit code 2."""
    app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    app.command()(function)
    command = typer.main.get_command(app)
    try:
        result = command.main(args=arguments, prog_name=f"turbnet {name}", standalone_mode=False)
    except _UsageError as error:
        message = " ".join(error.format_message().split()).rstrip(".")
        print(f"turbnet {name}: {message}; see turbnet {name} --help", file=sys.stderr)
        return 2
    except typer.Abort:
        return 130
    return result if isinstance(result, int) else 0
