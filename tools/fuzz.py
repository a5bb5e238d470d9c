"""Damaged and forged files against everything in turbnet that reads one.

python tools/fuzz.py [--minutes 10] [--seed 0] [--cases N] [KIND ...]

A case is a whole file of a kind, spoiled by a seeded generator: cut, bits flipped, blocks zeroed, repeated or exchanged,
numbers in it replaced by extreme ones, fields of a structure replaced by odd values. Reading it must give a result or an
InputError of one line, within --seconds and --memory. Everything else is a finding, printed with its recipe: KIND and a
number that `--only` makes again. Cases run in a process of their own, so that one that crashes is a finding too.
"""

import argparse
import json
import multiprocessing
import resource
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from functools import lru_cache
from io import StringIO
from itertools import count, islice
from pathlib import Path
from typing import Any

import numpy as np

from turbnet.errors import InputError

SECONDS, MEMORY = 60.0, 4.0


# --- spoiling bytes ---------------------------------------------------------------------------------------------------

_EXTREME = [
    0,
    1,
    0x7F,
    0x80,
    0xFF,
    0x7FFF,
    0x8000,
    0xFFFF,
    60_000,
    10**9,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**63 - 1,
    2**64 - 1,
]


def spoil(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes spoiled in one to three ways; half of the places lie in the first kilobyte, where headers are."""
    for _ in range(rng.integers(1, 4)):
        data = _WAYS[rng.integers(len(_WAYS))](data, rng)
    return data


def _place(data: bytes, rng: np.random.Generator) -> int:
    near = min(1024, len(data)) if rng.random() < 0.5 else len(data)
    return int(rng.integers(max(near, 1)))


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: _place(data, rng)]


def _flip(data: bytes, rng: np.random.Generator) -> bytes:
    spoiled = bytearray(data)
    for _ in range(rng.integers(1, 20) if data else 0):
        spoiled[_place(data, rng)] ^= 1 << rng.integers(8)
    return bytes(spoiled)


def _zero(data: bytes, rng: np.random.Generator) -> bytes:
    start, length = _place(data, rng), int(rng.integers(1, 256))
    return data[:start] + bytes(len(data[start : start + length])) + data[start + length :]


def _number(data: bytes, rng: np.random.Generator) -> bytes:
    """A size, a count or an offset becomes an extreme one: 2, 4 or 8 bytes, either order."""
    start, length = _place(data, rng), int(rng.choice([1, 2, 4, 8]))
    value = _EXTREME[rng.integers(len(_EXTREME))] % 256**length
    return data[:start] + value.to_bytes(length, rng.choice(["little", "big"])) + data[start + length :]


def _repeat(data: bytes, rng: np.random.Generator) -> bytes:
    start, length = _place(data, rng), int(rng.integers(1, 512))
    return data[:start] + data[start : start + length] * int(rng.integers(2, 20)) + data[start + length :]


def _exchange(data: bytes, rng: np.random.Generator) -> bytes:
    first, second = sorted((_place(data, rng), _place(data, rng)))
    length = min(int(rng.integers(1, 64)), second - first)
    ends = first + length, second + length
    return data[:first] + data[second : ends[1]] + data[ends[0] : second] + data[first : ends[0]] + data[ends[1] :]


_WAYS = [_cut, _flip, _zero, _number, _repeat, _exchange]


# --- spoiling structures ----------------------------------------------------------------------------------------------

_ODD: list[Any] = [
    None,
    True,
    -1,
    0,
    1.5,
    10**9,
    2**63,
    float("nan"),
    float("inf"),
    "",
    "x",
    "../../x",
    "\x1b[2J",
    [],
    {},
]
_ODD += [[1, 2], {"x": 1}, [[[[]]]], "9" * 5000, {"_target_": "os.system"}, ["a"] * 1000]


def spoil_values(value: Any, rng: np.random.Generator) -> Any:
    """A structure of dicts and lists with one value somewhere in it replaced by an odd one, or left out."""
    entries = (
        list(value.items()) if isinstance(value, dict) else list(enumerate(value)) if isinstance(value, list) else []
    )
    if not entries or rng.random() < 0.2:
        return _ODD[rng.integers(len(_ODD))]
    key, item = entries[rng.integers(len(entries))]
    changed = dict(entries)
    if rng.random() < 0.1:
        del changed[key]
    else:
        changed[key] = spoil_values(item, rng)
    return changed if isinstance(value, dict) else list(changed.values())


# --- kinds ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Kind:
    """`make` writes a spoiled file into a folder and returns its path, `read` reads it to the end."""

    make: Callable[[Path, np.random.Generator], Path]
    read: Callable[[Path], Any]


def _frames() -> np.ndarray:
    """Seven frames of 64 x 80."""
    y, x = np.mgrid[:64, :80]
    moving = [np.stack([np.sin((x + 3 * t) / (4 + c)) * np.cos(y / 5) for c in range(3)], -1) for t in range(7)]
    return np.float32(0.5 + 0.4 * np.stack(moving))


@lru_cache
def _clip_bytes(name: str) -> bytes:
    from PIL import Image

    from turbnet.media.clip import write_clip

    frames, bytes_of = _frames(), np.uint8(_frames() * 255)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        images = [Image.fromarray(frame) for frame in bytes_of]
        if name == "a.webm":
            _encode(path, bytes_of, "libvpx", "yuv420p")
        elif name == "a.mpg":
            _encode(path, bytes_of, "mpeg1video", "yuv420p")
        elif name == "a.ts":
            _encode(path, bytes_of, "libx264", "yuv420p")
        elif name == "b.avi":
            _encode(path, bytes_of, "mjpeg", "yuvj420p")
        elif name == "deep.png":
            _encode(path, bytes_of[:1], "png", "rgb48be")
        elif name in ("moving.png", "moving.webp"):
            images[0].save(path, save_all=True, append_images=images[1:])
        elif name == "lzw.tif":
            images[0].save(path, save_all=True, append_images=images[1:], compression="tiff_lzw")
        elif name == "deflated.tif":
            import tifffile

            tifffile.imwrite(path, np.uint16(frames * 65535), photometric="rgb", compression="zlib")
        else:
            still = path.suffix in (".png", ".jpg", ".bmp", ".webp")
            write_clip(path, frames[:1] if still else frames)
        return path.read_bytes()


def _encode(path: Path, frames: np.ndarray, codec: str, pixel_format: str) -> None:
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], pixel_format
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "rgb24")))
        container.mux(stream.encode(None))


def _clip_kind(name: str) -> Kind:
    def make(folder: Path, rng: np.random.Generator) -> Path:
        suffix = rng.choice([".mp4", ".png", ".tif", ".avi"]) if rng.random() < 0.05 else Path(name).suffix
        path = folder / f"{Path(name).stem}{suffix}"
        path.write_bytes(spoil(_clip_bytes(name), rng))
        return path

    return Kind(make, _read_clip)


def _read_clip(path: Path) -> None:
    from turbnet.media.clip import open_clip

    with open_clip(path) as clip:
        for frame in islice(clip, 2000):
            assert frame.shape == (clip.info.height, clip.info.width, 3)
            assert frame.dtype == np.float32
            assert np.isfinite(frame).all()


def _make_pack(folder: Path, rng: np.random.Generator) -> Path:
    path = folder / "pictures.zip"
    path.write_bytes(spoil(_pack_bytes(), rng))
    return path


@lru_cache
def _pack_bytes() -> bytes:
    from turbnet.data.pack import write_pack

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for index in range(3):
            (folder / f"{index}.png").write_bytes(_clip_bytes("a.png"))
        write_pack(sorted(folder.glob("*.png")), folder / "p.zip")
        return (folder / "p.zip").read_bytes()


def _read_pack(path: Path) -> None:
    from turbnet.data.pack import packed_pictures

    for picture in packed_pictures(path):
        assert picture.load().ndim == 3


def _make_boxes(folder: Path, rng: np.random.Generator) -> Path:
    lines = ["file\tleft\ttop\twidth\theight\ttext", *(f"a.png\t{5 * k}\t4\t20\t9\tword {k}" for k in range(9))]
    path = folder / "boxes.tsv"
    path.write_bytes(spoil("\n".join(lines).encode(), rng))
    return path


def _read_boxes(path: Path) -> None:
    from turbnet.data.boxes import read_boxes
    from turbnet.metrics.text import crop_boxes

    for boxes in read_boxes(path).values():
        crop_boxes(_frames()[0], boxes)


def _make_dataset(folder: Path, rng: np.random.Generator) -> Path:
    import hashlib

    from safetensors.numpy import save

    from turbnet.data.shards import CONDITIONS, FORMAT, MANIFEST, PICTURES, shard_name

    tensors = {name: np.zeros((2, 3, 3, 8, 8), np.uint8) for name in PICTURES}
    tensors |= {"tilt": np.zeros((2, 3, 2, 8, 8), np.float16)} | {name: np.zeros(2) for name in CONDITIONS}
    data = save(tensors)
    record = {"file": shard_name(0), "samples": 2, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    manifest: Any = {"format": FORMAT, "complete": True, "count": 2, "shard_size": 2, "shards": [record]}
    text = json.dumps(manifest).encode()
    which = rng.integers(3)
    if which == 0:
        data = spoil(data, rng)
    elif which == 1:
        text = spoil(text, rng)
    else:
        text = json.dumps(spoil_values(manifest, rng)).encode()
    (folder / shard_name(0)).write_bytes(data)
    (folder / MANIFEST).write_bytes(text)
    return folder


def _read_dataset(folder: Path) -> None:
    from turbnet.data.shards import Shards, verify

    list(islice(verify(folder), 100))
    shards = Shards(folder)
    for index in range(min(len(shards), 3)):
        assert shards[index]["frames"].ndim == 4


@lru_cache
def _model() -> Any:
    from onnx import TensorProto, helper

    shape = ["batch", "frames", 3, "height", "width"]
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name in ("frames", "restored")]
    nodes = [helper.make_node("Mul", ["frames", "w"], ["y"]), helper.make_node("Relu", ["y"], ["restored"])]
    weight = helper.make_tensor("w", TensorProto.FLOAT, [1, 1, 3, 1, 1], [0.9, 1.0, 1.1])
    graph = helper.make_graph(nodes, "scale", values[:1], values[1:], [weight])
    return helper.make_model(graph, ir_version=10, opset_imports=[helper.make_opsetid("", 20)])


def _make_model(folder: Path, rng: np.random.Generator) -> Path:
    """Spoiled after sealing, before it, or in its card."""
    from onnx import helper

    from turbnet.deploy.card import ModelCard
    from turbnet.deploy.seal import seal

    card = ModelCard("scale", {"a": 1}, 4, 6, notes={"b": 2}).to_metadata()
    which = rng.integers(3)
    if which == 2:
        fields = {key: json.loads(value) for key, value in card.items() if not key.endswith("sha256")}
        key = list(fields)[rng.integers(len(fields))]
        card[key] = json.dumps(spoil_values(fields[key], rng))
    model = type(_model())()
    model.CopyFrom(_model())
    helper.set_model_props(model, card)
    data = model.SerializeToString()
    if which == 1:
        data = spoil(data, rng)
    with suppress(InputError, ValueError):  # the seal itself is spoiled
        data = seal(data)
    path = folder / "model.onnx"
    path.write_bytes(spoil(data, rng) if which == 0 else data)
    return path


def _read_model(path: Path) -> None:
    from turbnet.deploy.restore import restore_array
    from turbnet.deploy.session import Model

    model = Model.load(path, threads=1)
    restored = restore_array(_frames()[:2, :, :, :3], model)
    assert restored.shape[:3] == (2, 64, 80)


@lru_cache
def _checkpoint() -> dict[str, Any]:
    import torch

    from turbnet.nets import build

    torch.manual_seed(0)
    net = {"name": "dncnn", "width": 4, "depth": 3}
    weights = {f"net.{name}": value for name, value in build(net).state_dict().items()}
    recipe = {"frames": [1, 6], "data": "x"}
    return {"state_dict": weights, "hyper_parameters": {"net": net, "simulator": {}, "seed": 1, "recipe": recipe}}


def _make_checkpoint(folder: Path, rng: np.random.Generator) -> Path:
    import torch

    path = folder / "last.ckpt"
    spoiled = rng.random() < 0.5
    torch.save(spoil_values(_checkpoint(), rng) if spoiled else _checkpoint(), path)
    if not spoiled:
        path.write_bytes(spoil(path.read_bytes(), rng))
    return path


def _read_checkpoint(path: Path) -> None:
    import torch

    from turbnet.deploy.checkpoint import card_of, load_network

    network, hyper_parameters = load_network(path)
    with torch.no_grad():
        network(torch.zeros(1, 2, 3, 16, 16))
    card_of(network, hyper_parameters, 6)


def _make_config(folder: Path, rng: np.random.Generator) -> Path:
    import yaml

    config = {
        "data": {"size": 32, "frames": 2},
        "net": {"tcja": {"width": 8}},
        "hydra": {"mode": "RUN", "callbacks": {}},
    }
    if rng.random() < 0.5:
        text = yaml.safe_dump(spoil_values(config, rng)).encode()
    else:
        text = spoil(yaml.safe_dump(config).encode(), rng)
    path = folder / "experiment" / "odd.yaml"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"# @package _global_\n" + text)
    return path


def _read_config(path: Path) -> None:
    from turbnet.cli import run

    with redirect_stdout(StringIO()), redirect_stderr(StringIO()) as said:
        run(["train", "--cfg", "job", "--config-dir", str(path.parents[1]), "experiment=odd"])
    assert said.getvalue().count("\n") <= 1, said.getvalue()


KINDS: dict[str, Kind] = {
    **{name: _clip_kind(name) for name in ("a.mp4", "a.mov", "a.mkv", "a.avi", "b.avi", "a.webm", "a.mpg", "a.ts")},
    **{name: _clip_kind(name) for name in ("a.gif", "a.png", "deep.png", "moving.png", "a.jpg", "a.bmp")},
    **{name: _clip_kind(name) for name in ("a.webp", "moving.webp", "a.tif", "lzw.tif", "deflated.tif")},
    "pack": Kind(_make_pack, _read_pack),
    "boxes": Kind(_make_boxes, _read_boxes),
    "dataset": Kind(_make_dataset, _read_dataset),
    "model": Kind(_make_model, _read_model),
    "checkpoint": Kind(_make_checkpoint, _read_checkpoint),
    "config": Kind(_make_config, _read_config),
}


# --- running ----------------------------------------------------------------------------------------------------------

Case = tuple[str, int, int]
"""Kind, seed and number of a case: all that it depends on."""


def run_case(case: Case) -> str:
    """Empty if the case went as it should, else what happened."""
    name, seed, number = case
    kind = KINDS[name]
    rng = np.random.default_rng([seed, number, sorted(KINDS).index(name)])
    with tempfile.TemporaryDirectory() as folder:
        path = kind.make(Path(folder), rng)
        try:
            with warnings.catch_warnings(record=True) as warned:
                warnings.simplefilter("always")
                kind.read(path)
        except InputError as error:
            return "" if "\n" not in str(error) and str(error) else f"an error of several lines: {error}"
        except BaseException as error:
            return f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        return f"a warning: {warned[0].message}" if warned else ""


def _work(cases: list[Case], memory: float, results: Any) -> None:
    for name in {case[0] for case in cases}:  # what is imported does not count
        run_case((name, 0, 0))
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + int(memory * 2**30), -1))
    for case in cases:
        results.send(run_case(case))


def findings(cases: list[Case], seconds: float = SECONDS, memory: float = MEMORY) -> Iterator[tuple[Case, str]]:
    """Cases that went wrong, and how; a process that dies or takes `seconds` for one case is replaced by another.

    Args:
        memory: GiB that reading a file may take beside what the process needs at rest.
    """
    # Spawned, not forked: libraries with threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    while cases:
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=_work, args=(cases, memory, sender), daemon=True)
        process.start()
        sender.close()
        patience = 10 * seconds  # for its imports
        while cases:
            try:
                found = receiver.recv() if receiver.poll(patience) else f"no end after {seconds:g} s"
            except EOFError:
                process.join()
                found = f"the process died with exit code {process.exitcode}"
            case, *cases = cases
            if found:
                yield case, found
            patience = seconds
            if found.startswith(("no end", "the process")):
                break
        process.kill()
        process.join()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(KINDS)}; all of them unless given")
    parser.add_argument("--minutes", type=float, default=10.0, help="stop after so long")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", type=int, help="of each kind, in place of --minutes")
    parser.add_argument("--only", type=int, metavar="NUMBER", help="this case alone, as a finding names it")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="that one case may take")
    parser.add_argument("--memory", type=float, default=MEMORY, help="GiB that one case may take")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="with --only: leave the file there")
    options = parser.parse_args()
    kinds = options.kinds or list(KINDS)
    unknown = [name for name in kinds if name not in KINDS]
    if unknown:
        print(f"fuzz: there is no kind {unknown[0]}; the kinds are {', '.join(KINDS)}", file=sys.stderr)
        return 2
    if options.keep:
        options.keep.mkdir(parents=True, exist_ok=True)
        for name in kinds:
            rng = np.random.default_rng([options.seed, options.only, sorted(KINDS).index(name)])
            print(KINDS[name].make(options.keep, rng))
    end = time.monotonic() + 60 * options.minutes
    done = wrong = 0
    for batch in count():
        numbers = [options.only] if options.only is not None else range(20 * batch, 20 * batch + 20)
        if options.cases is not None:
            numbers = [number for number in numbers if number < options.cases]
        cases = [(name, options.seed, number) for name in kinds for number in numbers]
        if not cases or (options.cases is None and time.monotonic() > end):
            break
        for (name, seed, number), found in findings(cases, options.seconds, options.memory):
            wrong += 1
            print(f"{name} --seed {seed} --only {number}: {found}", flush=True)
        done += len(cases)
        if options.only is not None:
            break
    print(f"{done} cases, {wrong} findings")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
