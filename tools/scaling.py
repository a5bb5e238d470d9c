"""How quality rises with training compute: xs, s and m trained from scratch by one recipe, on one plot.

    python tools/scaling.py --pictures FOLDER [--steps xs=800 s=400 m=200 unet=800] [--frames 8] [--output outputs/scaling]
        [--also m=50900:24:CHECKPOINT ...]

Trains every network on clips of 1 to so many frames, resumable, and validates it on the same clips as it goes; `unet` is the
plain U-Net of the cost of s, by its recipe. Prints a table and draws docs/images/scaling.png: PSNR on the validation clips
against what the training had cost by then, counted in multiplications and additions of the network, forward and backward
(three times forward); the simulator is not counted. With --also NAME=CLIPS:FRAMES:CHECKPOINT the table and the plot have
networks that were trained elsewhere on so many clips of 1 to FRAMES frames as well.
"""

import argparse
import csv
import json
import math
import sys
from pathlib import Path
from typing import Any

import lightning.pytorch as L
import matplotlib.pyplot as plt
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from resumable import train
from torch.utils.flop_counter import FlopCounterMode

from turbnet.media.atomic import atomic_path
from turbnet.nets import build
from turbnet.tasks.checkpoint import read_checkpoint

SIZE, BATCH, EPOCH = 128, 3, 20


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", nargs="+", type=Path, required=True, help="clean pictures: folders, packs")
    steps = [("xs", 800), ("s", 400), ("m", 200)]
    parser.add_argument("--steps", nargs="+", type=wanted, default=steps, metavar="NET=N")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--also", nargs="+", type=elsewhere, default=[], metavar="NAME=CLIPS:FRAMES:CHECKPOINT")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--output", type=Path, default=Path("outputs/scaling"))
    parser.add_argument("--figure", type=Path, default=Path("docs/images/scaling.png"))
    parser.add_argument(
        "--set", dest="overrides", nargs="+", default=[], metavar="KEY=VALUE", help="of the configuration"
    )
    options = parser.parse_args()
    curves: dict[str, list[tuple[int, float, float]]] = {}
    for name, steps in options.steps:
        folder = trained(name, steps, options)
        cost = 3 * clip_flops(OmegaConf.load(folder / "config.yaml").net, options.frames)
        curves[name] = [(BATCH * step, BATCH * step * cost, quality) for step, quality in history(folder)]
    for name, clips, frames, path in options.also:
        cost = 3 * clip_flops(read_checkpoint(path)["hyper_parameters"]["net"], frames)
        point = (clips, clips * cost, validated(path, folder))
        curves.setdefault(f"{name}, elsewhere", []).append(point)
    lines = ["| network | clips | TFLOP | PSNR, dB |", "|---|---|---|---|"]
    for name, curve in curves.items():
        lines += [f"| {name} | {clips} | {flops / 1e12:.1f} | {quality:.2f} |" for clips, flops, quality in curve]
    print("\n".join(lines))
    with atomic_path(options.output / "scaling.json") as temporary:
        temporary.write_text(json.dumps(curves, indent=2) + "\n")
    draw(curves, options.figure)
    return 0


def wanted(entry: str) -> tuple[str, int]:
    """NET=N."""
    name, steps = entry.split("=")
    return name, int(steps)


def elsewhere(entry: str) -> tuple[str, int, int, Path]:
    """NAME=CLIPS:FRAMES:CHECKPOINT."""
    name, rest = entry.split("=", 1)
    clips, frames, path = rest.split(":", 2)
    return name, int(clips), int(frames), Path(path)


def trained(name: str, steps: int, options: argparse.Namespace) -> Path:
    """The folder of one network's training."""
    folder: Path = options.output / name
    epochs = math.ceil(steps / EPOCH)
    arguments = [f"experiment={name}", "data=folders", f"data.frames=[1,{options.frames}]", "data.val_clips=6"]
    arguments += [f"data.size={SIZE}", f"data.batch_size={BATCH}", f"data.steps_per_epoch={EPOCH}"]
    arguments += [f"data.curriculum={steps // 4}", "data.text=0.25", "data.moving=0.25"]
    arguments += [f"trainer.check_val_every_n_epoch={math.gcd(epochs, 2)}", *options.overrides]
    train(folder, epochs, options.pictures, options.threads, arguments)
    return folder


def validated(checkpoint: Path, folder: Path) -> float:
    """PSNR of a checkpoint on the validation clips of the training in `folder`."""
    config: Any = OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"), resolve=True)
    net = read_checkpoint(checkpoint)["hyper_parameters"]["net"]
    task = instantiate({**config["task"], "net": net, "start_from": str(checkpoint)}, _convert_="all")
    trainer = L.Trainer(accelerator="cpu", logger=False, enable_progress_bar=False, enable_model_summary=False)
    return float(trainer.validate(task, instantiate(config["data"], _convert_="all"), verbose=False)[0]["val/psnr"])


def clip_flops(net: Any, most: int) -> float:
    """Of a forward pass of a clip on average: clips have 1 to `most` frames, equally likely on a logarithmic scale."""
    network = build(OmegaConf.to_container(net) if OmegaConf.is_config(net) else net).eval()
    counts = []
    for frames in (1, most):
        with FlopCounterMode(display=False) as counter, torch.no_grad():
            network(torch.rand(1, frames, 3, SIZE, SIZE))
        counts.append(counter.get_total_flops())
    edges = [math.log(n) for n in range(1, most + 2)]
    mean = sum(n * (b - a) / edges[-1] for n, (a, b) in enumerate(zip(edges, edges[1:], strict=False), start=1))
    return float(counts[0] + (counts[1] - counts[0]) * (mean - 1) / (most - 1))


def history(folder: Path) -> list[tuple[int, float]]:
    """Steps taken and PSNR of the averaged weights on the validation clips, of all legs."""
    found = {}
    for path in sorted(folder.glob("csv/version_*/metrics.csv")):
        with path.open(newline="") as file:
            for row in csv.DictReader(file):
                if row.get("val/psnr"):
                    found[int(row["step"]) + 1] = float(row["val/psnr"])
    return sorted(found.items())


def draw(curves: dict[str, list[tuple[int, float, float]]], path: Path) -> None:
    figure, axis = plt.subplots(figsize=(5.5, 3.6), layout="constrained")
    for (name, curve), marker in zip(curves.items(), "os^vDP*X", strict=False):
        axis.plot(
            [flops / 1e12 for _, flops, _ in curve], [quality for *_, quality in curve], marker=marker, label=name
        )
    axis.set(xscale="log", xlabel="training compute, TFLOP", ylabel="PSNR on validation clips, dB")
    axis.grid(alpha=0.3)
    axis.legend()
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150, format="png")


if __name__ == "__main__":
    sys.exit(main())
