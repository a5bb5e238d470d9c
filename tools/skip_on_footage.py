"""What `turbnet restore --skip` saves and loses on footage of a still camera, seen through simulated air.

    python tools/skip_on_footage.py VIDEO --crop L,T,W,H [--first 0] [--frames 104] [--strength 2] [--model s] [--bound]

Prints how much faster the crop is restored with --skip, the share of tiles that were spared, and the PSNR against the clean
footage of the frames as seen, restored without and with --skip, for docs/benchmarks.md. With --bound, the
most that a test for change could save: how much faster it would be if the clean footage itself told which blocks differ by
more than 1/60 RMS from the window before, with and without an exposure fitted to every frame; nothing is restored.
"""

import argparse
import sys
from itertools import islice
from pathlib import Path

import numpy as np

from turbnet.bench.deployment import BORDER, restored, through_air
from turbnet.cli.options import parse_crop
from turbnet.deploy.exposure import exposures
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
        for name, fitted in (("as it is", False), ("exposure fitted", True)):
            faster = bound(clean.mean(-1), window_of(model), model.card.size_multiple, fitted)
            print(f"{name}: at most {faster:.2f} x as fast")
        return 0
    frames, skipped = through_air(clean, options.strength), Skipped()
    (whole, seconds), (spared, fewer) = restored(frames, model), restored(frames, model, skipped)
    scores = (float(psnr(clip, clean, BORDER).mean()) for clip in (frames, whole, spared))
    print(f"{seconds / fewer:.2f} x as fast, {skipped.saved:.0%} of the tiles spared")
    print("PSNR, dB: seen {:.2f}, restored {:.2f}, with --skip {:.2f}".format(*scores))
    return 0


def bound(clean_THW: np.ndarray, window: int, multiple: int, fitted: bool) -> float:
    """How much faster whoever knew the clean clip could be.

    The mean of the window before stands for every block that differs from it by at most `_CHANGED` in a window; `fitted`:
    as each frame is exposed. The first two windows are restored whole.
    """
    sides, step = clean_THW.shape[1:], window - window_overlap(window)
    shares = [1.0, 1.0]
    for first in range(2 * step, len(clean_THW) - window + 1, step):
        frames, before = clean_THW[first : first + window], clean_THW[first - step : first - step + window].mean(0)
        if fitted:
            frames = exposures(block_means(before[None])[0], block_means(frames)).taken_out(frames)
        boxes = around(block_means((frames - before) ** 2).mean(0) > _CHANGED, sides, multiple)
        area = sum((down.stop - down.start) * (across.stop - across.start) for down, across in boxes)
        shares.append(min(area / (sides[0] * sides[1]), 1.0))
    return len(shares) / sum(shares)


if __name__ == "__main__":
    sys.exit(main())
