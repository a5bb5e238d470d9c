r"""Non-blind deconvolution inside a network: guesses at undoing the mean blur, for a few kernels.

Richardson's and Lucy's iteration (1972, 1974) with Nesterov's momentum, in linear light, where blur is a convolution:

.. math::
    x_{k+1} = y_k \cdot h_s * \frac{b}{h_s * y_k}, \qquad y_{k+1} = x_{k+1} + \frac{k}{k + 3} (x_{k+1} - x_k)

of the picture b from x_0 = y_0 = b. The kernel h is that of turbulence of strength s = D/r0, by its short-exposure transfer
function

.. math::
    H_s(f) = \exp\{-3.44\, (s f)^{5/3}\, (1 - f^{1/3})\}

(f the frequency over the cutoff, of a camera that samples at Nyquist's rate, cutoff at half a cycle a pixel; negative lobes
left out), that of a lens out of focus, a Gaussian, or that of blurs of many widths together, exp(-r / a). Light is not
negative, nor is the picture: that bound is what a linear filter does not know. Nothing is learned here: a network that sees
the guesses learns which to believe where.

What a kernel takes from beyond a few pixels is as smooth as the picture, so it is taken at half the resolution: a fifth of
the sums, and guesses from which a network restores as well.
"""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbnet.errors import ParameterError, check_range
from turbnet.media.colour import to_linear, to_srgb
from turbnet.nets.inverse import GRID, kernel_of, short_exposure_transfer
from turbnet.optics.psf import exponential_psf

_NEAR = 7  # pixels across what is convolved at full resolution
DARKEST = 1e-3
"""Linear intensity: nothing is divided by less."""


class RichardsonLucy(nn.Module):
    """A picture deconvolved once for each kernel.

    Args:
        kernels: (K, size, size), size odd, not negative, of sum one: `turbulence_kernel`, `defocus_kernel`, `tails_kernel`.
        steps: of the iteration.

    Raises:
        ParameterError: a value out of range.
    """

    near: Tensor
    far: Tensor

    def __init__(self, kernels: Sequence[np.ndarray], steps: int) -> None:
        super().__init__()
        self.steps = int(check_range("steps", steps, 1, 1000))
        self.count = len(kernels)
        scales = [_scales(kernel) for kernel in kernels]
        for index, name in enumerate(("near", "far")):
            parts = np.stack([scale[index] for scale in scales])[:, None]
            self.register_buffer(name, torch.from_numpy(parts).float(), persistent=False)

    def forward(self, linear_BCHW: Tensor) -> Tensor:
        """(B, K, C, H, W), linear intensities as the picture's, which are 0.001 at least; H and W even."""
        channels = linear_BCHW.shape[1]
        # All guesses of all colours side by side: processors convolve channels together.
        near, far = (part.repeat_interleave(channels, dim=0) for part in (self.near, self.far))
        found = self.iterate(linear_BCHW.repeat(1, self.count, 1, 1), near, far, self.steps)
        return found.unflatten(1, (self.count, channels))

    @staticmethod
    def iterate(seen_BCHW: Tensor, near_C1kk: Tensor, far_C1kk: Tensor, steps: int) -> Tensor:
        """The iteration itself, each channel with its kernel."""
        found = guess = seen_BCHW
        for step in range(steps):
            before = found
            again = _blurred(guess, near_C1kk, far_C1kk).clamp(min=DARKEST)
            found = guess * _blurred(seen_BCHW / again, near_C1kk, far_C1kk)
            guess = (found + step / (step + 3) * (found - before)).clamp(min=DARKEST)
        return found


class Deconvolution(nn.Module):
    """Guesses at the picture behind a blurred one.

    Args:
        strengths: D/r0 of turbulence.
        defocus: of lenses out of focus, RMS width of a Gaussian along either axis, pixels.
        tails: of blurs that fall off exponentially, RMS width along either axis, pixels.

    Raises:
        ParameterError: a value out of range, or no kernel at all.
    """

    def __init__(
        self,
        strengths: Sequence[float] = (2.0, 3.0, 4.5, 6.5),
        defocus: Sequence[float] = (2.5,),
        tails: Sequence[float] = (),
    ) -> None:
        super().__init__()
        self.count = len(strengths) + len(defocus) + len(tails)
        if not self.count:
            raise ParameterError("deconvolution needs a kernel: D/r0 of turbulence, defocus or tails")
        # Wide blurs leave less of the high frequencies, and they come back slowly.
        blurs = ((turbulence_kernel, strengths, 8), (defocus_kernel, defocus, 24), (tails_kernel, tails, 30))
        self.blurs = nn.ModuleList(RichardsonLucy([kernel(x) for x in xs], steps) for kernel, xs, steps in blurs if xs)

    @torch.no_grad()
    def forward(self, picture_BCHW: Tensor) -> Tensor:
        """(B, K, C, H, W), sRGB-encoded as the picture is; H and W even; no gradient passes.

        What of the picture lies outside [0, 1] is not deconvolved but stays.
        """
        with torch.autocast(picture_BCHW.device.type, enabled=False):
            picture = picture_BCHW.float()
            inside = picture.clamp(0, 1)
            linear = to_linear(inside).clamp(min=DARKEST)
            guesses = to_srgb(torch.cat([undo(linear) for undo in self.blurs], dim=1).clamp(0, 1))
            return (guesses + (picture - inside)[:, None]).to(picture_BCHW.dtype)


def turbulence_kernel(d_over_r0: float, size: int = 19) -> np.ndarray:
    """h_s of D/r0 = s, (size, size) float32, its middle pixel the origin, not negative, sum one.

    Raises:
        ParameterError: a value out of range.
    """
    kernel = kernel_of(short_exposure_transfer(d_over_r0), _checked(size)).clip(min=0)
    return (kernel / kernel.sum()).astype(np.float32)


def defocus_kernel(sigma: float, size: int = 19) -> np.ndarray:
    """A Gaussian of RMS width `sigma` pixels along either axis, (size, size) float32, sum one.

    Raises:
        ParameterError: a value out of range.
    """
    line = np.exp(-(((np.arange(_checked(size)) - size // 2) / check_range("sigma", sigma, 0.1, 100.0)) ** 2) / 2)
    kernel = np.outer(line, line)
    return (kernel / kernel.sum()).astype(np.float32)


def tails_kernel(sigma: float, size: int = 25) -> np.ndarray:
    """`turbnet.optics.psf.exponential_psf` of RMS width `sigma` pixels along either axis, (size, size) float32, sum one.

    Raises:
        ParameterError: a value out of range.
    """
    kernel: np.ndarray = exponential_psf(sigma, _checked(size)).float().numpy()
    return kernel


def _checked(size: int) -> int:
    return int(check_range("size of a kernel", size, _NEAR, GRID - 1, "pixels"))


def _scales(kernel_kk: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The middle of a kernel, and the rest of it on cells of 2 x 2 pixels between which is interpolated."""
    reach, cells = len(kernel_kk) // 2, (len(kernel_kk) + 1) // 4
    middle = slice(reach - _NEAR // 2, reach + _NEAR // 2 + 1)
    rest = kernel_kk.astype(np.float64)
    rest[middle, middle] = 0
    # A mean over 2 x 2 pixels here and one there: three shifts along either axis, the middle one twice.
    to_cells = np.zeros((2 * cells + 1, len(kernel_kk)))
    for cell in range(2 * cells + 1):
        for shift, part in ((-1, 0.5), (0, 1.0), (1, 0.5)):
            at = reach + 2 * (cell - cells) + shift
            if 0 <= at < len(kernel_kk):
                to_cells[cell, at] += part
    return kernel_kk[middle, middle], to_cells @ rest @ to_cells.T


def _blurred(pictures_BCHW: Tensor, near_C1kk: Tensor, far_C1kk: Tensor) -> Tensor:
    far = _convolved(F.avg_pool2d(pictures_BCHW, 2), far_C1kk)
    return _convolved(pictures_BCHW, near_C1kk) + F.interpolate(far, scale_factor=2.0, mode="bilinear")


def _convolved(pictures_BCHW: Tensor, kernels_C1kk: Tensor) -> Tensor:
    reach = kernels_C1kk.shape[-1] // 2
    padded = F.pad(pictures_BCHW, (reach, reach, reach, reach), mode="replicate")
    return F.conv2d(padded, kernels_C1kk, groups=len(kernels_C1kk))
