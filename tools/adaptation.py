"""Whether a restorer learns from clips without truth: trained on weak turbulence, fine-tuned on strong, measured on both.

    python tools/adaptation.py --pictures FOLDER [--kind lens] [--clips] [--epochs 30] [--tuning 6] [--seeds 5]

Trains `task=redegradation net=redegrading` at D/r0 = 1 to 2, then `task=finetune` on clips at D/r0 = 4 of a new kind, with
more noise, a lens out of focus, a blur with tails or much more noise, simulated from pictures of the folder and kept as
files without their truth, once for each seed. Clips of both kinds over the still scenes of the benchmark, which neither saw,
then tell what was gained and what was lost, by the weights as tuned and by their mean with those before (--before).
Resumable: what is trained is not trained again. Prints a table and keeps it in --output. With --real FOLDER it does the same
with clips of its own: there is no truth, so what is measured is the re-degradation error, by the frame a restored one came
from and by another, and the residual jitter.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from resumable import train
from torch import Tensor

from turbnet.bench.suite import SIZE, make_clip
from turbnet.data.footage import footage_paths
from turbnet.data.pairs import Pair, PairMaker
from turbnet.data.sources import Pictures, folder_paths
from turbnet.media.atomic import atomic_path
from turbnet.media.clip import read_clip, write_clip
from turbnet.metrics.fidelity import psnr
from turbnet.metrics.stability import jitter
from turbnet.nets import build
from turbnet.nets.redegradation import Redegrading
from turbnet.tasks.checkpoint import load_net, mean_of, read_checkpoint
from turbnet.tasks.losses import charbonnier

OLD = {"d_over_r0": [1.0, 2.0], "full_well": 20_000.0, "read_noise": [0.0, 0.02]}
NOISY = {"d_over_r0": 4.0, "full_well": 3_000.0, "read_noise": 0.03, "blurred": 1.0}
KINDS = {
    "lens": {**NOISY, "defocus": 1.0},
    "tails": {**NOISY, "defocus": 2.5, "tails": 1.0},
    "dark": {**NOISY, "full_well": 300.0, "read_noise": 0.06, "defocus": 1.0},
}
FRAMES, SCENES, BORDER = 16, 4, 8
UNLABELLED, LONG = 16, 50  # clips without truth, and their frames


class Form(NamedTuple):
    """What a restorer of frames or of clips is trained with, and what it is fine-tuned with besides."""

    trained: tuple[str, ...]
    tuned: tuple[str, ...]


OF_FRAMES = Form(
    ("net=redegrading", "data.frames=4"),
    ("data.clip_frames=4", "task.learning_rate=1e-3"),
)
OF_CLIPS = Form(
    ("net=redegrading_clip", "data.frames=8"),
    ("data.clip_frames=8", "task.learning_rate=2e-4", "task.rehearsal_weight=4"),
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", nargs="+", type=Path, required=True, help="clean pictures: folders, packs")
    parser.add_argument(
        "--real", nargs="+", type=Path, help="folders of clips to fine-tune on in place of simulated ones"
    )
    parser.add_argument("--kind", choices=KINDS, default="lens", help="of the clips without truth")
    parser.add_argument(
        "--clips",
        dest="form",
        action="store_const",
        const=OF_CLIPS,
        default=OF_FRAMES,
        help="a restorer of clips, in place of one of single frames",
    )
    parser.add_argument("--start", help="with --clips: the released network that the restorer starts from")
    parser.add_argument("--epochs", type=int, default=30, help="of 50 steps, with truth")
    parser.add_argument("--tuning", type=int, default=6, help="epochs of 50 steps, without truth")
    parser.add_argument("--seeds", type=int, default=5, help="how many fine-tunings")
    parser.add_argument("--before", type=float, default=0.1, help="share of the weights before in the mean")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--output", type=Path, default=Path("outputs/adaptation"))
    parser.add_argument(
        "--set", dest="overrides", nargs="+", default=[], metavar="KEY=VALUE", help="of the configuration"
    )
    options = parser.parse_args()
    torch.set_num_threads(options.threads)

    old = [f"simulator.{name}={value}" for name, value in OLD.items()]
    start = [f"task.start_from={options.start}", "task.learning_rate=5e-4"] if options.start else []
    first = trained(options, "trained", options.epochs, ["task=redegradation", *old, *start])
    unlabelled = options.real or [simulate(options)]
    before = load(first)
    clips = {name: list(scenes(where)) for name, where in (("old", OLD), ("new", KINDS[options.kind]))}
    rows = {"trained": measure(before, clips, options.real)}
    for seed in range(options.seeds):
        folders = ",".join(str(folder.resolve()) for folder in unlabelled)
        more = ["task=finetune", "data=clips", f"data.clips=[{folders}]", f"task.start_from={first}", *old]
        more += [f"data.fused={options.output.resolve() / 'fused'}", "task.agree_weight=3", *options.form.tuned]
        tuned = trained(options, f"{options.kind}-{seed}", options.tuning, [*more, f"seed={seed}"])
        rows[f"fine-tuned, seed {seed}"] = measure(load(tuned), clips, options.real)
        mean = options.output / f"{options.kind}-{seed}" / "mean.ckpt"
        with atomic_path(mean) as temporary:
            torch.save(mean_of([first, tuned], [options.before, 1 - options.before]), temporary)
        rows[f"mean, seed {seed}"] = measure(load(mean), clips, options.real)
        print({name: round(value, 4) for name, value in rows[f"mean, seed {seed}"].items()}, flush=True)
    lines = ["| network | " + " | ".join(rows["trained"]) + " |", "|---" * (1 + len(rows["trained"])) + "|"]
    for name, row in rows.items():
        lines.append(f"| {name} | " + " | ".join(f"{v:.5f}" if v < 1 else f"{v:.2f}" for v in row.values()) + " |")
    print("\n".join(lines))
    with atomic_path(options.output / f"adaptation-{options.kind}.json") as temporary:
        temporary.write_text(json.dumps(rows, indent=2) + "\n")
    return 0


def trained(options: argparse.Namespace, name: str, epochs: int, arguments: list[str]) -> Path:
    """The last checkpoint of one training."""
    common = ["data.size=96", "data.steps_per_epoch=50"]
    if not options.start:  # what has learned how scenes move is to keep it
        common.append("data.moving=0")
    arguments = [*options.form.trained, *common, *arguments, *options.overrides]
    return train(options.output / name, epochs, options.pictures, options.threads, arguments)


def simulate(options: argparse.Namespace) -> Path:
    """Clips of the new kind without their truth, as files."""
    folder: Path = options.output / f"clips-{options.kind}"
    pictures = Pictures(folder_paths(options.pictures))
    maker = PairMaker(SIZE, SIZE, **KINDS[options.kind])
    for number in range(UNLABELLED):
        path = folder / f"{number:02d}.mkv"
        if not path.is_file():
            folder.mkdir(parents=True, exist_ok=True)
            picture = pictures(np.random.default_rng([7, number]), SIZE, SIZE)
            write_clip(path, as_frames(made(maker, np.asarray(picture, np.float32), number, LONG).frames))
    return folder


def scenes(where: dict[str, object]) -> Iterator[tuple[Tensor, np.ndarray]]:
    """Frames (1, T, C, H, W) and the clean clip of the benchmark's still scenes."""
    maker = PairMaker(SIZE, SIZE, **where)
    for scene in range(SCENES):
        clean = make_clip("static", scene, 3.0, 1).target
        pair = made(maker, clean[0], 10_000 + scene)
        yield pair.frames, as_frames(pair.target)


def made(maker: PairMaker, picture_HWC: np.ndarray, seed: int, frames: int = FRAMES) -> Pair:
    scene = torch.from_numpy(picture_HWC).permute(2, 0, 1).expand(1, frames, 3, SIZE, SIZE)
    pair: Pair = maker(scene, [seed])
    return pair


def as_frames(clip_BTCHW: Tensor) -> np.ndarray:
    frames: np.ndarray = clip_BTCHW[0].clamp(0, 1).permute(0, 2, 3, 1).numpy()
    return frames


def load(checkpoint: Path) -> Redegrading:
    config = read_checkpoint(checkpoint)["hyper_parameters"]["net"]
    network = build(config)
    network.load_state_dict(load_net(checkpoint, config))
    assert isinstance(network, Redegrading)
    return network.eval()


@torch.no_grad()
def measure(
    network: Redegrading, clips: dict[str, list[tuple[Tensor, np.ndarray]]], real: list[Path] | None
) -> dict[str, float]:
    """PSNR, dB, of either kind, input and restored; of real clips what can be known without truth."""
    rows = {}
    for kind, of_kind in clips.items():
        for name, restore in (("input", lambda frames: frames), ("restored", network)):
            scores = [psnr(as_frames(restore(frames)), clean, BORDER).mean() for frames, clean in of_kind]
            rows[f"{kind}, {name}"] = float(np.mean(scores))
    for number, path in enumerate(footage_paths(real or [])):
        frames = torch.from_numpy(read_clip(path)[0][:FRAMES]).permute(0, 3, 1, 2)[None]
        height, width = (side // network.size_multiple * network.size_multiple for side in frames.shape[-2:])
        frames = frames[..., :height, :width]
        found = network.stages(frames)
        rows[f"clip {number}, re-degradation error"] = float(charbonnier(found.frames, frames))
        # A restored frame may keep noise of its own frame, which explains that frame and no other.
        others = network.degradation(found.restored.roll(frames.shape[1] // 2, dims=1), found.code)
        rows[f"clip {number}, by another"] = float(charbonnier(others, frames))
        restored = as_frames(found.restored)
        rows[f"clip {number}, jitter"] = jitter(restored, restored.mean(0))
    return rows


if __name__ == "__main__":
    sys.exit(main())
