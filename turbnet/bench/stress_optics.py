"""Stress of the simulator's parts: field, tilt, blur, the phase-to-space network, the sensor.

What is compared in units of the largest value allows for rounding alone: 1e-5 is 100 units of float32's last place, which a
sum over some thousand numbers, a Fourier transform or a grid's coordinate of some thousand pixels loses.
"""

from collections.abc import Iterator
from functools import partial
from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor

from turbnet.atmosphere.noll import noll_covariance
from turbnet.atmosphere.path import OpticalPath
from turbnet.bench.stress_cell import Cell, Check, close, finite, not_hidden, within
from turbnet.bench.stress_content import BRIGHTEST, BROKEN, CONTENTS, clip
from turbnet.bench.stress_paths import STRENGTHS
from turbnet.optics.superposition import scatter
from turbnet.simulate.blur import blur, blur_weights
from turbnet.simulate.draw import TILT_PIXELS
from turbnet.simulate.field import ZernikeField
from turbnet.simulate.phase_to_space import MODES, released
from turbnet.simulate.psf_basis import psf_basis, psf_samples, tilt_free_psf
from turbnet.simulate.sensor import Sensor
from turbnet.simulate.tilt import splat, tilt

SIZES = ((1, 1), (1, 17), (31, 18), (64, 64))
_NARROW = (torch.bfloat16, torch.float16, torch.uint8)
EIGHT_MEGAPIXELS = (2304, 3456)
_STRIDE = 4
_ROUNDING = 1e-5
_COORDINATE = 1e-4  # bicubic slopes times 2e-5 pixels: what float32 knows of a place in a picture of this size


# Field --------------------------------------------------------------------------------------------------------------


def field_cells(quick: bool) -> Iterator[Cell]:
    """Strengths, sizes, precisions, lengths of a clip."""
    dtypes, strengths = (torch.float32, torch.float64), (0.0, 50.0) if quick else STRENGTHS
    for strength, (height, width), dtype in product(strengths, SIZES[1:3], dtypes):
        name = f"D/r0 = {strength:g}, {height} x {width}, {str(dtype)[6:]}"
        yield Cell("field", name, partial(_field, strength, height, width, dtype))
    for frames in (2, 50) if quick else (2, 50, 500):
        yield Cell("field", f"{frames} frames", partial(_long_field, frames))
    for strength in STRENGTHS:
        yield Cell("field", f"gradient at D/r0 = {strength:g}", partial(_field_gradient, strength))
    for strength in (-1.0, float("nan"), float("inf")):
        yield Cell("field", f"scaled to D/r0 = {strength:g}", partial(_field_gradient, strength), must_refuse=True)


def _field(strength: float, height: int, width: int, dtype: torch.dtype) -> Iterator[Check]:
    field = ZernikeField(OpticalPath.from_d_over_r0(strength), height, width, modes=15, stride=_STRIDE, dtype=dtype)
    draw = field.draw(range(4), 2)
    yield finite("coefficients", draw.coefficients)
    theory = noll_covariance(2, 2) * strength ** (5 / 3)
    yield Check("variance of the tilt held", float(field.covariance(2, 2, 0.0)), theory, 0.02 * theory, "rad^2")
    deviation = theory**0.5
    yield within("tilts, in standard deviations", draw.coefficients[:, :, :2] / max(deviation, 1e-30), -6.0, 6.0)


def _long_field(frames: int) -> Iterator[Check]:
    field = ZernikeField(OpticalPath.from_d_over_r0(3.0), 8, 8, modes=6, stride=8, layers=4)
    wind = torch.tensor([5.0, -3.0])
    draw = field.draw([1], frames, wind)
    yield finite("coefficients", draw.coefficients)
    last = field.draw([1], 1, wind, start=frames - 1)
    yield close("last frame, drawn alone", last.coefficients[:, 0], draw.coefficients[:, -1], 0.0)


def _field_gradient(strength: float) -> Iterator[Check]:
    """a ~ s^(5/6): s da/ds = 5/6 a, and a slope without bound at 0, where the field is left out of the graph."""
    field = ZernikeField(OpticalPath.from_d_over_r0(1.0), 8, 8, modes=6, stride=8, layers=4)
    wanted = torch.tensor([strength], requires_grad=True)
    coefficients = field.draw([3], d_over_r0=wanted).coefficients
    yield finite("coefficients", coefficients)
    if strength > 0:
        total = coefficients.sum()
        (slope,) = torch.autograd.grad(total, wanted)
        yield close("slope in D/r0", strength * slope, 5 / 6 * total[None], _ROUNDING)


# Tilt ---------------------------------------------------------------------------------------------------------------


def tilt_cells(quick: bool) -> Iterator[Cell]:
    """Sizes, contents, strengths, precisions; and one picture of eight megapixels."""
    contents = ("texture", "impulse", "black", "HDR", "NaN") if quick else CONTENTS
    strengths = (0.0, 1.0, 50.0) if quick else STRENGTHS
    for (height, width), content, strength in product(SIZES, contents, strengths):
        name = f"{height} x {width}, {content}, D/r0 = {strength:g}"
        yield Cell("tilt", name, partial(_tilt, height, width, content, strength))
    for height, width in SIZES:
        yield Cell("tilt", f"{height} x {width}, out of the picture", partial(_tilt_away, height, width))
    for dtype in _NARROW:
        yield Cell("tilt", f"64 x 64, {str(dtype)[6:]}", partial(_tilt_of, dtype), must_refuse=True)
    yield Cell("tilt", "a tilt that is not a number", _broken_tilt, must_refuse=True)
    if not quick:
        yield Cell("tilt", "2304 x 3456", _large_tilt)


def _pixels(strength: float) -> float:
    """Standard deviation of the tilt."""
    return TILT_PIXELS * float(noll_covariance(2, 2) * strength ** (5 / 3)) ** 0.5


def _shift(height: int, width: int, pixels: float) -> Tensor:
    """A smooth shift of every pixel by at most so much along each axis, (1, 2, H, W), float64."""
    wave = torch.rand(1, 2, 4, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return pixels * F.interpolate(2 * wave - 1, (height, width), mode="bilinear", align_corners=True)


def _tilt(height: int, width: int, content: str, strength: float) -> Iterator[Check]:
    margin = int(_pixels(strength)) + 3  # so that no light can leave
    scene = F.pad(clip(content, height, width)[0], (margin,) * 4)
    shift = _shift(scene.shape[-2], scene.shape[-1], _pixels(strength))
    single = splat(scene.float(), shift.float())
    if content in BROKEN:
        yield not_hidden("picture", single)
        return
    exact = splat(scene, shift)
    yield finite("picture", single)
    yield close("light", single.double().sum(), scene.sum(), _ROUNDING)
    yield close("difference from float64", single, exact, _COORDINATE)
    mirrored = splat(scene.flip(-1), shift.flip(-1) * torch.tensor([-1.0, 1.0]).view(2, 1, 1))
    yield close("difference of the mirrored picture", mirrored.flip(-1), exact, 1e-9)
    leaf, moves = scene.float().requires_grad_(), shift.float().requires_grad_()
    yield finite("gradients", *torch.autograd.grad(splat(leaf, moves).square().sum(), (leaf, moves)))


def _tilt_away(height: int, width: int) -> Iterator[Check]:
    moved = splat(torch.ones(1, 1, height, width), torch.full((1, 2, height, width), 2.0 * max(height, width) + 4))
    yield Check("light left", float(moved.abs().sum()))


def _tilt_of(dtype: torch.dtype) -> Iterator[Check]:
    scene, shift = F.pad(clip("texture", 64, 64)[0], (8,) * 4), _shift(80, 80, 2.0)
    narrow = splat(scene.to(dtype), shift.to(dtype))
    yield finite("picture", narrow)
    yield close("light", narrow.double().sum(), scene.sum(), 0.01)


def _broken_tilt() -> Iterator[Check]:
    yield finite("picture", tilt(torch.ones(1, 1, 9, 9), torch.full((1, 2, 3, 3), float("nan")), 4))


def _large_tilt() -> Iterator[Check]:
    scene, shift = torch.ones(1, 1, *EIGHT_MEGAPIXELS), _shift(*EIGHT_MEGAPIXELS, 2.0).float()
    scene[..., :8, :], scene[..., -8:, :], scene[..., :8], scene[..., -8:] = 0, 0, 0, 0
    moved = splat(scene, shift)
    yield finite("picture", moved)
    yield close("light", moved.double().sum(), scene.double().sum(), _ROUNDING)


# Blur ---------------------------------------------------------------------------------------------------------------


def blur_cells(quick: bool) -> Iterator[Cell]:
    """Kernels of all strengths; contents and sizes blurred by them, at full and at half resolution."""
    contents, sizes = (("impulse", "HDR", "NaN"), SIZES[1:3]) if quick else (CONTENTS, SIZES)
    for strength in (0.01, 50.0) if quick else STRENGTHS:
        yield Cell("blur", f"kernels, D/r0 = {strength:g}", partial(_kernels, strength))
        yield Cell("blur", f"dense, D/r0 = {strength:g}", partial(_dense, strength))
        for (height, width), content, factor in product(sizes, contents, (1, 2)):
            name = f"{height} x {width}, {content}, D/r0 = {strength:g}, factor {factor}"
            yield Cell("blur", name, partial(_blur, height, width, content, strength, factor))
    for dtype in _NARROW:
        yield Cell("blur", f"64 x 64, {str(dtype)[6:]}", partial(_blur_of, dtype), must_refuse=True)


def _kernels(strength: float) -> Iterator[Check]:
    high = psf_samples(strength, strength)[:64]
    for q in (0.5, 1.0, 2.0):
        psf = tilt_free_psf(high, q)
        yield within(f"kernels, q = {q:g}", psf, 0.0, 1.0, _ROUNDING)
        yield within(f"sums of the kernels, q = {q:g}", psf.sum((1, 2)), 1.0, 1.0, _ROUNDING)
        yield close(f"kernels in float64, q = {q:g}", psf, tilt_free_psf(high.double(), q), _ROUNDING)
    leaf = high.clone().requires_grad_()
    yield finite("gradients", *torch.autograd.grad(tilt_free_psf(leaf).square().sum(), leaf))


def _dense(strength: float) -> Iterator[Check]:
    """A point and its kernel, the sum over all points of their kernels."""
    side = 40
    kernels = tilt_free_psf(psf_samples(strength, strength)[: side * side]).view(side, side, 31, 31)
    scene = F.pad(torch.rand(8, 8, generator=torch.Generator().manual_seed(1)), (16,) * 4)
    seen = scatter(scene, kernels)
    yield close("light", seen.sum(), scene.sum(), _ROUNDING)
    yield close("difference from float64", seen, scatter(scene.double(), kernels.double()), _ROUNDING)


def _blur(height: int, width: int, content: str, strength: float, factor: int) -> Iterator[Check]:
    basis = psf_basis(20, strength, strength)
    margin = -(-basis.size // _STRIDE) * _STRIDE
    scene = F.pad(clip(content, height, width)[0], (margin, margin + _STRIDE, margin, margin))
    points = [1 + -(-side // _STRIDE) for side in scene.shape[-2:]]
    high = psf_samples(strength, strength)[: points[0] * points[1]].T.reshape(1, -1, *points)
    weights = blur_weights(high, basis)
    single = blur(scene.float(), weights, basis, _STRIDE, factor)
    if content in BROKEN:
        yield not_hidden("picture", single)
        return
    yield finite("picture", single)
    # At half the resolution the soft edge of the spectrum spreads a point so far that some of it leaves the picture.
    yield close("light", single.double().sum(), scene.sum(), 1e-4 if factor == 1 else 1e-3)
    exact = blur(scene, weights.double(), basis, _STRIDE, factor)
    yield close("difference from float64", single, exact, _ROUNDING)
    moved = blur(scene.roll(_STRIDE, -1), weights.double().roll(1, -1), basis, _STRIDE, factor)
    inner = (..., slice(_STRIDE * 4, -_STRIDE * 4))
    yield close("difference of the shifted picture", moved.roll(-_STRIDE, -1)[inner], exact[inner], 1e-4)
    leaf, own = scene.float().requires_grad_(), weights.clone().requires_grad_()
    yield finite("gradients", *torch.autograd.grad(blur(leaf, own, basis, _STRIDE, factor).square().sum(), (leaf, own)))


def _blur_of(dtype: torch.dtype) -> Iterator[Check]:
    basis = psf_basis(20, 5.0, 5.0)
    scene = F.pad(clip("texture", 32, 32)[0], (16,) * 4)
    weights = blur_weights(psf_samples(5.0, 5.0)[: 17 * 17].T.reshape(1, -1, 17, 17), basis)
    narrow = blur(scene.to(dtype), weights.to(dtype), basis, _STRIDE)
    yield finite("picture", narrow)
    yield close("light", narrow.double().sum(), scene.sum(), 0.01)


# Phase to space -----------------------------------------------------------------------------------------------------


def network_cells(quick: bool) -> Iterator[Cell]:
    """Strengths, within what the network was trained for (D/r0 <= 6) and beyond."""
    for strength in STRENGTHS:
        yield Cell("phase-to-space", f"D/r0 = {strength:g}", partial(_phase_to_space, strength))
    yield Cell("phase-to-space", "37 modes", _too_many_modes, must_refuse=True)


def _phase_to_space(strength: float) -> Iterator[Check]:
    network, high = released(), psf_samples(strength, strength)[:256]
    psf = network(high)
    yield finite("kernels", psf)
    yield within("kernels", psf, 0.0, 1.0, 0.005)
    yield within("sums of the kernels", psf.sum((1, 2)), 1.0, 1.0, 0.02)
    leaf = high.clone().requires_grad_()
    (slope,) = torch.autograd.grad(network(leaf).square().sum(), leaf)
    yield finite("gradients", slope)
    yield within("gradients", slope, -1.0, 1.0)


def _too_many_modes() -> Iterator[Check]:
    yield finite("kernels", released()(torch.zeros(1, MODES - 2)))


# Sensor -------------------------------------------------------------------------------------------------------------

_CAMERAS = {
    "plain": Sensor(),
    "shot noise": Sensor(full_well=1.0),
    "read noise": Sensor(read_noise=1.0),
    "1 bit": Sensor(bits=1),
    "16 bits": Sensor(bits=16),
    "gamma": Sensor(gamma=True),
    "jpeg 1": Sensor(jpeg=1),
    "everything": Sensor(1e4, 0.01, 8, 2, True, 50),
}


def sensor_cells(quick: bool) -> Iterator[Cell]:
    """Cameras, contents, sizes, precisions; one frame of eight megapixels."""
    sizes = SIZES[:3] if quick else SIZES
    for (name, sensor), content, (height, width) in product(_CAMERAS.items(), CONTENTS, sizes):
        yield Cell("sensor", f"{name}, {content}, {height} x {width}", partial(_sense, sensor, content, height, width))
    for dtype in _NARROW[:2]:
        yield Cell("sensor", f"everything, {str(dtype)[6:]}", partial(_sense_of, dtype))
    if not quick:
        yield Cell("sensor", "8 bits, 2304 x 3456", _large_sensor)


def _sense(sensor: Sensor, content: str, height: int, width: int) -> Iterator[Check]:
    scene = clip(content, height, width, sensor.exposures).float()
    seen = sensor(scene)
    if content == "NaN":
        yield not_hidden("frame", seen)
        return
    clean = sensor == Sensor() or sensor == Sensor(gamma=True)
    if content == "Inf":  # an infinite pixel saturates or stays infinite
        yield within("frame", torch.nan_to_num(seen, 1.0, 1.0), 0.0, 1.0, 1e-6)
        return
    yield finite("frame", seen)
    yield within("frame", seen, 0.0, BRIGHTEST if clean else 1.0, 1e-6)
    if sensor.bits and not sensor.gamma:
        steps = 2**sensor.bits - 1
        yield close("whole steps", (seen * steps).round() / steps, seen, 1e-6)
    leaf = scene.requires_grad_()
    (slope,) = torch.autograd.grad(sensor(leaf).sum(), leaf)
    yield finite("gradients", slope)


def _sense_of(dtype: torch.dtype) -> Iterator[Check]:
    sensor = _CAMERAS["everything"]
    scene = clip("texture", 31, 18, 2)
    seen = sensor(scene.to(dtype))
    yield within("frame", seen, 0.0, 1.0, 1e-6)
    yield close("mean, against float32", seen.double().mean(), sensor(scene.float()).double().mean(), 0.02)


def _large_sensor() -> Iterator[Check]:
    seen = Sensor(bits=8)(torch.rand(1, 1, 1, *EIGHT_MEGAPIXELS))
    yield within("frame", seen, 0.0, 1.0, 1e-6)
