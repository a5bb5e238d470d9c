import numpy as np
import pytest

from turbnet.data.text import fonts, random_word, render_text


def test_fonts_come_with_matplotlib():
    assert len(fonts()) >= 10
    assert all(path.is_file() for path in fonts())


@pytest.mark.parametrize("size", [(64, 64), (33, 71), (8, 200), (1, 1)])
def test_a_picture_in_range(size):
    picture = render_text(np.random.default_rng(0), *size)
    assert picture.shape == (*size, 3)
    assert picture.dtype == np.float32
    assert picture.min() >= 0
    assert picture.max() <= 1


def test_the_seed_decides():
    first, again, other = (render_text(np.random.default_rng(seed), 48, 48) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_text_can_be_told_from_paper():
    """Ink and paper are a fifth of full scale apart, tinted by at most 15 %; hardly a picture shows no letter."""
    contrast = [np.ptp(render_text(np.random.default_rng(seed), 96, 96).mean(-1)) for seed in range(40)]
    assert np.mean(np.array(contrast) > 0.05) > 0.9
    assert np.median(contrast) > 0.2


def test_words():
    words = [random_word(np.random.default_rng(seed)) for seed in range(200)]
    assert {len(word) for word in words} == set(range(2, 9))
    assert all(word.isalnum() and word.isascii() for word in words)
