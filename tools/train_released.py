"""Retrain the released weights: one command, resumable.

    python tools/train_released.py s --pictures FOLDER [--leg 9] [--gpu] [--output outputs/released] [--threads 2]
    python tools/train_released.py s --checkpoint FILE

Trains `experiment=s` (or xs, m) on the pictures of folders or packs (tools/pack_pictures.py) and rendered text, goes on from
the last checkpoint if any, measures the result on the standard benchmark, whose scenes are never trained on, and writes
turbnet/weights/s.onnx and s.safetensors with their card. With --leg it stops after so many minutes if it has not finished;
the same command goes on. With --checkpoint it trains nothing and releases what was trained elsewhere.
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

from turbnet.deploy.checkpoint import card_of, load_network
from turbnet.deploy.export import export_onnx, flush_denormals
from turbnet.deploy.session import Model
from turbnet.weights.released import DIGEST

WINDOW = {"xs": 32, "s": 32, "m": 32}
"""Frames restored together, as recommended to users."""

MEASURES = {
    "static": ("PSNR",),
    "dynamic": ("PSNR where it moves", "PSNR where it does not"),
    "text": ("PSNR", "character error rate"),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("net", choices=("xs", "s", "m"), help="which network")
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
    options.output.mkdir(parents=True, exist_ok=True)
    path = options.output / f"{options.net}.onnx"
    export_onnx(network, card_of(network, {**hyper_parameters, "recipe": {}}, frames), path)
    measured = quality(path, options.suite)
    hyper_parameters["recipe"] = {
        "data": options.data,
        "recipe": f"python tools/train_released.py {options.net} --pictures FOLDER",
        "steps": options.steps or torch.load(checkpoint, weights_only=True, map_location="cpu")["global_step"],
        "history": options.history,
        "measured by": f"turbnet bench restoration --suite {options.suite} --model {options.net}; means over scenes with "
        "95 % intervals",
        **measured,
        "known failures": options.failures,
        DIGEST: hashlib.sha256(weights).hexdigest(),
    }
    path = options.weights / f"{options.net}.onnx"
    for row in export_onnx(network, card_of(network, hyper_parameters, frames), path):
        print(f"{row.shape}: largest difference from torch {row.difference:.1e}")
    Model.load(path).card.write_beside(path)
    path.with_suffix(".safetensors").write_bytes(weights)
    print(path.with_suffix(".md").read_text())


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
