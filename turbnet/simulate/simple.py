r"""Two simple models of turbulence: move every scene point, then spread it as a Gaussian.

.. math::
    I = \mathrm{sensor}\left(\frac{B(T(J))}{B(T(1))}\right), \qquad
    B(T(J))(x) = \sum_u J(u)\, g_{\sigma(u)}(x - u - t(u)), \qquad
    g_\sigma(x) = \frac{1}{2\pi\sigma^2} e^{-|x|^2/2\sigma^2}

Both have the contract of `turbnet.simulate.simulator.Simulator`: a draw is a value (t and sigma of every scene point),
applying it a differentiable function; tilt comes first and blur second, both indexed by the source point; air without
turbulence leaves the scene as it is.

Widths are equivalent widths, see `turbnet.simulate.width`.
"""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.fft import next_fast_len
from torch import Tensor, nn

from turbnet.atmosphere.covariance import zernike_covariance
from turbnet.atmosphere.noll import noll_covariance
from turbnet.atmosphere.path import OpticalPath
from turbnet.errors import InputError, check_range
from turbnet.simulate.draw import TILT_PIXELS
from turbnet.simulate.field import ZernikeField
from turbnet.simulate.sensor import Sensor
from turbnet.simulate.tilt import tilt, upsample
from turbnet.simulate.white import white_noise
from turbnet.simulate.width import STRONGEST, short_exposure_sigma, width_statistics

_WIDTHS = 6  # Gaussians between which the widths of a field are interpolated
_TILT_REACH, _BLUR_REACH = 4.0, 3.0  # standard deviations from beyond the edge that reach into the picture


@dataclass(frozen=True)
class GaussianDraw:
    """One draw of a simple atmosphere.

    Attributes:
        tilt: displacement of each scene point on the coarse grid, (B, T, 2, h, w), x then y, pixels.
        sigma: standard deviation of each point's Gaussian, (B, T, 1, h, w), pixels; 0 for no blur.
        stride: step of that grid in pixels; its first point is the corner pixel (-margin, -margin) of the picture.
        margin: pixels by which the grid overlaps the picture on each side.
    """

    tilt: Tensor
    sigma: Tensor
    stride: int
    margin: int

    def centred(self) -> "GaussianDraw":
        """The same atmosphere seen by a camera that points at the clip's mean position: tilts sum to zero over a clip."""
        return replace(self, tilt=self.tilt - self.tilt.mean(dim=(1, 3, 4), keepdim=True))


@dataclass(frozen=True)
class GaussianTurbulent:
    """A simulated clip and the truth about it; all linear intensities, (B, T, C, H, W) unless said otherwise.

    Attributes:
        frames: what the camera sees.
        tilt_only: the scene moved but not blurred.
        tilt: where each scene point moved, (B, T, 2, H, W), pixels, x then y. Sampling `frames` at x + tilt(x) undoes it.
        draw: the atmosphere, to be applied again.
    """

    frames: Tensor
    tilt_only: Tensor
    tilt: Tensor
    draw: GaussianDraw
    _blur_only: Callable[[], Tensor]

    @cached_property
    def blur_only(self) -> Tensor:
        """The scene through the same blur without tilt, made when it is asked for."""
        return self._blur_only()


class _GaussianModel(nn.Module):
    """What both models share: how a draw is applied. They differ in how t and sigma are drawn."""

    def __init__(
        self,
        path: OpticalPath,
        height: int,
        width: int,
        stride: int,
        tilt_std: float,
        widest: float,
        sensor: Sensor | None,
    ) -> None:
        super().__init__()
        check_range("height", height, 1, 2**15, "pixels")
        check_range("width", width, 1, 2**15, "pixels")
        check_range("stride", stride, 1, 64, "pixels")
        self.path, self.height, self.width, self.stride = path, height, width, stride
        self.sensor = sensor or Sensor()
        reach = _TILT_REACH * tilt_std + _BLUR_REACH * widest
        self.margin = int(np.ceil(reach / stride)) * stride

    @abstractmethod
    def _split(self, sigma_F1hw: Tensor) -> tuple[Tensor, Tensor]:
        """g_sigma(u) = sum_k w_k(u) g_sigma_k: sigma_k (F or 1, K) and w, (F, K, H, W) or one for all pixels."""

    def forward(self, scene_BTCHW: Tensor, draw: GaussianDraw, noise_seed: int = 0) -> GaussianTurbulent:
        """Look at a scene through an atmosphere.

        Args:
            scene_BTCHW: linear intensities; T is the draw's number of frames, or 1 for a still scene. Differentiable.
            draw: the atmosphere, differentiable in its tilt and sigma.
            noise_seed: of the sensor.

        Raises:
            InputError: the scene is of another size than the model, or holds values that are not finite.
        """
        batch, frames = draw.tilt.shape[:2]
        if scene_BTCHW.ndim != 5 or scene_BTCHW.shape[-2:] != (self.height, self.width):
            raise InputError(
                f"the scene is {tuple(scene_BTCHW.shape)}; the model expects (B, T, C, {self.height}, {self.width})"
            )
        if not bool(torch.isfinite(scene_BTCHW).all()):
            raise InputError("the scene holds NaN or infinite values")
        scene = scene_BTCHW.expand(batch, frames, *scene_BTCHW.shape[2:]).flatten(0, 1)
        rows, columns = (np.pad(np.arange(n), self.margin, mode="reflect") for n in (self.height, self.width))
        padded = scene[..., rows, :][..., columns]
        padded = torch.cat((padded, torch.ones_like(padded[:, :1])), dim=1)  # a uniform scene comes along
        tilts, sigma = draw.tilt.flatten(0, 1), draw.sigma.flatten(0, 1)

        def crop(x: Tensor) -> Tensor:
            m = self.margin
            return x[..., m : m + self.height, m : m + self.width].unflatten(0, (batch, frames))

        def picture(x: Tensor) -> Tensor:
            x = crop(x)
            return x[:, :, :-1] / x[:, :, -1:].clamp(min=1e-3)

        return GaussianTurbulent(
            frames=self.sensor(picture(self._scatter(padded, tilts, sigma)), noise_seed),
            tilt_only=picture(tilt(padded, tilts, draw.stride)),
            tilt=crop(upsample(tilts, draw.stride, *padded.shape[-2:])),
            draw=draw,
            _blur_only=lambda: picture(self._scatter(padded, torch.zeros_like(tilts), sigma)),
        )

    def _scatter(self, image_FCHW: Tensor, tilt_F2hw: Tensor, sigma_F1hw: Tensor) -> Tensor:
        """B(T(image)): each Gaussian's share of the light is moved, then spread, so no width need be carried along."""
        if not bool(sigma_F1hw.detach().any()):
            return tilt(image_FCHW, tilt_F2hw, self.stride)
        *_, height, width = image_FCHW.shape
        nodes_FK, weights_FKHW = self._split(sigma_F1hw)
        shares = (weights_FKHW[:, :, None] * image_FCHW[:, None]).flatten(1, 2)
        moved = tilt(shares, tilt_F2hw, self.stride).unflatten(1, (nodes_FK.shape[1], -1))
        # What wraps around stays in the margin.
        size = [next_fast_len(n, real=True) for n in (height, width)]
        f_y = torch.fft.fftfreq(size[0], dtype=image_FCHW.dtype, device=image_FCHW.device)
        f_x = torch.fft.rfftfreq(size[1], dtype=image_FCHW.dtype, device=image_FCHW.device)
        decay = 2 * np.pi**2 * nodes_FK.square()[..., None]
        transfer = torch.exp(-decay * f_y.square())[..., None] * torch.exp(-decay * f_x.square())[..., None, :]
        spectrum = (torch.fft.rfft2(moved, s=size) * transfer[:, :, None]).sum(1)
        return torch.fft.irfft2(spectrum, s=size)[..., :height, :width]

    def _strengths(self, clips: int, d_over_r0: Tensor | None) -> list[float]:
        own = self.path.d_over_r0
        if d_over_r0 is None:
            return [own] * clips
        for strength in d_over_r0.tolist():
            check_range("D/r0", strength, 0.0, own)  # the margin is made for the path's own
        return [float(strength) for strength in d_over_r0]


class WarpBlur(_GaussianModel):
    r"""The warp and blur of the literature: smoothed white noise moves the points, one Gaussian blurs them all.

    .. math::
        t = s\, \frac{G_\ell * n}{\|G_\ell\|}, \qquad E[t(u)\, t(u')] = s^2 e^{-|u-u'|^2/4\ell^2}, \qquad
        \sigma = \mathrm{const}

    for either component of t, n white. The defaults agree with theory in three numbers, all in Nyquist pixels:

    - s^2 = (4/pi)^2 E[a_2^2] = (4/pi)^2 0.4489 (D/r0)^(5/3), the variance of the tilt of one point.
    - l = D / (2 sqrt(-ln rho(D))) with rho(D) the path's own correlation of tilts one aperture apart, mean of both
      components: points at that distance move against each other as they should.
    - sigma is the equivalent width of the mean short exposure: H the exact mean transfer function of aperture and
      tilt-free Kolmogorov phase, `turbnet.atmosphere.exposure.tilt_free_otf`.

    Wrong by construction: both components have the same, Gaussian correlation, so that points far apart are unrelated and
    close ones move together too well; every point has the same blur in every frame. With wind the pattern moves as if all
    air were half way.

    Args:
        path: the turbulent path; a pixel of the picture is its Nyquist pixel in the scene.
        height, width: size of the picture, pixels.
        stride: step of the coarse grid of displacements, pixels.
        tilt_std: s, pixels.
        correlation: l, pixels.
        sigma: of the Gaussian, pixels. All three at the path's D/r0; None: from theory.
        sensor: the camera's noise.

    Raises:
        ParameterError: a size or parameter out of range, or a path stronger than D/r0 = 10.
    """

    _smooth: Tensor

    def __init__(
        self,
        path: OpticalPath,
        height: int,
        width: int,
        stride: int = 4,
        tilt_std: float | None = None,
        correlation: float | None = None,
        sigma: float | None = None,
        sensor: Sensor | None = None,
    ) -> None:
        strength = check_range("D/r0", path.d_over_r0, 0.0, STRONGEST)
        self.tilt_std = theoretical_tilt_std(strength) if tilt_std is None else tilt_std
        self.sigma = (short_exposure_sigma(strength) if strength else 0.0) if sigma is None else sigma
        self.correlation = _tilt_correlation(path) if correlation is None else correlation
        check_range("tilt_std", self.tilt_std, 0.0, 1e3, "pixels")
        check_range("sigma", self.sigma, 0.0, 1e3, "pixels")
        check_range("correlation", self.correlation, 0.0, 1e4, "pixels")
        super().__init__(path, height, width, stride, self.tilt_std, self.sigma, sensor)
        self.rows, self.columns = (1 + -(-(n + 2 * self.margin - 1) // stride) for n in (height, width))
        # Six correlation lengths around the picture, e^-9 is left of the correlation with the next period.
        beyond = int(np.ceil(6 * self.correlation / stride))
        size = next_fast_len(max(self.rows, self.columns) + beyond, real=True)
        k = 2 * np.pi * np.fft.fftfreq(size)
        smooth = np.exp(-0.5 * (k**2 + k[:, None] ** 2) * (self.correlation / stride) ** 2)
        smooth /= np.sqrt(np.mean(smooth**2))
        self.register_buffer("_smooth", torch.as_tensor(smooth[:, : size // 2 + 1]).float(), persistent=False)

    def draw(
        self,
        seeds: Sequence[int],
        frames: int = 1,
        wind: Tensor | None = None,
        frame_rate: float = 30.0,
        d_over_r0: Tensor | None = None,
        start: int = 0,
    ) -> GaussianDraw:
        """Draw one atmosphere per seed; the same seed gives the same atmosphere, alone or in any batch.

        Args:
            seeds: one per clip.
            frames: T, frames of a clip.
            wind: velocity of the air across the path, m/s, x then y, (2,) or (B, 2). None draws every frame
                independently.
            frame_rate: frames a second.
            d_over_r0: strength of each clip, (B,), at most the path's; tilts scale like (D/r0)^(5/6), sigma like the
                equivalent width. None: as the path says.
            start: number of the first frame.

        Raises:
            ParameterError: no seeds, no frames, a strength out of range.
        """
        check_range("number of clips", len(seeds), 1, 2**20)
        check_range("frames", frames, 1, 2**20)
        numbers = range(start, start + frames)
        tilts, widths = [], []
        for clip, (seed, strength) in enumerate(zip(seeds, self._strengths(len(seeds), d_over_r0), strict=True)):
            weaker = strength / self.path.d_over_r0 if strength else 0.0
            if wind is None:
                fields = [self._field(white_noise(seed, n, 2, *self._square)) for n in numbers]
            else:
                # The eddies half way to the scene, seen from the camera, move twice as far in the scene.
                velocity = (wind[clip] if wind.ndim == 2 else wind) * (2 / (frame_rate * self.path.pixel * self.stride))
                noise = white_noise(seed, 0, 2, *self._square)
                fields = [self._field(noise, velocity * n) for n in numbers]
            tilts.append(self.tilt_std * weaker ** (5 / 6) * torch.stack(fields))
            width = self.sigma * _relative_width(strength, self.path.d_over_r0)
            widths.append(self._smooth.new_full((frames, 1, self.rows, self.columns), width))
        return GaussianDraw(torch.stack(tilts), torch.stack(widths), self.stride, self.margin)

    @property
    def _square(self) -> tuple[int, int]:
        return (len(self._smooth), len(self._smooth))

    def _field(self, noise_2yx: Tensor, travel_2: Tensor | None = None) -> Tensor:
        """Two unit fields (2, rows, columns), moved by `travel_2` grid steps, x then y."""
        spectrum = torch.fft.rfft2(noise_2yx.to(self._smooth)) * self._smooth
        if travel_2 is not None:
            size = len(self._smooth)
            x, y = (2 * np.pi * travel_2).to(self._smooth)
            angle = x * torch.fft.rfftfreq(size).to(x) + y * torch.fft.fftfreq(size).to(x)[:, None]
            spectrum = spectrum * torch.polar(torch.ones_like(angle), -angle)
        return torch.fft.irfft2(spectrum, s=self._square)[:, : self.rows, : self.columns]

    def _split(self, sigma_F1hw: Tensor) -> tuple[Tensor, Tensor]:
        return sigma_F1hw.mean((2, 3)), torch.ones_like(sigma_F1hw[:, :, :1, :1])


class DirectToImage(_GaussianModel):
    r"""Exact tilts, and a Gaussian blur whose width follows the air's defocus and astigmatism from point to point.

    t is that of `ZernikeField`, with its exact covariance. The width belongs to the same field,

    .. math::
        \sigma(u) = \mu + \varsigma\, \frac{q(u) - 3}{\sqrt 6}, \qquad
        q(u) = \sum_{j=4}^{6} \frac{a_j(u)^2}{E[a_j^2]}

    The blur of a wave grows with its squared aberrations, and the three modes of second order carry half of the tilt-free
    variance (0.070 of 0.134). They are independent and Gaussian, so q is a chi-square of 3 degrees of freedom, mean 3 and
    variance 6, and mu and varsigma are mean and standard deviation of sigma. They are those of the equivalent widths of
    tilt-free PSFs at that D/r0 (`width_statistics`). Widths of two points are related as squares of Gaussians are, by
    rho_4(u - u')^2 and the like.

    Wrong by construction: no structure in the blur (no speckle, no astigmatic or comatic spots), and widths are
    distributed like q, with a skewness of 1.6 where PSFs have 1.4 at D/r0 = 1 and 0.4 at 4.5.

    Args:
        path: the turbulent path; a pixel of the picture is its Nyquist pixel in the scene.
        height, width: size of the picture, pixels.
        stride: step of the coarse grid on which the atmosphere is drawn, pixels.
        sensor: the camera's noise.

    Raises:
        ParameterError: a size out of range, or a path stronger than D/r0 = 10.
    """

    _nodes: Tensor
    _variance: Tensor

    def __init__(
        self, path: OpticalPath, height: int, width: int, stride: int = 4, sensor: Sensor | None = None
    ) -> None:
        strength = check_range("D/r0", path.d_over_r0, 0.0, STRONGEST)
        mean, spread = width_statistics(strength)
        narrowest, widest = width_statistics(0.0)[0], mean + 11 * spread  # q < 30 but once in a million points
        super().__init__(path, height, width, stride, theoretical_tilt_std(strength), mean + 3 * spread, sensor)
        self.field = ZernikeField(path, height, width, self.margin, 6, stride)
        # Chebyshev points in log sigma.
        cosine = np.cos(np.pi * (np.arange(_WIDTHS) + 0.5) / _WIDTHS)
        nodes = np.exp(np.log(narrowest) + np.log(widest / narrowest) * 0.5 * (1 - cosine)) if strength else np.ones(1)
        self.narrowest, self.widest = narrowest, widest
        self.register_buffer("_nodes", torch.as_tensor(nodes), persistent=False)
        # What the field holds: a coarse grid loses some of the modes, and the widths must not.
        variance = [float(self.field.covariance(j, j, 0.0)) if strength else 1.0 for j in (4, 5, 6)]
        self.register_buffer("_variance", torch.tensor(variance), persistent=False)

    def draw(
        self,
        seeds: Sequence[int],
        frames: int = 1,
        wind: Tensor | None = None,
        frame_rate: float = 30.0,
        d_over_r0: Tensor | None = None,
        start: int = 0,
    ) -> GaussianDraw:
        """Draw one atmosphere per seed; arguments as in `ZernikeField.draw`, strengths at most the path's.

        Raises:
            ParameterError: no seeds, no frames, a strength out of range.
        """
        strengths = self._strengths(len(seeds), d_over_r0)
        coefficients = self.field.draw(seeds, frames, wind, frame_rate, d_over_r0, start).coefficients
        tilts, second = coefficients[:, :, :2], coefficients[:, :, 2:]
        statistics = [width_statistics(strength) if strength else (0.0, 0.0) for strength in strengths]
        mean, spread = coefficients.new_tensor(statistics).T[..., None, None, None, None]
        relative = coefficients.new_tensor(strengths)[:, None, None, None, None] / (self.path.d_over_r0 or 1.0)
        variance = self._variance[:, None, None] * relative.clamp(min=1e-6) ** (5 / 3)
        q = (second.square() / variance).sum(2, keepdim=True)
        return GaussianDraw(TILT_PIXELS * tilts, mean + spread * (q - 3) / 6**0.5, self.stride, self.margin)

    def _split(self, sigma_F1hw: Tensor) -> tuple[Tensor, Tensor]:
        """Lagrange interpolation in log sigma, right to 0.004 of the transfer function at D/r0 = 3; still air apart."""
        still = sigma_F1hw == 0
        position = torch.where(still, self.narrowest, sigma_F1hw).clamp(self.narrowest, self.widest).log()
        nodes = self._nodes.to(sigma_F1hw)
        points = nodes.log()
        weights = []
        for k in range(len(points)):
            others = [i for i in range(len(points)) if i != k]
            factors = [(position - points[i]) / (points[k] - points[i]) for i in others]
            weights.append(torch.stack(factors).prod(0))
        shares = torch.cat(weights, dim=1)
        if bool(still.any()):
            shares, nodes = (
                torch.cat((shares * ~still, still.to(shares)), dim=1),
                torch.cat((nodes, nodes.new_zeros(1))),
            )
        full = [n + 2 * self.margin for n in (self.height, self.width)]
        return nodes[None], upsample(shares, self.stride, full[0], full[1])


def theoretical_tilt_std(d_over_r0: float) -> float:
    """Standard deviation of either component of the tilt of one point, Nyquist pixels."""
    return float(TILT_PIXELS * np.sqrt(noll_covariance(2, 2) * d_over_r0 ** (5 / 3)))


def _relative_width(strength: float, own: float) -> float:
    """sigma at a strength over sigma at the path's own; 0 in still air."""
    if strength in (0.0, own):
        return float(strength > 0)
    return short_exposure_sigma(strength) / short_exposure_sigma(own)


def _tilt_correlation(path: OpticalPath) -> float:
    """l, pixels; one aperture in still air, where nothing moves."""
    across = path.aperture / path.pixel
    if path.d_over_r0 == 0:
        return across
    here, there = (sum(float(zernike_covariance(path, j, j, x)) for j in (2, 3)) for x in (0.0, path.aperture))
    return float(across / (2 * np.sqrt(-np.log(there / here))))
