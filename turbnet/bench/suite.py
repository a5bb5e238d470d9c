"""The frozen benchmark of restoration: clips regenerated on demand from seeds, so that no data has to be shipped.

Still scenes (crops of pictures in scikit-image that turbnet never trains on), scenes in which an ellipse of another
picture moves, and text. Each is seen at D/r0 = 1.5, 3 and 4.5 over the default path, by a camera that points at the clip's
mean position, with shot noise of 20,000 electrons, read noise of 1 % and 8 bits; still scenes and text through frames of
independent air, moving ones through air under a wind of 4 m/s at 30 frames a second. A clip of n frames is the first n
of the longest.

A clip of few frames has a mean tilt of its own, which no method can know: a picture without fault, seen in the clip's mean
geometry, still scores less than infinity. `Clip.settled` is that picture: PSNR against it tells how good a restoration is
but for the geometry. Its own PSNR is no strict bound: blurring what is uncertain scores a little more where little is known.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray

from turbnet.atmosphere.path import OpticalPath
from turbnet.data.boxes import TextBox
from turbnet.data.sources import embedded_paths, load_picture
from turbnet.data.text_scenes import render_scene
from turbnet.media.colour import to_linear, to_srgb
from turbnet.nets.blocks import warp
from turbnet.simulate.sensor import Sensor
from turbnet.simulate.simulator import Simulator

Frames = NDArray[np.float32]

SIZE = 160
STRENGTHS = (1.5, 3.0, 4.5)
LENGTHS = (1, 12, 50)
KINDS = ("static", "dynamic", "text")
_CROPS = ((0, 40, 120), (0, 250, 60), (1, 60, 100), (1, 200, 330))  # picture of the test split, top, left
_SEED = 2026


@dataclass(frozen=True)
class Suite:
    """Which clips: scenes of each kind, strengths, lengths."""

    scenes: int
    strengths: tuple[float, ...]
    lengths: tuple[int, ...]


SUITES = {"standard": Suite(4, STRENGTHS, LENGTHS), "quick": Suite(1, (3.0,), (12,))}


@dataclass(frozen=True)
class Clip:
    """One clip of the benchmark; pictures are sRGB in [0, 1].

    Attributes:
        name: kind, scene and strength.
        kind: one of KINDS.
        strength: D/r0.
        frames: what the camera saw, (T, H, W, 3), 8 bits.
        target: the clean clip, (T, H, W, 3).
        moving: where something moves, (T, H, W).
        boxes: of text.
        tilt: where each scene point went, (T, 2, H, W), pixels.
    """

    name: str
    kind: str
    strength: float
    frames: Frames
    target: Frames
    moving: NDArray[np.bool_]
    boxes: tuple[TextBox, ...]
    tilt: Frames

    def first(self, count: int) -> "Clip":
        """The clip of its first frames."""
        cut = (self.frames[:count], self.target[:count], self.moving[:count])
        return Clip(self.name, self.kind, self.strength, *cut, self.boxes, self.tilt[:count])

    def settled(self) -> Frames:
        """The clean clip in the mean geometry of its frames: what shows u in the scene shows u + mean t(u) there."""
        clean = torch.from_numpy(self.target).permute(0, 3, 1, 2)
        shift = torch.from_numpy(self.tilt).mean(0, keepdim=True)
        # Tilts are smooth and a mean tilt is small: that of where a point arrives is that of where it came from.
        return warp(clean, -shift.expand(len(clean), -1, -1, -1)).permute(0, 2, 3, 1).numpy()


def names(suite: Suite) -> list[tuple[str, int, float]]:
    """(kind, scene, strength) of every clip."""
    return [(kind, scene, s) for kind in KINDS for scene in range(suite.scenes) for s in suite.strengths]


def make_clip(kind: str, scene: int, strength: float, frames: int) -> Clip:
    """A clip of the benchmark, always the same."""
    target, moving, boxes = {"static": _static, "dynamic": _dynamic, "text": _text}[kind](scene, frames)
    seed = int(np.random.SeedSequence([_SEED, KINDS.index(kind), scene]).generate_state(1)[0])
    simulator = _simulator(strength)
    wind = torch.tensor([4.0, 0.0]) if kind == "dynamic" else None
    clean = torch.from_numpy(target).permute(0, 3, 1, 2)
    still = kind != "dynamic"
    with torch.no_grad():
        # All moments at once, so that the camera points at the mean of the longest clip whatever is asked for.
        draw = simulator.draw([seed], max(LENGTHS), wind).centred()
        seen = simulator(to_linear(clean[:1] if still else clean)[None], draw.moments(0, frames), seed)
        shown = (to_srgb(seen.frames[0].clamp(0, 1)) * 255).round() / 255
    name = f"{kind} {scene + 1}, D/r0 = {strength:g}"
    frames_THWC = shown.permute(0, 2, 3, 1).numpy()
    return Clip(name, kind, strength, frames_THWC, target, moving, boxes, seen.tilt[0].numpy())


@lru_cache
def _simulator(strength: float) -> Simulator:
    return Simulator(OpticalPath.from_d_over_r0(strength), SIZE, SIZE, sensor=Sensor(20_000, 0.01))


def _crop(index: int) -> Frames:
    picture, top, left = _CROPS[index % len(_CROPS)]
    return load_picture(embedded_paths("test")[picture])[top : top + SIZE, left : left + SIZE].copy()


def _static(scene: int, frames: int) -> tuple[Frames, NDArray[np.bool_], tuple[TextBox, ...]]:
    return np.repeat(_crop(scene)[None], frames, 0), np.zeros((frames, SIZE, SIZE), bool), ()


def _dynamic(scene: int, frames: int) -> tuple[Frames, NDArray[np.bool_], tuple[TextBox, ...]]:
    """An ellipse of the next picture crosses, one pixel a frame."""
    ground, sprite = _crop(scene), _crop(scene + 2)
    rng = np.random.default_rng([_SEED, scene])
    radius, direction = rng.uniform(18, 30, size=2), rng.uniform(0, 2 * np.pi)
    y, x = np.mgrid[:SIZE, :SIZE]
    target, moving = [], []
    for frame in range(frames):
        way = frame - (max(LENGTHS) - 1) / 2
        dx, dy = way * np.cos(direction), way * np.sin(direction)
        inside = np.hypot((x - SIZE / 2 - dx) / radius[0], (y - SIZE / 2 - dy) / radius[1])
        share = np.clip((1 - inside) * radius.min() + 0.5, 0, 1)[..., None].astype(np.float32)
        moved = np.roll(sprite, (round(dy), round(dx)), axis=(0, 1))
        target.append(ground * (1 - share) + moved * share)
        moving.append(share[..., 0] > 0.5)
    return np.stack(target), np.stack(moving), ()


def _text(scene: int, frames: int) -> tuple[Frames, NDArray[np.bool_], tuple[TextBox, ...]]:
    rng = np.random.default_rng([_SEED, 1, scene])
    drawn = render_scene(rng, SIZE, SIZE, ("words", "lines")[scene % 2], (14.0, 22.0), (0.5, 1.0), 0.05)
    picture = np.asarray(drawn.picture, dtype=np.float32)
    return np.repeat(picture[None], frames, 0), np.zeros((frames, SIZE, SIZE), bool), tuple(drawn.boxes)


Restore = Callable[[Clip], Frames]
"""A clip to as many restored frames (T, H, W, 3), sRGB in [0, 1]."""
