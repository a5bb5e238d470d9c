r"""Deconvolution with a known kernel: the picture x behind y = h * x + noise.

**Wiener.** The best linear estimate for noise of variance N and pictures of spectrum S(f) = P / f^2, f in cycles a pixel:

.. math:: \hat x = \frac{\hat h^*\, \hat y}{|\hat h|^2 + \frac{N}{P} f^2}

**Richardson-Lucy.** x <- x . h^T * (y / (h * x)): the likeliest picture under photon noise, stopped early, as it goes on to
fit the noise; scikit-image's. Richardson, JOSA 62, 55 (1972); Lucy, AJ 79, 745 (1974).

**Total variation.** Edges, few and sharp, with all channels turning together:

.. math::
    \min_x \frac{1}{2 \sigma^2} \|M (h * x) - y\|^2 + \lambda \sum_p \Big(\sum_c |\nabla x_c|^2_p\Big)^{1/2}, \qquad
    \lambda = \frac{\kappa}{\text{mean} |\nabla y|}

With the noise's sigma known there is nothing to tune: a picture half as bright and half as noisy comes back half as bright.

**Plug and play.** The same with any denoiser where total variation has its shrinkage: the denoiser is the prior.
Venkatakrishnan, Bouman & Wohlberg, GlobalSIP (2013).

Both are solved by ADMM with the splits g = grad x (or v = x) and z = h * x. M keeps the pixels that were seen: x goes on
beyond the picture by half a kernel, where it is free, so no rule about borders is needed (Almeida & Figueiredo,
IEEE TIP 22, 3074, 2013). Kernels are odd, their middle is the zero shift, and they sum to one.
"""

from collections.abc import Callable

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2

from turbnet.classical.local import Array
from turbnet.errors import InputError, ParameterError, check_range

Denoiser = Callable[[Array, float], Array]
"""(picture (H, W, C), standard deviation of its noise) -> picture."""

_FIDELITY = np.float32(0.3)  # penalty of the split z = h * x, in units of the data term's own: fastest at the border

EDGES = 1.0
"""kappa: at this price of an edge the mean step between neighbouring pixels stays about as it was before the blur went."""


def transfer_function(kernel_kk: Array, shape: tuple[int, int]) -> np.ndarray:
    """FFT of the kernel with its middle at the origin, as `rfft2` of pictures of this shape has it."""
    rows, columns = kernel_kk.shape
    padded = np.zeros(shape, np.float32)
    padded[:rows, :columns] = kernel_kk
    return rfft2(np.roll(padded, (-(rows // 2), -(columns // 2)), (0, 1)))


def wiener(picture_HWC: Array, kernel_kk: Array, noise_to_signal: float = 1e-2) -> Array:
    """Wiener deconvolution, (H, W, C).

    Args:
        noise_to_signal: N / P, the noise's variance over the picture's power a f^-2, positive.
    """
    check_range("noise_to_signal", noise_to_signal, 1e-12, 1e12)
    picture, kernel = _checked(picture_HWC, kernel_kk)
    padded = _periodic(picture, kernel.shape)
    height, width = padded.shape[:2]
    h = transfer_function(kernel, (height, width))
    f2 = np.fft.fftfreq(height)[:, None] ** 2 + np.fft.rfftfreq(width) ** 2
    gain = (np.conj(h) / (np.abs(h) ** 2 + noise_to_signal * f2))[..., None]
    restored = irfft2(gain * rfft2(padded, axes=(0, 1)), s=(height, width), axes=(0, 1))
    return restored[: picture.shape[0], : picture.shape[1]].astype(np.float32)


def richardson_lucy(picture_HWC: Array, kernel_kk: Array, iterations: int = 30) -> Array:
    """Richardson-Lucy, (H, W, C), never negative.

    Args:
        iterations: 1 to 10000; more is sharper and noisier.
    """
    from skimage.restoration import richardson_lucy as lucy

    check_range("iterations", iterations, 1, 10_000)
    picture, kernel = _checked(picture_HWC, kernel_kk)
    margin = 2 * max(kernel.shape)
    padded = np.pad(picture, [(margin, margin), (margin, margin), (0, 0)], mode="symmetric").clip(min=1e-6)
    planes = [lucy(plane, kernel, int(iterations), clip=False) for plane in np.moveaxis(padded, -1, 0)]
    return np.stack(planes, axis=-1)[margin:-margin, margin:-margin].astype(np.float32)


def total_variation(
    picture_HWC: Array, kernel_kk: Array, noise: float, edges: float = EDGES, iterations: int = 12
) -> Array:
    """Total-variation deconvolution by ADMM, (H, W, C).

    Args:
        noise: sigma, standard deviation of the picture's noise, positive.
        edges: kappa; less lets more texture and more noise through.
        iterations: ADMM steps.
    """
    _check_positive(noise=noise, edges=edges, iterations=iterations)
    problem = _Problem(*_checked(picture_HWC, kernel_kk))
    step = mean_step(problem.picture)
    weight = noise**2 * edges / step  # the problem is solved times sigma^2
    penalty = np.float32(weight / step)
    differences = problem.finite_differences()
    response = penalty * sum(np.abs(d) ** 2 for d in differences)
    x_hat = rfft2(problem.start, axes=(0, 1))
    z, v = problem.start, np.zeros_like(problem.start)
    u = np.float32(0)
    for _ in range(iterations):
        slopes = np.stack([problem.back(d * x_hat) for d in differences]) + u
        length = np.sqrt((slopes**2).sum(axis=(0, -1), keepdims=True))
        shrunk = slopes * np.maximum(1 - np.float32(step) / np.maximum(length, 1e-12), 0)
        u = slopes - shrunk
        blurred = problem.back(problem.h * x_hat) + v
        z = problem.seen(blurred)
        v = blurred - z
        pull = sum(np.conj(d) * rfft2(s, axes=(0, 1)) for d, s in zip(differences, shrunk - u, strict=True))
        right = _FIDELITY * np.conj(problem.h) * rfft2(z - v, axes=(0, 1)) + penalty * pull
        x_hat = right / (_FIDELITY * problem.power + response + 1e-12)
    return problem.cut(problem.back(x_hat))


def plug_and_play(
    picture_HWC: Array, kernel_kk: Array, denoise: Denoiser, noise: float, strength: float = 1.0, iterations: int = 15
) -> Array:
    """Plug-and-play ADMM, (H, W, C).

    Args:
        denoise: for instance `non_local_means` or `chambolle`.
        noise: standard deviation of the picture's noise, positive.
        strength: the denoiser is asked to remove noise of standard deviation strength x 0.02 at first, ending at
            strength x `noise`, falling geometrically.
        iterations: ADMM steps, one call of the denoiser each.
    """
    _check_positive(noise=noise, strength=strength, iterations=iterations)
    problem = _Problem(*_checked(picture_HWC, kernel_kk))
    sigmas = strength * np.geomspace(max(0.02, noise), noise, iterations)
    x = problem.start
    u = np.zeros_like(x)
    z, v = x, np.zeros_like(x)
    for sigma in sigmas:
        smooth = denoise(x + u, float(sigma)).astype(np.float32)
        u = u + x - smooth
        blurred = problem.back(problem.h * rfft2(x, axes=(0, 1)))
        z = problem.seen(blurred + v)
        v = v + blurred - z
        penalty = np.float32(noise**2 / sigma**2)
        right = _FIDELITY * np.conj(problem.h) * rfft2(z - v, axes=(0, 1)) + penalty * rfft2(smooth - u, axes=(0, 1))
        x = problem.back(right / (_FIDELITY * problem.power + penalty))
    return problem.cut(x)


def chambolle(picture_HWC: Array, noise: float) -> Array:
    """Total-variation denoising by Chambolle's projections, scikit-image's."""
    from skimage.restoration import denoise_tv_chambolle

    return denoise_tv_chambolle(picture_HWC, weight=noise, channel_axis=-1)


def non_local_means(picture_HWC: Array, noise: float) -> Array:
    """Non-local means, scikit-image's fast version."""
    from skimage.restoration import denoise_nl_means

    return denoise_nl_means(
        picture_HWC, patch_size=5, patch_distance=5, h=0.8 * noise, sigma=noise, fast_mode=True, channel_axis=-1
    )


class _Problem:
    """y seen through M and h, on a domain that is larger by half a kernel on every side and wraps around."""

    def __init__(self, picture_HWC: Array, kernel_kk: Array) -> None:
        self.picture = picture_HWC
        sides = zip(picture_HWC.shape[:2], kernel_kk.shape, strict=True)
        self.shape = tuple(next_fast_len(side + k, real=True) for side, k in sides)
        self.start = _periodic(picture_HWC, kernel_kk.shape)
        self.h = transfer_function(kernel_kk, self.shape)[..., None]
        self.power = np.abs(self.h) ** 2

    def back(self, spectrum: np.ndarray) -> Array:
        return irfft2(spectrum, s=self.shape, axes=(0, 1))

    def seen(self, blurred: Array) -> Array:
        """Nearest z to `blurred` and, where there are data, to them."""
        z = blurred.copy()
        height, width = self.picture.shape[:2]
        z[:height, :width] = (self.picture + _FIDELITY * blurred[:height, :width]) / (1 + _FIDELITY)
        return z

    def finite_differences(self) -> list[np.ndarray]:
        """Transfer functions of x(p + 1) - x(p) down and across."""
        rows, columns = self.shape
        down = np.exp(2j * np.pi * np.fft.fftfreq(rows))[:, None] - 1
        across = np.exp(2j * np.pi * np.fft.rfftfreq(columns))[None] - 1
        shape = (rows, columns // 2 + 1)
        return [np.broadcast_to(d, shape).astype(np.complex64)[..., None] for d in (down, across)]

    def cut(self, padded: Array) -> Array:
        height, width = self.picture.shape[:2]
        return np.ascontiguousarray(padded[:height, :width], np.float32)


def _periodic(picture_HWC: Array, kernel: tuple[int, ...]) -> Array:
    """The picture continued below and to the right so that it wraps around smoothly, by at least a kernel."""
    for axis in (0, 1):
        side = picture_HWC.shape[axis]
        extra = next_fast_len(side + kernel[axis], real=True) - side
        index = np.arange(extra)
        mirror = np.pad(np.arange(side), (extra, extra), mode="symmetric")
        ramp = np.sin(np.pi / 2 * (index + 0.5) / extra) ** 2
        ramp = ramp.reshape([-1 if k == axis else 1 for k in range(3)]).astype(np.float32)
        after, before = mirror[extra + side :], mirror[:extra]
        fill = (1 - ramp) * picture_HWC.take(after, axis) + ramp * picture_HWC.take(before, axis)
        picture_HWC = np.concatenate((picture_HWC, fill), axis)
    return picture_HWC


def mean_step(picture_HWC: Array) -> float:
    """mean |grad y| over the picture, all channels together; never quite 0."""
    down, across = np.diff(picture_HWC, axis=0)[:, :-1], np.diff(picture_HWC, axis=1)[:-1]
    return float(np.sqrt((down**2 + across**2).sum(axis=-1)).mean()) + 1e-6 if down.size and across.size else 1e-6


def _checked(picture_HWC: Array, kernel_kk: Array) -> tuple[Array, Array]:
    if picture_HWC.ndim != 3 or 0 in picture_HWC.shape:
        raise InputError(f"a picture is (height, width, channels), none of them 0; this one is {picture_HWC.shape}")
    if kernel_kk.ndim != 2 or not all(side % 2 for side in kernel_kk.shape):
        raise InputError(f"a kernel has two odd sides; this one is {kernel_kk.shape}")
    if not (np.isfinite(picture_HWC).all() and np.isfinite(kernel_kk).all()):
        raise InputError("the picture or the kernel holds NaN or infinite values")
    if abs(float(kernel_kk.sum()) - 1) > 1e-2:
        raise InputError(f"a kernel sums to one; this one sums to {float(kernel_kk.sum()):g}")
    return np.asarray(picture_HWC, np.float32), np.asarray(kernel_kk, np.float32)


def _check_positive(**values: float) -> None:
    for name, value in values.items():
        if not value > 0:
            raise ParameterError(f"{name} = {value:g} must be positive")
