"""A sealed ONNX file with its dense convolutions in eight bits, quantised after training by onnxruntime's own tool.

Weights by channel and in seven bits, so that sums of two products fit into the sixteen bits that processors without VNNI
have for them; activations by the range they have on a few clips; everything else stays in float32. So do convolutions
that go channel by channel, which are the closed-form ones of deconvolution and slow in eight bits, and those into few
channels: a picture, a tilt or weights come out of them, whose steps would be seen.
"""

import logging
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

from turbnet.deploy.export import sealed
from turbnet.deploy.seal import UNSEALED
from turbnet.deploy.session import INPUT, Model
from turbnet.errors import InputError
from turbnet.media.atomic import atomic_path

FEW = 12
"""Channels of the widest output that stays in float32: red, green and blue of 2 x 2 pixels."""


class _Clips(CalibrationDataReader):
    """What onnxruntime asks for clips one after the other."""

    def __init__(self, clips: Iterable[np.ndarray]) -> None:
        self.left: Iterator[np.ndarray] = iter(clips)

    def get_next(self) -> dict[str, Any] | None:
        clip_THWC = next(self.left, None)
        if clip_THWC is None:
            return None
        return {INPUT: np.ascontiguousarray(clip_THWC.transpose(0, 3, 1, 2)[None], np.float32)}


def write_eight_bits(source: Path, target: Path, clips: Iterable[np.ndarray]) -> None:
    """Write the network of the sealed file `source` in eight bits to `target`, sealed again, its card saying so.

    Args:
        clips: (T, H, W, C) in [0, 1], sides multiples of what the network asks for: what activations are calibrated on.

    Raises:
        InputError: source is no model of ours, or one that carries something from frame to frame.
    """
    card = Model.load(source).card
    if card.carried:
        raise InputError(f"{source} goes frame by frame; only networks that take windows are calibrated for eight bits")
    log = logging.getLogger()
    level = log.level
    with atomic_path(target) as temporary:
        log.setLevel(logging.ERROR)  # it would like another pass over the file first
        try:
            quantize_static(
                source,
                temporary,
                _Clips(clips),
                quant_format=QuantFormat.QDQ,
                per_channel=True,
                reduce_range=True,
                op_types_to_quantize=["Conv"],
                nodes_to_exclude=_exact(onnx.load(source).graph),
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
            )
        finally:
            log.setLevel(level)
        notes = {"numbers": f"convolutions into more than {FEW} channels in eight bits, all else float32", **card.notes}
        temporary.write_bytes(sealed(onnx.load(temporary), replace(card, sha256=UNSEALED, notes=notes)))


def _exact(graph: onnx.GraphProto) -> list[str]:
    """Names of the convolutions that stay in float32."""
    outer = {weights.name: weights.dims[0] for weights in graph.initializer if weights.dims}
    convolutions = [node for node in graph.node if node.op_type == "Conv"]
    grouped = {n.name for n in convolutions if any(a.name == "group" and a.i > 1 for a in n.attribute)}
    return [n.name for n in convolutions if n.name in grouped or outer.get(n.input[1], 0) <= FEW]
