"""Whether a network is worth running in eight bits: convolutions quantised after training, by onnxruntime's own tool.

Weights by channel, activations calibrated on two clips of the benchmark; everything but convolutions stays in float32. It is
worth it if it is a tenth faster at least and loses a tenth of a decibel at most, over the still scenes at D/r0 = 3 that it
was not calibrated on. Half precision is no question: onnxruntime has no kernels for it on a processor and would convert.
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

FRAMES, STRENGTH, BORDER = 6, 3.0, 8


def measure(file: Path, quick: bool = False) -> list[Row]:
    """Speed, loss and verdict for the ONNX file of a network that takes windows."""
    clips = [make_clip("static", scene, STRENGTH, FRAMES) for scene in range(1, SUITES["standard"].scenes)]
    if quick:
        clips = clips[:1]
    with tempfile.TemporaryDirectory() as folder:
        files = (file, _quantised(file, Path(folder) / "int8.onnx"))
        sessions = [open_session(path.read_bytes(), available_cores()) for path in files]
        scores: list[list[float]] = [[], []]
        ratios = []
        for clip in clips:
            frames = np.ascontiguousarray(clip.frames.transpose(0, 3, 1, 2)[None], np.float32)
            times = []
            for session, own in zip(sessions, scores, strict=True):
                begun = time.perf_counter()
                (restored,) = session.run(None, {INPUT: frames})
                times.append(time.perf_counter() - begun)
                own.append(float(psnr(restored[0].transpose(0, 2, 3, 1).clip(0, 1), clip.target, BORDER).mean()))
            ratios.append(times[0] / times[1])
    faster, loss = float(np.median(ratios)), float(np.mean(scores[0]) - np.mean(scores[1]))
    worth = "yes" if faster >= FASTER and loss <= LOSS else "no"
    return [Row("int8: faster by", faster, "x"), Row("int8: loses", loss, "dB"), Row("int8: worth it", worth)]


def _quantised(source: Path, target: Path) -> Path:
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
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
    finally:
        log.setLevel(level)
    return target
