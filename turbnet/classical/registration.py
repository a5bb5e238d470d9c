r"""Registration: where each pixel of a frame went, seen from a reference.

Both methods return a shift d (2, H, W), pixels, x then y, such that I(x + d(x)) resembles R(x); sampling there undoes the
dance (`turbnet.simulate.tilt.sample`).

**Optical flow.** Iterative Lucas-Kanade over scales, scikit-image's `optical_flow_ilk`: in a window around each pixel the
shift solves min sum (I(x + d) - R(x))^2, the frame warped again at every step. Le Besnerais & Champagnat, ICIP (2005).

**B-spline control points.** The shift is a cubic B-spline over a coarse lattice of spacing s,

.. math:: d(x) = \sum_k c_k\, \beta^3(x/s - k), \qquad \min_c \sum_x (I(x + d(x)) - R(x))^2 + \mu \sum_k |c_k|^2

solved by Gauss-Newton: smooth by construction, few unknowns, no window. Rueckert et al., IEEE TMI 18, 712 (1999).
"""

from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F

from turbnet.classical.local import Array, check_clip, luminance
from turbnet.errors import InputError, check_range
from turbnet.simulate.parallel import on_all_cores
from turbnet.simulate.tilt import sample

Flow = Callable[[Array, Array], Array]
"""(moving (H, W), reference (H, W)) -> shift (2, H, W)."""


def optical_flow(moving_HW: Array, reference_HW: Array, radius: int = 7, warps: int = 5) -> Array:
    """Shift by multiscale iterative Lucas-Kanade, (2, H, W).

    Args:
        radius: half the window, pixels; the field is smooth over about as much.
        warps: Lucas-Kanade steps a scale.
    """
    from skimage.registration import optical_flow_ilk

    _check_pair(moving_HW, reference_HW)
    if min(moving_HW.shape) < 2 * radius + 1:  # too small for a window
        return np.zeros((2, *moving_HW.shape), np.float32)
    rows, columns = optical_flow_ilk(reference_HW, moving_HW, radius=radius, num_warp=warps, gaussian=True)
    return np.stack((columns, rows)).astype(np.float32)


def control_point_flow(
    moving_HW: Array, reference_HW: Array, spacing: int = 16, prior: float = 1e-3, iterations: int = 8
) -> Array:
    """Shift as a cubic B-spline with control points every `spacing` pixels, (2, H, W).

    Args:
        spacing: s, pixels, 4 to 256.
        prior: mu as a share of what a typical control point sees; keeps points over flat regions still.
        iterations: Gauss-Newton steps at each of two degrees of smoothing.
    """
    from scipy.ndimage import gaussian_filter

    check_range("spacing", spacing, 4, 256, "pixels")
    _check_pair(moving_HW, reference_HW)
    shift_2HW = np.zeros((2, *moving_HW.shape), np.float32)
    if min(moving_HW.shape) < 2:
        return shift_2HW
    rows, columns = (_spline_basis(side, spacing) for side in moving_HW.shape)
    lattice = rows.shape[1], columns.shape[1]
    points = np.zeros((2, *lattice))
    for blur in (2.0, 0.7):  # coarse first: the linear step reaches no farther than the picture is smooth
        moving, reference = (gaussian_filter(picture, blur) for picture in (moving_HW, reference_HW))
        for _ in range(iterations):
            warped = warp(moving[..., None], shift_2HW)[..., 0]
            slopes = [np.gradient((warped + reference) / 2, axis=axis) for axis in (1, 0)]
            gradient = np.stack([rows.T @ (slope * (warped - reference)) @ columns for slope in slopes])
            normal = np.block([[_normal(a * b, rows, columns) for b in slopes] for a in slopes])
            ridge = prior * np.trace(normal) / len(normal) + 1e-12
            normal[np.diag_indices_from(normal)] += ridge
            step = np.linalg.solve(normal, (gradient + ridge * points).ravel()).reshape(points.shape)
            points -= step
            shift_2HW = (rows @ points @ columns.T).astype(np.float32)
            if np.abs(step).max() < 1e-2:
                break
    return shift_2HW


def _spline_basis(side: int, spacing: int) -> np.ndarray:
    """Cubic B-splines along one axis, (pixels, control points)."""
    from scipy.interpolate import BSpline

    knots = spacing * np.arange(-3, -(-side // spacing) + 4)
    return BSpline.design_matrix(np.arange(side, dtype=float), knots, 3).toarray()


def _normal(weight_HW: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """sum_x w(x) B_k(x) B_l(x) over all pairs of control points (K, K), one axis after the other."""
    (_, a), (_, b) = rows.shape, columns.shape
    pairs = [np.einsum("pa,pb->pab", basis, basis).reshape(len(basis), -1) for basis in (rows, columns)]
    return (pairs[0].T @ weight_HW @ pairs[1]).reshape(a, a, b, b).transpose(0, 2, 1, 3).reshape(a * b, a * b)


def warp(picture_HWC: Array, shift_2HW: Array) -> Array:
    """picture(x + shift(x)), bicubic, (H, W, C)."""
    planes = torch.from_numpy(np.ascontiguousarray(np.moveaxis(picture_HWC, -1, 0)))[None]
    moved = sample(planes, torch.from_numpy(shift_2HW)[None])
    return np.moveaxis(moved[0].numpy(), 0, -1)


def register(
    frames_THWC: Array,
    references: Array,
    flow: Flow = optical_flow,
    reduction: int = 1,
    cores: int = 1,
) -> tuple[Array, Array]:
    """Every frame brought to a reference: registered frames (T, H, W, C) and shifts (T, 2, H, W).

    Args:
        references: one for all, (H, W, C), or one a frame, (T, H, W, C).
        flow: from luminances to a shift.
        reduction: the flow is sought in pictures smaller by this factor; dance is smooth, so 2 loses little at a quarter
            of the cost.
        cores: frames at a time.
    """
    clip = check_clip(frames_THWC)
    check_range("reduction", reduction, 1, 8)
    per_frame = references if references.ndim == 4 else np.broadcast_to(references, clip.shape)
    size = clip.shape[1:3]

    def one(index: int) -> tuple[Array, Array]:
        frame, reference = (_reduce(luminance(picture), reduction) for picture in (clip[index], per_frame[index]))
        shift_2HW = _enlarge(flow(frame, reference), *size)
        return warp(clip[index], shift_2HW), shift_2HW

    registered, shifts = zip(*on_all_cores(one, range(len(clip)), cores), strict=True)
    return np.stack(registered), np.stack(shifts)


def _reduce(picture_HW: Array, factor: int) -> Array:
    if factor == 1:
        return picture_HW
    size = [max(-(-side // factor), 1) for side in picture_HW.shape]
    return F.interpolate(torch.from_numpy(picture_HW.copy())[None, None], size, mode="area")[0, 0].numpy()


def _enlarge(shift_2hw: Array, height: int, width: int) -> Array:
    h, w = shift_2hw.shape[1:]
    if (h, w) == (height, width):
        return shift_2hw
    fine = F.interpolate(torch.from_numpy(shift_2hw)[None], (height, width), mode="bicubic", align_corners=False)[0]
    return fine.numpy() * np.array([width / w, height / h], np.float32)[:, None, None]


def _check_pair(moving_HW: Array, reference_HW: Array) -> None:
    if moving_HW.ndim != 2 or moving_HW.shape != reference_HW.shape:
        raise InputError(f"a frame {moving_HW.shape} and its reference {reference_HW.shape} must be of one size (H, W)")
