"""The command line, one thin file a verb.

A verb's module is imported only when its verb runs, so that `restore` and `simulate` never pay for lightning.
"""

import importlib
import signal
import sys

VERBS = {
    "simulate": "turbulence on a picture or a clip",
    "train": "train a network; takes Hydra overrides",
    "export": "a checkpoint to an ONNX file",
    "restore": "a turbulent clip to a clear one",
    "evaluate": "score a restored clip against its reference",
    "bench": "run time against error",
    "stress": "try to break every part numerically",
}


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit: 0 done, 1 a check failed, 2 the input cannot be used, 130 interrupted."""
    # A job that is told to end still takes its half-written files with it.
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    sys.exit(run(sys.argv[1:] if arguments is None else arguments))


def run(arguments: list[str]) -> int:
    """Run one command; return its exit code. Errors of the user's making are one line on standard error."""
    verb = arguments[0] if arguments else "--help"
    if verb in ("--help", "-h"):
        print(_help())
        return 0
    if verb == "--version":
        from turbnet._version import __version__

        print(f"turbnet {__version__}")
        return 0
    if verb not in VERBS:
        print(f"turbnet: there is no command {verb!r}; the commands are {', '.join(VERBS)}", file=sys.stderr)
        return 2

    from turbnet.errors import InputError

    try:
        return int(importlib.import_module(f"turbnet.cli.{verb}").main(arguments[1:]) or 0)
    except InputError as error:
        print(f"turbnet {verb}: {_one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"turbnet {verb}: interrupted", file=sys.stderr)
        return 130


def _one_line(error: Exception) -> str:
    """Its words alone: what a file says of itself may stand in them, and must not steer a terminal."""
    text = " ".join(str(error).split())
    return "".join(character if character.isprintable() else "?" for character in text)


def _help() -> str:
    verbs = "\n".join(f"  {name:10s}{text}" for name, text in VERBS.items())
    return (
        "Usage: turbnet COMMAND ...\n\n"
        "Restore images and video seen through atmospheric turbulence.\n\n"
        f"Commands:\n{verbs}\n\n"
        "turbnet COMMAND --help   options of a command\n"
        "turbnet --version        version"
    )
