"""Turbulence on a clip of any length, one frame in memory at a time."""

from collections.abc import Iterable, Iterator
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from turbnet.media.colour import to_linear, to_srgb
from turbnet.simulate.simulator import Simulator, Turbulent

Frame = NDArray[np.float32]


def simulate_stream(
    scenes: Iterable[Frame],
    simulator: Simulator,
    seed: int = 0,
    wind: tuple[float, float] | None = (2.0, 0.0),
    frame_rate: float = 30.0,
    shutter: float = 1.0,
    grey: bool = False,
) -> Iterator[Turbulent]:
    """Look at each frame of a clip through one atmosphere that moves with the wind.

    Args:
        scenes: clean frames (H, W, 3), sRGB in [0, 1].
        simulator: for pictures of that size; with its sensor.
        seed: of the atmosphere and of the noise.
        wind: velocity across the path, m/s; None gives every frame an atmosphere of its own.
        frame_rate: frames a second.
        shutter: part of a frame's time in which it is exposed, over as many moments as the sensor averages.
        grey: the three channels are equal, so that one is enough.

    Yields:
        one frame at a time with its truth: (1, 1, C, H, W), sRGB in [0, 1], C = 1 if grey.
    """
    velocity = None if wind is None else torch.tensor(wind)
    for number, scene in enumerate(scenes):
        picture = torch.from_numpy(np.ascontiguousarray(scene[..., :1] if grey else scene)).permute(2, 0, 1)[None, None]
        with torch.no_grad():
            draw = simulator.draw([seed], 1, velocity, frame_rate, start=number, shutter=shutter)
            noise_seed = int(np.random.SeedSequence([seed, number, 1]).generate_state(1)[0])
            seen = simulator(to_linear(picture), draw, noise_seed)
            frames = seen.frames if simulator.sensor.gamma else to_srgb(seen.frames.clamp(0, 1))
            yield Turbulent(
                frames=frames.clamp(0, 1),
                tilt_only=to_srgb(seen.tilt_only.clamp(0, 1)),
                tilt=seen.tilt,
                draw=draw,
                _blur_only=partial(_encoded_blur_only, seen),
            )


def _encoded_blur_only(seen: Turbulent) -> torch.Tensor:
    with torch.no_grad():
        return to_srgb(seen.blur_only.clamp(0, 1))


def to_frame(picture_11CHW: torch.Tensor) -> Frame:
    """A frame (H, W, 3) of a stream's picture, grey repeated."""
    frame = picture_11CHW[0, 0].permute(1, 2, 0).numpy()
    return np.repeat(frame, 3, axis=2) if frame.shape[2] == 1 else frame
