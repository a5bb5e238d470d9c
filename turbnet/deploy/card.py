"""The model card: what a network states about itself, kept inside its ONNX file and beside it."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from turbnet._version import __version__
from turbnet.deploy.seal import UNSEALED
from turbnet.errors import InputError
from turbnet.media.atomic import atomic_path

PREFIX = "turbnet."


@dataclass(frozen=True)
class ModelCard:
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

    def to_metadata(self) -> dict[str, str]:
        """The card as ONNX `metadata_props`: keys `turbnet.<field>`, values JSON, the digest bare."""
        values = {name: json.dumps(value, allow_nan=False) for name, value in asdict(self).items()}
        return {PREFIX + name: value for name, value in (values | {"sha256": self.sha256}).items()}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> "ModelCard":
        """The card in a file's metadata.

        Raises:
            InputError: a field is missing or is not what this version of turbnet writes.
        """
        try:
            values = {item.name: metadata[PREFIX + item.name] for item in fields(cls)}
            sha256 = values.pop("sha256")
            card = {name: json.loads(value) for name, value in values.items()}
            return cls(**card | {"data_range": tuple(card["data_range"]), "sha256": sha256})
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(
                f"the model card cannot be read by turbnet {__version__} ({error}); "
                f"it was written by turbnet {metadata.get(PREFIX + 'version', 'of unknown version')}"
            ) from error

    def to_json(self) -> str:
        return json.dumps(asdict(self), indent=2) + "\n"

    def to_markdown(self, title: str) -> str:
        """The card for people."""
        rows = [
            ("architecture", self.architecture),
            ("configuration", ", ".join(f"{name} = {value}" for name, value in self.config.items())),
            ("input and output", f"(batch, frames, {self.channels}, height, width), RGB, sRGB-encoded, float32"),
            ("values", "{:g} to {:g}".format(*self.data_range)),
            ("height and width", f"multiples of {self.size_multiple}"),
            ("frames at a time", f"{self.frames} recommended, any number accepted"),
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
