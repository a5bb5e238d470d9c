"""Properties of pure functions, on examples that hypothesis looks for: always the same ones."""

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from turbnet.cli.options import parse_crop
from turbnet.deploy.stream import stream, window_count
from turbnet.deploy.tiling import Axis, raised_cosine
from turbnet.errors import InputError, ParameterError, check_range
from turbnet.media.colour import to_linear, to_srgb
from turbnet.metrics.fidelity import psnr
from turbnet.optics.zernike import noll_to_nm
from turbnet.simulate.tilt import splat

steadily = settings(derandomize=True, deadline=None, max_examples=50, database=None)


def pictures(low: float = 0.0, high: float = 1.0) -> st.SearchStrategy[np.ndarray]:
    """(H, W, C), float64."""
    shapes = st.tuples(st.integers(1, 9), st.integers(1, 9), st.integers(1, 3))
    return arrays.arrays(np.float64, shapes, elements=st.floats(low, high, allow_subnormal=False))


@steadily
@given(pictures(-1.0, 1e6))
def test_srgb_and_linear_values_undo_each_other(values):
    np.testing.assert_allclose(to_linear(to_srgb(values)), values, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(to_srgb(to_linear(values)), values, rtol=1e-6, atol=1e-6)


@steadily
@given(pictures(0.0, 1.0))
def test_the_srgb_curve_rises(values):
    known = np.unique(values)
    assert (np.diff(to_linear(known)) >= 0).all()
    assert (np.diff(to_srgb(known)) >= -1e-7).all()  # the standard's two pieces miss each other by 3e-8


@steadily
@given(st.integers(1, 500))
def test_raised_cosines_of_neighbours_sum_to_one(n):
    rising = raised_cosine(n)
    assert (np.diff(rising) > 0).all()
    np.testing.assert_allclose(rising + rising[::-1], 1.0, atol=1e-12)


@steadily
@given(st.integers(4, 400), st.integers(1, 16), st.integers(32, 300), st.data())
def test_tiles_cover_every_pixel_with_weights_that_sum_to_one(cells, multiple, tile, data):
    """Of all that `Tiling` accepts: a padded side is at least four multiples."""
    tile = max(tile, 4 * multiple)
    overlap = data.draw(st.integers(0, tile // 2 - multiple))
    size = cells * multiple
    axis = Axis.cover(size, tile, overlap, multiple)
    total = np.zeros(size)
    for start, weight in zip(axis.starts, axis.weights, strict=True):
        total[start : start + axis.length] += weight
    np.testing.assert_allclose(total, 1.0, atol=1e-12)
    assert axis.length % multiple == 0
    assert axis.length <= tile
    assert axis.starts[0] == 0
    assert axis.starts[-1] + axis.length == size
    assert (axis.weights >= 0).all()


@steadily
@given(st.integers(0, 60), st.integers(1, 20), st.data())
def test_a_stream_gives_every_frame_once_and_in_order(count, window, data):
    overlap = data.draw(st.integers(0, window // 2))
    lengths = []

    def restore(frames):
        lengths.append(len(frames))
        return np.stack(frames)

    clip = [np.full((1, 1, 1), float(t), np.float32) for t in range(count)]
    out = [float(frame[0, 0, 0]) for frame in stream(iter(clip), restore, window, overlap)]
    np.testing.assert_allclose(out, np.arange(count), atol=1e-5)
    assert max(lengths, default=0) <= window
    if count:
        assert len(lengths) == window_count(count, window, overlap)
        assert lengths[-1] == min(count, window)


@steadily
@given(pictures(), st.integers(0, 2**32 - 1))
def test_psnr_does_not_care_which_is_which(picture, seed):
    other = np.random.default_rng(seed).random(picture.shape)
    assert psnr(picture, other) == psnr(other, picture)
    assert psnr(picture, picture) == np.inf
    assert psnr(picture, other) == pytest.approx(psnr(1 - picture, 1 - other), abs=1e-6)


def nm_to_noll(n: int, m: int, sine: bool) -> int:
    """The index of the sine (odd) or cosine (even) of m in the order n, by counting."""
    first = n * (n + 1) // 2 + 1
    found = [j for j in range(first, first + n + 1) if noll_to_nm(j) == (n, m)]
    return next(j for j in found if m == 0 or (j % 2 == 1) == sine)


@steadily
@given(st.integers(1, 3000))
def test_noll_indices_there_and_back(j):
    n, m = noll_to_nm(j)
    assert 0 <= m <= n
    assert (n - m) % 2 == 0
    assert nm_to_noll(n, m, j % 2 == 1) == j


@steadily
@given(st.integers(1, 9), st.integers(1, 9), st.floats(0.0, 12.0, allow_subnormal=False), st.integers(0, 1000))
def test_splatting_keeps_light_that_stays_in_the_picture(height, width, pixels, seed):
    generator = torch.Generator().manual_seed(seed)
    margin = int(pixels) + 3
    scene = torch.zeros(1, 1, height + 2 * margin, width + 2 * margin, dtype=torch.float64)
    scene[..., margin : margin + height, margin : margin + width] = torch.rand(height, width, generator=generator)
    shift = pixels * (2 * torch.rand(1, 2, *scene.shape[-2:], generator=generator, dtype=torch.float64) - 1)
    assert float(splat(scene, shift).sum()) == pytest.approx(float(scene.sum()), rel=1e-9)


@steadily
@given(st.tuples(*[st.integers(-(10**6), 10**6)] * 4))
def test_a_crop_is_read_as_it_was_written(crop):
    assert parse_crop(",".join(map(str, crop))) == crop


@steadily
@given(st.text(max_size=20))
def test_anything_else_than_a_crop_is_refused(text):
    try:
        parts = [int(part) for part in text.split(",")]
    except ValueError:
        parts = []
    assume(len(parts) != 4)
    with pytest.raises(InputError, match="--crop"):
        parse_crop(text)


@steadily
@given(*[st.floats(allow_nan=True, allow_infinity=True, allow_subnormal=False)] * 3)
def test_a_range_holds_what_lies_in_it_and_nothing_else(value, low, high):
    if low <= value <= high:
        assert check_range("x", value, low, high) == value
    else:
        with pytest.raises(ParameterError, match="x = "):
            check_range("x", value, low, high, "m")
