"""Single frames of the benchmark through networks and through the best linear filter.

    python tools/single_frames.py NAME=CHECKPOINT [...] [--picture docs/images/maps.png]

Prints a table for docs: mean PSNR, dB, over the still scenes and the texts of the standard benchmark, of
the input, of Wiener's filter with the mean PSF of the very simulator that made the frames (without tilt) and whatever price
of noise suits each strength best, and of each checkpoint. With --picture it draws the maps of the first one that has any.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from make_guide_figures import sheet

from turbnet.atmosphere.path import OpticalPath
from turbnet.bench.suite import SIZE, STRENGTHS, SUITES, Clip, make_clip
from turbnet.classical.deconvolution import wiener
from turbnet.deploy.checkpoint import load_network
from turbnet.media.colour import to_linear, to_srgb
from turbnet.metrics.fidelity import psnr
from turbnet.nets.still import StillRestorer
from turbnet.simulate.simulator import Simulator

BORDER, DRAWS, REACH = 8, 64, 15
KINDS = ("static", "text")
PRICES = 10.0 ** np.arange(-5, 0.1, 0.5)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkpoints", nargs="+", metavar="NAME=CHECKPOINT")
    parser.add_argument("--picture", type=Path, help="draw the maps")
    options = parser.parse_args()
    networks = {name: load_network(path)[0] for name, path in (item.split("=", 1) for item in options.checkpoints)}
    clips = benchmark()
    print("| single frames | " + " | ".join(f"{kind}, D/r0 = {s:g}" for kind, s in clips) + " |")
    print("|---" * (1 + len(clips)) + "|")
    line("input", [mean(lambda x: x, those) for those in clips.values()])
    line("Wiener, mean PSF known", [best_wiener(s, those) for (_, s), those in clips.items()])
    for name, network in networks.items():
        line(name, [mean(lambda x, network=network: through(network, x), those) for those in clips.values()])
    if options.picture:
        with_maps = [net for net in networks.values() if isinstance(net, StillRestorer) and net.maps is not None]
        if not with_maps:
            parser.error("no checkpoint has maps to draw")
        draw(with_maps[0], options.picture)
    return 0


def benchmark() -> dict[tuple[str, float], list[Clip]]:
    """Clips of one frame, by kind and strength."""
    scenes = range(SUITES["standard"].scenes)
    return {(kind, s): [make_clip(kind, scene, s, 1) for scene in scenes] for kind in KINDS for s in STRENGTHS}


def line(name: str, values: list[float]) -> None:
    print(f"| {name} | " + " | ".join(f"{value:.2f}" for value in values) + " |", flush=True)


def mean(restore, clips) -> float:
    return float(np.mean([psnr(restore(clip.frames[0])[None], clip.target, BORDER).mean() for clip in clips]))


@torch.no_grad()
def through(network, frame_HWC: np.ndarray) -> np.ndarray:
    clip = torch.from_numpy(frame_HWC).permute(2, 0, 1)[None, None]
    return network(clip)[0, 0].clamp(0, 1).permute(1, 2, 0).numpy()


def mean_psf(strength: float) -> np.ndarray:
    """Mean over draws of a point's picture without tilt, (31, 31), sum one."""
    simulator = Simulator(OpticalPath.from_d_over_r0(strength), SIZE, SIZE)
    point = torch.zeros(1, 1, 1, SIZE, SIZE)
    point[..., SIZE // 2, SIZE // 2] = 1.0
    with torch.no_grad():
        spread = sum(simulator(point, simulator.draw([seed])).blur_only[0, 0, 0] for seed in range(DRAWS))
    around = slice(SIZE // 2 - REACH, SIZE // 2 + REACH + 1)
    kernel = spread[around, around].clamp(min=0).numpy().astype(np.float32)
    return kernel / kernel.sum()


def best_wiener(strength: float, clips) -> float:
    kernel = mean_psf(strength)

    def restored(frame_HWC: np.ndarray, price: float) -> np.ndarray:
        linear = to_linear(torch.from_numpy(frame_HWC)).numpy()
        return to_srgb(torch.from_numpy(wiener(linear, kernel, price)).clamp(0, 1)).numpy()

    return max(mean(lambda x, price=price: restored(x, price), clips) for price in PRICES)


@torch.no_grad()
def draw(network: StillRestorer, path: Path) -> None:
    """Frame, restored frame, truth; both maps and the true error, at one scale."""
    clip = make_clip("static", 1, 3.0, 1)
    found = network.stages(torch.from_numpy(clip.frames).permute(0, 3, 1, 2)[None])
    assert found.uncertainty is not None
    restored = found.frames[0, 0].clamp(0, 1).permute(1, 2, 0).numpy()
    tilt, blur = found.uncertainty.maps[0, 0].numpy()
    error = np.abs(clip.target[0] - restored).mean(-1)
    scale = 1 / np.quantile(error, 0.99)
    pictures = {
        "seen, D/r0 = 3": clip.frames[0],
        "restored": restored,
        "truth": clip.target[0],
        "map of tilt": grey(scale * tilt),
        "map of blur": grey(scale * blur),
        "error of what is restored": grey(scale * error),
    }
    sheet(list(pictures.values()), list(pictures), path, columns=3)


def grey(map_HW: np.ndarray) -> np.ndarray:
    return np.repeat(map_HW[..., None], 3, axis=2)


if __name__ == "__main__":
    sys.exit(main())
