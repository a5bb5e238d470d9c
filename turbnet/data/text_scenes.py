"""Text to be read: words, lines, plates and eye-chart ladders in perspective, with a box and a transcript for each.

A scene is laid out on a flat page, drawn four times as large, carried to the picture by the homography

    (x, y) -> (h11 x + h12 y + h13, h21 x + h22 y + h23) / (h31 x + h32 y + 1)

that moves the page's corners inwards, and reduced by averaging. The box of a text is the upright rectangle around its
ink, carried the same way. Ink and paper are `contrast` of full scale apart, in sRGB.
"""

import string
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from turbnet.data.boxes import TextBox
from turbnet.data.text import fonts, load_font
from turbnet.data.words import WORDS
from turbnet.errors import ParameterError, check_range

KINDS = ("words", "lines", "plates", "ladder")
"""words: one word a box, one size. lines: several words a box. plates: capitals and digits on a plate of their own.
ladder: rows of capitals that shrink downwards, as an optician's chart."""

_FINER = 4  # the page is drawn this many times finer than the picture
_LETTERS, _DIGITS = string.ascii_uppercase, string.digits


@dataclass(frozen=True)
class TextScene:
    """A picture (H, W, 3), float32 sRGB in [0, 1], and the text in it."""

    picture: NDArray[np.float32]
    boxes: tuple[TextBox, ...]


@dataclass(frozen=True)
class _Item:
    """A text on the page: its left, its top and its letters' size, picture pixels; on a plate or on paper."""

    x: float
    y: float
    size: float
    text: str
    plate: bool = False


def render_scene(
    rng: np.random.Generator,
    height: int,
    width: int,
    kind: str | None = None,
    size: tuple[float, float] = (10.0, 28.0),
    contrast: tuple[float, float] = (0.25, 1.0),
    perspective: float = 0.15,
    font_paths: Sequence[Path] | None = None,
) -> TextScene:
    """A scene of text.

    Args:
        rng: decides everything.
        height, width: of the picture, pixels.
        kind: one of `KINDS`; None: any of them.
        size: range of the size of the letters, pixels an em (capitals are about 0.7 of it); a ladder goes from the
            largest to the smallest.
        contrast: range of the distance of ink from paper, fraction of full scale.
        perspective: how far a corner may move inwards, fraction of the picture's sides.
        font_paths: to choose from; None: those that come with matplotlib.

    Raises:
        ParameterError: a range that is none, a kind that does not exist.
        InputError: a font that cannot be read.
    """
    check_range("height", height, 1, 2**15, "pixels")
    check_range("width", width, 1, 2**15, "pixels")
    check_range("perspective", perspective, 0, 0.4)
    if kind is not None and kind not in KINDS:
        raise ParameterError(f"kind = {kind!r} is none of {', '.join(KINDS)}")
    for name, bounds, least, most in (("size", size, 2, 1000), ("contrast", contrast, 0.01, 1)):
        if len(bounds) != 2 or not least <= bounds[0] <= bounds[1] <= most:
            raise ParameterError(f"{name} = {bounds} must be a range: two numbers, {least} <= low <= high <= {most}")
    kind = kind or KINDS[rng.integers(len(KINDS))]
    paths = fonts() if font_paths is None else font_paths
    path = paths[int(rng.integers(len(paths)))]
    items = _ladder(rng, height, width, path, size) if kind == "ladder" else _page(rng, height, width, path, size, kind)
    return _draw(rng, height, width, items, path, rng.uniform(*contrast), perspective)


class TextScenes:
    """Scenes of text as a source of clean crops; the arguments are those of `render_scene`."""

    def __init__(
        self,
        kind: str | None = None,
        size: tuple[float, float] = (10.0, 28.0),
        contrast: tuple[float, float] = (0.25, 1.0),
        perspective: float = 0.15,
        font_paths: Sequence[Path] | None = None,
    ) -> None:
        self._scene = partial(
            render_scene, kind=kind, size=size, contrast=contrast, perspective=perspective, font_paths=font_paths
        )

    def __call__(self, rng: np.random.Generator, height: int, width: int) -> NDArray[np.float32]:
        return self._scene(rng, height, width).picture


def plate_text(rng: np.random.Generator) -> str:
    """Five to seven capitals and digits."""
    return "".join(rng.choice(list(_LETTERS + _DIGITS), size=rng.integers(5, 8)))


def _word(rng: np.random.Generator) -> str:
    word = WORDS[rng.integers(len(WORDS))]
    return [word, word.capitalize(), word.upper()][rng.choice(3, p=(0.6, 0.25, 0.15))]


def _page(
    rng: np.random.Generator, height: int, width: int, path: Path, sizes: tuple[float, float], kind: str
) -> list[_Item]:
    """Rows of texts of one size; a row that does not fit is left out."""
    size = rng.uniform(*sizes)
    make = plate_text if kind == "plates" else _word
    pad = 0.35 * size if kind == "plates" else 0.0
    items, y = [], rng.uniform(0.1, 0.5) * size
    while y + 1.2 * size + 2 * pad <= height:
        row, x = [], rng.uniform(0.2, 1.0) * size
        while True:
            text = make(rng)
            end = x + load_font(path, size).getlength(text) + 2 * pad
            if end > width - 0.2 * size:
                break
            row.append(_Item(x + pad, y + pad, size, text, kind == "plates"))
            x = end + (0.3 if kind == "lines" else rng.uniform(0.8, 1.6)) * size
        if kind == "lines" and row:
            row = [_Item(row[0].x, y, size, " ".join(item.text for item in row))]
        items += row
        y += rng.uniform(1.3, 1.7) * size + 2 * pad
    return items


def _ladder(rng: np.random.Generator, height: int, width: int, path: Path, sizes: tuple[float, float]) -> list[_Item]:
    """Rows of five capitals, each 10^0.1 times smaller than the one above it (ISO 8596), in the middle."""
    items, y, size = [], 0.1 * sizes[1], sizes[1]
    while size >= sizes[0] and y + 1.2 * size <= height:
        text = "".join(rng.choice(list(_LETTERS), size=5))
        length = load_font(path, size).getlength(text)
        if length <= 0.95 * width:
            items.append(_Item((width - length) / 2, y, size, text))
            y += 1.5 * size
        size /= 10**0.1
    return items


def _draw(
    rng: np.random.Generator,
    height: int,
    width: int,
    items: Sequence[_Item],
    path: Path,
    contrast: float,
    perspective: float,
) -> TextScene:
    light = rng.uniform(contrast, 1.0)
    levels = np.array([light, light - contrast]) if rng.random() < 0.7 else np.array([light - contrast, light])
    tint = rng.uniform(0.85, 1.0, size=3) if rng.random() < 0.5 else np.ones(3)
    page = Image.new("L", (width * _FINER, height * _FINER))  # 0: paper, 255: ink
    draw = ImageDraw.Draw(page)
    outlines = []
    for item in items:
        font = load_font(path, item.size * _FINER)
        left, top, right, bottom = draw.textbbox((item.x * _FINER, item.y * _FINER), item.text, font=font)
        if item.plate:
            pad = 0.3 * item.size * _FINER
            draw.rectangle((left - pad, top - pad, right + pad, bottom + pad), fill=255)
        draw.text((item.x * _FINER, item.y * _FINER), item.text, fill=0 if item.plate else 255, font=font)
        outlines.append(np.array([[left, top], [right, top], [right, bottom], [left, bottom]]) / _FINER)

    sides = np.array([width, height], dtype=float)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * sides
    inwards = np.where(corners == 0, 1, -1) * rng.uniform(0, perspective, size=(4, 2)) * sides
    forward = homography(corners, corners + inwards)
    if perspective > 0:
        fine = np.diag([_FINER, _FINER, 1.0])
        back = fine @ np.linalg.inv(forward) @ np.linalg.inv(fine)
        coefficients = (back / back[2, 2]).flatten()[:8].tolist()
        page = page.transform(page.size, Image.Transform.PERSPECTIVE, coefficients, Image.Resampling.BILINEAR)
    ink = np.asarray(page, dtype=np.float32).reshape(height, _FINER, width, _FINER).mean((1, 3)) / np.float32(255)
    paper, dark = (levels[:, None] * tint).astype(np.float32)
    picture = paper + ink[..., None] * (dark - paper)
    boxes = []
    for item, outline in zip(items, outlines, strict=True):
        carried = carry_points(forward, outline)
        left, top = np.maximum(np.floor(carried.min(0)), 0).astype(int).tolist()
        right, bottom = np.minimum(np.ceil(carried.max(0)), (width, height)).astype(int).tolist()
        boxes.append(TextBox(left, top, right - left, bottom - top, item.text))
    return TextScene(picture, tuple(boxes))


def homography(source_42: NDArray[np.float64], target_42: NDArray[np.float64]) -> NDArray[np.float64]:
    """The 3 x 3 matrix, last entry 1, that carries four points to four others."""
    rows, values = [], []
    for (x, y), (u, v) in zip(source_42, target_42, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]
        values += [u, v]
    return np.append(np.linalg.solve(np.array(rows), np.array(values)), 1.0).reshape(3, 3)


def carry_points(matrix_33: NDArray[np.float64], points_N2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (N, 2), x then y, carried by a homography."""
    carried = np.column_stack((points_N2, np.ones(len(points_N2)))) @ matrix_33.T
    return carried[:, :2] / carried[:, 2:]
