r"""The default pipeline: reference, registration, fusion, blind deconvolution; nothing to set for a clip.

1. **Reference.** Each frame gets its non-local mean: what is still is averaged, what moves stays.
2. **Registration.** Each frame is brought to its own reference by optical flow at half resolution. Both steps are done
   twice, the second time with references made of registered frames, which are sharper.
3. **Fusion.** For each frame the registered ones are averaged where they show the same, sharper ones counting a little
   more: (S + mean S)^4, S the local variance, which goes like S^2 near the mean but never outvotes a flat object that
   passes before a lively scene.
4. **Deconvolution.** The dance tells D/r0, that the mean PSF; one blind round on the middle frame refines the kernel, and
   every frame is deconvolved with it by total variation. The noise is what registered frames still differ by, over the
   root of how many are averaged.

A moving object gains from no other frame: it keeps its own noise and its own blur, which is deconvolved with the rest.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.signal import fftconvolve

from turbnet.classical.blind import STRONGEST, WEAKEST, blind_kernel, strength_of_dance
from turbnet.classical.deconvolution import total_variation
from turbnet.classical.edges import edge_width
from turbnet.classical.fusion import soft_weights
from turbnet.classical.local import Array, check_clip, luminance
from turbnet.classical.reference import non_local_means, still_variance
from turbnet.classical.registration import register
from turbnet.classical.sharpness import variance
from turbnet.errors import InputError
from turbnet.optics.psf import exponential_psf
from turbnet.simulate.parallel import on_all_cores

PASSES = 2
REDUCTION = 2
ROUNDS = 1
"""Of the blind search. The dance knows the kernel's width better than alternating minimisation does, which drifts."""


SHARP = 0.8
"""Width of the sharpest edges that nothing has blurred, pixels."""
EXPLAINED = 1.7
"""How much wider than the kernel edges may be before a lens, focus or sampling must have blurred them as well.

In the benchmark up to 1.4 times, 1.7 where frames hang together: such a clip dances less than it is blurred.
"""


@dataclass(frozen=True)
class Restored:
    """What the pipeline made: `frames` (T, H, W, C), the strength D/r0 that it saw, the `kernel` (k, k) it took out.

    Below D/r0 = 0.5 the air does not blur: nothing is deconvolved and the kernel is a point.
    """

    frames: Array
    d_over_r0: float
    kernel: Array


def restore(frames_THWC: Array, cores: int = 1, report: Callable[[float], object] = lambda share: None) -> Restored:
    """Restore a clip.

    Args:
        frames_THWC: linear intensities, T >= 2; 12 or more for turbulence to average out.
        cores: frames at a time.
        report: is told after each step which share of the work it was; the shares sum to one.

    Raises:
        InputError: fewer than two frames, or values that are not finite.
    """
    clip = check_clip(frames_THWC)
    if len(clip) < 2:
        raise InputError("turbulence is taken out by comparing frames; this clip has a single one")
    aligned = clip
    for _ in range(PASSES):
        references = np.stack(list(non_local_means(aligned, cores=cores)))
        report(0.1)
        aligned, shifts = register(clip, references, reduction=REDUCTION, cores=cores)
        report(0.2)

    y = luminance(aligned)
    sharpness = variance(y)
    weights = soft_weights(sharpness + sharpness.mean(axis=0), power=4.0)
    fused = np.stack(list(non_local_means(aligned, weights, cores=cores)))
    report(0.1)

    strength = strength_of_dance(shifts)
    if strength < WEAKEST:
        report(0.3)
        return Restored(fused, strength, np.ones((1, 1), np.float32))
    noise = float(np.sqrt(still_variance(y).mean() / len(y)))
    middle_HW = luminance(fused[len(fused) // 2])
    kernel = blind_kernel(middle_HW, noise, min(strength, STRONGEST), rounds=ROUNDS)
    kernel = _widened(kernel, edge_width(middle_HW))

    def sharpen(frame_HWC: Array) -> Array:
        return total_variation(frame_HWC, kernel, noise)

    sharp = np.stack(list(on_all_cores(sharpen, fused, cores)))
    report(0.3)
    return Restored(sharp, strength, kernel)


def _widened(kernel_kk: Array, width: float) -> Array:
    """The kernel with the blur that edges of this `width`, pixels, show beyond what it explains; no smaller than before.

    That blur falls off exponentially, exp(-r / a). Widths of unlike shapes do not add by their squares, so a is the one with
    which an edge, blurred by both, is as steep as what was seen.
    """
    explained, seen = _edge(kernel_kk), math.sqrt(max(0.0, width**2 - SHARP**2))
    if seen <= EXPLAINED * explained:
        return kernel_kk
    # Alone, exp(-r / a) has edges as steep as a Gaussian of s = a sqrt(pi / 2); its RMS width is sqrt(3) a.
    widest = seen * math.sqrt(6 / math.pi)
    kernel = np.pad(kernel_kk, max(0, math.ceil(4 * widest) - len(kernel_kk) // 2))

    def blurred(sigma: float) -> Array:
        wide = np.maximum(fftconvolve(kernel, exponential_psf(sigma, len(kernel)).numpy(), mode="same"), 0)
        return np.asarray(wide / wide.sum(), dtype=kernel_kk.dtype)

    return blurred(brentq(lambda sigma: _edge(blurred(sigma)) - seen, 0.1 * widest, 1.1 * widest, rtol=1e-3))


def _edge(kernel_kk: Array) -> float:
    """s of a Gaussian that makes edges as steep as the kernel does, pixels."""
    steepest = (kernel_kk.sum(0).max() + kernel_kk.sum(1).max()) / 2
    return 1 / (math.sqrt(2 * math.pi) * float(steepest))
