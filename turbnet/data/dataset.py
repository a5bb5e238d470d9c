"""Pairs written to disk, for those who train elsewhere: shards that appear one by one, a manifest that knows them.

The manifest is the state of the run. It is rewritten, whole, after every shard; a run that was killed goes on from the
shards that it lists and whose bytes are still what it says, and ends with the very files of a run that was not. A sample
is made by one process on one thread, and its number decides everything about it.
"""

import hashlib
import json
import math
import os
import re
import threading
import time
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save
from torch.utils.data import DataLoader, Dataset

from turbnet.data.clips import Scene
from turbnet.data.pairs import PairMaker
from turbnet.data.shards import CONDITIONS, FORMAT, MANIFEST, PICTURES, is_whole, read_manifest, shard_name, shard_rows
from turbnet.errors import InputError, check_range
from turbnet.media.atomic import atomic_path, check_output
from turbnet.progress import progress_bar

Sample = dict[str, NDArray[Any]]

_LEFTOVER = re.compile(r"\.(manifest|shard-\d+)\.[0-9a-f]+\.partial\.(json|safetensors)")


def write_dataset(
    folder: str | Path,
    scenes: Dataset[Scene],
    maker: PairMaker,
    settings: dict[str, Any],
    count: int,
    shard_size: int = 64,
    workers: int = 0,
    quiet: bool = True,
) -> dict[str, Any]:
    """Write `count` pairs in shards of `shard_size`, or go on with what is there of them; returns the manifest.

    Args:
        folder: to write: new, empty, or begun by the same run.
        scenes: clean clips and their seeds.
        maker: of the pairs.
        settings: what else decides about the pairs, for the manifest; a run with other settings is another run.
        count: samples.
        shard_size: samples of a shard.
        workers: processes that make samples, 0 for none but this one; the files do not depend on it.
        quiet: no progress bar.

    Raises:
        InputError: the folder holds something else or cannot be written, or a scene cannot be used. Shards that are
            finished by then stay and are gone on from.
    """
    check_range("samples", count, 1, 10**8)
    check_range("shard size", shard_size, 1, 2**16, "samples")
    check_range("workers", workers, 0, 2**10)
    folder = Path(folder)
    manifest = {
        "format": FORMAT,
        **settings,
        "count": count,
        "shard_size": shard_size,
        "geometries": [
            {"aperture_m": path.aperture, "distance_m": path.distance, "wavelength_m": path.wavelength}
            | {"pixel_m": path.pixel, "aperture_pixels": path.aperture / path.pixel}
            for path in maker.ranges.paths()
        ],
        "complete": False,
        "shards": [],
    }
    shards = range(-(-count // shard_size))
    done = _resume(folder, manifest)
    missing = [number for number in shards if number not in done]
    indices = [index for number in missing for index in shard_rows(manifest, number)]
    fresh, begun = not folder.exists(), False
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", message="This DataLoader will create"
        )  # more workers than cores: the user's say
        loader = DataLoader(
            _Samples(scenes, maker),
            batch_size=None,
            sampler=indices,
            num_workers=workers,
            collate_fn=_as_it_is,
            worker_init_fn=partial(_end_with, os.getpid()),
        )
    try:
        with _one_thread(), progress_bar(quiet) as progress:
            task = progress.add_task("simulating", total=count, completed=count - len(indices))
            samples = iter(loader)
            for number in missing:
                made = []
                for _ in shard_rows(manifest, number):
                    made.append(_made(next(samples)))
                    progress.advance(task)
                if not (folder / MANIFEST).exists():
                    check_output(folder)
                    folder.mkdir(exist_ok=True)
                    begun = True
                    _write_manifest(folder, manifest)
                done[number] = _write_shard(folder, number, made)
                _write_manifest(folder, manifest | {"shards": [done[key] for key in sorted(done)]})
    except BaseException:
        if begun and not done:
            (folder / MANIFEST).unlink(missing_ok=True)
            if fresh:
                folder.rmdir()
        raise
    table = [row for number in shards for row in _table(folder, manifest, number)]
    manifest |= {"complete": True, "shards": [done[number] for number in shards], "samples": table}
    _write_manifest(folder, manifest)
    return manifest


def _resume(folder: Path, manifest: dict[str, Any]) -> dict[int, dict[str, Any]]:
    """Records of the shards that are finished, by their number."""
    if folder.is_dir():
        for path in folder.iterdir():
            if _LEFTOVER.fullmatch(path.name):
                path.unlink()
    if not (folder / MANIFEST).is_file():
        check_output(folder)
        if folder.is_file():
            raise InputError(f"cannot write {folder}: it is a file; name a folder")
        return {}
    found = read_manifest(folder)
    # The command last: where something else differs too, that says more.
    for key, value in sorted(json.loads(json.dumps(manifest)).items(), key=lambda item: item[0] == "command"):
        if key not in ("complete", "shards") and found.get(key) != value:
            raise InputError(
                f"{folder} holds another dataset: its {key} is {_short(found.get(key))}, not {_short(value)}; "
                "choose another folder, or repeat the command in its manifest to go on with it"
            )
    numbers = {shard_name(number): number for number in range(-(-manifest["count"] // manifest["shard_size"]))}
    records = [record for record in found["shards"] if record["file"] in numbers]
    return {numbers[record["file"]]: record for record in records if is_whole(folder, record)}


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 200 else f"{text[:200]}..."


class _Samples(Dataset[Sample | InputError]):
    """Finished samples; a bad scene comes back as the error, which a worker's traceback would bury."""

    def __init__(self, scenes: Dataset[Scene], maker: PairMaker) -> None:
        self.scenes, self.maker = scenes, maker

    def __getitem__(self, index: int) -> Sample | InputError:
        try:
            clip = self.scenes[index]
            seed = int(clip["seed"])
            pair = self.maker(clip["scene"][None].float(), [seed])
        except InputError as error:
            return error
        conditions = self.maker.conditions(seed)
        pictures = {name: (getattr(pair, name)[0] * 255 + 0.5).clamp(0, 255).to(torch.uint8) for name in PICTURES}
        return {
            **{name: picture.numpy() for name, picture in pictures.items()},
            "tilt": pair.tilt[0].to(torch.float16).numpy(),
            "seed": np.int64(seed),
            "d_over_r0": np.float64(conditions.d_over_r0),
            "geometry": np.int64(conditions.geometry),
            "wind": np.array(conditions.wind or (math.nan, math.nan)),
            "read_noise": np.float64(conditions.sensor.read_noise),
            "full_well": np.float64(conditions.sensor.full_well),
            "draw_seed": np.int64(conditions.draw_seed),
            "noise_seed": np.int64(conditions.noise_seed),
        }


def _as_it_is(sample: Any) -> Any:
    """NumPy arrays stay so and travel through a pipe: shared memory is scarce in containers."""
    return sample


def _end_with(parent: int, worker: int) -> None:
    """End a worker soon after its parent was killed, even while it waits to hand over a sample that nobody will take."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _made(sample: Sample | InputError) -> Sample:
    if isinstance(sample, InputError):
        raise sample
    return sample


def _write_shard(folder: Path, number: int, samples: Iterable[Sample]) -> dict[str, Any]:
    rows = list(samples)
    data = save({name: np.stack([row[name] for row in rows]) for name in rows[0]}, metadata={"format": FORMAT})
    with atomic_path(folder / shard_name(number)) as temporary:
        temporary.write_bytes(data)
    sha256 = hashlib.sha256(data).hexdigest()
    return {"file": shard_name(number), "samples": len(rows), "bytes": len(data), "sha256": sha256}


def _write_manifest(folder: Path, manifest: dict[str, Any]) -> None:
    with atomic_path(folder / MANIFEST) as temporary:
        temporary.write_text(json.dumps(manifest, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _table(folder: Path, manifest: dict[str, Any], number: int) -> Iterator[dict[str, Any]]:
    """The samples of a shard as rows of the manifest's table; JSON has no infinity and no NaN: both are null."""
    with safe_open(folder / shard_name(number), framework="np") as shard:
        columns = {name: shard.get_tensor(name).tolist() for name in CONDITIONS}
    for row, index in enumerate(shard_rows(manifest, number)):
        values = {name: column[row] for name, column in columns.items()}
        if math.isnan(values["wind"][0]):
            values["wind"] = None
        if math.isinf(values["full_well"]):
            values["full_well"] = None
        yield {"index": index, "shard": shard_name(number), "row": row, **values}


@contextmanager
def _one_thread() -> Iterator[None]:
    """Sums depend on how many threads share them."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
