"""What the parts of the restorer and of its training are worth: one network and one recipe, a part left out at a time.

    python tools/ablation.py --pictures FOLDER [--epochs 25] [--only NAME ...] [--output outputs/ablation]

Trains `experiment=xs` and its variants from the same seed for as many steps, resumable, then restores clips of 12 frames
that none was trained on: those of the standard benchmark, and still scenes seen through a split-step simulation of wave
optics, which neither the exact nor the simple simulator made. Prints a table for docs/benchmarks.md and keeps it in
--output.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbnet.atmosphere.path import OpticalPath
from turbnet.bench.restoration import BORDER, psnr_moving
from turbnet.bench.suite import make_clip
from turbnet.cli.train import main as train
from turbnet.deploy.checkpoint import load_network
from turbnet.media.atomic import atomic_path
from turbnet.media.colour import to_linear, to_srgb
from turbnet.metrics.fidelity import psnr
from turbnet.nets import NETS
from turbnet.nets.blocks import each_frame
from turbnet.nets.restorer import Restorer
from turbnet.nets.tilt import Registered, TiltNet
from turbnet.optics.psf import convolve
from turbnet.simulate.draw import TILT_PIXELS
from turbnet.simulate.point_field import run_points
from turbnet.simulate.sampling import Sampling
from turbnet.simulate.sensor import Sensor
from turbnet.simulate.split_step import SplitStep, point_grid
from turbnet.simulate.tilt import splat

FRAMES, SCENES, STRENGTH = 12, 4, 3.0
SIZE, STEP = 128, 16  # of the split-step clips and between their points, pixels

VARIANTS: dict[str, tuple[str, ...]] = {
    "as it is": (),
    "without tilt removal": ("net.name=unregistered",),
    "without TCJA: temporal mean of features": ("net.name=mean-features",),
    "without the drift": ("net.name=no-drift",),
    "plain U-Net of as many MACs": ("net=unet", "net.widths=[18,36,56]", "net.depths=[1,2,3]"),
    "trained with direct-to-image": ("simulator.model=direct-to-image",),
    "trained with warp and blur": ("simulator.model=warp-blur",),
}


class _Unregistered(TiltNet):
    """Takes frames as they are."""

    def forward(
        self, frames_BTCHW: Tensor, past_BCHW: Tensor | None = None, recent_BCHW: Tensor | None = None
    ) -> Registered:
        found = super().forward(frames_BTCHW, past_BCHW, recent_BCHW)
        reference = frames_BTCHW.mean(1, keepdim=True)
        nowhere, even = ([torch.zeros_like(x) for x in xs] for xs in (found.tilts, found.logits))
        half = each_frame(lambda x: F.avg_pool2d(x, 2), frames_BTCHW)
        return Registered(
            frames_BTCHW, nowhere, even, reference, half, half - F.avg_pool2d(reference[:, 0], 2)[:, None]
        )


class Unregistered(Restorer):
    """A restorer without tilt removal."""

    def __init__(self, tilt: Mapping[str, Any] | None = None, **more: Any) -> None:
        super().__init__(tilt=tilt, **more)
        self.tilt = _Unregistered(**(tilt or {}))


class _MeanOverTime(nn.Module):
    """In place of attention: every frame gathers the mean of all."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.expand, self.project = nn.Conv2d(channels, channels, 1), nn.Conv2d(channels, channels, 1)

    def forward(
        self, x_BTCHW: Tensor, memory_BMCHW: Tensor | None = None, held_BM1HW: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        mean = each_frame(self.expand, x_BTCHW).mean(1, keepdim=True)
        return each_frame(self.project, mean).expand_as(x_BTCHW), torch.cat((x_BTCHW, x_BTCHW), dim=2)


class MeanFeatures(Restorer):
    """A restorer whose frames tell each other their mean only."""

    def __init__(self, **parts: Any) -> None:
        super().__init__(**parts)
        for block in self.tcja.blocks:
            block.attention = _MeanOverTime(self.tcja.width)


class _NoDrift(TiltNet):
    def forward(
        self, frames_BTCHW: Tensor, past_BCHW: Tensor | None = None, recent_BCHW: Tensor | None = None
    ) -> Registered:
        # Each frame as a clip of its neighbours alone would need another reference: the levels' weights are cut instead.
        with torch.no_grad():
            for level in self.levels:
                level.layers[0].weight[:, -frames_BTCHW.shape[2] :] = 0
        found = super().forward(frames_BTCHW, past_BCHW, recent_BCHW)
        return found._replace(drift=torch.zeros_like(found.drift))


class NoDrift(Restorer):
    """A restorer that knows nothing of the order of frames."""

    def __init__(self, tilt: Mapping[str, Any] | None = None, **more: Any) -> None:
        super().__init__(tilt=tilt, **more)
        self.tilt = _NoDrift(**(tilt or {}))


NETS |= {"unregistered": Unregistered, "mean-features": MeanFeatures, "no-drift": NoDrift}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", nargs="+", type=Path, required=True, help="clean pictures: folders, packs")
    parser.add_argument("--epochs", type=int, default=25, help="of 50 steps")
    parser.add_argument("--only", nargs="+", default=list(VARIANTS), choices=VARIANTS, metavar="NAME")
    parser.add_argument("--output", type=Path, default=Path("outputs/ablation"))
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument(
        "--set", dest="overrides", nargs="+", default=[], metavar="KEY=VALUE", help="of the configuration"
    )
    parser.add_argument("--run", choices=VARIANTS, help=argparse.SUPPRESS)  # one training, in a process of its own
    options = parser.parse_args()
    if options.run:
        return run(options.run, options)
    for name in options.only:
        if not finished(name, options):
            subprocess.run([sys.executable, *sys.argv, "--run", name], check=True)
    torch.set_num_threads(options.threads)
    found = {name: measure(folder(name, options) / "checkpoints/last.ckpt", options.output) for name in options.only}
    lines = ["| variant | " + " | ".join(next(iter(found.values()))) + " |", "|---" * (1 + len(found[name])) + "|"]
    lines += [f"| {name} | " + " | ".join(f"{v:.2f}" for v in row.values()) + " |" for name, row in found.items()]
    print("\n".join(lines))
    with atomic_path(options.output / "ablation.json") as temporary:
        temporary.write_text(json.dumps({"epochs": options.epochs, "rows": found}, indent=2) + "\n")
    return 0


def folder(name: str, options: argparse.Namespace) -> Path:
    return Path(options.output, "".join(c if c.isalnum() else "-" for c in name))


def finished(name: str, options: argparse.Namespace) -> bool:
    last = folder(name, options) / "checkpoints/last.ckpt"
    return last.is_file() and torch.load(last, weights_only=True, map_location="cpu")["epoch"] + 1 >= options.epochs


def run(name: str, options: argparse.Namespace) -> int:
    """Train one variant, or go on."""
    output = folder(name, options)
    last = output / "checkpoints/last.ckpt"
    pictures = ",".join(str(path.resolve()) for path in options.pictures)
    arguments = ["experiment=xs", f"data.folders=[{pictures}]", f"threads={options.threads}", f"output={output}"]
    arguments += ["callbacks=quiet", f"trainer.max_epochs={options.epochs}", *VARIANTS[name]]
    arguments += options.overrides
    return train([*arguments, *([f"resume={last.resolve()}"] if last.is_file() else [])])


@torch.no_grad()
def measure(checkpoint: Path, output: Path) -> dict[str, float]:
    """Mean PSNR, dB, over scenes of the benchmark and of the split-step clips."""
    network = load_network(checkpoint)[0]

    def restore(frames_THWC: np.ndarray) -> np.ndarray:
        clip = torch.from_numpy(frames_THWC).permute(0, 3, 1, 2)[None]
        out: np.ndarray = network(clip)[0].clamp(0, 1).permute(0, 2, 3, 1).numpy()
        return out

    rows: dict[str, list[float]] = {}
    for scene in range(SCENES):
        for kind in ("static", "dynamic", "text"):
            clip = make_clip(kind, scene, STRENGTH, FRAMES)
            restored = restore(clip.frames)
            if kind == "dynamic":
                for where, value in zip(
                    ("where it moves", "where it does not"), psnr_moving(restored, clip), strict=True
                ):
                    rows.setdefault(where, []).append(value)
            else:
                rows.setdefault(kind, []).append(float(np.mean(psnr(restored, clip.target, BORDER))))
        frames, clean = split_step_clip(scene, output / "split-step")
        rows.setdefault("split-step", []).append(float(np.mean(psnr(restore(frames), clean, BORDER))))
    return {name: float(np.mean(values)) for name, values in rows.items()}


def split_step_clip(scene: int, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Frames and the clean clip, (T, H, W, 3): a still scene of the benchmark through independent draws of wave optics.

    PSFs and tilts are computed on a grid of points and interpolated between them, bilinearly and bicubically.
    """
    path = OpticalPath.from_d_over_r0(STRENGTH)
    points = SIZE // STEP + 1
    across = SplitStep(Sampling(path), point_grid(path, points, points, float(STEP)))
    clean = make_clip("static", scene, STRENGTH, 1).target[:, :SIZE, :SIZE].repeat(FRAMES, 0)
    linear = to_linear(torch.from_numpy(clean[0]).permute(2, 0, 1))
    shares = F.interpolate(
        torch.eye(points**2).view(1, -1, points, points), (SIZE + 1, SIZE + 1), mode="bilinear", align_corners=True
    )[0, :, :SIZE, :SIZE]
    tilts, images = [], []
    fields = [run_points(across, folder / f"air-{frame}", seed=frame, quiet=True) for frame in range(FRAMES)]
    for field in fields:
        tilt = TILT_PIXELS * field.coefficients[:, 1:3].T.reshape(1, 2, points, points)
        tilts.append(F.interpolate(tilt, (SIZE + 1, SIZE + 1), mode="bicubic", align_corners=True)[..., :SIZE, :SIZE])
    aim = torch.stack(tilts).mean((0, 1, 3, 4))[None, :, None, None]
    for number, (field, tilt) in enumerate(zip(fields, tilts, strict=True)):
        parts = shares[:, None] * torch.cat((linear, torch.ones_like(linear[:1])))
        moved = splat(parts.flatten(0, 1)[None], tilt - aim)[0].unflatten(0, (points**2, 4))
        seen = sum(
            convolve(part, psf[None].expand(4, -1, -1)) for part, psf in zip(moved, field.tilt_free_psf, strict=True)
        )
        picture = (seen[:3] / seen[3:].clamp(min=1e-3))[None, None]
        images.append(Sensor(20_000, 0.01)(picture, 1000 * scene + number)[0, 0])
    frames = (to_srgb(torch.stack(images).clamp(0, 1)) * 255).round() / 255
    return frames.permute(0, 2, 3, 1).numpy(), clean


if __name__ == "__main__":
    sys.exit(main())
