"""Measure what `turbnet restore --quality` and `--budget-ms` choose from: turbnet/weights/curve.json.

    python tools/measure_curve.py [--models xs s] [--windows 1 2 4 8 16 32] [--views 2 4 8]

Every network and window on the benchmark's still scenes at D/r0 = 3, clips of 32 frames, with the largest window several
views too; the gain is over the input, the time the better of two runs on noise. Ten minutes on a quiet machine.
"""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np

from turbnet.bench.suite import SUITES, make_clip
from turbnet.deploy.budget import CURVE, Setting, seconds_here
from turbnet.deploy.restore import restore_array
from turbnet.deploy.session import Model
from turbnet.deploy.weights import find_model, released_models
from turbnet.media.atomic import atomic_path
from turbnet.metrics.fidelity import psnr
from turbnet.report import machine

FRAMES, STRENGTH, BORDER = 32, 3.0, 8


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--models", nargs="+", default=[name for name in ("xs", "s") if name in released_models()])
    parser.add_argument("--windows", nargs="+", type=int, default=[1, 2, 4, 8, 16, 32])
    parser.add_argument("--views", nargs="+", type=int, default=[2, 4, 8])
    parser.add_argument("--output", type=Path, default=Path(__file__).parents[1] / "turbnet" / "weights" / CURVE)
    options = parser.parse_args()
    clips = [make_clip("static", scene, STRENGTH, FRAMES) for scene in range(SUITES["standard"].scenes)]
    before = np.mean([psnr(clip.frames, clip.target, BORDER).mean() for clip in clips])
    points = []
    for name in options.models:
        model = Model.load(find_model(name))
        most = max(options.windows)
        for window, views in [(window, 1) for window in options.windows] + [(most, views) for views in options.views]:
            scores = []
            for clip in clips:
                out = restore_array(clip.frames, model, window=window, views=views)
                scores.append(psnr(out, clip.target, BORDER).mean())
            seconds = seconds_here(Setting(name, window, 0.0, 0.0, views))
            point = asdict(Setting(name, window, float(np.mean(scores) - before), seconds, views))
            points.append({key: round(value, 4) if isinstance(value, float) else value for key, value in point.items()})
            print(points[-1], flush=True)
    with atomic_path(options.output) as temporary:
        temporary.write_text(json.dumps({"machine": machine(), "points": points}, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
