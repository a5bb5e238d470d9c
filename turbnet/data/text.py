"""Rendered text: words and lines in fonts that matplotlib ships, as scenes to train on."""

import string
from functools import lru_cache
from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

_CHARACTERS = string.ascii_uppercase + string.ascii_lowercase + string.digits


@lru_cache
def fonts() -> tuple[Path, ...]:
    """Latin fonts that come with matplotlib."""
    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    names = ("DejaVuSans*", "DejaVuSerif*", "STIXGeneral*", "cmr10*", "cmss10*", "cmtt10*")
    return tuple(sorted(path for name in names for path in folder.glob(name) if "Display" not in path.name))


@lru_cache(maxsize=256)
def _font(path: Path, size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(str(path), size)


def random_word(rng: np.random.Generator) -> str:
    """Two to eight letters and digits."""
    word = "".join(rng.choice(list(_CHARACTERS), size=rng.integers(2, 9)))
    return [word, word.upper(), word.lower(), word.capitalize()][rng.integers(4)]


def render_text(rng: np.random.Generator, height: int, width: int) -> NDArray[np.float32]:
    """A picture (height, width, 3), sRGB in [0, 1], filled with lines of random words of one font, size and contrast."""
    size = int(rng.integers(10, 41))
    font = _font(fonts()[rng.integers(len(fonts()))], size)
    paper, ink = _colours(rng)
    picture = Image.new("RGB", (width, height), paper)
    draw = ImageDraw.Draw(picture)
    y = -int(rng.integers(size))
    while y < height:
        x = -int(rng.integers(2 * size))
        while x < width:
            word = random_word(rng)
            draw.text((x, y), word, fill=ink, font=font)
            x += int(font.getlength(word)) + size // 2
        y += int(size * rng.uniform(1.1, 1.6))
    return np.asarray(picture, dtype=np.float32) / 255


def _colours(rng: np.random.Generator) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """Paper and ink at least a fifth of full scale apart, either one the lighter."""
    light = rng.uniform(0.45, 1.0)
    dark = rng.uniform(0.0, light - 0.2)
    tint = rng.uniform(0.85, 1.0, size=(2, 3)) if rng.random() < 0.5 else np.ones((2, 3))
    levels = (255 * np.array([light, dark])[:, None] * tint).astype(int)
    order = (0, 1) if rng.random() < 0.7 else (1, 0)
    first, second = (tuple(int(v) for v in levels[i]) for i in order)
    return first, second  # type: ignore[return-value]
