"""What `turbnet restore --skip` saves and loses on footage of a still camera, seen through simulated air.

    python tools/skip_on_footage.py VIDEO --crop L,T,W,H [--first 0] [--frames 104] [--strength 2] [--model s] [--bound]

Prints how much faster the crop is restored with --skip, the share of tiles that were spared, and the PSNR against the clean
footage of the frames as seen, restored without and with --skip, for docs/benchmarks.md. With --bound, the
most that any test for change could save: how much faster it would be if the clean footage itself told which blocks change by
more than 1/60 RMS, with and without a brightness fitted to every frame; nothing is restored.
"""

import argparse
import sys
from itertools import islice
from pathlib import Path

import numpy as np

from turbnet.bench.deployment import BORDER, restored, through_air
from turbnet.cli.options import parse_crop
from turbnet.deploy.restore import window_of, window_overlap
from turbnet.deploy.session import Model
from turbnet.deploy.skipping import Skipped, around, block_means
from turbnet.deploy.weights import find_model
from turbnet.media.clip import open_clip
from turbnet.metrics.fidelity import psnr

_CHANGED = (1 / 60) ** 2


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("video", type=Path)
    parser.add_argument("--crop", help="L,T,W,H, pixels")
    parser.add_argument("--first", type=int, default=0, help="frame to begin with")
    parser.add_argument("--frames", type=int, default=104)
    parser.add_argument("--strength", type=float, default=2.0, help="D/r0")
    parser.add_argument("--model", default="s")
    parser.add_argument("--bound", action="store_true", help="of the footage, whatever tells change")
    options = parser.parse_args()
    with open_clip(options.video, parse_crop(options.crop)) as clip:
        clean = np.stack(list(islice(clip, options.first, options.first + options.frames)))
    model = Model.load(find_model(options.model))
    if options.bound:
        for name, fitted in (("as it is", False), ("brightness fitted", True)):
            faster, mse = bound(clean.mean(-1), window_of(model), model.card.size_multiple, fitted)
            print(f"{name}: at most {faster:.2f} x as fast, MSE of what is not restored again {mse:.1e}")
        return 0
    frames, skipped = through_air(clean, options.strength), Skipped()
    (whole, seconds), (spared, fewer) = restored(frames, model), restored(frames, model, skipped)
    scores = (float(psnr(clip, clean, BORDER).mean()) for clip in (frames, whole, spared))
    print(f"{seconds / fewer:.2f} x as fast, {skipped.saved:.0%} of the tiles spared")
    print("PSNR, dB: seen {:.2f}, restored {:.2f}, with --skip {:.2f}".format(*scores))
    return 0


def bound(clean_THW: np.ndarray, window: int, multiple: int, fitted: bool) -> tuple[float, float]:
    """How much faster whoever knew the clean clip could be, and the mean square of the changes that would be missed.

    The mean of the first two windows stands for every block that differs from it by at most `_CHANGED` in a window;
    `fitted`: after a line through the means of the blocks, by least absolute differences, as cameras change their exposure.
    """
    sides = clean_THW.shape[1:]
    step = window - window_overlap(window)
    kept = clean_THW[: step + window].mean(0)
    levels = block_means(kept[None])[0].ravel()
    changes = []
    for frame in clean_THW:
        known = kept
        if fitted:
            slope, level = _line(levels, block_means(frame[None])[0].ravel())
            known = slope * kept + level
        changes.append(block_means((frame - known)[None] ** 2)[0])
    shares, missed = [1.0, 1.0], [0.0, 0.0]
    for first in range(2 * step, len(clean_THW) - window + 1, step):
        change = np.mean(changes[first : first + window], axis=0)
        boxes = around(change > _CHANGED, sides, multiple)
        area = sum((down.stop - down.start) * (across.stop - across.start) for down, across in boxes)
        shares.append(min(area / (sides[0] * sides[1]), 1.0))
        missed.append(float(np.where(change > _CHANGED, 0, change).mean()))
    return len(shares) / sum(shares), float(np.mean(missed))


def _line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Slope and level of least absolute differences, by weighted least squares."""
    weights = np.ones_like(x)
    for _ in range(20):
        slope, level = np.polyfit(x, y, 1, w=weights)
        weights = 1 / np.sqrt(np.abs(y - slope * x - level) + 1e-3)
    return float(slope), float(level)


if __name__ == "__main__":
    sys.exit(main())
