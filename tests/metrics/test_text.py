import numpy as np
import pytest
from torchmetrics.functional.text import char_error_rate

from turbnet.data.boxes import TextBox
from turbnet.errors import InputError
from turbnet.metrics.text import TextScore, compare_texts, crop_boxes, edit_distance, normalise, score_text


@pytest.mark.parametrize(
    ("first", "second", "distance"),
    [("", "", 0), ("abc", "", 3), ("", "ab", 2), ("kitten", "sitting", 3), ("flaw", "lawn", 2), ("same", "same", 0)],
)
def test_edit_distance(first, second, distance):
    assert edit_distance(first, second) == distance
    assert edit_distance(second, first) == distance


def test_edit_distance_is_a_metric():
    rng = np.random.default_rng(0)
    words = ["".join(rng.choice(list("abc"), size=rng.integers(0, 7))) for _ in range(20)]
    for a in words:
        for b in words:
            assert edit_distance(a, b) >= (a != b)
            assert edit_distance(a, b) <= max(len(a), len(b))
            assert all(edit_distance(a, c) <= edit_distance(a, b) + edit_distance(b, c) for c in words[:5])


def test_rate_agrees_with_torchmetrics():
    rng = np.random.default_rng(1)
    read, truth = (
        ["".join(rng.choice(list("abcdef12"), size=rng.integers(1, 9))) for _ in range(50)] for _ in range(2)
    )
    score = compare_texts(read, truth)
    assert score.character_error_rate == pytest.approx(float(char_error_rate(read, truth)), abs=1e-6)


def test_normalise():
    assert normalise(" Ab-1.２ ") == "ab12"
    assert normalise("Straße") == "strasse"


def test_scores_add_up():
    score = compare_texts(["Hello", "w0rld"], ["hello!", "WORLD"])
    assert score == TextScore(errors=1, characters=10, right=1, boxes=2)
    assert score.character_error_rate == 0.1
    assert score.word_accuracy == 0.5
    assert score + score == TextScore(2, 20, 2, 4)


@pytest.mark.parametrize(
    ("read", "truth", "says"), [(["a"], [], "1 texts were read but"), (["a"], ["!?"], "neither a letter nor a digit")]
)
def test_what_cannot_be_compared(read, truth, says):
    with pytest.raises(InputError, match=says):
        compare_texts(read, truth)


def test_crops_keep_a_margin_inside_the_picture():
    picture = np.arange(20 * 30, dtype=float).reshape(20, 30, 1)
    inner, corner = crop_boxes(picture, [TextBox(10, 5, 6, 10, "w"), TextBox(0, 0, 4, 10, "w")], margin=0.2)
    np.testing.assert_array_equal(inner, picture[3:17, 8:18])
    np.testing.assert_array_equal(corner, picture[0:12, 0:6])


@pytest.mark.parametrize(
    ("picture", "box", "says"),
    [
        (np.zeros((20, 30, 3)), TextBox(25, 0, 6, 5, "w"), r"the box of 'w' \(25,0,6,5\) does not lie inside"),
        (np.zeros((20, 30, 3)), TextBox(0, -1, 6, 5, "w"), "does not lie inside"),
        (np.zeros((20, 30)), TextBox(0, 0, 6, 5, "w"), "not in an array of shape"),
        (np.full((20, 30, 3), np.nan), TextBox(0, 0, 6, 5, "w"), "NaN"),
    ],
)
def test_bad_input(picture, box, says):
    with pytest.raises(InputError, match=says):
        crop_boxes(picture, [box])


def test_any_reader_will_do():
    boxes = [TextBox(0, 0, 10, 5, "yes"), TextBox(0, 6, 10, 5, "no")]
    assert score_text(np.zeros((20, 30, 3)), boxes, lambda picture, boxes: ["YES"] * len(boxes)) == TextScore(
        3, 5, 1, 2
    )
