import sys

import numpy as np
import pytest
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter

from turbnet.data.boxes import TextBox
from turbnet.data.text import fonts, load_font
from turbnet.errors import InputError
from turbnet.metrics.ocr_rapid import RapidReader
from turbnet.metrics.text import score_text

TEXTS = ("tribes", "Window 7", "HARVEST")


@pytest.fixture(scope="module")
def page():
    """Three texts, their boxes, on a page of 300 x 180."""
    face = load_font(next(path for path in fonts() if path.stem == "DejaVuSans"), 26)
    canvas, boxes = Image.new("L", (300, 180), 230), []
    draw = ImageDraw.Draw(canvas)
    for row, text in enumerate(TEXTS):
        left, top, right, bottom = (round(v) for v in draw.textbbox((30, 15 + 55 * row), text, font=face))
        draw.text((30, 15 + 55 * row), text, fill=40, font=face)
        boxes.append(TextBox(left, top, right - left, bottom - top, text))
    return np.repeat(np.asarray(canvas, dtype=np.float32)[..., None] / 255, 3, axis=2), boxes


@pytest.mark.parametrize("find", [False, True])
def test_reads_sharp_text_and_not_what_is_gone(page, find):
    pytest.importorskip("rapidocr")
    picture, boxes = page
    reader = RapidReader(find)
    assert score_text(picture, boxes, reader).character_error_rate == 0
    assert score_text(gaussian_filter(picture, (9, 9, 0)), boxes, reader).character_error_rate > 0.7
    assert reader(np.full_like(picture, 0.5), boxes) == [""] * 3


def test_what_is_found_elsewhere_does_not_count(page):
    pytest.importorskip("rapidocr")
    picture, boxes = page
    swapped = [boxes[1], boxes[0]]
    assert [text.lower() for text in RapidReader(find=True)(picture, swapped)] == ["window 7", "tribes"]
    assert RapidReader(find=True)(picture, [TextBox(250, 150, 40, 20, "none")]) == [""]


def test_bad_input(page):
    pytest.importorskip("rapidocr")
    with pytest.raises(InputError, match="does not lie inside"):
        RapidReader()(page[0], [TextBox(280, 0, 40, 20, "none")])


def test_without_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "rapidocr", None)
    with pytest.raises(InputError, match=r"needs the extra 'ocr': pip install 'turbnet\[ocr\]'"):
        RapidReader()
