r"""Inverse filters: a first guess at undoing the mean blur, in closed form and then learned.

Wiener's filter for the short-exposure transfer function H of D/r0 = s,

.. math::
    w_s = \mathcal{F}^{-1}\left[\frac{H_s}{H_s^2 + \varepsilon}\right], \qquad
    H_s(f) = \exp\{-3.44\, (s f)^{5/3}\, (1 - f^{1/3})\}

f the frequency over the cutoff, of a camera that samples at Nyquist's rate (cutoff at half a cycle a pixel). Convolutions of
3 x 3 reach as far only in many layers.
"""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from turbnet.atmosphere.exposure import short_exposure_factor
from turbnet.errors import check_range

GRID = 64
"""Frequencies a side; no kernel is wider."""
_NOISE = 0.02  # epsilon


class InverseFilters(nn.Module):
    """A picture through one learned filter for each strength that they start from.

    Args:
        strengths: D/r0 of the Wiener filters.
        size: of the filters, pixels, odd.

    Raises:
        ParameterError: a value out of range.
    """

    def __init__(self, strengths: Sequence[float] = (1.5, 3.0, 4.5, 6.0), size: int = 15) -> None:
        super().__init__()
        check_range("size of a filter", size, 1, GRID - 1, "pixels")
        self.weight = nn.Parameter(torch.from_numpy(np.stack([wiener_kernel(s, size) for s in strengths]))[:, None])

    def forward(self, picture_BCHW: Tensor) -> Tensor:
        """(B, K, C, H, W)."""
        batch, channels, height, width = picture_BCHW.shape
        reach = self.weight.shape[-1] // 2
        flat = picture_BCHW.reshape(batch * channels, 1, height, width)
        flat = F.pad(flat, (reach, reach, reach, reach), mode="replicate")
        return F.conv2d(flat, self.weight).unflatten(0, (batch, channels)).transpose(1, 2)


def wiener_kernel(d_over_r0: float, size: int) -> np.ndarray:
    """w_s, (size, size) float32, its middle pixel the origin, sum one."""
    blur = short_exposure_transfer(d_over_r0)
    kernel = kernel_of(blur / (blur**2 + _NOISE), size)
    return (kernel / kernel.sum()).astype(np.float32)


def short_exposure_transfer(d_over_r0: float) -> np.ndarray:
    """H_s on a grid of frequencies in FFT order."""
    nu = np.fft.fftfreq(GRID)
    frequency = np.minimum(2 * np.hypot(nu[:, None], nu), 1.0)
    return short_exposure_factor(frequency, check_range("D/r0", d_over_r0, 0.0, 100.0))


def kernel_of(transfer: np.ndarray, size: int) -> np.ndarray:
    """The middle (size, size) of a transfer function's kernel."""
    kernel = np.fft.fftshift(np.fft.ifft2(transfer).real)
    first = GRID // 2 - size // 2
    return kernel[first : first + size, first : first + size]
