"""`turbnet simulate --dataset`: turbulent clips with their truth, in shards, for training elsewhere."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from turbnet.cli.typed import run_typed
from turbnet.errors import InputError

if TYPE_CHECKING:
    from turbnet.data.pack import PackedPicture

Folders = list[Path] | None


def dataset(
    dataset: Annotated[Path, typer.Option(metavar="OUT", help="Folder to write, or to go on with.")],
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="Of the simulator, as in d_over_r0=[1,3].")
    ] = None,
    pictures: Annotated[
        Folders, typer.Option(metavar="FOLDER", help="Of clean pictures, searched for more folders; may be repeated.")
    ] = None,
    clips: Annotated[
        Folders, typer.Option(metavar="FOLDER", help="Of clean videos and folders of frames; may be repeated.")
    ] = None,
    simulator: Annotated[
        str, typer.Option(metavar="NAME", help="Of a group: path7km, recipe, wide or weak.")
    ] = "path7km",
    samples: Annotated[int, typer.Option(help="How many.")] = 1000,
    frames: Annotated[int, typer.Option(help="Of a sample.")] = 8,
    size: Annotated[str, typer.Option(metavar="HEIGHTxWIDTH", help="Of a frame, pixels; one number: square.")] = "128",
    moving: Annotated[float, typer.Option(help="Fraction of pictures across which a patch of another moves.")] = 0.25,
    text: Annotated[float, typer.Option(help="Fraction of pictures that are rendered text.")] = 0.0,
    shard_size: Annotated[int, typer.Option(help="Samples of a shard.")] = 64,
    seed: Annotated[int, typer.Option(help="Of everything.")] = 0,
    workers: Annotated[
        int | None, typer.Option(help="Processes; by default one for each core. The files do not depend on it.")
    ] = None,
    check: Annotated[bool, typer.Option("--verify", help="Write nothing; check what is there by its hashes.")] = False,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the figures as JSON.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar, no summary.")] = False,
) -> int:
    """Write pairs of turbulent and clean clips, with their tilt maps and conditions, in shards of safetensors.

    Give --pictures, --clips, or both, of which each then gives every other sample. A run that was stopped goes on where it
    stopped when the same command is given again. --verify exits with 1 if a shard is damaged or missing.
    """
    from turbnet.media.atomic import check_output
    from turbnet.report import Report, Row

    if json is not None:
        check_output(json)
    report = Report()
    if check:
        from turbnet.data.shards import verify

        for row in verify(dataset, quiet):
            report.add(row)
            if not row.ok or (row.name == "shards" and not quiet):
                print(f"{row.name}: {row.value}" + (f" of {row.reference:g}" if row.reference else ""))
    else:
        import time

        began = time.perf_counter()
        manifest = _write(
            {
                "pictures": pictures or [],
                "clips": clips or [],
                "simulator": simulator,
                "samples": samples,
                "frames": frames,
                "size": size,
                "moving": moving,
                "text": text,
                "shard_size": shard_size,
                "seed": seed,
                "overrides": overrides or [],
            },
            dataset,
            workers,
            quiet,
        )
        report.add(Row("samples", manifest["count"]))
        report.add(Row("shards", len(manifest["shards"])))
        report.add(Row("size", sum(shard["bytes"] for shard in manifest["shards"]), "B"))
        report.add(Row("time", time.perf_counter() - began, "s"))
        if not quiet:
            print(", ".join(f"{row.name} {row.value:.4g} {row.unit}".rstrip() for row in report.rows))
    if json is not None:
        report.write(json)
    return 0 if report.ok else 1


def main(arguments: list[str]) -> int:
    """Run the command."""
    return run_typed(dataset, arguments, "simulate")


def _write(options: dict[str, Any], folder: Path, workers: int | None, quiet: bool) -> dict[str, Any]:
    import torch

    from turbnet._version import __version__
    from turbnet.data.clips import CleanClips
    from turbnet.data.dataset import write_dataset
    from turbnet.data.footage import Alternating, Footage, footage_paths
    from turbnet.data.pairs import PairMaker
    from turbnet.data.sources import Mixture, Pictures, Text, folder_paths
    from turbnet.errors import check_range
    from turbnet.report import machine

    torch.set_num_threads(1)  # the basis of the blur, too, must not depend on the number of cores
    if not options["pictures"] and not options["clips"]:
        raise InputError("nothing to look at: give --pictures FOLDER or --clips FOLDER")
    height, width = _parse_size(options["size"])
    frames, count, seed, text = (options[name] for name in ("frames", "samples", "seed", "text"))
    check_range("text", text, 0, 1)
    check_range("samples", count, 1, 10**8)
    sets: list[Any] = []
    settings: dict[str, Any] = {
        "version": __version__,
        "command": _command(options),
        "seed": seed,
        "frames": frames,
        "height": height,
        "width": width,
        "moving": options["moving"],
        "text": text,
        "sources": {},
    }
    if options["pictures"]:
        pictures = folder_paths(options["pictures"])
        settings["sources"]["pictures"] = _fingerprint(pictures)
        source = Mixture([Pictures(pictures), Text()], [1 - text, text])
        sets.append(CleanClips(source, count, frames, height, width, options["moving"], seed))
    if options["clips"]:
        paths = footage_paths(options["clips"])
        settings["sources"]["clips"] = _fingerprint(paths)
        sets.append(Footage(paths, frames, height, width, seed))
    settings["simulator"] = _simulator(options["simulator"], options["overrides"], height, width)
    maker = PairMaker(**settings["simulator"])
    processes = int(machine()["cores"]) if workers is None else workers
    return write_dataset(folder, Alternating(sets), maker, settings, count, options["shard_size"], processes, quiet)


def _simulator(name: str, overrides: list[str], height: int, width: int) -> dict[str, Any]:
    """Arguments of `PairMaker` from a group of the configuration that `train` uses, and overrides as there."""
    from hydra import compose, initialize_config_module
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    size = [f"simulator={name}", f"simulator.height={height}", f"simulator.width={width}"]
    try:
        with initialize_config_module("turbnet.configs", version_base="1.3"):
            known = [key for key in compose("train", overrides=size).simulator if key not in ("height", "width")]
            for change in overrides:
                if change.partition("=")[0] not in known or "=" not in change:
                    raise InputError(f"{change}: give KEY=VALUE of the simulator; its keys are {', '.join(known)}")
            config = compose("train", overrides=[*size, *(f"simulator.{change}" for change in overrides)])
        found: Any = OmegaConf.to_container(config.simulator, resolve=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise InputError(str(error).partition("\nfull_key")[0].partition("\nConfig search path")[0]) from error
    return dict(found)


def _parse_size(text: str) -> tuple[int, int]:
    try:
        height, width = (int(part) for part in (text.split("x") if "x" in text else [text, text]))
    except ValueError as error:
        raise InputError(f"--size {text}: give HEIGHTxWIDTH in pixels, such as 128x160, or one number") from error
    return height, width


def _command(options: dict[str, Any]) -> str:
    """The command that makes the same files, wherever OUT is and however many processes share the work."""
    import shlex

    words = ["turbnet", "simulate", "--dataset", "OUT"]
    for name, value in options.items():
        if name != "overrides":
            for one in value if isinstance(value, list) else [value]:
                words += [f"--{name.replace('_', '-')}", str(one)]
    return shlex.join([*words, *options["overrides"]])


def _fingerprint(paths: "Sequence[Path | PackedPicture]") -> dict[str, Any]:
    """Number of files and a digest of their names and sizes, by which a resumed run knows its sources again."""
    import hashlib

    files = [
        (part.name, part.stat().st_size) if isinstance(part, Path) else (f"{part.pack.name} {part.start}", part.size)
        for path in paths
        for part in (sorted(path.iterdir()) if isinstance(path, Path) and path.is_dir() else [path])
    ]
    listing = "".join(f"{name} {size}\n" for name, size in files)
    return {"files": len(files), "sha256_of_names_and_sizes": hashlib.sha256(listing.encode()).hexdigest()}
