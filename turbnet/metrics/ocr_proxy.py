r"""How legible text is, by templates: no learning, no text recognised, differentiable in the picture.

The transcript of a box is written in the best-fitting of a few fonts and stretched to the box. Letter by letter, the
picture is compared with what should stand there and with everything that might stand there instead:

.. math::
    c_k = \frac{1}{\beta} \log \sum_{s} e^{\beta\,\rho(P_s, G_k)}, \qquad
    p = \frac{e^{c_t / \tau}}{\sum_k e^{c_k / \tau}}, \qquad \text{error} = 1 - \langle p \rangle

rho is the correlation coefficient of the patch P_s, cut out around the letter at the shift s (the local registration),
with the template G_k of character k between the neighbours of the letter; c_k is a soft maximum over shifts; p tells how
well the true character t stands out from the other 35 digits and letters of its case. Brightness, contrast and which of
ink and paper is lighter do not matter; blur, noise and warps within a letter do: they bring c_t close to the rest. The
error is that of a reader who answers with probability p: near 0 for sharp text, 1 - 1/36 for text that is gone.

The font, and the slope at which the text crosses its upright box, are chosen by correlation of the whole text, without
gradient.
"""

import string
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from turbnet.data.boxes import TextBox
from turbnet.data.text import fonts, load_font
from turbnet.errors import InputError
from turbnet.metrics.text import Picture, TextScore, normalise

FONTS = ("DejaVuSans", "DejaVuSerif", "DejaVuSansMono", "STIXGeneral", "STIXGeneralItalic", "DejaVuSans-Bold")
"""Fonts to write the transcript in; all come with matplotlib."""

SLOPES = (0.0, -0.15, 0.15, -0.3, 0.3, -0.45, 0.45, -0.6, 0.6)
"""How far a text may fall from the left to the right of its box, fraction of the box's height."""

INK = 24
"""Height the ink of a box is brought to, pixels."""

_CASES = (string.digits + string.ascii_lowercase, string.digits + string.ascii_uppercase)
_CHARACTERS = string.digits + string.ascii_lowercase + string.ascii_uppercase
_EM, _ROOM = 48, 24  # pixels an em of the stored glyphs, and around them
_BEYOND, _HALF = 2, 10  # a patch: pixels above and below the ink, half its width
_REACH_X, _REACH_Y = 6, 3  # greatest shifts, pixels
_MARGIN_X, _MARGIN_Y = _HALF + _REACH_X, _BEYOND + _REACH_Y
_BETA, _TAU = 60.0, 0.03


def legibility_error(pictures_NCHW: Tensor, boxes: Sequence[TextBox]) -> Tensor:
    """Expected error rate of the letters and digits in each box, (N, boxes), differentiable in the pictures.

    Args:
        pictures_NCHW: sRGB in [0, 1].
        boxes: upright rectangles around the ink, with their transcripts.

    Raises:
        InputError: a box does not lie inside the pictures or has neither a letter nor a digit; values are not finite.
    """
    if pictures_NCHW.ndim != 4:
        raise InputError(f"pictures of shape {tuple(pictures_NCHW.shape)} must be (N, C, H, W)")
    if not torch.isfinite(pictures_NCHW).all():
        raise InputError("cannot judge text in pictures that hold NaN or infinite pixels")
    height, width = pictures_NCHW.shape[-2:]
    for box in boxes:
        if box.left < 0 or box.top < 0 or box.left + box.width > width or box.top + box.height > height:
            raise InputError(f"the box of {box.text!r} does not lie inside the picture of {width}x{height} pixels")
        if not any(character in _CHARACTERS for character in box.text):
            raise InputError(f"the box of {box.text!r} has neither a letter nor a digit of the English alphabet")
    grey_N1HW = pictures_NCHW.mean(1, keepdim=True)
    errors = [_box_error(grey_N1HW, box) for box in boxes]
    return torch.stack(errors, 1) if errors else grey_N1HW.new_zeros(len(grey_N1HW), 0)


def score_legibility(picture: Picture, boxes: Sequence[TextBox]) -> TextScore:
    """Errors and right words to expect in the boxes of a picture (H, W, C), letters being misread independently.

    Raises:
        InputError: as `legibility_error`.
    """
    with torch.no_grad():
        errors = legibility_error(torch.from_numpy(np.ascontiguousarray(picture)).movedim(-1, 0)[None], boxes)[0]
    score = TextScore()
    for error, box in zip(errors.tolist(), boxes, strict=True):
        letters = len(normalise(box.text))
        score += TextScore(error * letters, letters, (1 - error) ** letters, 1)
    return score


def _box_error(grey_N1HW: Tensor, box: TextBox) -> Tensor:
    """Expected error rate (N,) of one box."""
    layout, slope, sign_N = _best_layout(grey_N1HW.detach(), box)
    line_N1hw = _cut(grey_N1HW, box, slope)
    errors = []
    for position, (character, origin) in enumerate(layout.letters):
        candidates = next(case for case in _CASES if character in case)
        centre = round((origin + layout.font.advances[character] / 2 - layout.left) * layout.scale_x)
        columns = torch.arange(centre - _HALF, centre + _HALF + 1)
        # A candidate stands in the middle of the place of the letter, between the letter's neighbours.
        starts = [origin + (layout.font.advances[character] - layout.font.advances[k]) / 2 for k in candidates]
        neighbours = layout.letters[:position] + layout.letters[position + 1 :]
        ink_Khw = layout.draw(list(zip(candidates, starts, strict=True)), columns)
        if neighbours:
            ink_Khw = (ink_Khw + layout.draw(neighbours, columns).sum(0)).clamp(max=1)
        patch_N1hw = line_N1hw[..., centre - _HALF + _HALF : centre + _HALF + 1 + _HALF + 2 * _REACH_X]
        rho_NSK = sign_N[:, None, None] * _correlations(patch_N1hw, ink_Khw)
        best_NK = torch.logsumexp(_BETA * rho_NSK, 1) / _BETA
        errors.append(1 - torch.softmax(best_NK / _TAU, -1)[:, candidates.index(character)])
    return torch.stack(errors).mean(0)


@dataclass(frozen=True)
class _Font:
    """Glyphs by character, (1, canvas, canvas), ink 1, origin at (_ROOM, _ROOM), and their advances, pixels."""

    glyphs: dict[str, Tensor]
    advances: dict[str, float]
    face: ImageFont.FreeTypeFont


@dataclass(frozen=True)
class _Layout:
    """A text in a font, its ink stretched to a line; letters and digits with their origins, pixels of the font."""

    font: _Font
    letters: list[tuple[str, float]]
    left: float
    top: float
    scale_x: float
    scale_y: float

    def draw(self, letters: Sequence[tuple[str, float]], columns: Tensor) -> Tensor:
        """Each letter alone on these columns of the line and a little beyond its height, (letters, h, columns)."""
        side = _EM + 2 * _ROOM
        y = (torch.arange(-_BEYOND, INK + _BEYOND).double() + 0.5) / self.scale_y + self.top + _ROOM
        x = (columns.double() + 0.5) / self.scale_x + self.left + _ROOM
        x_Kw = x - torch.tensor([[origin] for _, origin in letters], dtype=torch.float64)
        grid_x, grid_y = torch.broadcast_tensors(x_Kw[:, None], y[None, :, None])
        grid = torch.stack((grid_x, grid_y), -1) * (2 / side) - 1
        glyphs = torch.stack([self.font.glyphs[character] for character, _ in letters])
        return F.grid_sample(glyphs, grid, align_corners=False)[:, 0]


@lru_cache
def _font(name: str) -> _Font:
    face = load_font(next(path for path in fonts() if path.stem == name), _EM)
    glyphs = {}
    for character in _CHARACTERS:
        canvas = Image.new("L", (_EM + 2 * _ROOM, _EM + 2 * _ROOM))
        ImageDraw.Draw(canvas).text((_ROOM, _ROOM), character, fill=255, font=face)
        glyphs[character] = torch.from_numpy(np.asarray(canvas, dtype=np.float64) / 255)[None]
    return _Font(glyphs, {character: face.getlength(character) for character in _CHARACTERS}, face)


@lru_cache(maxsize=4096)
def _layout(name: str, text: str, width: int) -> tuple[_Layout, Tensor]:
    """The layout and the word it makes, (1, h, w)."""
    font = _font(name)
    left, top, right, bottom = font.face.getbbox(text)
    letters = [(c, font.face.getlength(text[:i])) for i, c in enumerate(text) if c in _CHARACTERS]
    layout = _Layout(font, letters, left, top, width / (right - left), INK / (bottom - top))
    return layout, layout.draw(letters, torch.arange(width)).sum(0, keepdim=True).clamp(max=1)


def _best_layout(grey_N1HW: Tensor, box: TextBox) -> tuple[_Layout, float, Tensor]:
    """Font and slope with which the text resembles the pictures best, and +1 or -1 for light or dark ink, (N,)."""

    def resemblance(name: str, slope: float) -> Tensor:
        line_N1hw = _cut(grey_N1HW, box, slope)
        _, word_1hw = _layout(name, box.text, _width(box, slope))
        rho_NS = _correlations(line_N1hw[..., _HALF:-_HALF], word_1hw)[..., 0]
        return rho_NS.gather(1, rho_NS.abs().argmax(1, keepdim=True))[:, 0]

    slope = max(SLOPES, key=lambda slope: float(resemblance(FONTS[0], slope).abs().mean()))
    name = max(FONTS, key=lambda name: float(resemblance(name, slope).abs().mean()))
    sign_N = torch.where(resemblance(name, slope) < 0, -1.0, 1.0).to(grey_N1HW)
    return _layout(name, box.text, _width(box, slope))[0], slope, sign_N


def _width(box: TextBox, slope: float) -> int:
    """Width of the ink of a box, its height brought to INK, pixels."""
    return max(round(box.width * INK / (box.height * (1 - abs(slope)))), 4)


def _cut(grey_N1HW: Tensor, box: TextBox, slope: float) -> Tensor:
    """The ink brought to INK x _width pixels, upright, with room for patches and their shifts on every side."""
    tall, width = box.height * (1 - abs(slope)), _width(box, slope)
    along = (torch.arange(-_MARGIN_X, width + _MARGIN_X).double() + 0.5) / width
    down = (torch.arange(-_MARGIN_Y, INK + _MARGIN_Y).double() + 0.5) / INK
    x = box.left + along * box.width
    y = box.top + (box.height - tall) / 2 + (along - 0.5) * slope * box.height + down[:, None] * tall
    height, wide = grey_N1HW.shape[-2:]
    grid_x, grid_y = torch.broadcast_tensors(x * 2 / wide - 1, y * 2 / height - 1)
    grid = torch.stack((grid_x, grid_y), -1).to(grey_N1HW).expand(len(grey_N1HW), -1, -1, -1)
    return F.grid_sample(grey_N1HW, grid, mode="bicubic", padding_mode="border", align_corners=False)


def _correlations(patch_N1hw: Tensor, ink_Khw: Tensor) -> Tensor:
    """Correlation coefficients (N, shifts, K) of templates with every part of the patch of their size."""
    template_Khw = ink_Khw - ink_Khw.mean((1, 2), keepdim=True)
    template_Khw = template_Khw / template_Khw.square().sum((1, 2), keepdim=True).sqrt().clamp(min=1e-6)
    pixels = template_Khw[0].numel()
    products = F.conv2d(patch_N1hw, template_Khw[:, None].to(patch_N1hw))
    ones = patch_N1hw.new_ones(1, 1, *template_Khw.shape[1:])
    variance = F.conv2d(patch_N1hw.square(), ones) - F.conv2d(patch_N1hw, ones).square() / pixels
    # The floor, a contrast of 0.1 % of full scale, keeps flat patches and their gradients finite.
    return (products / (variance.clamp(min=0) + pixels * 1e-6).sqrt()).flatten(2).transpose(1, 2)
