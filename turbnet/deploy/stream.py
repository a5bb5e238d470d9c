"""A clip of any length through a window of fixed length: overlapping windows, cross-faded, in bounded memory."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from turbnet.deploy.tiling import raised_cosine
from turbnet.errors import check_range


def stream(
    frames: Iterable[np.ndarray], restore: Callable[[list[np.ndarray]], Sequence[np.ndarray]], window: int, overlap: int
) -> Iterator[np.ndarray]:
    """Restore frames through a sliding window; yield one frame for each that comes in, in order.

    Windows start every `window - overlap` frames; where two meet, the later fades in as a raised cosine. The last one
    is shifted back to full length, and a clip shorter than the window is one window of its own length. At any time a
    few windows of frames are held, whatever the length of the clip.

    Args:
        frames: (C, H, W) each, float32.
        restore: T frames (C, H, W) -> T frames (C', H, W), for any T up to `window`.
        window: frames restored together, >= 1.
        overlap: frames that successive windows share, 0 to window/2.

    Raises:
        ParameterError: window or overlap is out of range.
    """
    check_range("window", window, 1, 1000, "frames")
    check_range("overlap", overlap, 0, window // 2, "frames")
    recent: deque[np.ndarray] = deque(maxlen=window)
    tail: list[np.ndarray] = []  # restored frames that the next window fades over
    fresh = 0  # frames not restored yet

    def restore_recent() -> list[np.ndarray]:
        restored = list(restore(list(recent))[-(len(tail) + fresh) :])
        for k, weight in enumerate(raised_cosine(len(tail)).astype(np.float32) if tail else ()):
            restored[k] = tail[k] + weight * (restored[k] - tail[k])
        return restored

    for frame in frames:
        recent.append(frame)
        fresh += 1
        if len(tail) + fresh == window:
            restored = restore_recent()
            tail, fresh = restored[window - overlap :], 0
            yield from restored[: window - overlap]
            del restored
    yield from restore_recent() if fresh else tail


def window_count(frames: int, window: int, overlap: int) -> int:
    """Number of windows that `stream` restores for a clip of `frames`."""
    return 1 + max(-(-(frames - window) // (window - overlap)), 0)
