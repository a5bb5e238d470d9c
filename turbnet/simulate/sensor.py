r"""Sensor: what the camera does after the optics, in this order.

.. math::
    \bar I = \frac1n \sum_{i=1}^n I_i, \qquad
    S = \bar I + \epsilon \sqrt{\bar I / N + \sigma_r^2}, \qquad
    Q = \frac{\mathrm{round}\,(2^b - 1) S}{2^b - 1}, \qquad
    V = \mathrm{jpeg}(\mathrm{sRGB}(Q))

Exposure averages the n instants within a frame. A signal of intensity I then collects N I electrons (N the `full_well`):
shot noise has the variance I / N, read noise the standard deviation sigma_r, both in units of full scale. Shot noise is
drawn as a Gaussian (epsilon standard normal), right from about ten electrons on, so that frames stay differentiable. Then
come the depth of quantisation, the sRGB curve (IEC 61966-2-1) and JPEG with 4:2:0 chroma, which works on sRGB values.
"""

from dataclasses import dataclass
from io import BytesIO

import numpy as np
import torch
from torch import Tensor

from turbnet.errors import InputError, check_range
from turbnet.media.colour import to_linear, to_srgb


@dataclass(frozen=True)
class Sensor:
    """A camera.

    Args:
        full_well: electrons at full scale; infinite for no shot noise.
        read_noise: standard deviation, fraction of full scale.
        bits: depth of quantisation; 0 for none. Rounding passes gradients straight through.
        exposures: instants averaged into one frame.
        gamma: return sRGB-encoded values instead of linear ones; leave it off where the caller encodes.
        jpeg: quality of JPEG compression, 1 to 100; None for none. It passes gradients straight through.

    Raises:
        ParameterError: a value out of range.
    """

    full_well: float = float("inf")
    read_noise: float = 0.0
    bits: int = 0
    exposures: int = 1
    gamma: bool = False
    jpeg: int | None = None

    def __post_init__(self) -> None:
        check_range("full_well", self.full_well, 1.0, float("inf"), "electrons")
        check_range("read_noise", self.read_noise, 0.0, 1.0)
        check_range("bits", self.bits, 0, 16)
        check_range("exposures", self.exposures, 1, 2**16)
        if self.jpeg is not None:
            check_range("jpeg", self.jpeg, 1, 100)

    def __call__(self, frames: Tensor, seed: int = 0) -> Tensor:
        """What the camera gives; values below 0 or above 1 saturate where there is noise, depth or compression.

        Args:
            frames: linear intensities; any shape, but (B, T exposures, C, H, W) if frames are averaged and
                (..., C, H, W), C = 1 or 3, if they are compressed.
            seed: of the noise.

        Returns:
            the same shape, T in place of T exposures; linear, or sRGB-encoded with `gamma`.

        Raises:
            InputError: the frames' shape does not suit the averaging or the compression.
        """
        out = exposed(frames, self.exposures)
        if self.read_noise > 0 or self.full_well != float("inf"):
            generator = torch.Generator().manual_seed(seed)
            noise = torch.randn(out.shape, generator=generator).to(out)
            variance = self.read_noise**2 + out.clamp(min=0) / self.full_well
            # The floor keeps the square root's gradient finite in black pixels.
            out = (out + noise * variance.clamp(min=1e-12).sqrt()).clamp(0, 1)
        if self.bits:
            steps = 2**self.bits - 1
            out = out.clamp(0, 1)  # before the difference, which is no number of an infinite pixel
            out = out + ((out * steps).round() / steps - out).detach()
        if self.gamma or self.jpeg is not None:
            out = to_srgb(out)
        if self.jpeg is not None:
            out = compressed(out.clamp(0, 1), self.jpeg)
            out = out if self.gamma else to_linear(out)
        return out


def exposed(frames: Tensor, exposures: int) -> Tensor:
    """Mean of every `exposures` consecutive instants: (B, T exposures, C, H, W) to (B, T, C, H, W)."""
    if exposures == 1:
        return frames
    if frames.ndim != 5 or frames.shape[1] % exposures:
        raise InputError(
            f"frames {tuple(frames.shape)} cannot be averaged {exposures} at a time; give (B, T * {exposures}, C, H, W)"
        )
    return frames.unflatten(1, (-1, exposures)).mean(2)


def compressed(pictures: Tensor, quality: int) -> Tensor:
    """sRGB pictures (..., C, H, W) in [0, 1], C = 1 or 3, after JPEG at a quality of 1 to 100, as libjpeg codes them.

    Gradients pass straight through, as they do through rounding. Codecs with soft rounding (R. Shin and D. Song, 2017)
    are a poor stand-in: a third of what JPEG changes is missing from their values, and their gradient in the picture's
    brightness is 1/4, the mean slope of x^3 about whole numbers, where JPEG follows brightness one to one.

    Raises:
        InputError: another number of channels than 1 or 3.
    """
    if pictures.ndim < 3 or pictures.shape[-3] not in (1, 3):
        raise InputError(f"JPEG takes pictures (..., 1 or 3, H, W), not {tuple(pictures.shape)}")
    flat = pictures.detach().reshape(-1, *pictures.shape[-3:])
    eight_bit = (flat * 255).round().to("cpu", torch.uint8).permute(0, 2, 3, 1).numpy()
    coded = np.stack([_libjpeg(picture, quality) for picture in eight_bit])
    values = (torch.from_numpy(coded).permute(0, 3, 1, 2).to(pictures) / 255).view_as(pictures)
    return pictures + (values - pictures).detach()


def _libjpeg(picture_HWC: np.ndarray, quality: int) -> np.ndarray:
    from PIL import Image

    file, grey = BytesIO(), picture_HWC.shape[2] == 1
    Image.fromarray(picture_HWC[..., 0] if grey else picture_HWC).save(
        file, "JPEG", quality=quality, subsampling="4:2:0"
    )
    decoded = np.asarray(Image.open(file))
    return decoded[..., None] if grey else decoded
