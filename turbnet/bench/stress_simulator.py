"""Stress of the whole simulator, and of the simple models beside it."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache, partial
from itertools import product

import torch

from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Constant
from turbnet.bench.stress_cell import Cell, Check, close, finite, same_on_two_threads, within
from turbnet.bench.stress_content import BRIGHTEST, BROKEN, CONTENTS, clip
from turbnet.bench.stress_paths import CN2, STRENGTHS
from turbnet.simulate.sensor import Sensor
from turbnet.simulate.simple import DirectToImage, WarpBlur
from turbnet.simulate.simulator import Simulator

_UNIFORM = 1e-4  # of the level: the same air is taken out of a uniform scene that was put in
_SLOW = 10.0  # D/r0 beyond which light comes from so far that a small picture takes seconds
_NEGATIVE = 0.05  # of the brightest: few components leave ripples of both signs around a point


def cells(quick: bool) -> Iterator[Cell]:
    """Strengths, contents, sizes, Cn2, lengths, precisions."""
    strengths = (0.0, 1.0) if quick else STRENGTHS
    contents = ("texture", "impulse", "black", "HDR", "NaN") if quick else CONTENTS
    for strength, content in product(strengths, contents):
        if strength > _SLOW and content not in ("texture", "HDR", "NaN"):
            continue
        name = f"D/r0 = {strength:g}, {content}"
        yield Cell("simulator", name, partial(_look, strength, content, 31, 18), content in BROKEN)
    for (height, width), content in product(((1, 1), (1, 17), (65, 64)), ("texture", "constant", "Inf")):
        name = f"{height} x {width}, {content}"
        yield Cell("simulator", name, partial(_look, 1.0, content, height, width), content in BROKEN)
    for strength in (s for s in strengths if s <= _SLOW):
        yield Cell("simulator", f"D/r0 = {strength:g}, points", partial(_points, strength))
        yield Cell("simulator", f"D/r0 = {strength:g}, float64", partial(_double, strength))
    for cn2 in (0.0, 1e-16, 1e-12, 1e-10) if quick else CN2:
        yield Cell("simulator", f"Cn2 = {cn2:g}", partial(_air, cn2))
    for frames in (1, 50) if quick else (1, 50, 500):
        yield Cell("simulator", f"{frames} frames", partial(_long, frames))
    yield Cell("simulator", "one thread and two", _threads)
    for dtype in (torch.bfloat16, torch.float16, torch.uint8):
        yield Cell("simulator", f"scene of {str(dtype)[6:]}", partial(_narrow, dtype), must_refuse=True)
    for model, strength in product((WarpBlur, DirectToImage), strengths):
        yield Cell("simulator", f"{model.__name__}, D/r0 = {strength:g}", partial(_simple, model, strength))


@lru_cache(maxsize=4)
def _simulator(strength: float, height: int, width: int, uniform: bool = True) -> Simulator:
    return Simulator(OpticalPath.from_d_over_r0(strength), height, width, uniform=uniform)


def _look(strength: float, content: str, height: int, width: int) -> Iterator[Check]:
    simulator = _simulator(strength, height, width)
    scene = clip(content, height, width).float()
    draw = simulator.draw([0], 2)
    seen = simulator(scene, draw)
    yield finite("frames and truth", seen.frames, seen.tilt_only, seen.blur_only, seen.tilt, seen.blur_strength)
    brightest = float(scene.max())
    yield within("frames", seen.frames, 0.0, brightest, _NEGATIVE * brightest)
    if content in ("constant", "black", "saturated"):
        yield within("frames of a uniform scene", seen.frames, brightest, brightest, _UNIFORM)
    leaf = scene.requires_grad_()
    coefficients = draw.coefficients.clone().requires_grad_()
    looked = simulator(leaf, replace(draw, coefficients=coefficients)).frames
    slopes = torch.autograd.grad(looked.sum(), (leaf, coefficients), allow_unused=True)
    yield finite("gradients", *(slope for slope in slopes if slope is not None))
    if content != "HDR":
        # Two frames, and a pixel near a corner is seen again in three reflections.
        yield within("gradient of the light in a pixel of the scene", slopes[0], 0.0, 8.0, 0.5)


def _points(strength: float) -> Iterator[Check]:
    simulator = _simulator(strength, 63, 63, uniform=False)
    points = torch.zeros(1, 1, 1, 63, 63)
    points[..., 31, 31] = BRIGHTEST
    seen = simulator(points, simulator.draw(range(4)))
    yield finite("frames", seen.frames)
    yield within("light of a point", seen.frames.double().sum((2, 3, 4)) / BRIGHTEST, 1.0, 1.0, 1e-3)


def _double(strength: float) -> Iterator[Check]:
    path = OpticalPath.from_d_over_r0(strength)
    double = Simulator(path, 31, 18, dtype=torch.float64)
    scene, draw = clip("texture", 31, 18), double.draw([0])
    single = replace(draw, coefficients=draw.coefficients.float())
    exact, found = double(scene, draw).frames, _simulator(strength, 31, 18)(scene.float(), single).frames
    yield close("difference from float64", found, exact, 1e-4)


def _air(cn2: float) -> Iterator[Check]:
    simulator = Simulator(OpticalPath(0.2034, 7000.0, Constant(cn2)), 16, 16)
    yield finite("frames", simulator(clip("texture", 16, 16).float(), simulator.draw([0])).frames)


def _long(frames: int) -> Iterator[Check]:
    simulator = Simulator(
        OpticalPath.from_d_over_r0(1.0), 8, 8, modes=6, stride=8, components=2, sensor=Sensor(exposures=2)
    )
    seen = simulator(clip("texture", 8, 8, frames).float(), simulator.draw([0], frames, torch.tensor([3.0, 1.0])))
    yield finite("frames", seen.frames)
    yield Check("frames", seen.frames.shape[1], frames)


def _threads() -> Iterator[Check]:
    simulator = _simulator(1.0, 31, 18)
    scene, draw = clip("texture", 31, 18).float(), simulator.draw([0])
    yield same_on_two_threads(lambda: simulator(scene, draw).frames, 1e-5)


def _narrow(dtype: torch.dtype) -> Iterator[Check]:
    simulator = _simulator(1.0, 31, 18)
    yield finite("frames", simulator(clip("texture", 31, 18).to(dtype), simulator.draw([0])).frames)


def _simple(model: type[WarpBlur] | type[DirectToImage], strength: float) -> Iterator[Check]:
    simple = model(OpticalPath.from_d_over_r0(strength), 31, 18)
    for content in ("texture", "constant", "HDR"):
        scene = clip(content, 31, 18).float()
        seen = simple(scene, simple.draw([0], 2))
        yield finite(f"frames of {content}", seen.frames, seen.tilt)
        if content == "constant":
            yield within("frames of a uniform scene", seen.frames, 0.5, 0.5, _UNIFORM)
