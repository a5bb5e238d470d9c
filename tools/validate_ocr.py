"""How well the built-in recogniser and the proxy stand for real recognition: numbers for docs/metrics/ocr.md.

    python tools/validate_ocr.py [--clips 240] [--output outputs/ocr] [--docs docs/metrics]

Looks at scenes of words and lines through atmospheres of D/r0 = 0 to 6 and ranks the clips by the character error rate of
rapidocr (extra `ocr`), by that of the recogniser that comes with turbnet and by what the proxy expects. Prints the table
and writes the figure. Resumable: the scores of each clip are kept in --output.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import matplotlib
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import spearmanr

from turbnet.atmosphere.path import OpticalPath
from turbnet.data.boxes import TextBox
from turbnet.data.text_scenes import render_scene
from turbnet.media.atomic import atomic_path
from turbnet.media.colour import to_linear, to_srgb
from turbnet.metrics.evaluation import text_scorer
from turbnet.metrics.text import TextScore
from turbnet.progress import progress_bar
from turbnet.simulate.sensor import Sensor
from turbnet.simulate.simulator import Simulator

HEIGHT, WIDTH, FRAMES = 96, 192, 2
STRONGEST = 6.0
SIZES = (9.0, 18.0)  # pixels an em: rapidocr reads the smallest in still air, and not the largest at D/r0 = 6
KINDS = ("words", "lines")
READERS = {"rapidocr": "rapidocr", "builtin": "built-in recogniser", "proxy": "template proxy"}
SEED = 2024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=int, default=240)
    parser.add_argument("--output", type=Path, default=Path("outputs/ocr"))
    parser.add_argument("--docs", type=Path, default=Path(__file__).parents[1] / "docs" / "metrics")
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.output.mkdir(parents=True, exist_ok=True)
    strengths = np.array([clip_seed(index)[1] for index in range(options.clips)])
    rates = {reader: scored(reader, options.clips, options.output / f"{reader}.json") for reader in READERS}
    print_table(strengths, rates)
    draw(strengths, rates, options.docs / "ocr.png")


def clip_seed(index: int) -> tuple[np.random.Generator, float]:
    """What decides clip `index`: a generator for its scene and atmosphere, and its D/r0."""
    rng = np.random.default_rng([SEED, index])
    return rng, float(rng.uniform(0, STRONGEST))


def clips(first: int, last: int) -> Iterator[tuple[NDArray[np.float32], tuple[TextBox, ...]]]:
    """Frames (T, H, W, 3), sRGB, and boxes of each clip."""
    simulator = Simulator(
        OpticalPath.from_d_over_r0(STRONGEST), HEIGHT, WIDTH, strengths=(0.0, STRONGEST), components=30, margin=16
    )
    for index in range(first, last):
        rng, strength = clip_seed(index)
        scene = render_scene(
            rng, HEIGHT, WIDTH, KINDS[index % len(KINDS)], SIZES, contrast=(0.3, 0.9), perspective=0.05
        )
        draw = simulator.draw([int(rng.integers(2**62))], FRAMES, d_over_r0=torch.tensor([strength])).centred()
        picture = to_linear(torch.from_numpy(scene.picture).permute(2, 0, 1))[None, None]
        with torch.no_grad():
            seen = Sensor(20_000, 0.01)(simulator(picture, draw).frames, index)
        yield to_srgb(seen[0].clamp(0, 1)).permute(0, 2, 3, 1).numpy(), scene.boxes


def scored(reader: str, count: int, path: Path) -> NDArray[np.float64]:
    """Character error rate of each clip, over its frames and boxes."""
    rates = json.loads(path.read_text()) if path.is_file() else []
    if len(rates) < count:
        scorer = text_scorer(reader)
        with progress_bar() as progress:
            remaining = progress.track(clips(len(rates), count), count, completed=len(rates), description=reader)
            for frames, boxes in remaining:
                score = sum((scorer(frame, boxes) for frame in frames), TextScore())
                rates.append(score.character_error_rate)
                with atomic_path(path) as temporary:
                    temporary.write_text(json.dumps(rates))
    return np.array(rates[:count])


def rank_correlation(rates: NDArray[np.float64], truth: NDArray[np.float64]) -> str:
    """Spearman's coefficient with its 95 % interval, by 2000 resamplings of the clips."""
    rng = np.random.default_rng(0)
    picks = rng.integers(len(rates), size=(2000, len(rates)))
    low, high = np.quantile([spearmanr(rates[pick], truth[pick])[0] for pick in picks], (0.025, 0.975))
    return f"{spearmanr(rates, truth)[0]:.3f} ({low:.3f} to {high:.3f})"


def print_table(strengths: NDArray[np.float64], rates: dict[str, NDArray[np.float64]]) -> None:
    truth = rates["rapidocr"]
    print(f"{len(truth)} clips; rapidocr reads {np.mean(truth == 0):.0%} of them without an error\n")
    print("| rank correlation with rapidocr's error rate | all clips | words | lines |\n|---|---|---|---|")
    for name, values in {**rates, "D/r0": strengths}.items():
        if name != "rapidocr":
            parts = [rank_correlation(values[i :: len(KINDS)], truth[i :: len(KINDS)]) for i in range(len(KINDS))]
            print(f"| {READERS.get(name, name)} | {rank_correlation(values, truth)} | {' | '.join(parts)} |")
    edges = np.linspace(0, STRONGEST, 7)
    print("\n| D/r0 | clips | " + " | ".join(READERS.values()) + " |\n|---" + "|---" * (1 + len(READERS)) + "|")
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        here = (strengths >= low) & (strengths < high)
        means = [f"{values[here].mean():.2f}" for values in rates.values()]
        print(f"| {low:.0f} to {high:.0f} | {here.sum()} | " + " | ".join(means) + " |")


def draw(strengths: NDArray[np.float64], rates: dict[str, NDArray[np.float64]], path: Path) -> None:
    """Each stand-in's error rate over rapidocr's, coloured by D/r0."""
    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 2, figsize=(9, 4), sharex=True, layout="constrained")
    for panel, reader in zip(panels, ("builtin", "proxy"), strict=True):
        points = panel.scatter(rates["rapidocr"], rates[reader], c=strengths, s=12, cmap="viridis")
        panel.set_xlabel("character error rate of rapidocr")
        panel.set_ylabel(f"error rate of the {READERS[reader]}")
        panel.set_title(f"Spearman {spearmanr(rates['rapidocr'], rates[reader])[0]:.3f}", fontsize=10)
        panel.grid(alpha=0.3)
    figure.colorbar(points, ax=panels, label="D/r0")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110, metadata={"Software": None})


if __name__ == "__main__":
    main()
