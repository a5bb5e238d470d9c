"""Lines of text seen through turbulence, one crop a line, to train a recogniser on.

A word is written at its native size (an em of 8 to 28 Nyquist pixels), blurred by the tilt-free point-spread function of
a random atmosphere and by what is left of the tilts, given noise, cut out with a random margin, slant and wobble, and
brought to the height of the recogniser. One blur a line, where the simulator has one a point: good enough to learn
letters from, and hundreds of times as fast.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image, ImageDraw
from torch import Tensor

from turbnet.atmosphere.noll import noll_covariance, noll_matrix
from turbnet.data.text import load_font
from turbnet.data.words import ALPHABET, WORDS
from turbnet.simulate.draw import TILT_PIXELS
from turbnet.simulate.psf_basis import kernel_size, tilt_free_psf

STRONGEST = 6.0
_MODES, _KERNELS = 36, 2048
_HEIGHT, _WIDTH = 48, 256  # of the canvas a word is written on, pixels
_INK = 8  # pixels between the canvas's edge and the ink, at least


@dataclass(frozen=True)
class Lines:
    """Crops (B, 1, height, W), grey sRGB values about [0, 1], and what they say, in ALPHABET."""

    pictures: Tensor
    texts: list[str]


class TextLines:
    """Batches of lines, each decided by its number alone.

    Args:
        font_paths: to write with.
        height: of the crops, pixels.
        multiple: their width is a multiple of this, pixels.
        batch: lines a batch.
        seed: of all batches.
    """

    def __init__(
        self, font_paths: Sequence[Path], height: int = 32, multiple: int = 4, batch: int = 64, seed: int = 0
    ) -> None:
        self.font_paths, self.height, self.multiple = list(font_paths), height, multiple
        self.batch, self.seed = batch, seed
        generator = torch.Generator().manual_seed(0)
        factor = torch.as_tensor(np.linalg.cholesky(noll_matrix(range(4, _MODES + 1))), dtype=torch.float32)
        strengths = torch.linspace(0, STRONGEST, _KERNELS)[:, None]
        high = torch.randn(_KERNELS, _MODES - 3, generator=generator) @ factor.T * strengths ** (5 / 6)
        spectra = [torch.fft.rfft2(part, s=(_HEIGHT, _WIDTH)) for part in tilt_free_psf(high).split(256)]
        self._blur = torch.cat(spectra).to(torch.complex64)  # by strength; the kernel's centre is put back below

    def __call__(self, number: int, severity: float | None = None) -> Lines:
        """Batch `number`; `severity` is D/r0 over what letters of that size can stand, None: drawn from 0 to 1."""
        rng = np.random.default_rng([self.seed, number])
        longest = int(rng.integers(4, 12))
        written = [self._write(rng, longest) for _ in range(self.batch)]
        texts = [text for text, *_ in written]
        ink = torch.from_numpy(np.stack([mask for _, mask, *_ in written])).float() / 255
        boxes = np.array([box for *_, box, _ in written], dtype=float)
        sizes = np.array([size for *_, size in written])

        severities = np.full(self.batch, severity) if severity is not None else rng.random(self.batch)
        # Letters of 20 pixels an em are about as large as the blur of D/r0 = 6.
        strengths = np.minimum(severities * 0.3 * sizes, STRONGEST)
        ink = self._blurred(ink, strengths, rng)
        light = rng.uniform(0.3, 1.0, self.batch)
        dark = light * rng.uniform(0.0, 0.75, self.batch)
        swap = rng.random(self.batch) < 0.4
        paper, pen = (torch.from_numpy(np.where(swap, *pair)).float() for pair in ((dark, light), (light, dark)))
        noise = torch.from_numpy(rng.normal(size=ink.shape) * rng.uniform(0, 0.03, (self.batch, 1, 1))).float()
        pictures = paper[:, None, None] + ink * (pen - paper)[:, None, None]
        pictures = pictures + noise * (pen - paper).abs()[:, None, None] * 2
        return Lines(self._cut(pictures, boxes, strengths, rng), texts)

    def _write(self, rng: np.random.Generator, longest: int) -> tuple[str, np.ndarray, tuple[float, ...], float]:
        """A text of at most `longest` characters, its ink on the canvas, the ink's box, its size."""
        path = self.font_paths[rng.integers(len(self.font_paths))]
        size = float(rng.uniform(8, 28))
        text = _text(rng, longest)
        while True:
            font = load_font(path, round(size))
            left, top, right, bottom = font.getbbox(text)
            if right - left <= _WIDTH - 2 * _INK and bottom - top <= _HEIGHT - 2 * _INK:
                break
            size *= 0.8
        canvas = Image.new("L", (_WIDTH, _HEIGHT))
        x, y = (_WIDTH - right + left) / 2 - left + rng.random(), (_HEIGHT - bottom + top) / 2 - top + rng.random()
        ImageDraw.Draw(canvas).text((x, y), text, fill=255, font=font)
        return text.lower(), np.asarray(canvas), (left + x, top + y, right + x, bottom + y), size

    def _blurred(self, ink_BHW: Tensor, strengths: np.ndarray, rng: np.random.Generator) -> Tensor:
        index = torch.from_numpy(np.rint(strengths / STRONGEST * (_KERNELS - 1)).astype(int))
        # Half the lines stand for means over frames, which keep some of the tilts' blur as well.
        share = rng.random(self.batch) * (rng.random(self.batch) < 0.5)
        sigma = share * TILT_PIXELS * np.sqrt(noll_covariance(2, 2)) * strengths ** (5 / 6)
        y, x = torch.fft.fftfreq(_HEIGHT)[:, None], torch.fft.rfftfreq(_WIDTH)
        squared = torch.from_numpy(sigma**2).float()[:, None, None] * (x.square() + y.square())
        centre = torch.polar(torch.ones(()), 2 * torch.pi * (kernel_size() // 2) * (x + y))
        spectrum = torch.fft.rfft2(ink_BHW) * self._blur[index] * centre * torch.exp(-2 * torch.pi**2 * squared)
        return torch.fft.irfft2(spectrum, s=(_HEIGHT, _WIDTH))

    def _cut(self, pictures: Tensor, boxes: np.ndarray, strengths: np.ndarray, rng: np.random.Generator) -> Tensor:
        """Crops around the boxes, slanted and wobbling, all as wide as the widest."""
        count = self.batch
        left, top, right, bottom = boxes.T
        tall = bottom - top
        margin = tall[:, None] * rng.uniform(0.0, 0.35, (count, 4))
        left, top, right, bottom = left - margin[:, 0], top - margin[:, 1], right + margin[:, 2], bottom + margin[:, 3]
        scale = (bottom - top) / self.height  # native pixels a pixel of the crop
        width = self.multiple * int(np.ceil(((right - left) / scale).max() / self.multiple))
        y, x = np.mgrid[0 : self.height, 0:width] + 0.5
        x_of = left[:, None, None] + x * scale[:, None, None]
        y_of = top[:, None, None] + y * scale[:, None, None]
        from_left, from_middle = x_of - ((left + right) / 2)[:, None, None], y_of - ((top + bottom) / 2)[:, None, None]
        turn, shear = rng.normal(0, 0.03, (count, 1, 1)), rng.normal(0, 0.08, (count, 1, 1))
        x_of, y_of = x_of + shear * from_middle, y_of + turn * from_left
        # The tilts' wobble: their part that changes within a line, a few nodes a word.
        nodes = torch.from_numpy(rng.normal(size=(count, 2, 3, 2 + width // 24))).float()
        wobble = F.interpolate(nodes, (self.height, width), mode="bicubic").numpy()
        amount = 0.25 * (strengths ** (5 / 6) * rng.random(count))[:, None, None]
        x_of, y_of = x_of + amount * wobble[:, 0], y_of + amount * wobble[:, 1]
        grid = torch.from_numpy(np.stack((x_of / _WIDTH, y_of / _HEIGHT), -1) * 2 - 1).float()
        return F.grid_sample(pictures[:, None], grid, padding_mode="border", align_corners=False)


def _text(rng: np.random.Generator, longest: int) -> str:
    """An English word, or characters at random, in lower, upper or mixed case."""
    if rng.random() < 0.35:
        text = WORDS[rng.integers(len(WORDS))][:longest]
    else:
        letters = ALPHABET if rng.random() < 0.4 else ALPHABET[10:]
        text = "".join(rng.choice(list(letters), size=rng.integers(max(2, longest - 4), longest + 1)))
    return [text, text.capitalize(), text.upper()][rng.choice(3, p=(0.5, 0.2, 0.3))]
