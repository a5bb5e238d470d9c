"""Clips without truth beside simulated ones with it, for self-supervised fine-tuning."""

from collections.abc import Sequence
from typing import Any

from lightning.pytorch.utilities import CombinedLoader
from torch.utils.data import DataLoader

from turbnet.data.clips import EpochSampler
from turbnet.data.footage import Footage, footage_paths
from turbnet.data.module import ClipData
from turbnet.errors import InputError, check_range


class UnlabelledData(ClipData):
    """Batches {"clips": cuts of the user's clips, "scenes": clean clips to be simulated}.

    Args:
        clips: folders of the user's clips of still scenes: videos, GIFs, folders of images.
        clip_frames: frames of a cut.
        more: see `ClipData`; `size`, `batch_size` and `seed` are those of the cuts as well.

    Raises:
        InputError: no clips, clips that are too short or small, and as `ClipData`.
    """

    def __init__(self, clips: Sequence[str], clip_frames: int = 6, **more: Any) -> None:
        super().__init__(**more)
        if isinstance(clips, str):
            raise InputError(f"clips = {clips!r} must be a list, such as [{clips}]")
        check_range("clip_frames", clip_frames, 2, 1000, "frames")
        paths, size = footage_paths(clips), self.train.height
        self.cuts = Footage(paths, clip_frames, size, size, self.train.seed)
        # Another seed than training's, and the same whatever training's is.
        self.val_cuts = Footage(paths, clip_frames, size, size, 2**31 - 1)

    def train_dataloader(self) -> Any:
        """Fresh cuts and scenes every epoch."""
        rank = self.trainer.global_rank if self.trainer else 0
        world = self.trainer.world_size if self.trainer else 1
        cuts = self._cuts(self.cuts, EpochSampler(len(self.train), rank, world))
        return CombinedLoader({"clips": cuts, "scenes": super().train_dataloader()}, "min_size")

    def val_dataloader(self) -> Any:
        """The same ones every time."""
        cuts = self._cuts(self.val_cuts, range(len(self.val)))
        return CombinedLoader({"clips": cuts, "scenes": super().val_dataloader()}, "min_size")

    def _cuts(self, cuts: Footage, sampler: Any) -> DataLoader[Any]:
        return DataLoader(cuts, batch_size=self.batch_size, sampler=sampler, num_workers=self.workers)
