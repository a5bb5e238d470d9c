import numpy as np
import pytest
from PIL import Image

from turbnet.data.text import fonts, fonts_in, load_font, random_word, render_text
from turbnet.data.words import WORDS
from turbnet.errors import InputError


def test_fonts_come_with_matplotlib():
    assert len(fonts()) >= 10
    assert all(path.is_file() for path in fonts())


def test_fonts_of_this_machine_can_be_written_with():
    for path in fonts_in()[:3]:
        assert np.ptp(render_text(np.random.default_rng(0), 64, 64, [path])) > 0.05


def test_fonts_of_folders(tmp_path):
    """Those with letters; in subfolders too."""
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "a.ttf").write_bytes(fonts()[0].read_bytes())
    (tmp_path / "b.ttf").write_bytes(b"no font")
    assert fonts_in([tmp_path]) == (tmp_path / "deep" / "a.ttf",)
    assert fonts_in([]) == ()
    (tmp_path / "deep" / "a.ttf").unlink()
    with pytest.raises(InputError, match="no fonts in"):
        fonts_in([tmp_path])
    with pytest.raises(InputError, match="there is no folder"):
        fonts_in([tmp_path / "none"])


def test_the_fonts_given_are_used():
    one, other = (render_text(np.random.default_rng(5), 64, 64, [path]) for path in (fonts()[0], fonts()[-1]))
    assert not np.array_equal(one, other)


def test_bad_font(tmp_path):
    (tmp_path / "none.ttf").write_bytes(b"no font")
    with pytest.raises(InputError, match="is no font that can be read"):
        load_font(tmp_path / "none.ttf", 12)


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
    words = [random_word(np.random.default_rng(seed)) for seed in range(400)]
    assert {len(word) for word in words} >= set(range(2, 11))
    assert all(word.isalnum() and word.isascii() for word in words)
    # Half are letters and digits at random, 58 % of those with a digit: 0.29, three standard errors either way.
    assert abs(np.mean([any(letter.isdigit() for letter in word) for word in words]) - 0.29) < 0.07
    # Half of the words are syllables, hardly one of them a word of the benchmark.
    assert np.mean([word.lower() in WORDS for word in words]) < 0.02


def test_lines_are_turned():
    """The strongest gradient of straight text is along the axes; of text turned by 6 to 12 degrees it is not."""
    pictures = [render_text(np.random.default_rng(seed), 256, 256).mean(-1) for seed in range(60)]
    angles = []
    for picture in pictures:
        # Orientation of the lines: the row projection is sharpest when the picture is turned back.
        trials = np.arange(-14, 15, 2)
        image = Image.fromarray((255 * picture).astype(np.uint8))
        sums = [np.asarray(image.rotate(-t, Image.Resampling.BILINEAR))[64:192, 64:192].sum(1) for t in trials]
        angles.append(trials[np.argmax([np.abs(np.diff(s.astype(float))).sum() for s in sums])])
    straight = np.mean(np.array(angles) == 0)
    assert 0.4 < straight < 0.8
    assert np.max(np.abs(angles)) >= 8


def test_the_light_falls_off():
    """Towards either side, by at most two fifths; the median of a third of the picture is paper, mostly."""
    pictures = [render_text(np.random.default_rng(seed), 96, 96).mean(-1) for seed in range(60)]
    ratios = np.log([np.median(p[:, :32]) / np.median(p[:, 64:]) for p in pictures])
    assert (ratios > 0.1).any()
    assert (ratios < -0.1).any()
    assert np.median(np.abs(ratios)) < -np.log(0.6)
