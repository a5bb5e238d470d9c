"""Networks that restore images and video seen through atmospheric turbulence."""

from turbnet._version import __version__

__all__ = ["__version__"]
