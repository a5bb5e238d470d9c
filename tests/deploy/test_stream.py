import tracemalloc

import numpy as np
import pytest

from turbnet.deploy.stream import stream, window_count
from turbnet.errors import ParameterError


def numbered(count):
    """Frames that hold their own index."""
    return (np.full((1, 2, 3), index, np.float32) for index in range(count))


@pytest.mark.parametrize(("window", "overlap"), [(1, 0), (2, 1), (5, 0), (6, 3), (12, 3), (12, 6)])
def test_identity_returns_every_frame_in_order(window, overlap):
    for count in (0, 1, 2, 5, 6, 7, 11, 12, 13, 21, 30, 31):
        lengths = []

        def restore(frames_TCHW, lengths=lengths):
            lengths.append(len(frames_TCHW))
            return frames_TCHW

        values = [frame[0, 0, 0] for frame in stream(numbered(count), restore, window, overlap)]
        np.testing.assert_allclose(values, np.arange(count), rtol=1e-6)
        # Every window is full unless the clip is shorter.
        assert set(lengths) <= {min(window, count)}
        if count:
            assert len(lengths) == window_count(count, window, overlap)


def test_windows_fade_into_each_other():
    """Each window answers with its own number: within the overlap the answer climbs as a raised cosine, no jumps."""
    calls = iter(range(10))

    def restore(frames_TCHW):
        return np.full_like(frames_TCHW, next(calls))

    values = np.array([frame[0, 0, 0] for frame in stream(numbered(22), restore, window=12, overlap=4)])
    ramp = np.sin(np.pi / 2 * (np.arange(4) + 0.5) / 4) ** 2
    np.testing.assert_allclose(values, [*[0] * 8, *ramp, *[1] * 4, *(1 + ramp), 2, 2], atol=1e-6)


def test_last_window_is_shifted_to_full_length():
    seen = []

    def restore(frames_TCHW):
        seen.append([int(frame[0, 0, 0]) for frame in frames_TCHW])
        return frames_TCHW

    list(stream(numbered(11), restore, window=6, overlap=2))
    assert seen == [[0, 1, 2, 3, 4, 5], [4, 5, 6, 7, 8, 9], [5, 6, 7, 8, 9, 10]]


def test_memory_depends_on_the_window_only():
    frame = np.zeros((3, 32, 32), np.float32)

    def peak(count):
        """Most memory in use while the clip streams, in frames."""
        tracemalloc.start()
        restored = sum(1 for _ in stream((frame.copy() for _ in range(count)), np.copy, window=8, overlap=2))
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert restored == count
        return most / frame.nbytes

    assert peak(40) < 5 * 8
    assert peak(3000) == pytest.approx(peak(40), abs=1)


def test_restored_frames_come_before_the_clip_ends():
    taken = 0

    def frames():
        nonlocal taken
        for frame in numbered(100):
            taken += 1
            yield frame

    next(stream(frames(), lambda frames_TCHW: frames_TCHW, window=8, overlap=2))
    assert taken == 8


@pytest.mark.parametrize(("window", "overlap"), [(0, 0), (-1, 0), (1, 1), (6, 4), (6, -1), (5000, 0)])
def test_senseless_windows_are_refused(window, overlap):
    with pytest.raises(ParameterError, match=r"window|overlap"):
        list(stream(numbered(3), lambda frames_TCHW: frames_TCHW, window, overlap))
