r"""Clips without truth beside simulated ones with it, for self-supervised fine-tuning.

What a classical method makes of a whole clip stands where the scene is seen on average. A cut of a few frames shows it
elsewhere, by the mean of their tilts :math:`\bar d`, which nobody can tell who has seen the cut alone; a network that had
to say where the whole clip shows the scene would learn to blur by what it cannot know (`turbnet.data.pairs.Pair.settled`).
So F is moved to where the cut shows it,

.. math::
    F'(x) = F(x - \bar d(x)), \qquad \bar d = \frac{1}{T} \sum_t d_t, \quad I_t(x + d_t(x)) \approx M(x)

with the frames of the cut registered to M, the mean of the whole clip.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypedDict, final

import numpy as np
import torch
from lightning.pytorch.utilities import CombinedLoader
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from turbnet._version import __version__
from turbnet.classical.local import Array
from turbnet.classical.methods import Method, find_method
from turbnet.classical.pipeline import REDUCTION
from turbnet.classical.registration import register, warp
from turbnet.data.footage import Footage, footage_paths
from turbnet.data.module import ClipData
from turbnet.errors import InputError, check_range
from turbnet.media.atomic import atomic_path
from turbnet.media.clip import open_clip
from turbnet.media.colour import to_linear, to_srgb
from turbnet.media.guard import reading

FUSED = 50
"""Frames of a clip that are fused, equally spaced where it has more."""


class Whole(NamedTuple):
    """What is known of all frames of a clip together, (H, W, 3).

    Attributes:
        mean: of the frames, linear intensities.
        fused: what a classical method makes of them, sRGB.
    """

    mean: Array
    fused: Array

    def cut(self, top: int, left: int, height: int, width: int) -> "Whole":
        """The same of a part of the picture."""
        return Whole(*(np.array(picture[top : top + height, left : left + width]) for picture in self))

    def seen_by(self, frames_THWC: Array) -> Array:
        """F', the fused picture where these sRGB frames of the clip show it on average, (H, W, 3)."""
        _, shifts = register(to_linear(frames_THWC), self.mean, reduction=REDUCTION)
        return warp(self.fused, -shifts.mean(0)).clip(0, 1)


def whole_clip(path: Path, method: Method) -> Whole:
    """A clip of a still scene through a classical method, whose frames are averaged.

    Raises:
        InputError: the clip cannot be read.
    """
    with open_clip(path) as clip:
        count = clip.info.frames or sum(1 for _ in clip)
        chosen = set(np.linspace(0, count - 1, min(count, FUSED)).round().astype(int).tolist())
        frames = np.stack([to_linear(frame.clip(0, 1)) for index, frame in enumerate(clip) if index in chosen])
    clear = method(frames, torch.get_num_threads(), lambda share: None).mean(0)
    return Whole(frames.mean(0), to_srgb(clear.clip(0, 1)).astype(np.float32))


def kept_whole(folder: Path, path: Path, fuse: str) -> Whole:
    """`whole_clip` by a method of this name, made once: a file in `folder`, named after what it was made of, holds it.

    Raises:
        InputError: the clip cannot be read, there is no such method, or the folder cannot be written.
    """
    made_of = hashlib.sha256(f"{__version__} {fuse} {FUSED}".encode())
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if file.is_file():
            with file.open("rb") as data:
                made_of.update(f"\0{file.relative_to(path)}\0".encode() + hashlib.file_digest(data, "sha256").digest())
    kept = folder / f"{made_of.hexdigest()}.npy"
    if not kept.is_file():
        print(f"fusing the frames of {path.name}", flush=True)
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_path(kept) as temporary:
            np.save(temporary, np.stack(whole_clip(path, find_method(fuse))), allow_pickle=False)
    with reading(kept):
        return Whole(*np.load(kept, mmap_mode="r", allow_pickle=False))


@final
class FusedCut(TypedDict):
    """A `Scene` of a clip without truth, and "fused" (3, H, W), what was made of the whole clip, as the cut shows it."""

    scene: Tensor
    seed: Tensor
    hardness: Tensor
    fused: Tensor


class Fused(Dataset[FusedCut]):
    """Cuts of clips, each with what was made of the whole clip.

    Args:
        cuts: of the clips.
        wholes: of each clip.
    """

    def __init__(self, cuts: Footage, wholes: dict[Path, Whole]) -> None:
        self.cuts, self.wholes = cuts, wholes

    def __getitem__(self, index: int) -> FusedCut:
        path, _, top, left, _ = self.cuts.place(index)
        cut = self.cuts[index]
        whole = self.wholes[path].cut(top, left, self.cuts.height, self.cuts.width)
        fused = torch.from_numpy(whole.seen_by(cut["scene"].permute(0, 2, 3, 1).numpy())).permute(2, 0, 1)
        return {"scene": cut["scene"], "seed": cut["seed"], "hardness": cut["hardness"], "fused": fused}


class UnlabelledData(ClipData):
    """Batches {"clips": cuts of the user's clips, "scenes": clean clips to be simulated}.

    Args:
        clips: folders of the user's clips of still scenes: videos, GIFs, folders of images.
        clip_frames: frames of a cut.
        fuse: classical method whose picture of the whole clip goes with every cut; it is made once, before training.
        fused: folder where these pictures are kept, for whoever goes on with a training or starts another.
        more: see `ClipData`; `size`, `batch_size` and `seed` are those of the cuts as well.

    Raises:
        InputError: no such method, no clips, clips that are too short or small, and as `ClipData`.
    """

    def __init__(
        self, clips: Sequence[str], fused: str, clip_frames: int = 6, fuse: str = "pipeline", **more: Any
    ) -> None:
        super().__init__(**more)
        if isinstance(clips, str):
            raise InputError(f"clips = {clips!r} must be a list, such as [{clips}]")
        check_range("clip_frames", clip_frames, 2, 1000, "frames")
        paths, size = footage_paths(clips), self.train.height
        self.cuts = Footage(paths, clip_frames, size, size, self.train.seed)
        # Another seed than training's, and the same whatever training's is.
        self.val_cuts = Footage(paths, clip_frames, size, size, 2**31 - 1)
        find_method(fuse)  # before anything is long at work
        self._fuse, self._fused, self._wholes = fuse, Path(fused), dict[Path, Whole]()

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
            if path not in self._wholes:
                self._wholes[path] = kept_whole(self._fused, path, self._fuse)
        data = Fused(cuts, self._wholes)
        return DataLoader(data, batch_size=self.batch_size, sampler=sampler, num_workers=self.workers)
