"""Clips without truth beside simulated ones with it, for self-supervised fine-tuning."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypedDict, final

import numpy as np
import torch
from lightning.pytorch.utilities import CombinedLoader
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from turbnet.classical.methods import Method, find_method
from turbnet.data.footage import Footage, footage_paths
from turbnet.data.module import ClipData
from turbnet.errors import InputError, check_range
from turbnet.media.clip import open_clip
from turbnet.media.colour import to_linear, to_srgb

FUSED = 50
"""Frames of a clip that are fused, equally spaced where it has more."""


def fused(path: Path, method: Method) -> Tensor:
    """What a classical method makes of a clip of a still scene, (3, H, W), sRGB: the mean of its frames.

    Raises:
        InputError: the clip cannot be read.
    """
    with open_clip(path) as clip:
        count = clip.info.frames or sum(1 for _ in clip)
        chosen = set(np.linspace(0, count - 1, min(count, FUSED)).round().astype(int).tolist())
        frames = np.stack([to_linear(frame.clip(0, 1)) for index, frame in enumerate(clip) if index in chosen])
    clear = method(frames, torch.get_num_threads(), lambda share: None).mean(0)
    return torch.from_numpy(to_srgb(clear.clip(0, 1)).astype(np.float32)).permute(2, 0, 1)


@final
class FusedCut(TypedDict):
    """A `Scene` of a clip without truth, and "fused" (3, H, W), what was made of the whole clip."""

    scene: Tensor
    seed: Tensor
    hardness: Tensor
    fused: Tensor


class Fused(Dataset[FusedCut]):
    """Cuts of clips, each with the same place in what was made of the whole clip.

    Args:
        cuts: of the clips.
        pictures: (3, H, W) for each clip.
    """

    def __init__(self, cuts: Footage, pictures: dict[Path, Tensor]) -> None:
        self.cuts, self.pictures = cuts, pictures

    def __getitem__(self, index: int) -> FusedCut:
        path, _, top, left, _ = self.cuts.place(index)
        picture = self.pictures[path][:, top : top + self.cuts.height, left : left + self.cuts.width]
        cut = self.cuts[index]
        return {"scene": cut["scene"], "seed": cut["seed"], "hardness": cut["hardness"], "fused": picture}


class UnlabelledData(ClipData):
    """Batches {"clips": cuts of the user's clips, "scenes": clean clips to be simulated}.

    Args:
        clips: folders of the user's clips of still scenes: videos, GIFs, folders of images.
        clip_frames: frames of a cut.
        fuse: classical method whose picture of the whole clip goes with every cut; it is made once, before training.
        more: see `ClipData`; `size`, `batch_size` and `seed` are those of the cuts as well.

    Raises:
        InputError: no such method, no clips, clips that are too short or small, and as `ClipData`.
    """

    def __init__(self, clips: Sequence[str], clip_frames: int = 6, fuse: str = "pipeline", **more: Any) -> None:
        super().__init__(**more)
        if isinstance(clips, str):
            raise InputError(f"clips = {clips!r} must be a list, such as [{clips}]")
        check_range("clip_frames", clip_frames, 2, 1000, "frames")
        paths, size = footage_paths(clips), self.train.height
        self.cuts = Footage(paths, clip_frames, size, size, self.train.seed)
        # Another seed than training's, and the same whatever training's is.
        self.val_cuts = Footage(paths, clip_frames, size, size, 2**31 - 1)
        self._fuse, self._pictures = find_method(fuse), dict[Path, Tensor]()

    def train_dataloader(self) -> Any:
        """Fresh cuts and scenes every epoch."""
        cuts = self._cuts(self.cuts, self._sampler())
        return CombinedLoader({"clips": cuts, "scenes": super().train_dataloader()}, "min_size")

    def val_dataloader(self) -> Any:
        """The same ones every time."""
        cuts = self._cuts(self.val_cuts, range(len(self.val)))
        return CombinedLoader({"clips": cuts, "scenes": super().val_dataloader()}, "min_size")

    def _cuts(self, cuts: Footage, sampler: Any) -> DataLoader[Any]:
        for path in cuts.paths:
            if path not in self._pictures:
                self._pictures[path] = fused(path, self._fuse)
        data = Fused(cuts, self._pictures)
        return DataLoader(data, batch_size=self.batch_size, sampler=sampler, num_workers=self.workers)
