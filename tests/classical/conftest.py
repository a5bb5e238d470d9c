"""Simulated clips the classical methods are tried on: photographs of scikit-image through the simulator."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import skimage.data
import torch

from turbnet.atmosphere.path import OpticalPath
from turbnet.media.colour import to_linear, to_srgb
from turbnet.simulate.simulator import Simulator


@dataclass(frozen=True)
class Simulated:
    """A scene (H, W, 3), a clip of it (T, H, W, 3), both linear, and the true tilt (T, 2, H, W), pixels."""

    scene: np.ndarray
    frames: np.ndarray
    tilt: np.ndarray


def simulated(
    picture: np.ndarray, frames: int, d_over_r0: float = 3.0, noise: float = 0.005, seed: int = 1
) -> Simulated:
    """A clip of 8-bit frames."""
    scene = to_linear((picture / 255).astype(np.float32))
    simulator = Simulator(OpticalPath.from_d_over_r0(d_over_r0), *scene.shape[:2])
    planes = torch.from_numpy(np.moveaxis(scene, -1, 0).copy())[None, None]
    seen = simulator(planes, simulator.draw([seed], frames).centred())
    clip = np.moveaxis(seen.frames[0].numpy(), 1, -1)
    clip = clip + noise * np.random.default_rng(seed).standard_normal(clip.shape)
    coded = (to_srgb(clip.clip(0, 1)) * 255).round() / 255
    return Simulated(scene, to_linear(coded).astype(np.float32), seen.tilt[0].numpy())


@pytest.fixture(scope="session")
def simulated_clip() -> Callable[..., Simulated]:
    return simulated


@pytest.fixture(scope="session")
def still_clip() -> Simulated:
    return simulated(skimage.data.astronaut()[:160, 160:320], 12)


@pytest.fixture(scope="session")
def scene() -> np.ndarray:
    """A sharp scene, (128, 144, 3), linear."""
    return to_linear((skimage.data.astronaut()[20:148, 170:314] / 255).astype(np.float32))
