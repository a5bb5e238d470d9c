"""Networks that restore images and video seen through atmospheric turbulence."""

from typing import TYPE_CHECKING, Any

from turbnet._version import __version__

if TYPE_CHECKING:
    from turbnet.deploy.restorer import Restorer

__all__ = ["Restorer", "__version__"]


def __getattr__(name: str) -> Any:
    """`Restorer` brings onnxruntime with it, so it is imported when first asked for."""
    if name == "Restorer":
        from turbnet.deploy.restorer import Restorer

        return Restorer
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
