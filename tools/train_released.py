"""Retrain the released weights: one command, resumable.

    python tools/train_released.py s --pictures FOLDER [--leg 9] [--gpu] [--output outputs/released] [--threads 2]

Trains `experiment=s` (or xs, m) on the pictures of folders or packs (tools/pack_pictures.py) and rendered text, goes on from
the last checkpoint if any, measures the result on pictures it has never seen, and writes turbnet/weights/s.onnx with its
card. With --leg it stops after so many minutes if it has not finished; the same command goes on.
"""

import argparse
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch
from omegaconf import OmegaConf

from turbnet.data.clips import CleanClips
from turbnet.data.pairs import PairMaker
from turbnet.data.sources import Pictures, Source, Text, embedded_paths
from turbnet.deploy.checkpoint import card_of, load_network
from turbnet.deploy.export import export_onnx
from turbnet.deploy.session import Model
from turbnet.metrics.fidelity import psnr

STRENGTHS = (1.5, 3.0, 4.5)
CLIPS, FRAMES, SIZE, WINDOW = 8, 12, 128, 12


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("net", choices=("xs", "s", "m"), help="which network")
    parser.add_argument("--pictures", required=True, nargs="+", type=Path, help="clean pictures: folders, packs")
    parser.add_argument(
        "--data", default="photographs of a user's folder, rendered text", help="what the card says of it"
    )
    parser.add_argument("--history", default="one uninterrupted recipe", help="what the card says of how it went")
    parser.add_argument("--output", type=Path, default=Path("outputs/released"))
    parser.add_argument("--weights", type=Path, default=Path(__file__).parents[1] / "turbnet" / "weights")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--leg", type=float, help="minutes to train at most this time")
    parser.add_argument("--gpu", action="store_true", help="train on one GPU")
    parser.add_argument(
        "--set", dest="overrides", nargs="+", default=[], metavar="KEY=VALUE", help="of the configuration"
    )
    options = parser.parse_args()

    output = options.output / options.net
    last = output / "checkpoints" / "last.ckpt"
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
    done, steps, wanted = progress(output)
    if done < wanted:
        print(f"{done} of {wanted} epochs; the same command goes on")
        return

    network, hyper_parameters = load_network(last)
    hyper_parameters["recipe"] = {
        "data": options.data,
        "recipe": f"python tools/train_released.py {options.net} --pictures FOLDER",
        "steps": steps,
        "history": options.history,
    }
    for name, source in (("photographs", Pictures(embedded_paths("test"), (0.4, 0.7))), ("text", Text())):
        for strength in STRENGTHS:
            hyper_parameters["recipe"][f"PSNR dB, {name}, D/r0 = {strength}"] = quality(network, source, strength)
    hyper_parameters["recipe"]["measured on"] = (
        f"{CLIPS} still scenes of {SIZE} x {SIZE} each, {FRAMES} frames that see independent atmospheres, read noise 1 %: "
        "two pictures of scikit-image that were never trained on, and rendered text; mean +- standard error over clips"
    )
    path = options.weights / f"{options.net}.onnx"
    for row in export_onnx(network, card_of(network, hyper_parameters, WINDOW), path):
        print(f"{row.shape}: largest difference from torch {row.difference:.1e}")
    Model.load(path).card.write_beside(path)
    print(path.with_suffix(".md").read_text())


def progress(output: Path) -> tuple[int, int, int]:
    """Epochs and steps behind the last checkpoint, and epochs of the whole recipe."""
    last = torch.load(output / "checkpoints" / "last.ckpt", weights_only=True, map_location="cpu")
    return last["epoch"] + 1, last["global_step"], OmegaConf.load(output / "config.yaml").trainer.max_epochs


def quality(network: torch.nn.Module, source: Source, strength: float) -> str:
    """PSNR of input, temporal mean and restored frames on held-out clips, dB."""
    clips = CleanClips(source, CLIPS, FRAMES, SIZE, SIZE, seed=777)
    maker = PairMaker(
        SIZE,
        SIZE,
        d_over_r0=strength,
        independent=1.0,
        read_noise=0.01,
        stride=4,
        components=20,
        margin=None,
    )
    scores: dict[str, list[float]] = {"input": [], "temporal mean": [], "restored": []}
    for index in range(CLIPS):
        clip = clips[index]
        pair = maker(clip["scene"][None], [int(clip["seed"])])
        with torch.no_grad():
            restored = network(pair.frames).clamp(0, 1)
        target = pair.target[0].permute(0, 2, 3, 1)
        for name, frames in (
            ("input", pair.frames),
            ("temporal mean", pair.frames.mean(1, keepdim=True).expand_as(pair.frames)),
            ("restored", restored),
        ):
            scores[name].append(float(psnr(frames[0].permute(0, 2, 3, 1), target).mean()))
    return ", ".join(f"{name} {np.mean(v):.2f} +- {np.std(v) / np.sqrt(CLIPS):.2f}" for name, v in scores.items())


if __name__ == "__main__":
    main()
