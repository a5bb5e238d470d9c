"""Clean clips out of footage: crops of real video, in space and time."""

from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import Dataset

from turbnet.data.clips import Scene
from turbnet.errors import InputError, check_range
from turbnet.media.clip import open_clip
from turbnet.media.readers import IMAGES, VIDEOS


def footage_paths(folders: Sequence[str | Path]) -> list[Path]:
    """Every video and GIF below the folders, and every folder of images there, which counts as one clip; sorted.

    Raises:
        InputError: a folder does not exist or holds no clip.
    """
    paths: list[Path] = []
    for folder in map(Path, folders):
        files = [path for path in folder.rglob("*") if path.is_file()]
        videos = {path for path in files if path.suffix.lower() in VIDEOS | {".gif"}}
        found = sorted(videos | {path.parent for path in files if path.suffix.lower() in IMAGES})
        if not found:
            raise InputError(f"no clips in {folder}" if folder.is_dir() else f"there is no folder {folder}")
        paths += found
    return paths


class Footage(Dataset[Scene]):
    """Clips cut at random out of longer ones; clip number i is the same whoever asks for it, in any order.

    A cut takes the time to decode the clip up to it.

    Args:
        paths: of clips, see `turbnet.media.clip.open_clip`.
        frames, height, width: of a cut.
        seed: of the whole set.

    Raises:
        InputError: a clip that cannot be read, or is smaller or shorter than a cut.
    """

    def __init__(self, paths: Sequence[Path], frames: int, height: int, width: int, seed: int = 0) -> None:
        check_range("frames", frames, 1, 10_000)
        check_range("height", height, 1, 2**15, "pixels")
        check_range("width", width, 1, 2**15, "pixels")
        check_range("seed", seed, 0, 2**63)
        self.paths, self.seed = list(paths), seed
        self.frames, self.height, self.width = frames, height, width
        self._room = [self._room_in(path) for path in self.paths]

    def __getitem__(self, index: int) -> Scene:
        path, first, top, left, seed = self.place(index)
        with open_clip(path, (left, top, self.width, self.height)) as clip:
            cut = np.stack(list(islice(clip, first, first + self.frames)))
        scene = torch.from_numpy(cut).permute(0, 3, 1, 2).clamp(0, 1).contiguous()
        return {"scene": scene, "seed": torch.tensor(seed), "hardness": torch.tensor(1.0)}

    def place(self, index: int) -> tuple[Path, int, int, int, int]:
        """Clip, first frame, top and left of cut number `index`, and its seed."""
        rng = np.random.default_rng([self.seed, index])
        which = int(rng.integers(len(self.paths)))
        first, top, left = (int(rng.integers(room + 1)) for room in self._room[which])
        return self.paths[which], first, top, left, int(rng.integers(2**62))

    def _room_in(self, path: Path) -> tuple[int, int, int]:
        """By how much a cut may start late, low and far right."""
        with open_clip(path) as clip:
            info = clip.info
            count = info.frames or sum(1 for _ in clip)
        room = count - self.frames, info.height - self.height, info.width - self.width
        if min(room) < 0:
            raise InputError(
                f"{path} holds {count} frames of {info.width}x{info.height} pixels, "
                f"too few for clips of {self.frames} frames of {self.width}x{self.height}"
            )
        return room


class Alternating(Dataset[Scene]):
    """Clip number i from set number i modulo the number of sets: of each set equally many."""

    def __init__(self, sets: Sequence[Dataset[Scene]]) -> None:
        self.sets = list(sets)

    def __getitem__(self, index: int) -> Scene:
        return self.sets[index % len(self.sets)][index]
