"""Released networks by name."""

from importlib import resources
from pathlib import Path

from turbnet.errors import InputError
from turbnet.media.guard import reading

DEFAULT = "s"
"""The released network that restores unless another is asked for."""

RECOGNISER, MAPS = "recogniser", "maps"
"""Names of the released networks that read text and that say what is uncertain; they restore nothing."""


def released_models() -> dict[str, Path]:
    """File of each released network that restores, by name."""
    return {path.stem: path for path in sorted(_folder().glob("*.onnx")) if path.stem not in (RECOGNISER, MAPS)}


def released_maps() -> Path:
    """File of the network that says where a frame needs restoration."""
    return _folder() / f"{MAPS}.onnx"


def released_recogniser() -> Path:
    """File of the network that reads text."""
    return _folder() / f"{RECOGNISER}.onnx"


def _folder() -> Path:
    return Path(str(resources.files("turbnet.weights")))


def find_model(name_or_path: str | Path) -> Path:
    """The file of a model: a released one by its name, any other by its path.

    Raises:
        InputError: neither a released model nor a file; lists the released ones.
    """
    models = released_models()
    if str(name_or_path) in models:
        return models[str(name_or_path)]
    path = Path(name_or_path)
    with reading(path):  # a name may be too long
        if path.is_file():
            return path
    names = ", ".join(models) or "none in this installation"
    raise InputError(f"there is no model {name_or_path}: neither a file nor a released model ({names})")
