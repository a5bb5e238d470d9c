"""The model card: what a network states about itself, kept inside its ONNX file and beside it."""

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Self

from turbnet._version import __version__
from turbnet.deploy.seal import UNSEALED
from turbnet.errors import InputError, check_range
from turbnet.media.atomic import atomic_path

PREFIX = "turbnet."
MAPS = "uncertainty maps"
"""Architecture on the card of a network that restores nothing but says where there is something to restore."""

_LATER = ("carried",)  # fields that older files lack
_CARRIED = 2**15  # greatest number of values carried for each pixel of a frame: what m needs to remember 1000 frames


class Card(ABC):
    """What every card does; the dataclasses below say what stands on one."""

    config: dict[str, Any]
    seed: int | None
    notes: dict[str, Any]
    version: str
    sha256: str

    @abstractmethod
    def rows(self) -> list[tuple[str, Any]]:
        """Name and value of what stands on this kind of card alone, for people."""

    def _values(self) -> dict[str, Any]:
        return asdict(self)  # type: ignore[call-overload]

    def to_metadata(self) -> dict[str, str]:
        """The card as ONNX `metadata_props`: keys `turbnet.<field>`, values JSON, the digest bare."""
        values = {name: json.dumps(value, allow_nan=False) for name, value in self._values().items()}
        return {PREFIX + name: value for name, value in (values | {"sha256": self.sha256}).items()}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> Self:
        """The card in a file's metadata.

        Raises:
            InputError: a field is missing or is not what this version of turbnet writes.
        """
        try:
            values = {
                item.name: metadata[PREFIX + item.name]
                for item in fields(cls)  # type: ignore[arg-type]
                if item.name not in _LATER or PREFIX + item.name in metadata
            }
            sha256 = values.pop("sha256")
            return cls(**{name: json.loads(value) for name, value in values.items()} | {"sha256": sha256})
        except (KeyError, ValueError, TypeError, RecursionError) as error:
            raise InputError(
                f"the model card cannot be read by turbnet {__version__} ({error}); "
                f"it was written by turbnet {metadata.get(PREFIX + 'version', 'of unknown version')}"
            ) from error

    def to_json(self) -> str:
        return json.dumps(self._values(), indent=2) + "\n"

    def to_markdown(self, title: str) -> str:
        """The card for people."""
        name, *more = self.rows()
        rows = [
            name,
            ("configuration", ", ".join(f"{name} = {value}" for name, value in self.config.items())),
            *more,
            ("seed", self.seed),
            ("written by", f"turbnet {self.version}"),
            ("SHA-256", f"`{self.sha256}`"),
            *self.notes.items(),
        ]
        table = "\n".join(f"| {name} | {str(value).replace('|', '/')} |" for name, value in rows)
        return f"# {title}\n\n| | |\n|---|---|\n{table}\n"

    def write_beside(self, model: str | Path) -> None:
        """Write the card as JSON and as Markdown beside the file of the model."""
        model = Path(model)
        for suffix, text in ((".json", self.to_json()), (".md", self.to_markdown(model.stem))):
            with atomic_path(model.with_suffix(suffix)) as temporary:
                temporary.write_text(text)


@dataclass(frozen=True)
class ModelCard(Card):
    """What a network is and what it asks of its input, `frames` (batch, frames, channels, height, width).

    Args:
        architecture: name under which `turbnet.nets.build` knows the network.
        config: arguments it was built with, plain values.
        size_multiple: height and width must be multiples of this, pixels.
        frames: recommended length of the temporal window, frames; any length >= 1 is accepted.
        data_range: least and greatest pixel value, sRGB-encoded.
        channels: 3 for R, G, B.
        seed: of the training; None when it is unknown.
        notes: data, training time, measured quality and whatever else a reader should know; plain values.
        version: of the turbnet that wrote the file.
        sha256: digest of the file, see `turbnet.deploy.seal`; zeros until there is a file.
        carried: further inputs and outputs of a network that goes frame by frame, by name: `shape` between batch and height,
            and `scale`, the fraction of the height and width it has; zero before the first frame. Empty: the network takes
            whole windows.

    Raises:
        InputError: a field of another kind, ParameterError: one out of range. A card may come from anywhere.
    """

    architecture: str
    config: dict[str, Any]
    size_multiple: int
    frames: int
    data_range: tuple[float, float] = (0.0, 1.0)
    channels: int = 3
    seed: int | None = None
    notes: dict[str, Any] = field(default_factory=dict)
    version: str = __version__
    sha256: str = UNSEALED
    carried: dict[str, dict[str, Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        low, high = self.data_range
        object.__setattr__(self, "data_range", (low, high))  # JSON knows lists only
        _check(architecture=self.architecture, version=self.version, kind=str)
        _check(config=self.config, notes=self.notes, carried=self.carried, kind=dict)
        _check(low=low, high=high, kind=(int, float))
        _check_whole("size_multiple", self.size_multiple, 1, 1024)
        _check_whole("frames", self.frames, 1, 1000)
        _check_whole("channels", self.channels, 1, 64)
        for name, spec in self.carried.items():
            _check(**{name: spec}, kind=dict)
            _check_whole(f"scale of {name}", spec["scale"], 1, 64)
            for size in spec["shape"]:
                _check_whole(f"shape of {name}", size, 1, 2**16)
            check_range(f"values a pixel of {name}", math.prod(spec["shape"]) / spec["scale"] ** 2, 0, _CARRIED)

    def carried_shapes(self, batch: int, height: int, width: int) -> dict[str, tuple[int, ...]]:
        """Shape of each part that is carried, for frames of this size."""
        return {
            name: (batch, *spec["shape"], height // spec["scale"], width // spec["scale"])
            for name, spec in self.carried.items()
        }

    def rows(self) -> list[tuple[str, Any]]:
        return [
            ("architecture", self.architecture),
            ("input and output", f"(batch, frames, {self.channels}, height, width), RGB, sRGB-encoded, float32"),
            ("values", "{:g} to {:g}".format(*self.data_range)),
            ("height and width", f"multiples of {self.size_multiple}"),
            ("frames at a time", f"{self.frames} recommended, any number accepted"),
            *((f"carried {name}", _carried(**spec)) for name, spec in self.carried.items()),
        ]


def _check(*, kind: type | tuple[type, ...], **values: Any) -> None:
    for name, value in values.items():
        if not isinstance(value, kind):
            raise InputError(f"{name} = {value!r:.100} is of the wrong kind")


def _check_whole(name: str, value: Any, low: int, high: int) -> None:
    _check(**{name: value}, kind=int)
    check_range(name, value, low, high)


def _carried(shape: Sequence[int], scale: int) -> str:
    sides = ("height", "width") if scale == 1 else (f"height / {scale}", f"width / {scale}")
    return f"(batch, {', '.join(map(str, shape))}, {', '.join(sides)}), zero at first, returned with `next_` before its name"


@dataclass(frozen=True)
class RecogniserCard(Card):
    """What a reader of text is and what it asks of its input, `lines` (batch, 1, line_height, width).

    Args:
        config: arguments the network was built with, plain values.
        alphabet: characters of classes 1, 2, ...; class 0 is none.
        line_height: pixels.
        stride: the width must be a multiple of it, pixels.
        seed, notes, version, sha256: as in `ModelCard`.
    """

    config: dict[str, Any]
    alphabet: str
    line_height: int
    stride: int
    seed: int | None = None
    notes: dict[str, Any] = field(default_factory=dict)
    version: str = __version__
    sha256: str = UNSEALED

    def __post_init__(self) -> None:
        _check(alphabet=self.alphabet, version=self.version, kind=str)
        _check(config=self.config, notes=self.notes, kind=dict)
        _check_whole("line_height", self.line_height, 1, 1024)
        _check_whole("stride", self.stride, 1, 1024)

    def rows(self) -> list[tuple[str, Any]]:
        return [
            ("architecture", "recogniser"),
            ("input", f"(batch, 1, {self.line_height}, width), grey, sRGB-encoded, float32, 0 to 1"),
            ("output", f"(batch, width / {self.stride}, {1 + len(self.alphabet)}), logarithms of probabilities"),
            ("classes", f"none, then {self.alphabet}"),
        ]
