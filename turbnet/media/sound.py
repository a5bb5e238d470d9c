"""Sound carried from one container to another, packet by packet, as it is."""

from collections import deque
from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import islice
from typing import Any


class Sound:
    """The sound streams of an open container.

    Args:
        container: open for reading.
        packets: of its sound streams as they lie in the file; empty where another reader of the container puts them into
            `waiting`.
    """

    def __init__(self, container: Any, packets: Iterable[Any] = ()) -> None:
        self.streams = list(container.streams.audio)
        self.waiting: deque[Any] = deque()
        self.left_out: dict[int, str] = {stream.index: stream.codec_context.name for stream in self.streams}
        """Codecs of the streams that nobody has copied, by their index."""
        self._packets = iter(packets)
        self._start = start_of(container)

    def until(self, time: float | Fraction) -> Iterator[Any]:
        """The packets not handed out yet that begin before `time`, seconds from the start of the container."""
        while packet := self._next():
            shift = round(self._start / packet.time_base)
            begin = packet.dts if packet.pts is None else packet.pts
            if (begin - shift) * packet.time_base >= time:
                return
            self.waiting.popleft()
            packet.dts -= shift
            packet.pts = begin - shift
            yield packet

    def mute(self) -> None:
        """Nobody listens: nothing waits any more."""
        self.waiting = deque(maxlen=0)
        self._packets = iter(())

    def _next(self) -> Any:
        if not self.waiting:
            self.waiting.extend(islice(self._packets, 1))
        return self.waiting[0] if self.waiting else None


def start_of(container: Any) -> Fraction:
    """When the first of the pictures and sounds of a container begins, seconds on its own clock."""
    streams = [*container.streams.video[:1], *container.streams.audio]
    starts = [stream.start_time * stream.time_base for stream in streams if stream.start_time is not None]
    return min(starts, default=Fraction(0))
