"""Clips through a released network or a classical method: file in, file out."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from itertools import chain, islice, pairwise
from pathlib import Path
from time import perf_counter

import numpy as np

from turbnet._version import __version__
from turbnet.deploy.method import ClassicalMethod
from turbnet.deploy.session import Carried, Model
from turbnet.deploy.sidecar import Sidecar, identity
from turbnet.deploy.skipping import Skipped, Skipping
from turbnet.deploy.stream import stream, window_count
from turbnet.deploy.tiling import Tiling, packed
from turbnet.deploy.views import MOST, Views
from turbnet.errors import InputError, check_range
from turbnet.media.clip import open_clip, open_writer
from turbnet.media.live import STANDARD, is_live
from turbnet.media.source import BRIGHTEST
from turbnet.progress import progress_bar

TILE, OVERLAP = 320, 32


@dataclass(frozen=True)
class Restoration:
    """What `restore_clip` did.

    Args:
        frames: frames restored; height, width: their size, pixels.
        window: frames restored together.
        tiles: tiles of a frame.
        seconds: wall-clock time from the first frame read to the last one written.
        network_seconds: the part of it spent inside the network or the method.
        skipped: what the network was spared.
        left_out: codecs of the sound that the destination does not take.
        resumed: the frames of them that an earlier run had restored.
    """

    frames: int
    height: int
    width: int
    window: int
    tiles: int
    seconds: float
    network_seconds: float
    skipped: Skipped
    left_out: list[str]
    resumed: int

    @property
    def milliseconds_a_frame(self) -> float:
        return 1e3 * self.seconds / max(self.frames - self.resumed, 1)


def restore_frames(
    frames: Iterable[np.ndarray],
    network: Callable[[np.ndarray], np.ndarray],
    tiling: Tiling,
    window: int,
) -> Iterator[np.ndarray]:
    """Restore a clip frame by frame, in memory that depends on the window and not on the length of the clip.

    Args:
        frames: (H, W, C) each, float32 in [0, 1], sRGB-encoded.
        network: (1, T, C, h, w) -> (1, T, C, h, w), a `Model` for instance.
        window: frames restored together; successive windows share a quarter of it.

    Yields:
        (H, W, C) float32 in [0, 1], one for each frame that comes in.

    Raises:
        InputError: a frame holds values that are not finite or far outside [0, 1], or the network returned such.
    """

    def planes() -> Iterator[np.ndarray]:
        for index, frame_HWC in enumerate(frames):
            if not np.isfinite(frame_HWC).all():
                raise InputError(f"frame {index} holds values that are not numbers (NaN or infinite); repair the clip")
            if (largest := np.abs(frame_HWC).max()) > BRIGHTEST:
                raise InputError(f"frame {index} holds values up to {largest:g}; scale floating-point frames to 0 to 1")
            yield np.moveaxis(packed(frame_HWC), -1, 0)

    restored = stream(planes(), partial(tiling.apply, network), window, window_overlap(window))
    for index, restored_CHW in enumerate(restored):
        if not np.isfinite(restored_CHW).all():
            raise InputError(f"the network returned values that are not finite for frame {index}")
        yield np.moveaxis(restored_CHW, 0, -1).clip(0, 1)


class FrameByFrame:
    """A network that carries something along, given the tiles of one frame after the other, always in the same order.

    Args:
        model: whose card names what is carried.
        tiles: of a frame.
    """

    def __init__(self, model: Model, tiles: int) -> None:
        self._model = model
        self._carried: list[Carried] = [{}] * tiles
        self._turn = 0

    def __call__(self, frames_BTCHW: np.ndarray) -> np.ndarray:
        """The next tile's frames restored, (1, T, C, h, w)."""
        batch, _, _, height, width = frames_BTCHW.shape
        carried = self._carried[self._turn] or self._model.nothing(batch, height, width)
        restored_BTCHW, self._carried[self._turn] = self._model.step(frames_BTCHW, carried)
        self._turn = (self._turn + 1) % len(self._carried)
        return restored_BTCHW


Ready = Model | ClassicalMethod | FrameByFrame | Skipping | Views


def ready(
    model: Model | ClassicalMethod,
    tiles: int,
    skipped: Skipped | None = None,
    maps: Model | None = None,
    views: int = 1,
) -> Ready:
    """What `restore_frames` takes for one pass over a clip of so many tiles a frame; what is carried starts from nothing.

    Args:
        skipped: counts what a model that takes whole windows is spared; None: it is spared nothing.
        maps: says of single frames what needs nothing.
        views: of every window through a model that takes whole windows: `views_of`.
    """
    if isinstance(model, ClassicalMethod):
        return model
    if model.card.carried:
        return FrameByFrame(model, tiles)
    network = model if views == 1 else Views(model, views)
    return network if skipped is None else Skipping(network, tiles, skipped, model.card.size_multiple, maps)


def tiling_of(model: Model | ClassicalMethod, tile: int = TILE, overlap: int | None = None) -> Tiling:
    """How frames are cut for a model; overlap None: 32 pixels, or a quarter of a tile smaller than 128."""
    return Tiling(tile, min(OVERLAP, tile // 4) if overlap is None else overlap, model.card.size_multiple)


def window_of(model: Model | ClassicalMethod, window: int | None = None) -> int:
    """Frames restored together; None: what the card recommends.

    Raises:
        InputError: out of range, or more than one of a model that goes frame by frame.
    """
    if model.card.carried and window not in (None, 1):
        raise InputError(f"window = {window}: the model goes frame by frame")
    return int(check_range("window", model.card.frames if window is None else window, 1, 1000, "frames"))


def views_of(model: Model | ClassicalMethod, views: int = 1) -> int:
    """Views of every window, see `turbnet.deploy.views`.

    Raises:
        InputError: out of range, or several of what does not take whole windows through a network.
    """
    if views != 1 and (isinstance(model, ClassicalMethod) or model.card.carried):
        raise InputError(
            f"views = {views}: a method without learning and a model that goes frame by frame have one view"
        )
    return int(check_range("views", views, 1, MOST))


def restore_array(
    frames_THWC: np.ndarray,
    model: Model | ClassicalMethod,
    skipped: Skipped | None = None,
    window: int | None = None,
    views: int = 1,
) -> np.ndarray:
    """A whole clip in memory, float32 (T, H, W, C) in [0, 1], as `turbnet restore` would; see `ready`."""
    tiling = tiling_of(model)
    network = ready(model, tiling.count(*frames_THWC.shape[1:3]), skipped, views=views_of(model, views))
    return np.stack(list(restore_frames(frames_THWC, network, tiling, window_of(model, window))))


def window_overlap(window: int) -> int:
    """Frames that successive windows share."""
    return window // 4


def restore_clip(
    source: str | Path,
    destination: str | Path,
    model: Model | ClassicalMethod,
    *,
    crop: tuple[int, int, int, int] | None = None,
    tile: int = TILE,
    overlap: int | None = None,
    window: int | None = None,
    passes: int = 1,
    views: int = 1,
    skip: bool = False,
    maps: Model | None = None,
    resume: bool = False,
    quiet: bool = True,
    ended: Callable[[], bool] = lambda: False,
) -> Restoration:
    """Restore the clip in the file `source` into the file `destination`, which appears whole or not at all.

    Args:
        source: file, folder or pattern of images, `-` for standard input, a named pipe, a camera.
        destination: as the ending says; `-` for standard output, which takes frame by frame.
        crop: (left, top, width, height), pixels; None: the whole frame.
        tile: greatest side of a tile, pixels.
        overlap: of neighbouring tiles, pixels; None: 32, or a quarter of a tile smaller than 128.
        window: frames restored together; None: what the model's card recommends, 50 for a classical method.
        passes: how often; a second pass restores what the first one left, for blur stronger than a network can undo at once.
        views: of every window: so many times a network restores it, turned and mirrored, see `turbnet.deploy.views`.
        skip: spare a model the tiles that need nothing, see `turbnet.deploy.skipping`.
        maps: with `skip`, the network that says what single frames need.
        resume: keep restored frames beside the destination until it is whole, and go on with those that are there, see
            `turbnet.deploy.sidecar`; the clip is the same, byte for byte.
        quiet: no progress bar on standard error.
        ended: whether a pipe or a camera is to end; what has come in by then is restored and written.

    Raises:
        InputError: the source cannot be read, the destination cannot be written, a parameter is out of range.
    """
    tiling, window = tiling_of(model, tile, overlap), window_of(model, window)
    passes = int(check_range("passes", passes, 1, 8))
    views = views_of(model, views)
    step = window - window_overlap(window)
    count, inside, start, skipped = 0, 0.0, perf_counter(), Skipped()
    with ExitStack() as stack:
        clip = stack.enter_context(open_clip(source, crop, model.threads, ended))
        info = clip.info
        sidecar = None
        if resume:
            _check_resumable(Path(source), Path(destination), model, skip)
            settings = {
                "version": __version__,
                "source": identity(Path(source)),
                "crop": crop,
                "network": model.digest if isinstance(model, Model) else model.card.architecture,
                "tile": tiling.tile,
                "overlap of tiles": tiling.overlap,
                "window": window,
                "passes": passes,
                "views": views,
            }
            sidecar = stack.enter_context(Sidecar(Path(destination), settings, step, info.grey))
        sound = stack.enter_context(clip.sound())
        within = sidecar.folder if sidecar else None
        writer = stack.enter_context(
            open_writer(destination, info.fps, info.grey, model.threads, info.tick, sound, within)
        )
        progress = stack.enter_context(progress_bar(quiet))
        tiles = tiling.count(info.height, info.width)
        kept = sidecar.frames if sidecar else 0
        # Each pass starts a window early, to fade from, and drops what came out before the next one starts.
        starts = [max(kept - step * (passes - number), 0) for number in range(passes + 1)]
        windows = [window_count((info.frames or 0) - first, window, window_overlap(window)) for first in starts[:-1]]
        task = progress.add_task("restoring", total=sum(windows) * tiles if info.frames else None)

        def timed(frames_BTCHW: np.ndarray, whole: Ready) -> np.ndarray:
            nonlocal inside
            began = perf_counter()
            if isinstance(whole, ClassicalMethod):  # a window of one takes minutes, so the bar moves within it
                restored_BTCHW = whole(frames_BTCHW, lambda share: progress.advance(task, share))
            else:
                restored_BTCHW = whole(frames_BTCHW)
                progress.advance(task)
            inside += perf_counter() - began
            return restored_BTCHW

        times: deque[Fraction | None] = deque()  # of the frames that have come in and not gone out

        def incoming() -> Iterator[np.ndarray]:
            for time, frame_HWC in clip.timed():
                times.append(time)
                yield frame_HWC

        frames: Iterable[np.ndarray] = incoming()
        if sidecar:
            held = []
            for restored_HWC, frame_HWC in zip(sidecar.kept(), frames, strict=False):  # the longer one last
                if count >= starts[0]:
                    held.append(frame_HWC)
                writer.write(restored_HWC, times.popleft())
                count += 1
            frames = chain(held, frames)
        for first, following in pairwise(starts):
            whole = ready(model, tiles, skipped if skip else None, maps, views)
            restored = restore_frames(frames, partial(timed, whole=whole), tiling, window)
            frames = islice(restored, following - first, None)
        if sidecar:
            frames = stack.enter_context(closing(sidecar.keep(frames)))
        for frame_HWC in frames:
            writer.write(frame_HWC, times.popleft())
            count += 1
    seconds = perf_counter() - start
    left_out = list(sound.left_out.values()) if sound else []
    return Restoration(
        count, info.height, info.width, min(window, count), tiles, seconds, inside, skipped, left_out, kept
    )


def _check_resumable(source: Path, destination: Path, model: Model | ClassicalMethod, skip: bool) -> None:
    if is_live(source) or destination == STANDARD:
        raise InputError("a pipe or a camera cannot be resumed; leave --resume out")
    if model.card.carried:
        raise InputError("a model that goes frame by frame carries the whole clip along; leave --resume out")
    if skip:
        raise InputError("what is skipped depends on all that came before; leave --resume or --skip out")
