"""Deconvolution in one piece for the exporter, which takes a minute to trace its many steps through sizes that stay free."""

from collections.abc import Callable
from typing import Any

import torch
from onnxscript import opset18
from torch import Tensor, nn

from turbnet.nets.deconvolution import DARKEST, RichardsonLucy


@torch.library.custom_op("turbnet::richardson_lucy", mutates_args=())
def richardson_lucy(seen: Tensor, near: Tensor, far: Tensor, steps: int) -> Tensor:
    """`RichardsonLucy.iterate` as an operator of torch."""
    return RichardsonLucy.iterate(seen, near, far, steps).clone()


@richardson_lucy.register_fake
def _(seen: Tensor, near: Tensor, far: Tensor, steps: int) -> Tensor:
    return torch.empty_like(seen)


def opaque(module: nn.Module) -> nn.Module:
    """`module` with every deconvolution as that operator, in place."""
    for part in module.modules():
        if isinstance(part, RichardsonLucy):
            part.iterate = richardson_lucy  # type: ignore[method-assign]
    return module


def _to_onnx(seen: Any, near: Any, far: Any, steps: int) -> Any:
    """What the exporter makes of `RichardsonLucy.iterate`."""
    op: Any = opset18  # whose types know nothing of symbols
    darkest = op.Constant(value_float=DARKEST)

    def convolved(pictures: Any, kernels: Any) -> Any:
        reach = kernels.shape[-1] // 2
        around = op.Constant(value_ints=[0, 0, reach, reach] * 2)
        return op.Conv(op.Pad(pictures, around, mode="edge"), kernels, group=kernels.shape[0])

    def blurred(pictures: Any) -> Any:
        halved = op.AveragePool(pictures, kernel_shape=[2, 2], strides=[2, 2])
        doubled = op.Constant(value_floats=[1.0, 1.0, 2.0, 2.0])
        wide = op.Resize(convolved(halved, far), None, doubled, None, mode="linear")
        return op.Add(convolved(pictures, near), wide)

    found = guess = seen
    for step in range(steps):
        before = found
        found = op.Mul(guess, blurred(op.Div(seen, op.Clip(blurred(guess), darkest, None))))
        ahead = op.Mul(op.Sub(found, before), op.Constant(value_float=step / (step + 3)))
        guess = op.Clip(op.Add(found, ahead), darkest, None)
    return found


TRANSLATIONS: dict[Callable[..., Any], Callable[..., Any]] = {torch.ops.turbnet.richardson_lucy.default: _to_onnx}
