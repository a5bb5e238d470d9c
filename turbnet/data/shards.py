"""Pairs on disk: a folder of shards, each one safetensors file, and the manifest that lists them.

A shard of n samples holds, sample by sample along the first axis (B = n):

    frames, target, blur_only   uint8 (n, T, 3, H, W), sRGB
    tilt                        float16 (n, T, 2, H, W), pixels, x then y
    d_over_r0, read_noise       float64 (n,)
    full_well                   float64 (n,), electrons; infinite where there is no shot noise
    wind                        float64 (n, 2), m/s, x then y; NaN where every frame sees an atmosphere of its own
    geometry                    int64 (n,), index into the manifest's geometries
    seed, draw_seed, noise_seed int64 (n,)

Safetensors because a sample can be read without the rest of its shard, nothing in the file is ever executed, the same
tensors give the same bytes, and readers exist for NumPy, torch, JAX, TensorFlow, Rust and JavaScript.
"""

import hashlib
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.utils.data import Dataset

from turbnet.errors import InputError
from turbnet.media.guard import read_json
from turbnet.progress import progress_bar
from turbnet.report import Row

MANIFEST = "manifest.json"
FORMAT = "turbnet dataset 1"
PICTURES = ("frames", "target", "blur_only")
CONDITIONS = ("seed", "d_over_r0", "geometry", "wind", "read_noise", "full_well", "draw_seed", "noise_seed")
_SHARD = re.compile(r"shard-\d{5,}\.safetensors")


def read_manifest(folder: str | Path) -> dict[str, Any]:
    """What a dataset says of itself.

    Raises:
        InputError: there is none, or it is not one of turbnet's.
    """
    path = Path(folder) / MANIFEST
    if not path.is_file():
        raise InputError(f"there is no dataset in {folder}: it holds no {MANIFEST}")
    manifest = read_json(path)
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise InputError(f"{path} is not the manifest of a dataset of turbnet ({FORMAT})")
    count, size, shards = (manifest.get(name) for name in ("count", "shard_size", "shards"))
    if not (_is_whole(count) and _is_whole(size) and size and isinstance(shards, list) and "complete" in manifest):
        raise InputError(f"{path} is damaged: it does not say how many samples and shards there are")
    for record in shards:
        known = isinstance(record, dict) and [*map(type, map(record.get, ("file", "bytes", "sha256")))] == [
            str,
            int,
            str,
        ]
        if not known or not _SHARD.fullmatch(record["file"]):  # a name with folders in it would lead elsewhere
            raise InputError(f"{path} is damaged: {record!r:.200} describes no shard")
    return manifest


def _is_whole(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**53


def shard_name(number: int) -> str:
    """File name of a shard."""
    return f"shard-{number:05d}.safetensors"


def shard_rows(manifest: dict[str, Any], number: int) -> range:
    """Indices of the samples in a shard."""
    size, count = manifest["shard_size"], manifest["count"]
    return range(number * size, min((number + 1) * size, count))


def is_whole(folder: Path, record: dict[str, Any]) -> bool:
    """Whether a shard's file is there, byte by byte as the manifest's record says."""
    path = folder / record["file"]
    if not path.is_file() or path.stat().st_size != record["bytes"]:
        return False
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == record["sha256"]


def verify(folder: str | Path, quiet: bool = True) -> Iterator[Row]:
    """A row for each shard, `ok` if its bytes are those the manifest lists; the last row counts the shards.

    Raises:
        InputError: there is no dataset.
    """
    folder, manifest = Path(folder), read_manifest(folder)
    with progress_bar(quiet) as progress:
        for record in progress.track(manifest["shards"], description="verifying"):
            whole = is_whole(folder, record)
            yield Row(record["file"], "whole" if whole else "damaged or missing", ok=whole)
    expected = -(-manifest["count"] // manifest["shard_size"])
    yield Row.compared("shards", len(manifest["shards"]), expected, 0)


class Shards(Dataset[dict[str, Tensor]]):
    """The samples of a dataset, each read when it is asked for.

    A sample is a dict of `frames`, `target` and `blur_only`, float32 (T, 3, H, W), sRGB in [0, 1]; `tilt`, float32
    (T, 2, H, W), pixels; and its conditions as they stand in the shard.

    Args:
        folder: of the dataset.

    Raises:
        InputError: there is no dataset, it is incomplete, or, when a sample is read, its shard is damaged or missing.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder, self.manifest = Path(folder), read_manifest(folder)
        if not self.manifest["complete"]:
            raise InputError(f"the dataset {folder} is incomplete; run the command that began it again to finish it")

    def __len__(self) -> int:
        return int(self.manifest["count"])

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        if not 0 <= index < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        number, row = divmod(index, self.manifest["shard_size"])
        path = self.folder / shard_name(number)
        try:
            with safe_open(path, framework="pt") as shard:
                sample = {name: shard.get_slice(name)[row] for name in (*PICTURES, "tilt", *CONDITIONS)}
        except (OSError, SafetensorError, IndexError) as error:
            raise InputError(f"cannot read {path}: {error}; check the dataset with --verify") from error
        if any(sample[name].dtype != torch.uint8 for name in PICTURES) or sample["tilt"].ndim != 4:
            raise InputError(f"cannot read {path}: its tensors are not those of a dataset; check it with --verify")
        sample |= {name: sample[name].to(torch.float32) / 255 for name in PICTURES}
        return sample | {"tilt": sample["tilt"].float()}
