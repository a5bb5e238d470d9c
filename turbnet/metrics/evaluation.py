"""Scores of whole clips, read frame by frame; what `turbnet evaluate` prints and writes.

Against a reference: PSNR, SSIM and, where frames are large enough, MS-SSIM, as they are; beside them the shift of the
whole clip, estimated once between the means over time, and PSNR and SSIM with this fixed shift undone (the made-up edge
left out). Without one: jitter, flicker, sharpness, noise. Text: what is read in boxes, frame by frame and in the mean
over time. Means over time are taken in linear light, as a long exposure would.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import zip_longest
from typing import Any

import numpy as np
from numpy.typing import NDArray

from turbnet.data.boxes import TextBox
from turbnet.errors import InputError, ParameterError
from turbnet.media.clip import ClipReader
from turbnet.media.colour import to_linear, to_srgb
from turbnet.metrics.fidelity import MS_SSIM_SIZE, ms_ssim, psnr, ssim
from turbnet.metrics.registration import estimate_shift, margin_of, undo_shift
from turbnet.metrics.sharpness import noise_level, sharpness
from turbnet.metrics.stability import flicker, jitter
from turbnet.metrics.text import TextScore, score_text
from turbnet.report import Row

Frame = NDArray[np.float32]
TextScorer = Callable[[Frame, Sequence[TextBox]], TextScore]
Watch = Callable[[Iterable[Any], str], Iterable[Any]]
"""Wraps what is iterated over, to show how far it has come: (frames, description) -> frames."""

_UNITS = {"psnr": "dB"}

SHIFT_ERROR = 0.05
"""Shifts up to this, in pixels, are within the error of their estimate."""

SCORERS = ("builtin", "rapidocr", "rapidocr-find", "proxy")


@dataclass(frozen=True)
class Figure:
    """A measure of a clip: its value in each frame, or the one value that a whole clip has."""

    measure: str
    unit: str
    values: Sequence[float]
    per_frame: bool = True
    low_is_bad: bool = True

    @property
    def mean(self) -> float:
        return float(np.mean(self.values))

    @property
    def worst(self) -> tuple[float, int]:
        """The worst frame's value and its index."""
        index = int(np.argmin(self.values) if self.low_is_bad else np.argmax(self.values))
        return float(self.values[index]), index


@dataclass
class ClipScores:
    """The figures of one clip."""

    name: str
    frames: int
    figures: list[Figure] = field(default_factory=list)

    def rows(self) -> Iterator[Row]:
        yield Row(f"{self.name} frames", self.frames)
        for figure in self.figures:
            name = f"{self.name} {figure.measure}"
            yield Row(name, figure.mean, figure.unit)
            if figure.per_frame:
                worst, index = figure.worst
                yield Row(f"{name} worst", worst, figure.unit)
                yield Row(f"{name} worst frame", index)


class TemporalMean:
    """Mean over time of the frames that pass by, in linear light."""

    def __init__(self) -> None:
        self._sum: Any = 0.0
        self._count = 0

    def add(self, frame: Frame) -> None:
        self._sum = self._sum + to_linear(frame.astype("float64"))
        self._count += 1

    def frame(self) -> Frame:
        return to_srgb(self._sum / self._count).astype("float32")


def pairs(clip: ClipReader, target: ClipReader) -> Iterator[tuple[Frame, Frame]]:
    """Each frame with its reference; a reference of one frame stands beside every frame.

    Raises:
        InputError: one is longer than the other.
    """
    if target.info.frames == 1:
        still = next(iter(target))
        yield from ((frame, still) for frame in clip)
        return
    for index, (frame, reference) in enumerate(zip_longest(clip, target)):
        if frame is None or reference is None:
            shorter, longer = (clip, target) if frame is None else (target, clip)
            raise InputError(f"{shorter.path} ends after {index} frames but {longer.path} has more; cut one to match")
        yield frame, reference


def against_reference(
    name: str, make_pairs: Callable[[], Iterable[tuple[Frame, Frame]]], border: int, watch: Watch
) -> ClipScores:
    """Scores of frames against their references.

    Args:
        name: of the clip, for the report.
        make_pairs: starts another pass through frames and references.
        border: pixels left out at each edge.
        watch: shows the progress.

    Raises:
        InputError: as `psnr` and `ssim`.
    """
    measures: dict[str, Callable[..., Any]] = {"psnr": psnr, "ssim": ssim}
    scores: dict[str, list[float]] = {}
    first, second = TemporalMean(), TemporalMean()
    for frame, reference in watch(make_pairs(), name):
        if not scores and min(frame.shape[:2]) - 2 * border >= MS_SSIM_SIZE:
            measures["ms-ssim"] = ms_ssim
        for measure, function in measures.items():
            scores.setdefault(measure, []).append(float(function(frame, reference, border)))
        first.add(frame)
        second.add(reference)
    figures = [Figure(measure, _UNITS.get(measure, ""), values) for measure, values in scores.items()]
    figures += _registered(make_pairs, first.frame(), second.frame(), border, watch, name)
    return ClipScores(name, len(scores["psnr"]), figures)


def _registered(
    make_pairs: Callable[[], Iterable[tuple[Frame, Frame]]],
    mean: Frame,
    reference_mean: Frame,
    border: int,
    watch: Watch,
    name: str,
) -> list[Figure]:
    """The fixed shift of a clip and, where it is more than the estimate's error, the scores with it undone."""
    inner = np.s_[border : mean.shape[0] - border, border : mean.shape[1] - border]
    try:
        shift = estimate_shift(mean[inner], reference_mean[inner])
    except InputError:  # too small or too flat
        return []
    figures = [Figure(f"shift {axis}", "pixels", [value], False) for axis, value in zip("xy", shift, strict=True)]
    margin = max(border, margin_of(shift))
    if max(map(abs, shift)) <= SHIFT_ERROR or min(mean.shape[:2]) - 2 * margin < 11:
        return figures
    scores = [
        (float(psnr(back, reference, margin)), float(ssim(back, reference, margin)))
        for frame, reference in watch(make_pairs(), f"{name}, registered")
        for back in [undo_shift(frame, shift)]
    ]
    values = zip(*scores, strict=True)
    return figures + [
        Figure(f"registered {measure}", _UNITS.get(measure, ""), list(value))
        for measure, value in zip(("psnr", "ssim"), values, strict=True)
    ]


def without_reference(name: str, clip: ClipReader, watch: Watch) -> ClipScores:
    """Jitter and flicker of a clip; sharpness and noise of its frames and of their mean over time.

    Jitter is left out where there is one frame only or nothing to register.
    """
    mean, levels, sharp, noise = TemporalMean(), [], [], []
    for frame in watch(clip, name):
        mean.add(frame)
        levels.append(float(frame.mean()))
        sharp.append(sharpness(frame))
        noise.append(noise_level(frame))
    still = mean.frame()
    figures = [
        Figure("sharpness", "1/pixel^2", sharp),
        Figure("noise", "", noise, low_is_bad=False),
        Figure("sharpness of the mean", "1/pixel^2", [sharpness(still)], False),
        Figure("flicker", "", [flicker(np.array(levels))], False),
    ]
    with suppress(InputError):  # a still, or too flat
        figures.append(Figure("jitter", "pixels", [jitter(watch(clip, f"{name}, jitter"), still)], False))
    return ClipScores(name, len(levels), figures)


@dataclass(frozen=True)
class TextFigures:
    """What was read in a clip: one score a frame, and the one of the mean over time. They add up, frame by frame."""

    frames: tuple[TextScore, ...]
    mean: TextScore

    def __add__(self, other: "TextFigures") -> "TextFigures":
        """Of two clips: of all frames there are, the shorter clip's last one again and again."""
        length = max(len(self.frames), len(other.frames))
        first, second = (each.frames + each.frames[-1:] * (length - len(each.frames)) for each in (self, other))
        return TextFigures(tuple(a + b for a, b in zip(first, second, strict=True)), self.mean + other.mean)

    def scores(self, name: str) -> ClipScores:
        frames, mean = self.frames, self.mean
        return ClipScores(
            name,
            len(frames),
            [
                Figure("cer", "", [score.character_error_rate for score in frames], low_is_bad=False),
                Figure("word accuracy", "", [score.word_accuracy for score in frames]),
                Figure("words", "", [mean.boxes], False),
                Figure("words read", "", [score.right for score in frames]),
                Figure("cer of the mean", "", [mean.character_error_rate], False),
                Figure("word accuracy of the mean", "", [mean.word_accuracy], False),
                Figure("words read in the mean", "", [mean.right], False),
            ],
        )


def read_texts(name: str, clip: ClipReader, boxes: Sequence[TextBox], scorer: TextScorer, watch: Watch) -> TextFigures:
    """What `scorer` makes of the boxes of each frame and of the mean over time.

    Raises:
        InputError: a box does not lie inside the frames.
    """
    mean, scores = TemporalMean(), []
    for frame in watch(clip, f"{name}, text"):
        mean.add(frame)
        scores.append(scorer(frame, boxes))
    return TextFigures(tuple(scores), scorer(mean.frame(), boxes))


def text_scorer(name: str) -> TextScorer:
    """The scorer of a name in `SCORERS`.

    Raises:
        ParameterError: there is none of that name.
        InputError: the extra it needs is not installed.
    """
    if name == "proxy":
        from turbnet.metrics.ocr_proxy import score_legibility

        return score_legibility
    if name == "builtin":
        from turbnet.metrics.ocr_builtin import Recogniser

        return partial(score_text, reader=Recogniser.load())
    if name in ("rapidocr", "rapidocr-find"):
        from turbnet.metrics.ocr_rapid import RapidReader

        return partial(score_text, reader=RapidReader(find=name == "rapidocr-find"))
    raise ParameterError(f"there is no reader {name}; choose one of {', '.join(SCORERS)}")
