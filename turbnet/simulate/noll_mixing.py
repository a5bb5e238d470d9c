r"""The book's sampler: an independent field for each mode, then mixed point by point. For comparison only.

.. math::
    a(u) = (D/r_0)^{5/6}\, L\, z(u), \qquad L L^T = N, \qquad
    E[z_j(u) z_k(u')] = \delta_{jk}\, \frac{E[a_j(u) a_j(u')]}{E[a_j^2]}

with N the Noll matrix at D/r0 = 1 and L its Cholesky factor, so that one point has exactly Noll's covariance; z L in
place of L z would give L^T L. Two points have sum_k L_ik L_jk rho_k: pairs such as (2, 4), unrelated in one point, stay
so at any distance, where the exact field ties them (`turbnet.simulate.field`).

Each rho is sampled at the shortest lag around a periodic grid of at least twice the picture, where it is no exact
covariance: some Fourier bins come out negative. They are set to zero, what that took is in `clipped`, and the rest is
scaled to the exact variance. Source: N. Chimitt and S. H. Chan, Opt. Eng. 59, 083101 (2020); S. H. Chan and N. Chimitt
(2023).
"""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.fft import next_fast_len
from scipy.interpolate import make_interp_spline
from torch import Tensor, nn

from turbnet.atmosphere.covariance import zernike_covariance
from turbnet.atmosphere.noll import noll_matrix
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Array
from turbnet.errors import ParameterError, check_range
from turbnet.optics.zernike import noll_to_nm
from turbnet.simulate.draw import Draw
from turbnet.simulate.white import white_noise

_RADII = 200  # at which a mode's covariance is integrated; a spline in asinh(r) holds the rest


class NollMixing(nn.Module):
    """Draws Zernike coefficients with the right covariance in every point and the wrong one between points.

    Args:
        path: the turbulent path; a pixel is its Nyquist pixel lambda L / (2 D) in the scene.
        height, width: size of the picture, pixels.
        margin: pixels to cover beyond each edge of the picture.
        modes: highest Noll index J; coefficients 2..J are drawn.
        stride: grid step in pixels.
        padding: width of the periodic grid in widths of the picture.

    Attributes:
        clipped: negative part of each mode's spectrum over its positive part, (J-1,).

    Raises:
        ParameterError: a size, stride or mode out of range, or a path of still air, which has no correlation.
    """

    clipped: Tensor
    _amplitude: Tensor
    _mix: Tensor

    def __init__(
        self,
        path: OpticalPath,
        height: int,
        width: int,
        margin: int = 0,
        modes: int = 36,
        stride: int = 4,
        padding: float = 2.0,
    ) -> None:
        super().__init__()
        check_range("height", height, 1, 2**15, "pixels")
        check_range("width", width, 1, 2**15, "pixels")
        check_range("modes", modes, 3, 231)
        check_range("stride", stride, 1, 64, "pixels")
        check_range("padding", padding, 2.0, 16.0, "widths of the picture")
        if path.d_over_r0 == 0:
            raise ParameterError("a path of still air has no correlation to draw from; give it a Cn2 above 0")
        self.path, self.stride, self.margin = path, stride, margin
        self.rows, self.columns = (1 + -(-(n + 2 * margin) // stride) for n in (height, width))
        self.noll = range(2, modes + 1)
        size = next_fast_len(max(int(np.ceil(padding * max(self.rows, self.columns))), 16), real=True)

        lag = stride * path.pixel * np.fft.fftfreq(size, 1 / size)
        correlations = _correlations(path, self.noll, *np.meshgrid(lag, lag))
        spectrum = np.fft.fft2(correlations).real
        held = np.maximum(spectrum, 0)
        clipped = (held - spectrum).sum((1, 2)) / held.sum((1, 2))
        # The mean over the bins is the variance.
        held /= held.mean((1, 2), keepdims=True)

        def keep(name: str, value: np.ndarray) -> None:
            self.register_buffer(name, torch.as_tensor(value).float(), persistent=False)

        keep("clipped", clipped)
        keep("_amplitude", np.sqrt(held[:, :, : size // 2 + 1]))
        keep("_mix", np.linalg.cholesky(noll_matrix(self.noll)))
        self._held = np.fft.ifft2(held).real

    def covariance(self, i: int, j: int, x: Array | float, y: Array | float = 0.0) -> Array:
        """E[a_i(u) a_j(u')] that this sampler holds, without drawing any, rad^2.

        Args:
            i, j: Noll indices, 2 .. modes.
            x, y: u - u', pixels, whole strides; arrays broadcast against each other.
        """
        rows, columns = (np.rint(np.asarray(v) / self.stride).astype(int) for v in np.broadcast_arrays(y, x))
        own = self._held[:, rows, columns]
        mix = self._mix.double().numpy()
        return self.path.d_over_r0 ** (5 / 3) * np.einsum("k,k...,k->...", mix[i - 2], own, mix[j - 2])

    def draw(self, seeds: Sequence[int], frames: int = 1, d_over_r0: Tensor | None = None, start: int = 0) -> Draw:
        """Draw one atmosphere per seed, every frame independently: mixed fields have no layers for a wind to move.

        Args:
            seeds: one per clip; the same seed gives the same atmosphere, alone or in any batch.
            frames: T, frames of a clip.
            d_over_r0: strength of each clip, (B,). None: as the path says.
            start: number of the first frame.

        Raises:
            ParameterError: no seeds, no frames, a strength outside 0 .. 100.
        """
        check_range("number of clips", len(seeds), 1, 2**20)
        check_range("frames", frames, 1, 2**20)
        strengths = self._mix.new_full((len(seeds),), self.path.d_over_r0) if d_over_r0 is None else d_over_r0
        for strength in strengths.tolist():
            check_range("D/r0", strength, 0.0, 100.0)
        clips = [torch.stack([self._frame(seed, frame) for frame in range(start, start + frames)]) for seed in seeds]
        gain = strengths.to(self._mix) ** (5 / 6)
        return Draw(torch.stack(clips) * gain[:, None, None, None, None], self.stride, self.margin)

    def _frame(self, seed: int, frame: int) -> Tensor:
        """Coefficients (modes, rows, columns) at D/r0 = 1."""
        size = self._amplitude.shape[1]
        noise = white_noise(seed, frame, len(self.noll), size, size).to(self._mix)
        fields = torch.fft.irfft2(torch.fft.rfft2(noise) * self._amplitude, s=(size, size))
        return torch.einsum("ij,jyx->iyx", self._mix, fields[:, : self.rows, : self.columns])


def _correlations(path: OpticalPath, modes: range, x: Array, y: Array) -> Array:
    """rho_j at the lags x, y (m), (modes, ...): A(r) + B(r) cos 2 m psi, cosine and sine modes differing in B's sign."""
    r, psi = np.hypot(x, y), np.arctan2(y, x)
    stretched = np.linspace(0.0, np.arcsinh(r.max() / path.aperture), _RADII)
    radii = path.aperture * np.sinh(stretched)
    position = np.arcsinh(r / path.aperture)
    parts: dict[tuple[int, int], tuple[Array, Array]] = {}
    result = []
    for j in modes:
        n, m = noll_to_nm(j)
        sign = -1.0 if j % 2 else 1.0
        if (n, m) not in parts:
            along = zernike_covariance(path, j, j, radii)
            turn = np.pi / (2 * m) if m else 0.0
            across = zernike_covariance(path, j, j, radii * np.cos(turn), radii * np.sin(turn))
            even, odd = (along + across) / 2, sign * (along - across) / 2
            parts[n, m] = tuple(make_interp_spline(stretched, part / along[0], k=5)(position) for part in (even, odd))
        even, odd = parts[n, m]
        result.append(even + sign * odd * np.cos(2 * m * psi))
    return np.stack(result)
