import subprocess
import sys

import numpy as np
import pytest
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter

from turbnet.data.boxes import TextBox
from turbnet.data.text import fonts, load_font
from turbnet.data.words import WORDS
from turbnet.deploy.weights import released_models, released_recogniser
from turbnet.errors import InputError
from turbnet.metrics.ocr_builtin import Recogniser
from turbnet.metrics.text import TextScore, score_text


@pytest.fixture(scope="module")
def reader():
    return Recogniser.load()


def page(font, texts, size=22):
    """A picture with one text a row, and their boxes."""
    face = load_font(next(path for path in fonts() if path.stem == font), size)
    canvas, boxes = Image.new("L", (240, 40 * len(texts)), 230), []
    draw = ImageDraw.Draw(canvas)
    for row, text in enumerate(texts):
        left, top, right, bottom = (round(v) for v in draw.textbbox((12, 40 * row + 6), text, font=face))
        draw.text((12, 40 * row + 6), text, fill=40, font=face)
        boxes.append(TextBox(left, top, right - left, bottom - top, text))
    return np.repeat(np.asarray(canvas, dtype=np.float32)[..., None] / 255, 3, axis=2), boxes


@pytest.mark.parametrize("font", ["DejaVuSans", "DejaVuSerif", "STIXGeneral"])
def test_reads_sharp_text(reader, font):
    rng = np.random.default_rng(0)
    score = TextScore()
    for case in (str.lower, str.upper, str.capitalize):
        picture, boxes = page(font, [case(WORDS[i]) for i in rng.integers(len(WORDS), size=12)])
        score += score_text(picture, boxes, reader)
    # 36 words, 220 letters; the card says 3 % of the characters of sharp lines.
    assert score.character_error_rate < 0.08
    assert score.word_accuracy > 0.7


def test_blur_makes_it_worse(reader):
    picture, boxes = page("DejaVuSans", list(WORDS[10:22]))
    rates = [
        score_text(gaussian_filter(picture, (sigma, sigma, 0)), boxes, reader).character_error_rate
        for sigma in (0, 2.5, 4, 6)
    ]
    assert rates == sorted(rates)
    assert rates[0] < 0.05
    assert rates[-1] > 0.7


def test_polarity_and_grey(reader):
    picture, boxes = page("DejaVuSans", ["hello", "table"])
    assert reader(picture, boxes) == ["hello", "table"]
    assert reader(1 - picture, boxes) == ["hello", "table"]
    assert reader(picture[..., :1], boxes) == ["hello", "table"]
    assert reader(picture, []) == []


def test_tiny_boxes_are_no_trouble(reader):
    picture, _ = page("DejaVuSans", ["hello"])
    assert len(reader(picture, [TextBox(0, 0, 1, 1, "i"), TextBox(0, 0, 1, 40, "l"), TextBox(0, 0, 240, 1, "w")])) == 3


def test_the_file(reader):
    path = released_recogniser()
    assert path.stat().st_size < 2_000_000
    assert path.with_suffix(".json").read_text() == reader.card.to_json()
    assert path.with_suffix(".md").read_text() == reader.card.to_markdown(path.stem)
    assert path.stem not in released_models()


def test_not_a_recogniser(tmp_path):
    (tmp_path / "empty.onnx").write_bytes(b"")
    with pytest.raises(InputError, match=r"empty.onnx: not a turbnet model"):
        Recogniser.load(tmp_path / "empty.onnx")
    with pytest.raises(InputError, match="cannot read the recogniser"):
        Recogniser.load(tmp_path / "none.onnx")
    data = bytearray(released_recogniser().read_bytes())
    data[len(data) // 2] ^= 1
    with pytest.raises(InputError, match="was changed"):
        Recogniser(bytes(data))
    with pytest.raises(InputError, match="the model card cannot be read"):
        Recogniser.load(released_models()["s"])


def test_needs_no_torch():
    script = (
        "import sys; from turbnet.metrics.ocr_builtin import Recogniser; Recogniser.load()\n"
        "print([name for name in ('torch', 'lightning', 'rapidocr') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
