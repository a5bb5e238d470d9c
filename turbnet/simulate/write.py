"""From a file to a turbulent clip on disk, with its truth."""

import json
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import islice, repeat
from pathlib import Path
from typing import Any

import numpy as np
import torch

from turbnet.atmosphere.path import OpticalPath
from turbnet.errors import InputError, check_range
from turbnet.media.atomic import atomic_path
from turbnet.media.clip import open_clip, open_writer
from turbnet.media.colour import to_linear
from turbnet.progress import progress_bar
from turbnet.simulate.fit import Fit, fit_strength
from turbnet.simulate.plan import Plan
from turbnet.simulate.sensor import Sensor
from turbnet.simulate.simulator import Simulator
from turbnet.simulate.stream import Frame, simulate_stream, to_frame

STILL_FRAMES = 60
"""Frames made of a single picture unless told otherwise."""


def write_simulation(
    source: Path,
    output: Path,
    path: OpticalPath,
    frames: int | None = None,
    fps: float | None = None,
    wind: tuple[float, float] | None = (2.0, 0.0),
    sensor: Sensor | None = None,
    crop: tuple[int, int, int, int] | None = None,
    truth: Path | None = None,
    seed: int = 0,
    quiet: bool = False,
    shutter: float = 1.0,
    **simulator_options: Any,
) -> int:
    """Simulate turbulence on a picture or clip file and write the result; returns the number of frames.

    Args:
        source: picture, video, folder of frames, TIFF or GIF.
        output: clip to write.
        path: the turbulent path.
        frames: how many; None: 60 of a picture, all of a clip.
        fps: frames a second; None: the clip's own, 30 for a picture.
        wind: velocity across the path, m/s; None for independent frames.
        sensor: the camera; its `gamma` is set, files being sRGB.
        crop: left, top, width, height of the part to use, pixels.
        truth: folder to write tilt.npy (T, 2, H, W) in pixels, blur_strength.npy (T, H, W) in rad, the blur-only and
            tilt-only clips, and path.json.
        seed: of the atmosphere and the noise.
        quiet: no progress bar.
        shutter: part of a frame's time in which it is exposed.
        simulator_options: of `Simulator`: q, tolerance, wavelengths, outer_scale, boiling.

    Raises:
        InputError: the source cannot be read, has fewer frames than asked for, or an output cannot be written.
    """
    check_range("seed", seed, 0, 2**62)
    if frames is not None:
        check_range("frames", frames, 1, 10**6)
    with open_clip(source, crop=crop) as clip, progress_bar(quiet) as progress, ExitStack() as files:
        info = clip.info
        count = frames or (STILL_FRAMES if info.frames == 1 else info.frames)
        rate = fps or (30.0 if info.frames == 1 else info.fps)
        check_range("fps", rate, 0.1, 10_000)

        def scenes() -> Iterator[Frame]:
            if info.frames == 1:
                return islice(repeat(next(iter(clip))), count)
            return islice(iter(clip), count)

        camera = replace(sensor or Sensor(), gamma=True)
        simulator = Simulator(path, info.height, info.width, sensor=camera, **simulator_options)
        # The channels of a grey clip are the same, unless every one of them has a wavelength of its own.
        grey = info.grey and simulator.wavelengths is None
        out = files.enter_context(open_writer(output, fps=rate, grey=grey))
        if truth is not None:
            if count is None:
                raise InputError(f"{source} does not say how many frames it has; give --frames with --truth")
            folder = files.enter_context(atomic_path(truth))
            folder.mkdir()
            suffix = output.suffix
            blur_only = files.enter_context(open_writer(folder / f"blur_only{suffix}", fps=rate, grey=grey))
            tilt_only = files.enter_context(open_writer(folder / f"tilt_only{suffix}", fps=rate, grey=grey))
            tilts = np.lib.format.open_memmap(
                folder / "tilt.npy", mode="w+", dtype=np.float32, shape=(count, 2, info.height, info.width)
            )
            strengths = np.lib.format.open_memmap(
                folder / "blur_strength.npy", mode="w+", dtype=np.float32, shape=(count, info.height, info.width)
            )
            (folder / "path.json").write_text(json.dumps(_describe(path, rate, wind, seed), indent=2) + "\n")
        stream = simulate_stream(scenes(), simulator, seed, wind, rate, shutter, grey)
        written = 0
        for seen in progress.track(stream, total=count, description="simulating"):
            out.write(to_frame(seen.frames))
            if truth is not None:
                blur_only.write(to_frame(seen.blur_only))
                tilt_only.write(to_frame(seen.tilt_only))
                tilts[written] = seen.tilt[0, 0].numpy()
                strengths[written] = seen.blur_strength[0, 0, 0].numpy()
            written += 1
        if frames is not None and written < frames:
            raise InputError(f"{source} has {written} frames, {frames} were asked for")
    return written


FITTED_FRAMES, FITTED_SIZE = 40, 256
"""Of a clip whose strength is estimated: the first frames, and the middle of each."""


def fitted_strength(clip: Path, path: OpticalPath) -> Fit:
    """Strength of the turbulence in a clip of a still scene; see `turbnet.simulate.fit`.

    Args:
        clip: to read, its first 40 frames.
        path: its geometry.

    Raises:
        InputError: the clip cannot be read, or does not tell.
    """
    with open_clip(clip) as frames:
        taken = np.stack(list(islice(iter(frames), FITTED_FRAMES)))
    top, left = (max(n - FITTED_SIZE, 0) // 2 for n in taken.shape[1:3])
    middle = taken[:, top : top + FITTED_SIZE, left : left + FITTED_SIZE]
    return fit_strength(torch.from_numpy(np.ascontiguousarray(middle)).permute(0, 3, 1, 2), path)


def plan_of(source: Path, path: OpticalPath, crop: tuple[int, int, int, int] | None = None, **options: Any) -> Plan:
    """What a simulation of a file would leave out, by its first frame.

    Args:
        source: picture or clip.
        path: the turbulent path.
        crop: left, top, width, height of the part to use, pixels.
        options: of `Simulator`.
    """
    with open_clip(source, crop=crop) as clip:
        frame = to_linear(torch.from_numpy(next(iter(clip))).permute(2, 0, 1))
    return Simulator(path, *frame.shape[-2:], **options).plan(frame)


def _describe(path: OpticalPath, rate: float, wind: tuple[float, float] | None, seed: int) -> dict[str, object]:
    return {
        "aperture_m": path.aperture,
        "distance_m": path.distance,
        "wavelength_m": path.wavelength,
        "d_over_r0": path.d_over_r0,
        "r0_m": path.r0 if np.isfinite(path.r0) else None,
        "theta0_pixels": path.theta0_pixels if np.isfinite(path.theta0_pixels) else None,
        "pixel_m": path.pixel,
        "frames_per_second": rate,
        "wind_m_per_s": wind,
        "seed": seed,
    }
