"""Rendered text: words and lines, as scenes to train on, in fonts that matplotlib ships or in others."""

import string
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from turbnet.errors import InputError

_CHARACTERS = string.ascii_uppercase + string.ascii_lowercase + string.digits
# Of syllables: how they begin, their vowels as often as they occur, how they end, if they do.
_ONSETS, _NUCLEI, _CODAS = (
    parts.split(",")
    for parts in (
        "b,bl,br,c,ch,cl,cr,d,dr,f,fl,fr,g,gr,h,j,k,l,m,n,p,pl,pr,qu,r,s,sc,sh,sl,sm,sp,st,str,t,th,tr,v,w,wh,y",
        "a,a,a,e,e,e,e,i,i,i,o,o,o,u,u,ai,ea,ee,ie,io,oa,oo,ou",
        ",b,c,ck,ct,d,f,g,l,ll,ld,m,mp,n,nd,ng,nt,p,r,rd,rk,rm,rn,rt,s,ss,st,t,th,x",
    )
)

TURN = 12.0  # degrees: lines of text are turned by up to this


@lru_cache
def fonts() -> tuple[Path, ...]:
    """Latin fonts that come with matplotlib."""
    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    names = ("DejaVuSans*", "DejaVuSerif*", "STIXGeneral*", "cmr10*", "cmss10*", "cmtt10*")
    return tuple(sorted(path for name in names for path in folder.glob(name) if "Display" not in path.name))


def fonts_in(folders: Sequence[str | Path] | None = None) -> tuple[Path, ...]:
    """Fonts below the folders that have every letter and digit, sorted; None: of this machine, and another has others.

    Raises:
        InputError: a folder that does not exist or holds no such font.
    """
    if folders is None:
        return _complete_fonts(None)
    found: list[Path] = []
    for folder in map(Path, folders):
        here = _complete_fonts([str(folder)])
        if not here:
            raise InputError(f"no fonts in {folder}" if folder.is_dir() else f"there is no folder {folder}")
        found += here
    return tuple(found)


def _complete_fonts(folders: list[str] | None) -> tuple[Path, ...]:
    from matplotlib.font_manager import findSystemFonts  # on a new machine it first looks at every font there is

    return tuple(path for path in sorted(map(Path, findSystemFonts(folders))) if _is_complete(path))


def _is_complete(path: Path) -> bool:
    from matplotlib.ft2font import FT2Font

    try:
        return {ord(character) for character in _CHARACTERS} <= set(FT2Font(str(path)).get_charmap())
    except (RuntimeError, OSError):
        return False


@lru_cache(maxsize=512)
def load_font(path: Path, size: float) -> ImageFont.FreeTypeFont:
    """A font at `size` pixels an em.

    Raises:
        InputError: it cannot be read.
    """
    try:
        return ImageFont.truetype(str(path), size)
    except OSError as error:
        raise InputError(f"{path} is no font that can be read: {error}") from error


def random_word(rng: np.random.Generator) -> str:
    """Two to eight letters and digits at random, or, as often, one to three syllables of the kind that English has.

    Syllables teach what letters stand beside each other without teaching words: those of the benchmark stay unseen.
    """
    if rng.random() < 0.5:
        syllables = (
            "".join(rng.choice(part) for part in (_ONSETS, _NUCLEI, _CODAS)) for _ in range(rng.integers(1, 4))
        )
        word = "".join(syllables)
    else:
        word = "".join(rng.choice(list(_CHARACTERS), size=rng.integers(2, 9)))
    return [word, word.upper(), word.lower(), word.capitalize()][rng.integers(4)]


def render_text(
    rng: np.random.Generator, height: int, width: int, font_paths: Sequence[Path] | None = None
) -> NDArray[np.float32]:
    """A picture (height, width, 3), sRGB in [0, 1], of lines of random words of one font, size and contrast.

    Half of the pictures are filled with words and half have wide gaps, half are straight and half turned by up to `TURN`
    degrees, and the light on the paper falls off towards one side.

    Args:
        font_paths: to choose from; None: those that come with matplotlib.
    """
    size = int(rng.integers(10, 41))
    paths = fonts() if font_paths is None else font_paths
    font = load_font(paths[int(rng.integers(len(paths)))], size)
    paper, ink = _colours(rng)
    turn = rng.uniform(-TURN, TURN) if rng.random() < 0.5 else 0.0
    gap = size * (0.5 if rng.random() < 0.5 else rng.uniform(0.5, 4))
    spacing = rng.uniform(1.1, 1.6) if rng.random() < 0.5 else rng.uniform(1.1, 2.6)
    # Wide and high enough that its corners stay outside when it is turned.
    margin = int(np.ceil(max(height, width) * np.sin(np.radians(abs(turn)))))
    picture = Image.new("RGB", (width + 2 * margin, height + 2 * margin), paper)
    draw = ImageDraw.Draw(picture)
    y = -float(rng.integers(size))
    while y < picture.height:
        x = -float(rng.integers(2 * size))
        while x < picture.width:
            word = random_word(rng)
            draw.text((x, y), word, fill=ink, font=font)
            x += font.getlength(word) + gap
        y += size * spacing
    if turn:
        picture = picture.rotate(turn, Image.Resampling.BICUBIC)
    picture = picture.crop((margin, margin, margin + width, margin + height))
    return np.asarray(picture, dtype=np.float32) / np.float32(255) * _light(rng, height, width)


def _light(rng: np.random.Generator, height: int, width: int) -> NDArray[np.float32]:
    """A ramp across the picture, (height, width, 1), from 1 at one side to no less than 0.6 at the other."""
    direction, fall = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.4)
    y, x = np.linspace(-1, 1, height)[:, None], np.linspace(-1, 1, width)[None]
    across = np.cos(direction) * x + np.sin(direction) * y
    return (1 - fall * (1 + across / np.sqrt(2)) / 2).astype(np.float32)[:, :, None]


def _colours(rng: np.random.Generator) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
    """Paper and ink at least 0.15 of full scale apart, either one the lighter."""
    light = rng.uniform(0.45, 1.0)
    dark = rng.uniform(0.0, light - 0.15)
    tint = rng.uniform(0.85, 1.0, size=(2, 3)) if rng.random() < 0.5 else np.ones((2, 3))
    levels = (255 * np.array([light, dark])[:, None] * tint).astype(int)
    order = (0, 1) if rng.random() < 0.7 else (1, 0)
    first, second = (tuple(int(v) for v in levels[i]) for i in order)
    return first, second  # type: ignore[return-value]
