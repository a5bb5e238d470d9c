r"""Blind deconvolution: picture and kernel by turns, the kernel a tilt-free PSF.

The kernel is sought among

.. math:: h = \phi_0 + \sum_m \beta_m \phi_m

phi_0 the mean tilt-free PSF of Kolmogorov turbulence around a given D/r0 and phi_m its principal components
(`turbnet.simulate.psf_basis.psf_basis`): twenty numbers instead of a thousand, and never a kernel that no air can make.
By turns

.. math::
    x \leftarrow \text{total-variation deconvolution of } y \text{ with } h, \qquad
    \beta \leftarrow \arg\min_\beta \frac{1}{2 s^2} \|\nabla (y - h * x)\|^2 + \sum_m \frac{|\beta_m|}{b_m}

s^2 is the residual's own variance, times the pixels of a kernel, as its errors hang together over about as many; b_m is
the mean |beta_m| of drawn PSFs: the prior is the Laplace distribution that fits each component, so rare shapes cost more.
Derivatives whiten pictures. The quadratic is small, (M, M), and is
solved with its L1 term by coordinate descent. After Mao, Chimitt & Chan, IEEE TCI 6, 1415 (2020).

**Strength.** phi_0 already decides most. Where a clip is at hand its dance tells D/r0: the tilt a_2 has the variance
0.448 (D/r0)^(5/3) rad^2 and moves the picture by 4/pi Nyquist pixels a radian, so the displacement along an axis has

.. math:: \sigma^2 = (4/\pi)^2\, 0.448\, (D/r_0)^{5/3} \quad \text{pixels}^2

The camera is taken to sample at its Nyquist rate, a pixel lambda / (2 D).
"""

from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft2, rfft2

from turbnet.atmosphere.noll import noll_covariance, noll_matrix
from turbnet.classical.deconvolution import total_variation, transfer_function
from turbnet.classical.local import Array, luminance
from turbnet.errors import InputError, check_range
from turbnet.simulate.draw import TILT_PIXELS
from turbnet.simulate.psf_basis import psf_basis, tilt_free_psf

WEAKEST, STRONGEST = 0.5, 8.0
"""D/r0 between which PSFs are made; below, the air does not blur."""


@dataclass(frozen=True)
class KernelModel:
    """Kernels h = mean + sum beta_m components_m and the prior of their weights.

    Attributes:
        mean: (k, k), sums to one.
        components: (M, k, k).
        scale: b_m, (M,), mean |beta_m| of drawn PSFs.
    """

    mean: Array
    components: Array
    scale: Array

    @classmethod
    def around(cls, d_over_r0: float, components: int = 12, spread: float = 1.5, samples: int = 2000) -> "KernelModel":
        """Tilt-free PSFs with D/r0 log-uniform between d_over_r0 / spread and d_over_r0 * spread.

        Args:
            d_over_r0: 0.5 to 8.
            components: M, 0 to 100.
            samples: PSFs from which the prior is learned; seeded.
        """
        import torch

        check_range("D/r0", d_over_r0, WEAKEST, STRONGEST)
        check_range("components", components, 0, 100)
        weakest, strongest = d_over_r0 / spread, d_over_r0 * spread
        basis = psf_basis(int(components), weakest, strongest)
        generator = torch.Generator().manual_seed(1)
        factor = np.linalg.cholesky(noll_matrix(range(4, 37))).astype(np.float32)
        strengths = weakest * (strongest / weakest) ** torch.rand(samples, 1, generator=generator)
        high = torch.randn(samples, len(factor), generator=generator) @ torch.from_numpy(factor).T
        weights = basis.weights(tilt_free_psf(high * strengths ** (5 / 6)))
        return cls(basis.mean.numpy(), basis.components.numpy(), weights.abs().mean(0).numpy())

    def kernel(self, weights_M: Array) -> Array:
        """h, (k, k), what is negative cut off, sum one."""
        kernel = np.maximum(self.mean + np.tensordot(weights_M, self.components, 1), 0)
        return (kernel / kernel.sum()).astype(np.float32)


def strength_of_dance(shifts_T2HW: Array) -> float:
    """D/r0 from how far registered frames were moved: from the median over the picture of their variance.

    The median, as registration goes astray where there is nothing to see.

    Args:
        shifts_T2HW: displacements, pixels, T >= 2, about a reference that belongs to no single frame.

    Raises:
        InputError: a single frame does not dance.
    """
    if len(shifts_T2HW) < 2:
        raise InputError("the strength of turbulence shows in two frames or more; this clip has one")
    variance = float(np.median(shifts_T2HW.var(axis=0, ddof=1).mean(axis=0)))
    return (variance / (TILT_PIXELS**2 * noll_covariance(2, 2))) ** (3 / 5)


def kernel_weights(blurred_HW: Array, sharp_HW: Array, model: KernelModel) -> Array:
    """beta (M,): the most probable kernel between a sharp picture and its blurred one."""
    half = model.mean.shape[0] // 2
    shape = blurred_HW.shape
    if min(shape) <= 4 * half or not len(model.components):
        return np.zeros(len(model.components), np.float32)
    spectrum = rfft2(sharp_HW)
    kernels = np.concatenate((model.mean[None], model.components))
    inside = np.s_[half:-half, half:-half]

    def slopes(picture_HW: Array) -> Array:
        picture = picture_HW[inside]
        return np.concatenate((np.diff(picture, axis=0).ravel(), np.diff(picture, axis=1).ravel()))

    seen = np.stack([slopes(irfft2(transfer_function(k, shape) * spectrum, s=shape)) for k in kernels])
    error = slopes(blurred_HW) - seen[0]
    columns = seen[1:].astype(np.float64)
    return _lasso(
        columns @ columns.T, columns @ error, model.mean.size * float(np.mean(error**2)) / model.scale
    ).astype(np.float32)


def _lasso(gram: np.ndarray, target: np.ndarray, price: np.ndarray, sweeps: int = 200) -> np.ndarray:
    """argmin b^T gram b / 2 - target^T b + price^T |b| by coordinate descent."""
    b = np.zeros(len(target))
    for _ in range(sweeps):
        for m in range(len(b)):
            pull = target[m] - gram[m] @ b + gram[m, m] * b[m]
            b[m] = np.sign(pull) * max(abs(pull) - price[m], 0) / max(gram[m, m], 1e-30)
    return b


def blind_kernel(blurred_HW: Array, noise: float, d_over_r0: float, components: int = 12, rounds: int = 3) -> Array:
    """The kernel of a blurred picture, (k, k), found in the picture itself.

    Args:
        blurred_HW: still.
        noise: standard deviation of its noise, positive.
        d_over_r0: where the search begins; `strength_of_dance` reads it from a clip. 0.5 to 8.
        components: M.
        rounds: estimates, each after a deconvolution; 0 returns the mean PSF.
    """
    model = KernelModel.around(d_over_r0, components)
    kernel = model.kernel(np.zeros(len(model.components), np.float32))
    for _ in range(rounds):
        sharp = total_variation(blurred_HW[..., None], kernel, noise)[..., 0]
        kernel = model.kernel(kernel_weights(blurred_HW, sharp, model))
    return kernel


def blind_deconvolution(picture_HWC: Array, noise: float, d_over_r0: float) -> tuple[Array, Array]:
    """The deconvolved picture (H, W, C) and the kernel (k, k) found in its luminance; see `blind_kernel`."""
    kernel = blind_kernel(luminance(picture_HWC), noise, d_over_r0)
    return total_variation(picture_HWC, kernel, noise), kernel
