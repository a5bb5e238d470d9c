"""Clean pictures to look at through turbulence: those inside scikit-image, folders of a user, rendered text.

A source answers `source(rng, height, width)` with a crop (height, width, 3), float32 sRGB in [0, 1].
"""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from turbnet.data.pack import SUFFIX, PackedPicture, packed_pictures
from turbnet.data.text import render_text
from turbnet.errors import InputError
from turbnet.media.clip import open_clip

Picture = NDArray[np.float32]

EMBEDDED = {
    "train": (
        "brick.png",
        "camera.png",
        "chelsea.png",
        "coins.png",
        "grass.png",
        "gravel.png",
        "hubble_deep_field.jpg",
        "ihc.png",
        "moon.png",
        "motorcycle_left.png",
        "page.png",
        "rocket.jpg",
    ),
    "test": ("astronaut.png", "coffee.png"),
}
"""Pictures inside the scikit-image package; those of "test" are never trained on."""

_SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"}


class Source(Protocol):
    """A supply of clean crops."""

    def __call__(self, rng: np.random.Generator, height: int, width: int) -> Picture:
        """A crop (height, width, 3), float32 sRGB in [0, 1]."""
        ...


@lru_cache(maxsize=16)  # all embedded pictures; of a large folder, few enough for a small machine
def load_picture(path: Path | PackedPicture) -> Picture:
    """A picture in a file or a pack as (H, W, 3) float32 in [0, 1]; of several frames the first.

    Raises:
        InputError: it is no picture.
    """
    if isinstance(path, PackedPicture):
        return path.load()
    with open_clip(path) as clip:
        return next(iter(clip))


def embedded_paths(split: str) -> list[Path]:
    """Files of the embedded pictures of a split, "train" or "test"."""
    import skimage.data

    return [Path(skimage.data.__file__).parent / name for name in EMBEDDED[split]]


def folder_paths(folders: Sequence[str | Path]) -> list[Path | PackedPicture]:
    """Every picture below the folders, sorted; of a pack (`turbnet.data.pack`), every picture in it.

    Raises:
        InputError: a folder or a pack does not exist or holds no picture.
    """
    paths: list[Path | PackedPicture] = []
    for folder in map(Path, folders):
        if folder.suffix == SUFFIX and not folder.is_dir():
            paths += packed_pictures(folder)
            continue
        found = sorted(p for p in folder.rglob("*") if p.suffix.lower() in _SUFFIXES)
        if not found:
            raise InputError(f"no pictures in {folder}" if folder.is_dir() else f"there is no folder {folder}")
        paths += found
    return paths


class Pictures:
    """Random crops of pictures, turned, mirrored and reduced at random.

    Args:
        paths: image files, or pictures of a pack.
        scales: range of the factor by which a picture is reduced before cropping, at most 1. Reduction hides compression
            artefacts. A picture smaller than the crop is enlarged.
    """

    def __init__(self, paths: Sequence[Path | PackedPicture], scales: tuple[float, float] = (0.5, 1.0)) -> None:
        self.paths, self.scales = list(paths), scales

    def __call__(self, rng: np.random.Generator, height: int, width: int) -> Picture:
        picture = load_picture(self.paths[rng.integers(len(self.paths))])
        if rng.random() < 0.5:
            picture = np.ascontiguousarray(picture.transpose(1, 0, 2))
        scale = max(rng.uniform(*self.scales), height / picture.shape[0], width / picture.shape[1])
        if scale != 1:
            picture = _resize(picture, scale, height, width)
        top = rng.integers(picture.shape[0] - height + 1)
        left = rng.integers(picture.shape[1] - width + 1)
        crop = picture[top : top + height, left : left + width]
        return np.ascontiguousarray(crop[:: rng.choice((-1, 1)), :: rng.choice((-1, 1))])


class Text:
    """Rendered text; see `turbnet.data.text`.

    Args:
        font_paths: to choose from; None: those that come with matplotlib.
    """

    def __init__(self, font_paths: Sequence[Path] | None = None) -> None:
        self.font_paths = font_paths

    def __call__(self, rng: np.random.Generator, height: int, width: int) -> Picture:
        return render_text(rng, height, width, self.font_paths)


class Mixture:
    """One of several sources, by weight."""

    def __init__(self, sources: Sequence[Source], weights: Sequence[float]) -> None:
        self.sources = list(sources)
        self.weights = np.asarray(weights, dtype=float) / np.sum(weights)

    def __call__(self, rng: np.random.Generator, height: int, width: int) -> Picture:
        return self.sources[rng.choice(len(self.sources), p=self.weights)](rng, height, width)


def _resize(picture: Picture, scale: float, height: int, width: int) -> Picture:
    size = (max(height, round(picture.shape[0] * scale)), max(width, round(picture.shape[1] * scale)))
    image = Image.fromarray((picture * 255 + 0.5).astype(np.uint8))
    return np.asarray(image.resize(size[::-1], Image.Resampling.LANCZOS), dtype=np.float32) / np.float32(255)
