"""Stress of every network of `turbnet.nets.NETS`, small and with every weight at work, forward and backward.

Away from borders a network of convolutions commutes with shifts by whole multiples of its `size_multiple`. What float32 and
float64 make of the same input, one thread and two, and autocast to half precision, differs by rounding only.
"""

from collections.abc import Iterator
from copy import deepcopy
from functools import lru_cache, partial
from itertools import product
from typing import Any

import torch
from torch import Tensor, nn

from turbnet.bench.stress_cell import Cell, Check, close, finite, not_hidden, same_on_two_threads, within
from turbnet.bench.stress_content import BROKEN, CONTENTS, clip
from turbnet.nets import NETS, build

_U: dict[str, Any] = {"widths": (6, 8, 10), "depths": (1, 1, 1)}
SMALL: dict[str, list[dict[str, Any]]] = {
    "restorer": [
        {
            "tilt": {"widths": (6, 6, 6)},
            "tcja": {"width": 8, "depth": 1},
            "scene": _U,
            "own": {"width": 6, "depth": 1},
            "deconvolution": {"strengths": (2.0,)},
            "fusions": 2,
        }
    ],
    "still": [{**_U, "maps": _U}],
    "redegrading": [
        {"restorer": {"name": "unet", **_U}, "form": form, "code": {"width": 4, "depth": 1}}
        for form in ("linear", "physical")
    ],
    "unet": [_U],
    "complex-unet": [_U],
    "dncnn": [{"width": 6, "depth": 4}],
}
"""Arguments of a small network of each name."""

_DOUBLE = ("still", "unet", "complex-unet", "dncnn")  # registration is computed in float32 whatever the input
_ROUNDING = 1e-5
_PLACE = 1e-4  # float32 knows a place in a picture as wide to 1e-5 pixels, and sampling there takes slopes of one
_SIDE, _REACH = 240, 104  # pixels; from the second on no border is felt, two U-Nets one after the other included
_HALF = 0.02  # eight bits through some twenty layers


def cells(quick: bool) -> Iterator[Cell]:
    """Networks, contents, sizes, lengths, precisions."""
    contents = ("texture", "constant", "checkerboard", "HDR", "NaN") if quick else CONTENTS
    for name, variant in [(known, v) for known in NETS for v in range(len(SMALL[known]))]:
        title = f"{name} {SMALL[name][variant].get('form', '')}".rstrip()
        for content, (rows, columns), frames in product(contents, ((1, 1), (3, 2)), (1, 3)):
            where = f"{title}, {content}, {rows} x {columns} cells, {frames} frames"
            yield Cell("nets", where, partial(_run, name, variant, content, rows, columns, frames))
        yield Cell("nets", f"{title}, shifted", partial(_shifted, name, variant))
        yield Cell("nets", f"{title}, one thread and two", partial(_threads, name, variant))
        if name in _DOUBLE:
            yield Cell("nets", f"{title}, float64", partial(_double, name, variant))
        for dtype in (torch.bfloat16, torch.float16):
            yield Cell("nets", f"{title}, autocast to {str(dtype)[6:]}", partial(_half, name, variant, dtype))
        for frames in (50,) if quick else (50, 500):
            yield Cell("nets", f"{title}, {frames} frames", partial(_long, name, variant, frames))


@lru_cache
def _network(name: str, variant: int) -> tuple[nn.Module, int]:
    """A network without a zero weight, as after training, and its size multiple."""
    generator = torch.Generator().manual_seed(4)
    with torch.random.fork_rng():
        torch.manual_seed(4)
        network = build({"name": name, **SMALL[name][variant]})
    with torch.no_grad():
        for parameter in network.parameters():
            if not parameter.any():
                parameter.copy_(0.02 * torch.randn(parameter.shape, generator=generator))
    return network.eval(), int(network.size_multiple)  # type: ignore[arg-type]


def _forward(network: nn.Module, frames: Tensor) -> list[Tensor]:
    """Everything a network makes: the restored frames and, where it has them, those degraded again or expected errors."""
    if not hasattr(network, "stages"):
        return [network(frames)]
    found = network.stages(frames)  # type: ignore[operator]
    if isinstance(network, NETS["redegrading"]):
        return [found.restored, found.frames]
    if isinstance(network, NETS["still"]):
        return [found.frames, found.uncertainty.log_scale]
    return [found.frames, found.gate]


def _run(name: str, variant: int, content: str, rows: int, columns: int, frames: int) -> Iterator[Check]:
    network, multiple = _network(name, variant)
    seen = clip(content, rows * multiple, columns * multiple, frames).float().requires_grad_()
    made = _forward(network, seen)
    if content in BROKEN:
        yield not_hidden("frames", made[0])
        return
    yield finite("frames", *made)
    total = sum((x.mean() for x in made), torch.zeros(()))
    parameters = [p for p in network.parameters()]
    slope, *slopes = torch.autograd.grad(total, [seen, *parameters], allow_unused=True)
    yield finite("gradients", slope, *(s for s in slopes if s is not None))
    if content != "HDR":
        # The mean of a restored clip has about the slope 1 in the mean of the clip: none vanishes, none explodes.
        yield within("norm of the gradient in the clip", slope.norm() * seen.numel() ** 0.5, 1e-2, 1e2)
        yield within("largest gradient in a weight", max(float(s.abs().max()) for s in slopes if s is not None), 0, 1e3)


def _double(name: str, variant: int) -> Iterator[Check]:
    network, multiple = _network(name, variant)
    frames = clip("texture", 2 * multiple, 2 * multiple, 3)
    exact = deepcopy(network).double()
    yield close("difference from float64", network(frames.float()), exact(frames), _ROUNDING)


def _shifted(name: str, variant: int) -> Iterator[Check]:
    network, multiple = _network(name, variant)
    with torch.no_grad():
        wide = clip("texture", _SIDE, _SIDE + multiple, 2).float()
        first, second = network(wide[..., :-multiple]), network(wide[..., multiple:])
    kept = slice(_REACH, _SIDE - _REACH - multiple)
    moved, same = second[..., kept, kept], first[..., kept, _REACH + multiple : _SIDE - _REACH]
    yield close("difference of the shifted clip", moved, same, _PLACE)


def _threads(name: str, variant: int) -> Iterator[Check]:
    network, multiple = _network(name, variant)
    frames = clip("texture", 2 * multiple, 2 * multiple, 2).float()
    with torch.no_grad():
        yield same_on_two_threads(lambda: network(frames), _ROUNDING)


def _half(name: str, variant: int, dtype: torch.dtype) -> Iterator[Check]:
    network, multiple = _network(name, variant)
    frames = clip("texture", 2 * multiple, 2 * multiple, 3).float()
    made = []
    for enabled in (False, True):
        with torch.autocast("cpu", dtype, enabled=enabled):
            leaf = frames.clone().requires_grad_()
            made.append(network(leaf))
            (slope,) = torch.autograd.grad(made[-1].float().mean(), leaf)
    yield finite("frames", made[1])
    yield finite("gradients", slope)
    yield close("difference from float32", made[1].float(), made[0], _HALF)


def _long(name: str, variant: int, frames: int) -> Iterator[Check]:
    network, multiple = _network(name, variant)
    with torch.no_grad():
        made = network(clip("texture", multiple, multiple, frames).float())
    yield finite("frames", made)
    yield Check("frames", made.shape[1], frames)
