import numpy as np
import pytest

from turbnet.data.clips import CleanClips
from turbnet.data.text_scenes import (
    KINDS,
    TextScenes,
    carry_points,
    homography,
    render_scene,
)
from turbnet.errors import ParameterError


def scene(seed, kind=None, height=120, width=200, **options):
    return render_scene(np.random.default_rng(seed), height, width, kind, **options)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [(120, 200), (97, 133), (8, 9), (1, 1)])
def test_a_picture_in_range_with_boxes_inside(kind, size):
    made = scene(0, kind, *size)
    assert made.picture.shape == (*size, 3)
    assert made.picture.dtype == np.float32
    assert 0 <= made.picture.min() <= made.picture.max() <= 1
    for box in made.boxes:
        assert box.left >= 0
        assert box.top >= 0
        assert box.left + box.width <= size[1]
        assert box.top + box.height <= size[0]
    if size[0] > 90:
        assert made.boxes


def test_the_seed_decides():
    first, again, other = scene(1), scene(1), scene(2)
    assert np.array_equal(first.picture, again.picture)
    assert first.boxes == again.boxes
    assert not np.array_equal(first.picture, other.picture)


@pytest.mark.parametrize("kind", ["words", "lines", "ladder"])
@pytest.mark.parametrize("seed", [3, 4, 5])
def test_all_ink_lies_in_the_boxes_and_fills_them(kind, seed):
    made = scene(seed, kind, contrast=(0.5, 0.9))
    grey = made.picture.mean(-1)
    paper = np.median(grey)
    ink = np.abs(grey - paper) > 0.05
    inside = np.zeros_like(ink)
    for box in made.boxes:
        window = np.s_[box.top : box.top + box.height, box.left : box.left + box.width]
        inside[window] = True
        rows, columns = np.nonzero(ink[window])
        # Perspective slants a box's outline, so ink may keep away from its upright rectangle, by a slant's height.
        assert np.ptp(columns) + 1 >= 0.9 * box.width - 2
        assert np.ptp(rows) + 1 >= 0.5 * box.height - 2
    assert not ink[~inside].any()


@pytest.mark.parametrize("contrast", [0.2, 0.5, 0.9])
def test_contrast_of_ink_and_paper(contrast):
    spread = [
        np.ptp(scene(seed, "words", size=(24, 30), contrast=(contrast, contrast)).picture, axis=(0, 1)).max()
        for seed in range(8)
    ]
    # A tint takes at most 15 % of a channel, and not the same of all.
    assert np.all(np.array(spread) <= contrast + 1e-6)
    assert np.all(np.array(spread) >= 0.85 * contrast - 1e-6)


def test_kinds_differ_in_text():
    assert all(" " not in box.text for box in scene(1, "words").boxes)
    assert any(" " in box.text for box in scene(1, "lines", width=400).boxes)
    assert all(box.text.isupper() or box.text.isdigit() for box in scene(1, "plates").boxes)
    ladder = scene(1, "ladder", 200, 200, size=(8, 30), perspective=0)
    heights = [box.height for box in ladder.boxes]
    assert len(heights) >= 5
    assert heights == sorted(heights, reverse=True)
    # Every row is 10^0.1 times smaller; heights are whole pixels, capitals such as Q reach lower.
    assert heights[0] / heights[5] == pytest.approx(10**0.5, rel=0.3)


def test_perspective_moves_corners_inwards_only():
    corners = np.array([[0, 0], [200, 0], [200, 120], [0, 120.0]])
    target = corners + np.array([[10, 5], [-3, 9], [-20, -1], [0, -12]])
    matrix = homography(corners, target)
    np.testing.assert_allclose(carry_points(matrix, corners), target, atol=1e-9)
    assert matrix[2, 2] == 1.0


def test_as_a_source_of_clips():
    source = TextScenes("lines")
    crop = source(np.random.default_rng(0), 40, 60)
    assert crop.shape == (40, 60, 3)
    clip = CleanClips(source, 2, 3, 40, 60)[0]["scene"]
    assert clip.shape == (3, 3, 40, 60)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"kind": "poem"}, "kind = 'poem' is none of words, lines, plates, ladder"),
        ({"size": (20.0, 10.0)}, "size = .* must be a range"),
        ({"contrast": (0.5, 1.5)}, "contrast = .* must be a range"),
        ({"perspective": 0.5}, "perspective = 0.5 is outside"),
        ({"height": 0}, "height = 0 pixels is outside"),
    ],
)
def test_bad_parameters(options, says):
    with pytest.raises(ParameterError, match=says):
        scene(0, **options)
