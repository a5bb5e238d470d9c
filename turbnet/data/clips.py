"""Clean clips: still scenes, and scenes in which something moves."""

from typing import TypedDict

import numpy as np
import torch
from kornia.geometry.transform import translate
from torch import Tensor
from torch.utils.data import Dataset, DistributedSampler

from turbnet.data.sources import Source
from turbnet.errors import check_range


class Scene(TypedDict):
    """One clean clip and the seed of everything that will be done to it.

    `scene` is (T, 3, H, W), sRGB in [0, 1]; `seed` an integer tensor.
    """

    scene: Tensor
    seed: Tensor


class CleanClips(Dataset[Scene]):
    """Clips made on demand; clip number i is the same whoever asks for it, in any order, from any worker.

    Args:
        source: of clean crops.
        length: clips of an epoch. Indices beyond it are valid: they are the clips of later epochs.
        frames, height, width: of a clip.
        moving: fraction of clips in which a patch of another picture moves across.
        seed: of the whole set.
    """

    def __init__(
        self, source: Source, length: int, frames: int, height: int, width: int, moving: float = 0.0, seed: int = 0
    ) -> None:
        check_range("clips of an epoch", length, 1, 2**31)
        check_range("frames", frames, 1, 10_000)
        check_range("moving", moving, 0, 1)
        check_range("height", height, 1, 2**15, "pixels")
        check_range("width", width, 1, 2**15, "pixels")
        check_range("seed", seed, 0, 2**63)
        self.source, self.length, self.seed = source, length, seed
        self.frames, self.height, self.width, self.moving = frames, height, width, moving

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> Scene:
        rng = np.random.default_rng([self.seed, index])
        still = _tensor(self.source(rng, self.height, self.width))
        scene = still.expand(self.frames, *still.shape)
        if rng.random() < self.moving:
            scene = self._with_sprite(scene, rng)
        return {"scene": scene.contiguous(), "seed": torch.tensor(int(rng.integers(2**62)))}

    def _with_sprite(self, scene: Tensor, rng: np.random.Generator) -> Tensor:
        """Move an ellipse of another picture across the scene, up to 1.5 pixels a frame."""
        sprite = _tensor(self.source(rng, self.height, self.width))
        y, x = torch.meshgrid(torch.linspace(-1, 1, self.height), torch.linspace(-1, 1, self.width), indexing="ij")
        centre, radius = rng.uniform(-0.5, 0.5, size=2), rng.uniform(0.2, 0.6, size=2)
        distance = ((y - centre[0]) / radius[0]) ** 2 + ((x - centre[1]) / radius[1]) ** 2
        mask = torch.sigmoid((1 - distance) * 0.25 * min(self.height, self.width) * float(radius.min()))
        velocity = torch.as_tensor(rng.uniform(-1.5, 1.5, size=2), dtype=torch.float32)
        time = torch.arange(self.frames, dtype=torch.float32) - (self.frames - 1) / 2
        layer = torch.cat((sprite * mask, mask[None])).expand(self.frames, -1, -1, -1)
        layer = translate(layer, time[:, None] * velocity, align_corners=True)
        return layer[:, :3] + scene * (1 - layer[:, 3:])


class EpochSampler(DistributedSampler[Scene]):
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
