"""Whether a network is worth running in eight bits: convolutions quantised after training, by onnxruntime's own tool.

Weights by channel, activations calibrated on two clips of the benchmark; everything but dense convolutions stays in
float32. It is worth it if it is a tenth faster at least and loses a tenth of a decibel at most in scenes of every kind at
D/r0 = 3 that it was not calibrated on. Half precision is no question: onnxruntime has no kernels for it on a processor and
would convert.
"""

import logging
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from turbnet.bench.suite import SUITES, make_clip
from turbnet.deploy.session import INPUT, available_cores, open_session
from turbnet.metrics.fidelity import psnr
from turbnet.report import Row

FASTER, LOSS = 1.1, 0.1
"""The least gain in speed and the greatest loss in dB at which eight bits are worth it."""

KINDS = ("static", "dynamic", "text")
FRAMES, STRENGTH, BORDER = 6, 3.0, 8


def measure(file: Path, quick: bool = False) -> list[Row]:
    """Speed, loss by kind of scene and verdict for the ONNX file of a network that takes windows."""
    scenes = range(1, 2 if quick else SUITES["standard"].scenes)
    with tempfile.TemporaryDirectory() as folder:
        files = (file, _quantised(file, Path(folder) / "int8.onnx"))
        sessions = [open_session(path.read_bytes(), available_cores()) for path in files]
        losses, ratios = dict[str, float](), list[float]()
        for kind in KINDS:
            lost = []
            for scene in scenes:
                clip = make_clip(kind, scene, STRENGTH, FRAMES)
                frames = np.ascontiguousarray(clip.frames.transpose(0, 3, 1, 2)[None], np.float32)
                times, scores = [], []
                for session in sessions:
                    begun = time.perf_counter()
                    (restored,) = session.run(None, {INPUT: frames})
                    times.append(time.perf_counter() - begun)
                    shown = restored[0].transpose(0, 2, 3, 1).clip(0, 1)
                    scores.append(float(psnr(shown, clip.target, BORDER).mean()))
                lost.append(scores[0] - scores[1])
                ratios.append(times[0] / times[1])
            losses[kind] = float(np.mean(lost))
    faster = float(np.median(ratios))
    worth = "yes" if faster >= FASTER and max(losses.values()) <= LOSS else "no"
    rows = [Row(f"int8: loses, {kind} scenes", loss, "dB") for kind, loss in losses.items()]
    return [Row("int8: faster by", faster, "x"), *rows, Row("int8: worth it", worth)]


def _quantised(source: Path, target: Path) -> Path:
    import onnx
    from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

    class Clips(CalibrationDataReader):
        def __init__(self) -> None:
            self.left: Iterator[str] = iter(("static", "text"))

        def get_next(self) -> dict[str, Any] | None:
            kind = next(self.left, None)
            if kind is None:
                return None
            frames = make_clip(kind, 0, STRENGTH, FRAMES).frames
            return {INPUT: np.ascontiguousarray(frames.transpose(0, 3, 1, 2)[None], np.float32)}

    # Convolutions channel by channel are the closed-form ones of deconvolution, and slow in eight bits.
    nodes = onnx.load(source).graph.node
    exact = [n.name for n in nodes if n.op_type == "Conv" and any(a.name == "group" and a.i > 1 for a in n.attribute)]
    log = logging.getLogger()
    level = log.level
    log.setLevel(logging.ERROR)  # it would like another pass over the file first
    try:
        quantize_static(
            source,
            target,
            Clips(),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            op_types_to_quantize=["Conv"],
            nodes_to_exclude=exact,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
    finally:
        log.setLevel(level)
    return target
