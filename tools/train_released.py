"""Retrain the released weights: one command, resumable.

    python tools/train_released.py s --pictures FOLDER [--leg 9] [--gpu] [--output outputs/released] [--threads 2]
    python tools/train_released.py s --checkpoint FILE

Trains `experiment=s` (or xs, m, still) on the pictures of folders or packs (tools/pack_pictures.py) and rendered text, goes
on from the last checkpoint if any, measures the result on the standard benchmark, whose scenes are never trained on, and
writes turbnet/weights/s.onnx and s.safetensors with their card; the maps of `still` become maps.onnx as well. With --leg it
stops after so many minutes if it has not finished; the same command goes on. With --checkpoint it trains nothing and
releases what was trained elsewhere.
"""

import argparse
import hashlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from safetensors.torch import save
from single_frames import benchmark, mean, through

from turbnet.deploy.card import ModelCard
from turbnet.deploy.checkpoint import card_of, load_network, maps_alone
from turbnet.deploy.export import export_onnx, flush_denormals
from turbnet.deploy.session import Model
from turbnet.deploy.weights import MAPS
from turbnet.weights.released import DIGEST

WINDOW = {"xs": 32, "s": 32, "m": 32, "still": 1}
"""Frames restored together, as recommended to users."""

MEASURES = {
    "static": ("PSNR",),
    "dynamic": ("PSNR where it moves", "PSNR where it does not"),
    "text": ("PSNR", "character error rate"),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("net", choices=WINDOW, help="which network")
    parser.add_argument("--pictures", nargs="+", type=Path, default=[], help="clean pictures: folders, packs")
    parser.add_argument("--checkpoint", type=Path, help="release this one; no training")
    parser.add_argument("--data", default="photographs of a user's folder, rendered text", help="for the card")
    parser.add_argument("--history", default="one uninterrupted recipe", help="how it went, for the card")
    parser.add_argument("--failures", default="not looked into", help="known failures, for the card")
    parser.add_argument("--steps", type=int, help="taken, for the card; default: as the checkpoint says")
    parser.add_argument("--output", type=Path, default=Path("outputs/released"))
    parser.add_argument("--weights", type=Path, default=Path(__file__).parents[1] / "turbnet" / "weights")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--leg", type=float, help="minutes to train at most this time")
    parser.add_argument("--gpu", action="store_true", help="train on one GPU")
    parser.add_argument(
        "--suite", default="standard", choices=("quick", "standard"), help="of turbnet bench restoration"
    )
    parser.add_argument(
        "--set", dest="overrides", nargs="+", default=[], metavar="KEY=VALUE", help="of the configuration"
    )
    options = parser.parse_args()

    checkpoint = options.checkpoint
    if checkpoint is None:
        if not options.pictures:
            parser.error("give --pictures to train on, or a --checkpoint")
        checkpoint = train(options)
        if checkpoint is None:
            return 0
    release(checkpoint, options)
    return 0


def train(options: argparse.Namespace) -> Path | None:
    """Train, or go on; the last checkpoint, or None if there is more to train."""
    output = options.output / options.net
    last: Path = output / "checkpoints" / "last.ckpt"
    arguments = [
        f"experiment={options.net}",
        f"data.folders=[{','.join(str(path.resolve()) for path in options.pictures)}]",
        f"threads={options.threads}",
        f"output={output}",
    ]
    if last.is_file():
        arguments.append(f"resume={last.resolve()}")
    if options.gpu:
        arguments.append("trainer=gpu")
    if options.leg:
        arguments.append(f"+trainer.max_time={{minutes: {options.leg}}}")
    subprocess.run([sys.executable, "-m", "turbnet", "train", *arguments, *options.overrides], check=True)
    done = torch.load(last, weights_only=True, map_location="cpu")["epoch"] + 1
    wanted = OmegaConf.load(output / "config.yaml").trainer.max_epochs
    if done < wanted:
        print(f"{done} of {wanted} epochs; the same command goes on")
        return None
    return last


def release(checkpoint: Path, options: argparse.Namespace) -> None:
    """Measure a checkpoint and put it in the package with its card."""
    network, hyper_parameters = load_network(checkpoint)
    weights = save({key: value.contiguous() for key, value in flush_denormals(network).state_dict().items()})
    frames = WINDOW[options.net]
    if options.net == "still":
        measured = {"measured by": "tools/single_frames.py; means over scenes", **single(network)}
    else:
        options.output.mkdir(parents=True, exist_ok=True)
        path = options.output / f"{options.net}.onnx"
        export_onnx(network, card_of(network, {**hyper_parameters, "recipe": {}}, frames), path)
        by = f"turbnet bench restoration --suite {options.suite} --model {options.net}"
        measured = {"measured by": f"{by}; means over scenes with 95 % intervals", **quality(path, options.suite)}
    hyper_parameters["recipe"] = {
        "data": options.data,
        "recipe": f"python tools/train_released.py {options.net} --pictures FOLDER",
        "steps": options.steps or torch.load(checkpoint, weights_only=True, map_location="cpu")["global_step"],
        "history": options.history,
        **measured,
        "known failures": options.failures,
        DIGEST: hashlib.sha256(weights).hexdigest(),
    }
    card = card_of(network, hyper_parameters, frames)
    if options.net == "still":
        put(*maps_alone(network, card), options.weights / f"{MAPS}.onnx")
    path = options.weights / f"{options.net}.onnx"
    put(network, card, path)
    path.with_suffix(".safetensors").write_bytes(weights)
    print(path.with_suffix(".md").read_text())


def put(network: torch.nn.Module, card: ModelCard, path: Path) -> None:
    """Write an ONNX file and its card."""
    for row in export_onnx(network, card, path):
        print(f"{row.shape}: largest difference from torch {row.difference:.1e}")
    Model.load(path).card.write_beside(path)


def single(network: torch.nn.Module) -> dict[str, str]:
    """PSNR of single frames, by kind and strength."""
    notes = {}
    for (kind, strength), clips in benchmark().items():
        before, after = mean(lambda x: x, clips), mean(lambda x: through(network, x), clips)
        notes[f"PSNR, {kind}, D/r0 = {strength:g}"] = f"{after:.2f} (input {before:.2f})"
    return notes


def quality(model: Path, suite: str) -> dict[str, str]:
    """What the benchmark says of input and model, by kind, length and strength; its report stays beside the model."""
    report, table = model.with_suffix(".bench.json"), model.with_suffix(".bench.md")
    command = ["bench", "restoration", "--suite", suite, "--model", str(model), "--json", str(report)]
    command += ["--markdown", str(table), "--quiet"]
    subprocess.run([sys.executable, "-m", "turbnet", *command], check=True)
    rows: dict[str, float] = {row["name"]: row["value"] for row in json.loads(report.read_text())["rows"]}
    notes = {}
    for name in rows:
        entrant, _, rest = name.partition(", ")
        kind, _, measure = rest.partition(": ")
        if entrant == str(model) and measure in MEASURES.get(kind.split(", ")[0], ()):
            notes[f"{measure}, {kind}"] = f"{said(rows, name)} (input {said(rows, f'input, {rest}')})"
    return notes


def said(rows: dict[str, Any], name: str) -> str:
    digits = 2 if "error" in name else 1
    half = rows.get(f"{name}, half its 95 % interval")
    return f"{rows[name]:.{digits}f}" + (f" +- {half:.{digits}f}" if half is not None else "")


if __name__ == "__main__":
    sys.exit(main())
