import numpy as np
import pytest

from turbnet.deploy.tiling import Axis, Tiling, packed, raised_cosine
from turbnet.errors import ParameterError


def identity(frames_BTCHW):
    return frames_BTCHW


@pytest.mark.parametrize("n", [1, 2, 7, 32])
def test_ramp_and_its_mirror_image_sum_to_one(n):
    ramp = raised_cosine(n)
    np.testing.assert_allclose(ramp + ramp[::-1], 1, atol=1e-15)
    assert np.all(np.diff(ramp) > 0)


@pytest.mark.parametrize("multiple", [1, 4, 8])
@pytest.mark.parametrize(("tile", "overlap"), [(32, 0), (32, 8), (64, 24), (61, 13), (256, 32)])
def test_weights_sum_to_one_and_cover_everything(tile, overlap, multiple):
    for size in range(4 * multiple, 700, multiple * 3):
        axis = Axis.cover(size, tile, overlap, multiple)
        assert axis.length % multiple == 0
        assert axis.length <= tile
        assert axis.starts[0] == 0
        assert axis.starts[-1] + axis.length == size
        overlaps = axis.length - np.diff(axis.starts)
        assert np.all(overlaps >= overlap - 1)  # starts are rounded
        total = np.zeros(size)
        for start, weights in zip(axis.starts, axis.weights, strict=True):
            total[start : start + axis.length] += weights
        np.testing.assert_allclose(total, 1, atol=1e-14)
        assert np.all(axis.weights > 0)


def test_little_is_computed_twice():
    axis = Axis.cover(300, tile=256, overlap=32, multiple=4)
    assert (len(axis.starts), axis.length) == (2, 168)


@pytest.mark.parametrize("size", [(1, 1), (3, 3), (1, 200), (2, 31), (33, 32), (97, 131), (64, 64), (101, 300)])
@pytest.mark.parametrize(("tile", "overlap", "multiple"), [(32, 8, 4), (64, 12, 8), (64, 0, 1), (512, 64, 16)])
def test_identity_returns_the_picture(size, tile, overlap, multiple):
    tile = max(tile, 4 * multiple)
    frames_TCHW = np.random.default_rng(0).random((2, 3, *size), np.float32)
    shapes = []

    def network(frames_BTCHW):
        shapes.append(frames_BTCHW.shape)
        return frames_BTCHW

    tiling = Tiling(tile, overlap, multiple)
    np.testing.assert_allclose(tiling.apply(network, frames_TCHW), frames_TCHW, atol=1e-6)
    assert len(shapes) == tiling.count(*size)
    assert len(set(shapes)) == 1
    assert all(4 * multiple <= side <= tile and side % multiple == 0 for side in shapes[0][3:])


def test_small_pictures_pass_in_one_piece():
    assert Tiling(256, 32, 8).count(256, 256) == 1
    assert Tiling(256, 32, 8).count(257, 256) == 2


def test_padding_is_by_reflection():
    seen = []
    frames_TCHW = np.arange(3, dtype=np.float32).reshape(1, 1, 1, 3)
    Tiling(32, 4, 2).apply(lambda frames: seen.append(frames) or frames, frames_TCHW)
    np.testing.assert_array_equal(seen[0][0, 0, 0], np.tile([0, 1, 2, 1, 0, 1, 2, 1], (8, 1)))


def test_eight_bits_are_kept_as_such_and_lose_nothing():
    levels = np.arange(256, dtype=np.uint8).reshape(1, 16, 16)
    frame = levels / np.float32(255)
    assert packed(frame).dtype == np.uint8
    (seen,) = Tiling(64, 8, 4).apply(lambda frames: frames, [packed(frame)])
    assert seen.dtype == np.float32
    np.testing.assert_array_equal(seen, frame)


@pytest.mark.parametrize("value", [1e-7, 0.5, -1 / 255, 256 / 255, 1e6, 1 / 65535])
def test_what_is_not_of_eight_bits_stays_what_it_is(value):
    frame = np.full((1, 4, 4), value, np.float32)
    assert packed(frame) is frame


def test_frames_of_both_kinds_in_one_window():
    frames = [np.full((1, 32, 32), 200 / np.float32(255), np.float32), np.full((1, 32, 32), 0.3, np.float32)]
    for seen, frame in zip(Tiling(32, 8, 4).apply(lambda x: x, [packed(f) for f in frames]), frames, strict=True):
        np.testing.assert_allclose(seen, frame, rtol=1e-6)


def test_tiles_that_disagree_leave_no_seam():
    """Each tile is answered with its own number: the picture must pass smoothly from one to the next."""
    answers = iter([0.0, 1.0])

    def network(frames_BTCHW):
        return np.full_like(frames_BTCHW, next(answers))

    restored = Tiling(64, 16, 4).apply(network, np.zeros((1, 1, 64, 112), np.float32))[0][0, 0]
    assert restored[:40].max() == 0
    assert restored[-40:].min() == 1
    # The steepest step of a raised cosine over n pixels is pi / (2 n).
    assert np.diff(restored).min() >= 0
    assert np.diff(restored).max() < np.pi / (2 * 16) * 1.01


def test_output_may_have_other_channels():
    restored = Tiling(32, 8, 4).apply(lambda frames: frames[:, :, :2] * 2, np.ones((3, 3, 50, 60), np.float32))
    np.testing.assert_allclose(restored, np.full((3, 2, 50, 60), 2), atol=1e-6)


@pytest.mark.parametrize(
    ("tile", "overlap", "multiple"),
    [(16, 0, 4), (0, 0, 4), (-5, 0, 4), (60, 0, 16), (64, 32, 4), (64, -1, 4), (9000, 9, 4)],
)
def test_senseless_tiles_are_refused(tile, overlap, multiple):
    with pytest.raises(ParameterError, match=r"tile|overlap"):
        Tiling(tile, overlap, multiple)
