"""Every classical method as a way to restore a clip, by name: what `turbnet restore --method` offers.

A method takes linear frames (T, H, W, C), the number of cores and a function that is told the share of the work just
done, and returns as many frames. One that makes a single still picture returns it for every frame. The deconvolutions
work on the mean of registered frames, with the mean tilt-free PSF of the strength that the dance tells.
"""

from collections.abc import Callable

import numpy as np

from turbnet.classical import deconvolution
from turbnet.classical.blind import STRONGEST, WEAKEST, KernelModel, strength_of_dance
from turbnet.classical.fusion import fourier_burst, hard_weights, patch_fusion
from turbnet.classical.local import Array, luminance
from turbnet.classical.pipeline import REDUCTION, restore
from turbnet.classical.reference import low_rank_plus_sparse, non_local_means, still_variance, temporal_mean
from turbnet.classical.registration import Flow, control_point_flow, optical_flow, register
from turbnet.classical.sharpness import variance
from turbnet.errors import InputError

Report = Callable[[float], object]
Method = Callable[[Array, int, Report], Array]


def _still(picture_HWC: Array, frames_THWC: Array) -> Array:
    return np.broadcast_to(picture_HWC, frames_THWC.shape)


def _registered_by(flow: Flow, reduction: int) -> Method:
    def method(frames_THWC: Array, cores: int, report: Report) -> Array:
        registered, _ = register(frames_THWC, temporal_mean(frames_THWC), flow, reduction, cores)
        report(1.0)
        return registered

    return method


def _fused_by(fuse: Callable[[Array], Array]) -> Method:
    def method(frames_THWC: Array, cores: int, report: Report) -> Array:
        registered, _ = register(frames_THWC, temporal_mean(frames_THWC), reduction=REDUCTION, cores=cores)
        report(0.8)
        fused = fuse(registered)
        report(0.2)
        return _still(fused, frames_THWC)

    return method


def _lucky(registered_THWC: Array) -> Array:
    return patch_fusion(registered_THWC, hard_weights(variance(luminance(registered_THWC))))


def _deconvolved_by(deconvolve: Callable[[Array, Array, float], Array]) -> Method:
    """`deconvolve` takes a picture, a kernel and the standard deviation of the noise."""

    def method(frames_THWC: Array, cores: int, report: Report) -> Array:
        registered, shifts = register(frames_THWC, temporal_mean(frames_THWC), reduction=REDUCTION, cores=cores)
        report(0.8)
        picture = registered.mean(axis=0)
        strength = strength_of_dance(shifts)
        if strength >= WEAKEST:
            noise = float(np.sqrt(still_variance(luminance(registered)).mean() / len(registered)))
            kernel = KernelModel.around(min(strength, STRONGEST), components=0).mean
            picture = deconvolve(picture, kernel, noise)
        report(0.2)
        return _still(picture, frames_THWC)

    return method


def _wiener(picture_HWC: Array, kernel_kk: Array, noise: float) -> Array:
    # The mean squared step of a picture of spectrum P / f^2 is about (2 pi)^2 P, as it is blurred a good deal less.
    return deconvolution.wiener(picture_HWC, kernel_kk, (2 * np.pi * noise / deconvolution.mean_step(picture_HWC)) ** 2)


def _richardson_lucy(picture_HWC: Array, kernel_kk: Array, noise: float) -> Array:
    return deconvolution.richardson_lucy(picture_HWC, kernel_kk)


def _plug_and_play(picture_HWC: Array, kernel_kk: Array, noise: float) -> Array:
    return deconvolution.plug_and_play(picture_HWC, kernel_kk, deconvolution.non_local_means, noise, strength=2.0)


def _mean(frames_THWC: Array, cores: int, report: Report) -> Array:
    mean = temporal_mean(frames_THWC)
    report(1.0)
    return _still(mean, frames_THWC)


def _low_rank(frames_THWC: Array, cores: int, report: Report) -> Array:
    low, _ = low_rank_plus_sparse(frames_THWC)
    report(1.0)
    return low


def _non_local(frames_THWC: Array, cores: int, report: Report) -> Array:
    means = []
    for mean_HWC in non_local_means(frames_THWC, cores=cores):
        means.append(mean_HWC)
        report(1 / len(frames_THWC))
    return np.stack(means)


def _pipeline(frames_THWC: Array, cores: int, report: Report) -> Array:
    return restore(frames_THWC, cores, report).frames


METHODS: dict[str, Method] = {
    "pipeline": _pipeline,
    "mean": _mean,
    "low-rank": _low_rank,
    "non-local": _non_local,
    "optical-flow": _registered_by(optical_flow, REDUCTION),
    "b-spline": _registered_by(control_point_flow, 1),
    "lucky": _fused_by(_lucky),
    "fourier-burst": _fused_by(fourier_burst),
    "wiener": _deconvolved_by(_wiener),
    "richardson-lucy": _deconvolved_by(_richardson_lucy),
    "total-variation": _deconvolved_by(deconvolution.total_variation),
    "plug-and-play": _deconvolved_by(_plug_and_play),
}
"""By name; `pipeline` is the default one."""


def find_method(name: str) -> Method:
    """The method of this name.

    Raises:
        InputError: there is none; lists those there are.
    """
    if name not in METHODS:
        raise InputError(f"there is no method {name}; the methods are {', '.join(METHODS)}")
    return METHODS[name]
