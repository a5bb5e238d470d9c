r"""How strong was the turbulence of a real clip? Its D/r0, found by matching simulated frames to it.

The image of a scene point wanders with the variance (4/pi)^2 0.4489 (D/r0)^(5/3) square pixels an axis, but a camera that
shakes wanders too. What differs across the picture is the air's: with d the displacements of N points, less their mean in
each frame and in time,

.. math::
    S = \Big\langle \sum_{x,y} d^T W d \Big\rangle_{frames}, \qquad W = (C + v\,1)^{-1}, \qquad v = \mathrm{tr}\,C / N

where C is the exact covariance of d (`turbnet.atmosphere.covariance`) at D/r0 = 1. The weights W are those of least
squares for displacements measured with errors as large as themselves. They lower the share of the widest patterns, which
are few and change slowly: in wind the scatter of D/r0 falls from 5 to 2 or 3 %.

True tilts would give S proportional to (D/r0)^(5/3). Those measured in windows differ, by blur, averaging and noise, by
an amount that depends on the scene. So frames are simulated from the scene itself, which is the registered mean of the
clip with the mean tilt-free transfer function undone, and measured in the same way; D/r0 is where both S agree.
Registration: S. Baker and I. Matthews, Int. J. Comput. Vis. 56, 221 (2004), inverse composition.
"""

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from turbnet.atmosphere.covariance import zernike_covariance
from turbnet.atmosphere.exposure import tilt_free_otf
from turbnet.atmosphere.path import OpticalPath
from turbnet.errors import InputError
from turbnet.simulate.draw import TILT_PIXELS
from turbnet.simulate.sensor import Sensor
from turbnet.simulate.simulator import Simulator
from turbnet.simulate.tilt import sample, upsample

FEWEST_FRAMES, FEWEST_POINTS = 10, 12
WEAKEST, STRONGEST = 0.1, 10.0
"""Range of D/r0 that is searched."""
CALIBRATION = 0.04
"""Relative error of D/r0 that more frames do not lessen: how well simulated scenes stand for the real one."""

_SIGMA = 4.0  # of the windows' Gaussian weight, pixels
_REACH = int(2 * _SIGMA)
_LEVELS = ((3.0, 3), (1.0, 4))  # smoothing of frame and reference in pixels, and steps, coarse to fine
_BORDER = _REACH + 4
_SPACING, _MOST_POINTS = 10, 250
_TEXTURE = 0.12  # largest error that noise may bring to a displacement, pixels
_LEAST_NOISE = 0.003  # assumed at least: rounding to 8 bits, compression
_OUTLIER = 4.0  # standard deviations at which a displacement is cut
_SIMULATED = 24  # frames
_STEPS = 6
_CHUNK = 8  # frames whose windows are in memory at a time


@dataclass(frozen=True)
class Fit:
    """The strength of a clip's turbulence and what it rests on.

    Attributes:
        d_over_r0: D/r0, spherical wave; `WEAKEST` stands for that or less.
        uncertainty: its standard error: sampling of clip and simulation, and `CALIBRATION`.
        tilt_pixels: measured displacement that differs across the picture, rms an axis, pixels.
        points: windows that had texture enough to be registered.
        frames: of the clip.
        residual: rms difference that registration leaves between windows of the clip and its mean, over the same in the
            simulation. Near 1 if the clip is what the model says; well above, something else moves or flickers.
    """

    d_over_r0: float
    uncertainty: float
    tilt_pixels: float
    points: int
    frames: int
    residual: float


def fit_strength(frames: Tensor, path: OpticalPath) -> Fit:
    """Estimate D/r0 from a clip of a still scene.

    Args:
        frames: (T, H, W) or (T, C, H, W), at least 10, in [0, 1], linear or sRGB; a pixel is the path's Nyquist pixel.
        path: geometry, wavelength and shape of the Cn2 profile; its strength is not used.

    Raises:
        InputError: too few or too small frames, NaN or infinite values, values outside [0, 1], too little texture to
            register, motion beyond what D/r0 = 10 or the frames' width explains, or a path of still air, which has no
            profile to scale.
    """
    if path.d_over_r0 == 0:
        raise InputError("a path of still air has no profile to scale to a strength; give it a Cn2 above 0")
    clip = _check(frames)
    with torch.no_grad():
        reference, common = _align(clip)
        points = _textured(reference, common, _noise(clip))
        weights = _weights(points, path)
        shifts, reference, residual = _measure(clip, reference, points, common)
        seen = _energies(shifts, weights)

        strength = min(max(float(seen.mean()) ** 0.6, WEAKEST), STRONGEST)
        simulator = _simulator(path, reference, strength, _noise(clip))
        for _ in range(_STEPS):
            simulated, left = _simulate(simulator, reference, strength, points)
            made = _energies(simulated, weights)
            last, strength = strength, strength * float(seen.mean() / made.mean()) ** 0.6
            if strength > STRONGEST:
                raise InputError(f"the clip's frames move more than D/r0 = {STRONGEST:g} would move them")
            strength = max(strength, WEAKEST)
            if abs(strength / last - 1) < 0.005:
                break
    relative = np.hypot(_relative_error(seen), float(made.std() / made.mean()) / len(made) ** 0.5)
    return Fit(
        d_over_r0=strength,
        uncertainty=strength * float(np.hypot(0.6 * relative, CALIBRATION)),
        tilt_pixels=float(_relative(shifts).square().mean().sqrt()),
        points=len(points),
        frames=len(clip),
        residual=residual / left,
    )


def _check(frames: Tensor) -> Tensor:
    """The clip as (T, H, W) float32, channels averaged."""
    if frames.ndim not in (3, 4):
        raise InputError(f"the clip is {tuple(frames.shape)}; (T, H, W) or (T, C, H, W) is expected")
    if len(frames) < FEWEST_FRAMES:
        raise InputError(f"the clip has {len(frames)} frames; at least {FEWEST_FRAMES} are needed")
    clip = frames.float()
    if not bool(torch.isfinite(clip).all()):
        raise InputError("the clip holds NaN or infinite values")
    if float(clip.min()) < -0.5 or float(clip.max()) > 1.5:
        raise InputError(f"the clip's values lie in {float(clip.min()):g} .. {float(clip.max()):g}; [0, 1] is expected")
    if min(clip.shape[-2:]) < 2 * _BORDER + 3 * _SPACING:
        raise InputError(f"the frames are {clip.shape[-1]}x{clip.shape[-2]} pixels; at least 54x54 are needed")
    return clip if clip.ndim == 3 else clip.mean(1)


def _noise(clip_THW: Tensor) -> float:
    """Standard deviation of the noise, from the finest diagonal detail (Donoho's median estimate)."""
    height, width = (n // 2 * 2 for n in clip_THW.shape[1:])
    a, b, c, d = (clip_THW[:, y:height:2, x:width:2] for y in (0, 1) for x in (0, 1))
    return float((a - b - c + d).abs().median() / 2 / 0.6745)


def _smooth(pictures_THW: Tensor, sigma: float) -> Tensor:
    reach = int(3 * sigma + 0.5)
    kernel = torch.exp(-0.5 * (torch.arange(-reach, reach + 1.0) / sigma) ** 2)
    kernel = kernel / kernel.sum()
    padded = F.pad(pictures_THW[:, None], (reach, reach, reach, reach), mode="replicate")
    return F.conv2d(F.conv2d(padded, kernel.view(1, 1, 1, -1)), kernel.view(1, 1, -1, 1))[:, 0]


def _align(clip_THW: Tensor) -> tuple[Tensor, Tensor]:
    """The mean of the frames shifted by whole pixels onto each other, and their shifts from it, (T, 2), x then y."""
    reference = clip_THW[len(clip_THW) // 2]
    for _ in range(2):
        common = _whole_shift(clip_THW, reference)
        rolled = [torch.roll(frame, (-int(y), -int(x)), (0, 1)) for frame, (x, y) in zip(clip_THW, common, strict=True)]
        reference = torch.stack(rolled).mean(0)
    return reference, _whole_shift(clip_THW, reference)


def _whole_shift(clip_THW: Tensor, reference_HW: Tensor) -> Tensor:
    """Where the correlation of each frame with the reference peaks, (T, 2), x then y, whole pixels."""
    height, width = reference_HW.shape
    window = torch.hann_window(height)[:, None] * torch.hann_window(width)

    def spectrum(pictures: Tensor) -> Tensor:
        return torch.fft.rfft2((_smooth(pictures, 1.5) - _smooth(pictures, 8.0)) * window)

    correlation = torch.fft.irfft2(spectrum(clip_THW) * spectrum(reference_HW[None]).conj(), s=(height, width))
    peak = correlation.flatten(1).argmax(1)
    y, x = peak // width, peak % width
    return torch.stack(((x + width // 2) % width - width // 2, (y + height // 2) % height - height // 2), -1).float()


def _window() -> tuple[Tensor, Tensor, Tensor]:
    """Offsets x, y of a window's pixels and their weights, which sum to one, each (n,)."""
    offset = torch.arange(-_REACH, _REACH + 1.0)
    y, x = (v.flatten() for v in torch.meshgrid(offset, offset, indexing="ij"))
    weight = torch.exp(-0.5 * (x**2 + y**2) / _SIGMA**2)
    return x, y, weight / weight.sum()


def _patches(pictures_THW: Tensor, centres_TP2: Tensor) -> Tensor:
    """Windows around points between pixels, (T, P, n)."""
    x, y, _ = _window()
    height, width = pictures_THW.shape[-2:]
    at = (centres_TP2[..., :1] + x) * (2 / (width - 1)) - 1, (centres_TP2[..., 1:] + y) * (2 / (height - 1)) - 1
    return F.grid_sample(
        pictures_THW[:, None], torch.stack(at, -1), mode="bilinear", padding_mode="border", align_corners=True
    )[:, 0]


def _gradients(reference_HW: Tensor, points_P2: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient in each window less its mean, (P, 2, n), and its weighted square, (P, 2, 2)."""
    _, _, weight = _window()
    along_y, along_x = torch.gradient(reference_HW)
    gradient = torch.cat([_patches(g[None], points_P2[None]) for g in (along_x, along_y)]).transpose(0, 1)
    gradient = gradient - (gradient * weight).sum(-1, keepdim=True)
    return gradient, torch.einsum("pan,pbn,n->pab", gradient, gradient, weight)


def _textured(reference_HW: Tensor, common_T2: Tensor, noise: float) -> Tensor:
    """Points (P, 2), x then y, of a grid whose windows lie in every frame and are shifted by noise less than `_TEXTURE`."""
    first = _BORDER - common_T2.amin(0).clamp(max=0).int()
    last = torch.tensor(reference_HW.shape).flip(0) - 1 - _BORDER - common_T2.amax(0).clamp(min=0).int()
    width, height = (last - first).tolist()
    if min(width, height) < 0:
        raise InputError(
            "the camera moves by so much that the frames share too little of the scene; steady the clip first"
        )
    spacing = max(_SPACING, int(np.ceil((width * height / _MOST_POINTS) ** 0.5)))
    columns, rows = (
        int(start) + n % spacing // 2 + torch.arange(0, n + 1 - n % spacing // 2, spacing)
        for start, n in zip(first, (width, height), strict=True)
    )
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    points = torch.stack((x.flatten(), y.flatten()), -1).float()
    _, square = _gradients(_smooth(reference_HW[None], _LEVELS[-1][0])[0], points)
    weakest = torch.linalg.eigvalsh(square)[:, 0].clamp(min=1e-12)
    error = max(noise, _LEAST_NOISE) * (_window()[2].square().sum() / weakest).sqrt()
    points = points[error < _TEXTURE]
    if len(points) < FEWEST_POINTS:
        raise InputError(
            f"too little texture to register: {len(points)} windows of the picture show enough of it, at least "
            f"{FEWEST_POINTS} are needed; choose a part with more detail"
        )
    return points


def _measure(clip_THW: Tensor, first_HW: Tensor, points_P2: Tensor, common_T2: Tensor) -> tuple[Tensor, Tensor, float]:
    """Shifts (T, P, 2) from the mean of the frames registered to a first reference; that mean; rms difference left."""
    shifts, _ = _track(clip_THW, first_HW, points_P2, common_T2)
    reference = _register(clip_THW, shifts, points_P2).mean(0)
    shifts, left = _track(clip_THW, reference, points_P2, shifts.mean(1))
    return shifts, reference, left


def _track(clip_THW: Tensor, reference_HW: Tensor, points_P2: Tensor, common_T2: Tensor) -> tuple[Tensor, float]:
    """Shifts d (T, P, 2) for which frame(x + d) is the reference(x) in each point's window; rms difference left."""
    _, _, weight = _window()
    shifts = common_T2[:, None].repeat(1, len(points_P2), 1)
    left = 0.0
    for smoothing, steps in _LEVELS:
        reference = _smooth(reference_HW[None], smoothing)
        template = _patches(reference, points_P2[None])
        gradient, square = _gradients(reference[0], points_P2)
        inverse = torch.linalg.solve(square + 1e-9 * torch.eye(2), gradient * weight)
        left = 0.0
        for start in range(0, len(clip_THW), _CHUNK):
            part = slice(start, start + _CHUNK)
            smooth = _smooth(clip_THW[part], smoothing)
            for _ in range(steps):
                error = _patches(smooth, points_P2 + shifts[part]) - template
                shifts[part] -= torch.einsum("pan,tpn->tpa", inverse, error).clamp(-2, 2)
            left += float((error.square() * weight).sum())
    return shifts, (left / shifts[..., 0].numel()) ** 0.5


def _register(clip_THW: Tensor, shifts_TP2: Tensor, points_P2: Tensor) -> Tensor:
    """The frames sampled at x + d(x), d interpolated between the points by Gaussian weights."""
    stride, (height, width) = 4, clip_THW.shape[1:]
    y, x = (torch.arange(0, n + stride - 1, stride) for n in (height, width))
    squares = (x[None, :, None] - points_P2[:, 0]) ** 2 + (y[:, None, None] - points_P2[:, 1]) ** 2
    weight = torch.softmax(-0.5 * squares / _SPACING**2, dim=-1)
    field = torch.einsum("yxp,tpa->tayx", weight, shifts_TP2)
    return sample(clip_THW[:, None], upsample(field, stride, height, width))[:, 0]


def _relative(shifts_TP2: Tensor) -> Tensor:
    """Shifts less their mean over the points and over time, outliers cut."""
    d = shifts_TP2.double()
    d = d - d.mean(1, keepdim=True)
    d = d - d.mean(0)
    bound = _OUTLIER * float(d.abs().median()) / 0.6745
    return d.clamp(-bound, bound)


def _weights(points_P2: Tensor, path: OpticalPath) -> Tensor:
    """W of x and y, (2, P, P), such that true tilts at D/r0 = 1 give S = 1."""
    x, y = (points_P2.double().numpy() * path.pixel).T
    unit = TILT_PIXELS**2 * path.d_over_r0 ** (-5 / 3)
    out, total = [], 0.0
    for mode in (2, 3):
        full = unit * zernike_covariance(path, mode, mode, x[:, None] - x, y[:, None] - y, path.layers(32))
        covariance = full - full.mean(0) - full.mean(1)[:, None] + full.mean()
        weight = np.linalg.inv(covariance + np.eye(len(x)) * np.trace(covariance) / len(x))
        total += float((weight * covariance).sum())
        out.append(torch.from_numpy(weight))
    return torch.stack(out) / total


def _energies(shifts_TP2: Tensor, weights_2PP: Tensor) -> Tensor:
    """What each frame adds to the mean S, (T,), corrected for the mean in time."""
    d = _relative(shifts_TP2)
    return torch.einsum("tpa,apq,tqa->t", d, weights_2PP, d) * (len(d) / (len(d) - 1))


def _relative_error(energies_T: Tensor) -> float:
    """Relative standard error of their mean, neighbours in time correlated (Bartlett's weights to a quarter of T)."""
    count = len(energies_T)
    e = energies_T - energies_T.mean()
    variance = float((e * e).mean())
    for lag in range(1, count // 4):
        variance += 2 * (1 - 4 * lag / count) * float((e[lag:] * e[:-lag]).sum()) / count
    return (max(variance, float((e * e).mean())) / count) ** 0.5 / float(energies_T.mean())


def _simulator(path: OpticalPath, reference_HW: Tensor, strength: float, noise: float) -> Simulator:
    strengths = max(strength / 1.5, WEAKEST), min(2 * strength, STRONGEST)
    height, width = reference_HW.shape
    return Simulator(path, height, width, components=10, strengths=strengths, sensor=Sensor(read_noise=noise))


def _simulate(simulator: Simulator, reference_HW: Tensor, strength: float, points_P2: Tensor) -> tuple[Tensor, float]:
    """Shifts and rms difference left of independent frames of the same scene, whose seeds are the same at every call."""
    scene = _sharpen(reference_HW, strength)
    frames = []
    for seed in range(_SIMULATED):
        draw = simulator.draw([seed], d_over_r0=torch.tensor([strength]))
        frames.append(simulator(scene[None, None, None], draw, noise_seed=seed).frames[0, 0, 0])
    clip = torch.stack(frames)
    shifts, _, left = _measure(clip, reference_HW, points_P2, _whole_shift(clip, reference_HW))
    return shifts, left


def _sharpen(reference_HW: Tensor, strength: float) -> Tensor:
    """Undo the mean transfer function of aperture and tilt-free air (Wiener's inverse), so that frames blur it anew."""
    margin = min(32, *(n - 1 for n in reference_HW.shape))
    padded = F.pad(reference_HW[None, None], (margin,) * 4, mode="reflect")[0, 0]
    height, width = padded.shape
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)) * 2  # the cutoff is at 1/2 a pixel
    radii = np.linspace(0, 1, 33)
    otf = torch.from_numpy(np.interp(frequency, radii, tilt_free_otf(radii, strength))).float()
    sharp = torch.fft.irfft2(torch.fft.rfft2(padded) * otf / (otf**2 + 1e-2), s=(height, width))
    return sharp[margin:-margin, margin:-margin]
