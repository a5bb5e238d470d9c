r"""How much of the text in a picture can be read, by any recogniser.

.. math::
    \mathrm{CER} = \frac{\sum_b d(r_b, t_b)}{\sum_b |t_b|}, \qquad
    \text{word accuracy} = \frac{\#\{b : r_b = t_b\}}{\#\{b\}}

with t_b the transcript of box b, r_b what was read in it and d the edit distance: the least number of characters to
insert, delete or replace (V. I. Levenshtein, Sov. Phys. Dokl. 10, 707 (1966)). As is usual for text in scenes, letters
and digits count, their case, spaces and punctuation do not. An accuracy counts boxes, whether words or lines; the CER of
one who reads more than there is may exceed 1.
"""

import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from turbnet.data.boxes import TextBox
from turbnet.errors import InputError, check_range

Picture = NDArray[np.floating[Any]]

MARGIN = 0.15
"""Pixels kept around a box, fraction of its height: recognisers read worse where letters touch the edge."""


class TextReader(Protocol):
    """Reads the boxes of a picture."""

    def __call__(self, picture: Picture, boxes: Sequence[TextBox]) -> list[str]:
        """What stands in each box of a picture (H, W, 3), sRGB in [0, 1]; the boxes' own texts are not looked at."""
        ...


@dataclass(frozen=True)
class TextScore:
    """What was read right; scores add up.

    Attributes:
        errors: edits between what was read and the transcripts, or how many are expected.
        characters: letters and digits of the transcripts.
        right: boxes read without an error, or how many are expected.
        boxes: all of them.
    """

    errors: float = 0
    characters: int = 0
    right: float = 0
    boxes: int = 0

    def __add__(self, other: "TextScore") -> "TextScore":
        return TextScore(
            self.errors + other.errors,
            self.characters + other.characters,
            self.right + other.right,
            self.boxes + other.boxes,
        )

    @property
    def character_error_rate(self) -> float:
        return self.errors / self.characters

    @property
    def word_accuracy(self) -> float:
        return self.right / self.boxes


def edit_distance(first: str, second: str) -> int:
    """Characters to insert, delete or replace to make `second` of `first`."""
    row = list(range(len(second) + 1))
    for i, a in enumerate(first, 1):
        diagonal, row[0] = row[0], i
        for j, b in enumerate(second, 1):
            diagonal, row[j] = row[j], min(row[j] + 1, row[j - 1] + 1, diagonal + (a != b))
    return row[-1]


def normalise(text: str) -> str:
    """The letters and digits of a text in lower case; full-width and other compatible forms in their plain one."""
    return "".join(character for character in unicodedata.normalize("NFKC", text).casefold() if character.isalnum())


def compare_texts(read: Sequence[str], transcripts: Sequence[str]) -> TextScore:
    """Score of what was read against the transcripts, one by one.

    Raises:
        InputError: there are not as many of one as of the other, or a transcript has neither letter nor digit.
    """
    if len(read) != len(transcripts):
        raise InputError(f"{len(read)} texts were read but there are {len(transcripts)} transcripts")
    score = TextScore()
    for text, transcript in zip(map(normalise, read), map(normalise, transcripts), strict=True):
        if not transcript:
            raise InputError("a transcript has neither a letter nor a digit; leave its box out")
        errors = edit_distance(text, transcript)
        score += TextScore(errors, len(transcript), int(errors == 0), 1)
    return score


def crop_boxes(picture: Picture, boxes: Sequence[TextBox], margin: float = MARGIN) -> list[Picture]:
    """The picture (H, W, C) inside each box and `margin` of its height around it, as far as the picture goes.

    Raises:
        InputError: a box does not lie inside the picture, the picture holds NaN.
    """
    check_range("margin", margin, 0, 2)
    if picture.ndim != 3:
        raise InputError(f"text is read in one picture (H, W, C), not in an array of shape {picture.shape}")
    if not np.isfinite(picture).all():
        raise InputError("cannot read text in a picture that holds NaN or infinite pixels")
    height, width = picture.shape[:2]
    crops = []
    for box in boxes:
        if box.left < 0 or box.top < 0 or box.left + box.width > width or box.top + box.height > height:
            raise InputError(
                f"the box of {box.text!r} ({box.left},{box.top},{box.width},{box.height}) does not lie inside the "
                f"picture of {width}x{height} pixels"
            )
        wide = box.grown(round(margin * box.height))
        rows = slice(max(wide.top, 0), min(wide.top + wide.height, height))
        crops.append(picture[rows, max(wide.left, 0) : min(wide.left + wide.width, width)])
    return crops


def score_text(picture: Picture, boxes: Sequence[TextBox], reader: TextReader) -> TextScore:
    """What `reader` reads in the boxes of a picture (H, W, 3), sRGB in [0, 1], against their transcripts.

    Raises:
        InputError: as `crop_boxes` and `compare_texts`.
    """
    return compare_texts(reader(picture, boxes), [box.text for box in boxes])
