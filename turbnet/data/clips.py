"""Clean clips: still scenes, and scenes in which something moves."""

from collections.abc import Sequence
from typing import Any, TypedDict, cast, final

import numpy as np
import torch
from kornia.geometry.transform import translate
from torch import Tensor
from torch.utils.data import Dataset, DistributedSampler

from turbnet.data.pairs import PairMaker
from turbnet.data.sources import Source
from turbnet.errors import check_range
from turbnet.simulate.draw import Draw


@final
class Scene(TypedDict):
    """One clean clip and what decides everything that will be done to it.

    `scene` is (T, 3, H, W), sRGB in [0, 1]; `seed` an integer tensor; `hardness` 0 to 1, the part of the range of strengths
    to draw from.
    """

    scene: Tensor
    seed: Tensor
    hardness: Tensor


@final
class DrawnScene(TypedDict):
    """A clean clip and the atmosphere through which it will be seen: coefficients (T, J-1, h, w) of
    `turbnet.simulate.draw.Draw`; the rest as in `Scene`.
    """

    scene: Tensor
    seed: Tensor
    hardness: Tensor
    coefficients: Tensor


@final
class SimulatedScene(TypedDict):
    """One clip that has been seen through turbulence; see `turbnet.data.pairs.Pair`."""

    frames: Tensor
    target: Tensor
    blur_only: Tensor
    tilt: Tensor
    seed: Tensor


AnyScene = Scene | DrawnScene | SimulatedScene
"""What a data loader may give to a task."""


class CleanClips(Dataset[Scene]):
    """Clips made on demand; clip number i is the same whoever asks for it, in any order, from any worker.

    Args:
        source: of clean crops.
        length: clips of an epoch. Indices beyond it are valid: they are the clips of later epochs.
        frames: of a clip; two numbers: drawn from this range, equally likely on a logarithmic scale, for each batch.
        height, width: of a clip, pixels.
        moving: fraction of clips in which a patch of another picture moves across.
        seed: of the whole set.
        batch: clips of a step, all processes together; they share their number of frames.
        curriculum: clips over which hardness rises from 1/4 to 1; 0: it is always 1.
    """

    def __init__(
        self,
        source: Source,
        length: int,
        frames: int | Sequence[int],
        height: int,
        width: int,
        moving: float = 0.0,
        seed: int = 0,
        batch: int = 1,
        curriculum: int = 0,
    ) -> None:
        check_range("clips of an epoch", length, 1, 2**31)
        few, many = (frames, frames) if isinstance(frames, int) else frames
        check_range("frames", few, 1, 10_000)
        check_range("frames", many, few, 10_000)
        check_range("batch", batch, 1, 2**31)
        check_range("curriculum", curriculum, 0, 2**62, "clips")
        check_range("moving", moving, 0, 1)
        check_range("height", height, 1, 2**15, "pixels")
        check_range("width", width, 1, 2**15, "pixels")
        check_range("seed", seed, 0, 2**63)
        self.source, self.length, self.seed = source, length, seed
        self.few, self.many, self.height, self.width, self.moving = few, many, height, width, moving
        self.batch, self.curriculum = batch, curriculum

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> Scene:
        rng = np.random.default_rng([self.seed, index])
        still = _tensor(self.source(rng, self.height, self.width))
        frames = self.frames(index)
        scene = still.expand(frames, *still.shape)
        if rng.random() < self.moving:
            scene = self._with_sprite(scene, rng)
        hardness = min(1.0, 0.25 + 0.75 * index / self.curriculum) if self.curriculum else 1.0
        return {
            "scene": scene.contiguous(),
            "seed": torch.tensor(int(rng.integers(2**62))),
            "hardness": torch.tensor(hardness),
        }

    def frames(self, index: int) -> int:
        """Frames of clip number `index`."""
        draw = np.random.default_rng([self.seed, 2**32, index // self.batch]).random()
        return min(self.many, int(self.few * ((self.many + 1) / self.few) ** draw))

    def _with_sprite(self, scene: Tensor, rng: np.random.Generator) -> Tensor:
        """Move an ellipse of another picture across the scene, up to 1.5 pixels a frame."""
        sprite = _tensor(self.source(rng, self.height, self.width))
        y, x = torch.meshgrid(torch.linspace(-1, 1, self.height), torch.linspace(-1, 1, self.width), indexing="ij")
        centre, radius = rng.uniform(-0.5, 0.5, size=2), rng.uniform(0.2, 0.6, size=2)
        distance = ((y - centre[0]) / radius[0]) ** 2 + ((x - centre[1]) / radius[1]) ** 2
        mask = torch.sigmoid((1 - distance) * 0.25 * min(self.height, self.width) * float(radius.min()))
        velocity = torch.as_tensor(rng.uniform(-1.5, 1.5, size=2), dtype=torch.float32)
        time = torch.arange(len(scene), dtype=torch.float32) - (len(scene) - 1) / 2
        layer = torch.cat((sprite * mask, mask[None])).expand(len(scene), -1, -1, -1)
        layer = translate(layer, time[:, None] * velocity, align_corners=True)
        return layer[:, :3] + scene * (1 - layer[:, 3:])


class SimulatedClips(Dataset[SimulatedScene]):
    """Clean clips seen through turbulence where they are made: in the workers of a data loader.

    Args:
        clips: clean clips.
        pairs: looks at them.
    """

    def __init__(self, clips: CleanClips, pairs: PairMaker) -> None:
        self.clips, self.pairs = clips, pairs

    def __len__(self) -> int:
        return len(self.clips)

    def __getitem__(self, index: int) -> SimulatedScene:
        clean = self.clips[index]
        pair = self.pairs(clean["scene"][None], [int(clean["seed"])], [float(clean["hardness"])])
        return {
            "frames": pair.frames[0],
            "target": pair.target[0],
            "blur_only": pair.blur_only[0],
            "tilt": pair.tilt[0],
            "seed": clean["seed"],
        }


class DrawnClips(Dataset[DrawnScene]):
    """Clean clips with atmospheres that are drawn in the workers of a data loader; who trains looks through them.

    Drawing is many small steps, which a GPU does no faster than a processor; looking is what a GPU is good at.

    Args:
        clips: clean clips.
        pairs: draws.
    """

    def __init__(self, clips: CleanClips, pairs: PairMaker) -> None:
        self.clips, self.pairs = clips, pairs

    def __len__(self) -> int:
        return len(self.clips)

    def __getitem__(self, index: int) -> DrawnScene:
        clean = self.clips[index]
        through = self.pairs.conditions(int(clean["seed"]), float(clean["hardness"]))
        draw = cast(Draw, self.pairs.draw(through, len(clean["scene"])))
        return {**clean, "coefficients": draw.coefficients[0]}


class EpochSampler(DistributedSampler[Any]):
    """Indices epoch * length .. (epoch + 1) * length - 1, shared out among processes: fresh clips every epoch.

    Lightning calls `set_epoch`; a resumed run goes on with the clips it would have seen.
    """

    def __init__(self, length: int, rank: int = 0, world: int = 1) -> None:
        super().__init__(range(length), num_replicas=world, rank=rank, shuffle=False)  # type: ignore[arg-type]
        self.length = length

    def __iter__(self):  # type: ignore[no-untyped-def]
        return (self.epoch * self.length + index for index in super().__iter__())


def _tensor(picture: np.ndarray) -> Tensor:
    return torch.from_numpy(picture).permute(2, 0, 1)
