"""A torch network to a sealed ONNX file, with the proof that both compute the same.

Batch, frames, height and width stay free. What the exporter notes about the source (stack traces, file names, module
names) is taken out, weights below the smallest normal float32 are set to zero (denormal numbers slow a processor down
tenfold), and the file is put in place only after onnxruntime has reproduced the network on shapes it was not exported
with.
"""

import copy
import logging
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnxscript import opset18
from torch import nn

from turbnet.deploy.card import Card, ModelCard
from turbnet.deploy.deconvolution import TRANSLATIONS, opaque
from turbnet.deploy.seal import seal
from turbnet.deploy.session import INPUT, NEXT, OUTPUT, Model
from turbnet.errors import InputError
from turbnet.media.atomic import atomic_path

TOLERANCE = 1e-4


@dataclass(frozen=True)
class Parity:
    """Greatest absolute difference of onnxruntime and torch on one input shape (batch, frames, C, height, width)."""

    shape: tuple[int, ...]
    difference: float


def export_onnx(module: nn.Module, card: ModelCard, path: str | Path) -> list[Parity]:
    """Write `module` with its `card` to the ONNX file `path`; return the parity with torch, shape by shape.

    Args:
        module: (B, T, C, H, W) -> (B, T, C', H, W) float32, for any B, T >= 1 and H, W multiples of
            `card.size_multiple`. A part of a network (its tilt removal alone, say) qualifies as well. Where the card names
            what is carried, module takes it too, in that order, and returns (frames, *carried).
        card: its digest is filled in on the way.

    Raises:
        InputError: the network cannot be exported, or onnxruntime differs from torch by more than 1e-4; nothing is
            written then.
    """
    with atomic_path(path) as temporary:
        module = flush_denormals(copy.deepcopy(module).cpu().float().eval())
        data = sealed(_name_sizes(_to_onnx(module, card), card), card)
        try:
            parity = compare(module, Model(data))
        except InputError as error:
            raise InputError(f"cannot export {card.architecture}: {error}") from error
        for row in parity:
            if not row.difference <= TOLERANCE:  # NaN fails too
                raise InputError(
                    f"cannot export {card.architecture}: onnxruntime and torch differ by {row.difference:.2g} "
                    f"on frames of shape {row.shape}; at most {TOLERANCE:g} is accepted"
                )
        temporary.write_bytes(data)
    return parity


def sealed(model: onnx.ModelProto, card: Card) -> bytes:
    """The file of a model: what the exporter says of the source taken out, the card put in, sealed.

    Raises:
        InputError: a path of this machine would stand in it.
    """
    model = _strip(model)
    for key, value in card.to_metadata().items():
        model.metadata_props.add(key=key, value=value)
    _check_no_local_path(model)
    return seal(model.SerializeToString())


def compare(module: nn.Module, model: Model) -> list[Parity]:
    """Run both on seeded noise of ten shapes, none of them the export's."""
    unit, channels = model.card.size_multiple, model.card.channels
    generator = torch.Generator().manual_seed(0)
    rows = []
    for batch, frames, height, width in [
        (1, 1, 4 * unit, 4 * unit),
        (3, 1, 4 * unit, 7 * unit),
        (1, 5, 9 * unit, 5 * unit),
        (3, 2, 5 * unit, 4 * unit),
        (1, model.card.frames + 1, 4 * unit, 11 * unit),
        (2, 4, 7 * unit, 7 * unit),
        (1, 2, 16 * unit, 4 * unit),
        (4, 1, 5 * unit, 10 * unit),
        (1, 7, 4 * unit, 5 * unit),
        (2, 3, 9 * unit, 12 * unit),
    ]:
        shape = (batch, frames, channels, height, width)
        frames_BTCHW = torch.rand(shape, generator=generator)
        expected = _whole(module, frames_BTCHW, card=model.card).numpy()
        restored = model(frames_BTCHW.numpy())
        same_shape = restored.shape == expected.shape
        rows.append(Parity(shape, float(np.abs(restored - expected).max()) if same_shape else float("inf")))
    return rows


@torch.no_grad()
def _whole(module: nn.Module, frames_BTCHW: torch.Tensor, card: ModelCard) -> torch.Tensor:
    """The frames of a clip through `module`, one after the other if it carries something."""
    if not card.carried:
        return module(frames_BTCHW)
    batch, _, _, height, width = frames_BTCHW.shape
    carried, restored = _nothing(card, batch, height, width), []
    for frame in frames_BTCHW.split(1, dim=1):
        out, *carried = module(frame, *carried)
        restored.append(out)
    return torch.cat(restored, dim=1)


def _nothing(card: ModelCard, batch: int, height: int, width: int) -> list[torch.Tensor]:
    return [torch.zeros(shape) for shape in card.carried_shapes(batch, height, width).values()]


def flush_denormals(module: nn.Module) -> nn.Module:
    """Set parameters and buffers below the smallest normal float32 (1.2e-38) to zero, in place."""
    with torch.no_grad():
        for tensor in (*module.parameters(), *module.buffers()):
            if tensor.is_floating_point():
                tensor[tensor.abs() < torch.finfo(torch.float32).tiny] = 0
    return module


def _to_onnx(module: nn.Module, card: ModelCard) -> onnx.ModelProto:
    # Sizes of one would be baked in, equal sizes might be taken for one another.
    shape = (2, max(card.frames, 3), card.channels, 6 * card.size_multiple, 8 * card.size_multiple)
    clip = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    carried = _nothing(card, shape[0], *shape[3:])
    free = {axis: torch.export.Dim.DYNAMIC for axis in (0, 1, 3, 4)}
    sides = [{axis: torch.export.Dim.DYNAMIC for axis in (0, x.ndim - 2, x.ndim - 1)} for x in carried]
    try:
        with quiet_exporter():
            program = torch.onnx.export(
                opaque(copy.deepcopy(module)),
                (clip, *carried),
                dynamo=True,
                input_names=[INPUT, *card.carried],
                output_names=[OUTPUT, *(NEXT + name for name in card.carried)],
                dynamic_shapes=(free, *sides),
                external_data=False,
                verbose=False,
                custom_translation_table={torch.ops.aten.pixel_unshuffle.default: _pixel_unshuffle, **TRANSLATIONS},
            )
    except torch.onnx.OnnxExporterError as error:
        cause = error.__cause__ or error
        raise InputError(f"cannot export {card.architecture}: {str(cause).strip().splitlines()[0]}") from error
    assert program is not None
    return program.model_proto


def _pixel_unshuffle(self: Any, downscale_factor: int) -> Any:
    """Blocks before channels, then whole planes put in order: half the time of the exporter's transpose of six axes."""
    op: Any = opset18  # whose types know nothing of symbols
    blocks = op.SpaceToDepth(self, blocksize=downscale_factor)
    sides = op.Shape(blocks, start=2)
    apart = op.Concat(op.Constant(value_ints=[0, downscale_factor**2, -1]), sides, axis=0)
    planes = op.Transpose(op.Reshape(blocks, apart), perm=[0, 2, 1, 3, 4])
    return op.Reshape(planes, op.Concat(op.Constant(value_ints=[0, -1]), sides, axis=0))


@contextmanager
def quiet_exporter() -> Iterator[None]:
    """Silence the exporter's remarks on optional packages and on its own deprecated calls."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)


def _strip(model: onnx.ModelProto) -> onnx.ModelProto:
    """Remove what the exporter says of the source."""
    graph = model.graph
    del model.metadata_props[:], graph.metadata_props[:], graph.value_info[:]
    model.doc_string = graph.doc_string = ""
    for item in (*graph.node, *graph.input, *graph.output, *graph.initializer):
        item.doc_string = ""
        del item.metadata_props[:]
    return model


def _name_sizes(model: onnx.ModelProto, card: ModelCard) -> onnx.ModelProto:
    """Name the free sizes."""
    for value in (*model.graph.input, *model.graph.output):
        size = value.type.tensor_type.shape.dim
        size[0].dim_param = "batch"
        spec = card.carried.get(value.name.removeprefix(NEXT))
        scale = 1 if spec is None else spec["scale"]
        for axis, name in ((-2, "height"), (-1, "width")):
            size[axis].dim_param = name if scale == 1 else f"{name}/{scale}"
        if spec is None:
            size[1].dim_param = "frames"
    return model


def _check_no_local_path(model: onnx.ModelProto) -> None:
    bare = onnx.ModelProto()
    bare.CopyFrom(model)
    del bare.graph.initializer[:]
    data = bare.SerializeToString()
    for place in {Path.cwd(), Path.home(), Path(sys.prefix), Path(torch.__file__).parent, Path(__file__).parent}:
        if len(place.parts) > 1 and str(place).encode() in data:
            raise InputError(f"the file would tell of this machine: {place} stands in it; take it out of the card")
