"""One picture to judge restorations of a real clip by eye, and the figures beside it.

    python tools/contact_sheet.py CLIP -o sheet.png --methods pipeline --models s xs [--frames 24] [--crop L,T,W,H]

Rows: the input, its temporal mean, each method, each model. Columns: the first, the middle and the last frame, and a slice
through time (the middle row of pixels, time downwards): what stands still leaves straight lines. The table gives jitter
(pixels), flicker, sharpness and noise of `turbnet.metrics`.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from turbnet.cli.options import parse_crop
from turbnet.deploy.method import ClassicalMethod
from turbnet.deploy.restore import restore_array
from turbnet.deploy.session import Model
from turbnet.deploy.weights import find_model
from turbnet.errors import InputError
from turbnet.media.clip import open_clip
from turbnet.metrics.evaluation import TemporalMean
from turbnet.metrics.sharpness import noise_level, sharpness
from turbnet.metrics.stability import flicker, jitter

Clip = np.ndarray  # (T, H, W, 3), sRGB in [0, 1]
TITLE, GAP = 16, 4


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clip", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True, help="the sheet to write, .png")
    parser.add_argument("--methods", nargs="*", default=[], help="of turbnet restore --method")
    parser.add_argument("--models", nargs="*", default=[], help="released names or ONNX files")
    parser.add_argument("--frames", type=int, default=24, help="of the clip, from its start")
    parser.add_argument("--crop", help="L,T,W,H, pixels")
    options = parser.parse_args()
    try:
        rows = restorations(options)
        table = {name: figures(clip) for name, clip in rows.items()}
    except InputError as error:
        print(f"contact_sheet: {error}", file=sys.stderr)
        return 2
    sheet(rows).save(options.output)
    print(f"| {options.clip.name} | jitter, pixels | flicker | sharpness | noise |\n|---|---|---|---|---|")
    for name, values in table.items():
        print(f"| {name} | {' | '.join(f'{value:.2g}' for value in values)} |")
    return 0


def restorations(options: argparse.Namespace) -> dict[str, Clip]:
    with open_clip(options.clip, parse_crop(options.crop)) as clip:
        seen = np.stack([frame for _, frame in zip(range(options.frames), clip, strict=False)])
    mean = TemporalMean()
    for frame in seen:
        mean.add(frame)
    rows: dict[str, Clip] = {"input": seen, "temporal mean": mean.frame()[None].repeat(len(seen), 0)}
    for name in options.methods:
        rows[name] = restore_array(seen, ClassicalMethod(name))
    for name in options.models:
        rows[Path(name).stem] = restore_array(seen, Model.load(find_model(name)))
    return rows


def figures(clip: Clip) -> tuple[float, float, float, float]:
    still = len({frame.tobytes() for frame in clip}) == 1
    return (
        0.0 if still else jitter(clip, clip.mean(0)),
        flicker(clip.mean((1, 2, 3))),
        float(np.mean([sharpness(frame) for frame in clip])),
        float(np.mean([noise_level(frame) for frame in clip])),
    )


def sheet(rows: dict[str, Clip]) -> Image.Image:
    count, height, width, _ = next(iter(rows.values())).shape
    columns = 4
    paper = Image.new("RGB", (columns * (width + GAP), len(rows) * (height + TITLE + GAP)), "white")
    draw = ImageDraw.Draw(paper)
    for line, (name, clip) in enumerate(rows.items()):
        top = line * (height + TITLE + GAP)
        draw.text((2, top + 2), name, fill="black")
        through_time = clip[:, height // 2].repeat(max(1, height // count), 0)[:height]
        for column, picture in enumerate((clip[0], clip[count // 2], clip[-1], through_time)):
            paper.paste(
                Image.fromarray((picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)),
                (column * (width + GAP), top + TITLE),
            )
    return paper


if __name__ == "__main__":
    sys.exit(main())
