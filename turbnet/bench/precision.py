"""Whether a network is worth running in eight bits.

It is worth it if it is a tenth faster at least and loses a tenth of a decibel at most in scenes of every kind at D/r0 = 3
that it was not calibrated on, in windows as long as its card recommends: what runs once a window gains more by eight bits
than what runs once a frame. Half precision is no question: onnxruntime has no kernels for it on a processor and would
convert.
"""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from turbnet.bench.suite import LENGTHS, SUITES, make_clip
from turbnet.deploy.eight_bits import write_eight_bits
from turbnet.deploy.session import Model
from turbnet.metrics.fidelity import psnr
from turbnet.report import Row

FASTER, LOSS = 1.1, 0.1
"""The least gain in speed and the greatest loss in dB at which eight bits are worth it."""

KINDS = ("static", "dynamic", "text")
FEWEST, STRENGTH, BORDER = 6, 3.0, 8
"""Frames of a clip at least, D/r0, pixels left out."""


@dataclass(frozen=True)
class Verdict:
    """What eight bits bring.

    Attributes:
        faster: how many times as fast, the median of all scenes.
        losses: dB of PSNR by kind of scene.
    """

    faster: float
    losses: dict[str, float]

    @property
    def worth_it(self) -> bool:
        return self.faster >= FASTER and max(self.losses.values()) <= LOSS

    def __str__(self) -> str:
        lost = ", ".join(f"{loss:.3f} dB of {kind} scenes" for kind, loss in self.losses.items())
        return f"{self.faster:.2f} times as fast here, loses {lost}"

    def rows(self) -> list[Row]:
        lost = [Row(f"int8: loses, {kind} scenes", loss, "dB") for kind, loss in self.losses.items()]
        return [
            Row("int8: faster by", self.faster, "x"),
            *lost,
            Row("int8: worth it", "yes" if self.worth_it else "no"),
        ]


def measure(file: Path, quick: bool = False) -> list[Row]:
    """Speed, loss by kind of scene and verdict for the ONNX file of a network that takes windows."""
    with tempfile.TemporaryDirectory() as folder:
        return judge(file, calibrated(file, Path(folder) / "int8.onnx"), quick).rows()


def calibrated(source: Path, target: Path) -> Path:
    """The network in eight bits, calibrated on the first scene of every kind."""
    frames = _frames(Model.load(source))
    write_eight_bits(source, target, (make_clip(kind, 0, STRENGTH, frames).frames for kind in KINDS))
    return target


def judge(exact: Path, rounded: Path, quick: bool = False) -> Verdict:
    """The file of a network beside that of the same in eight bits, on this machine."""
    scenes = range(1, 2 if quick else SUITES["standard"].scenes)
    models = [Model.load(path) for path in (exact, rounded)]
    frames = _frames(models[0])
    losses, ratios = dict[str, float](), list[float]()
    for kind in KINDS:
        lost = []
        for scene in scenes:
            clip = make_clip(kind, scene, STRENGTH, frames)
            window = np.ascontiguousarray(clip.frames.transpose(0, 3, 1, 2)[None], np.float32)
            times, scores = [], []
            for model in models:
                begun = time.perf_counter()
                restored = model(window)
                times.append(time.perf_counter() - begun)
                shown = restored[0].transpose(0, 2, 3, 1).clip(0, 1)
                scores.append(float(psnr(shown, clip.target, BORDER).mean()))
            lost.append(scores[0] - scores[1])
            ratios.append(times[0] / times[1])
        losses[kind] = float(np.mean(lost))
    return Verdict(float(np.median(ratios)), losses)


def _frames(model: Model) -> int:
    """Frames of the window that the card recommends, as far as the benchmark has them."""
    return min(max(model.card.frames, FEWEST), max(LENGTHS))
