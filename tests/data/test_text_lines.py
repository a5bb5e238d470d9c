import pytest
import torch

from turbnet.data.text import fonts
from turbnet.data.text_lines import TextLines
from turbnet.data.words import ALPHABET


@pytest.fixture(scope="module")
def lines():
    return TextLines(fonts()[:4], batch=12, seed=3)


def test_a_batch(lines):
    made = lines(0)
    count, channels, height, width = made.pictures.shape
    assert (count, channels, height) == (12, 1, 32)
    assert width % 4 == 0
    assert made.pictures.isfinite().all()
    assert -0.3 < made.pictures.min() < made.pictures.max() < 1.3
    assert len(made.texts) == 12
    assert all(text and set(text) <= set(ALPHABET) for text in made.texts)


def test_the_number_decides(lines):
    again = TextLines(fonts()[:4], batch=12, seed=3)(1)
    assert torch.equal(lines(1).pictures, again.pictures)
    assert lines(1).texts == again.texts
    assert lines(2).texts != lines(1).texts


def test_severity_takes_contrast_from_the_letters_and_leaves_the_text(lines):
    """Turbulence that grows: the same words, less gradient across them."""
    steps = [lines(4, severity) for severity in (0.0, 0.5, 1.0)]
    assert steps[0].texts == steps[1].texts == steps[2].texts
    energy = [step.pictures.diff(dim=-1).square().mean() for step in steps]
    assert energy[0] > 1.5 * energy[1] > 1.5 * energy[2]
