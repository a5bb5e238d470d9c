"""Classical methods where a network could stand: no file, no weights, the same windows and tiles."""

from collections.abc import Callable

import numpy as np

from turbnet.deploy.card import ModelCard
from turbnet.deploy.session import available_cores
from turbnet.errors import check_range
from turbnet.media.colour import to_linear, to_srgb

WINDOW = 50
"""Frames a method sees at once unless told otherwise."""


class ClassicalMethod:
    """A method of `turbnet.classical.methods`, called as a network is.

    Args:
        name: of the method.
        threads: processor threads; None: all cores.

    Raises:
        InputError: there is no such method; lists those there are.
    """

    def __init__(self, name: str, threads: int | None = None) -> None:
        from turbnet.classical.methods import find_method  # torch, which networks do without

        self._restore = find_method(name)
        threads = available_cores() if threads is None else threads
        self.threads = int(check_range("threads", threads, 1, 1024))
        self.card = ModelCard(architecture=name, config={}, size_multiple=1, frames=WINDOW)

    def __call__(self, frames_BTCHW: np.ndarray, report: Callable[[float], object] = lambda share: None) -> np.ndarray:
        """Restore clips (B, T, C, H, W), sRGB-encoded in [0, 1]; `report` is told the share of the work just done."""
        restored = []
        for frames_TCHW in frames_BTCHW:
            linear = to_linear(np.ascontiguousarray(np.moveaxis(frames_TCHW, 1, -1), np.float32))
            clear = self._restore(linear, self.threads, lambda share: report(share / len(frames_BTCHW)))
            restored.append(np.moveaxis(to_srgb(clear.clip(0, 1)), -1, 1))
        return np.stack(restored).astype(np.float32)
