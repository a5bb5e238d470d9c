"""What `turbnet restore --skip` saves and loses on footage of a still camera, seen through simulated air.

    python tools/skip_on_footage.py VIDEO --crop L,T,W,H [--first 0] [--frames 104] [--strength 2] [--model s]

Prints how much faster the crop is restored with --skip, the share of tiles that were spared, and the PSNR against the clean
footage of the frames as seen, restored without and with --skip, for docs/benchmarks.md.
"""

import argparse
import sys
from itertools import islice
from pathlib import Path

import numpy as np

from turbnet.bench.deployment import BORDER, restored, through_air
from turbnet.cli.options import parse_crop
from turbnet.deploy.session import Model
from turbnet.deploy.skipping import Skipped
from turbnet.deploy.weights import find_model
from turbnet.media.clip import open_clip
from turbnet.metrics.fidelity import psnr


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("video", type=Path)
    parser.add_argument("--crop", help="L,T,W,H, pixels")
    parser.add_argument("--first", type=int, default=0, help="frame to begin with")
    parser.add_argument("--frames", type=int, default=104)
    parser.add_argument("--strength", type=float, default=2.0, help="D/r0")
    parser.add_argument("--model", default="s")
    options = parser.parse_args()
    with open_clip(options.video, parse_crop(options.crop)) as clip:
        clean = np.stack(list(islice(clip, options.first, options.first + options.frames)))
    frames, model, skipped = through_air(clean, options.strength), Model.load(find_model(options.model)), Skipped()
    (whole, seconds), (spared, fewer) = restored(frames, model), restored(frames, model, skipped)
    scores = (float(psnr(clip, clean, BORDER).mean()) for clip in (frames, whole, spared))
    print(f"{seconds / fewer:.2f} x as fast, {skipped.saved:.0%} of the tiles spared")
    print("PSNR, dB: seen {:.2f}, restored {:.2f}, with --skip {:.2f}".format(*scores))
    return 0


if __name__ == "__main__":
    sys.exit(main())
