"""Clean clips for training and validation, as Lightning wants them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning as L
from torch.utils.data import DataLoader, Dataset

from turbnet.data.clips import CleanClips, DrawnClips, EpochSampler, SimulatedClips
from turbnet.data.pack import PackedPicture
from turbnet.data.pairs import PairMaker
from turbnet.data.sources import Mixture, Pictures, Source, Text, embedded_paths, folder_paths
from turbnet.data.text import fonts as matplotlib_fonts
from turbnet.data.text import fonts_in
from turbnet.data.text_scenes import TextScenes
from turbnet.errors import InputError, ParameterError, check_range


class ClipData(L.LightningDataModule):
    """Clips of crops from pictures and rendered text.

    Args:
        frames: of a clip; two numbers: a range to draw from for every training step, the largest for validation.
        size: crops are size x size pixels.
        batch_size: clips of a step, in each process.
        steps_per_epoch: training steps of an epoch, which several processes share; every epoch brings fresh clips.
        folders: of the user's pictures, searched recursively, or packs of them (`turbnet.data.pack`); empty: the pictures
            embedded in scikit-image.
        val_folders: the same for validation.
        text: fraction of clips with rendered text: half of them scenes of it, half filled with it.
        moving: fraction of clips with something that moves.
        fonts: folders of fonts to write training text with, besides those that come with matplotlib; validation uses these.
        scales: range of the factor by which pictures are reduced before cropping.
        val_clips: clips to validate on, always the same.
        curriculum: training steps over which strength rises from a quarter of its range to all of it.
        workers: processes that make clips; the clips do not depend on their number.
        simulator: arguments of `turbnet.data.pairs.PairMaker`: turbulence is then simulated here, in the workers, and not
            in the training loop. The pairs are the same; worth it where few cores idle.
        drawn: with `simulator`: only the atmospheres are drawn in the workers, and the training loop looks through them. The
            pairs are the same; worth it where the loop runs on a GPU.
        seed: of the clips.

    Raises:
        InputError: a folder without pictures, a value out of range.
    """

    def __init__(
        self,
        frames: int | Sequence[int] = 8,
        size: int = 128,
        batch_size: int = 4,
        steps_per_epoch: int = 100,
        folders: Sequence[str] = (),
        val_folders: Sequence[str] = (),
        text: float = 0.25,
        fonts: Sequence[str] = (),
        moving: float = 0.25,
        scales: Sequence[float] = (0.5, 1.0),
        val_clips: int = 8,
        curriculum: int = 0,
        workers: int = 0,
        simulator: Mapping[str, Any] | None = None,
        drawn: bool = False,
        seed: int = 0,
    ) -> None:
        super().__init__()
        check_range("batch_size", batch_size, 1, 2**16)
        check_range("workers", workers, 0, 2**10)
        check_range("text", text, 0, 1)
        if len(scales) != 2 or not 0 < scales[0] <= scales[1] <= 1:
            raise ParameterError(f"scales = {list(scales)} must be a range: two numbers, 0 < low <= high <= 1")
        for name, paths in (("folders", folders), ("val_folders", val_folders), ("fonts", fonts)):
            if isinstance(paths, str):
                raise InputError(f"{name} = {paths!r} must be a list, such as [{paths}]")
        self.batch_size, self.workers = batch_size, workers
        ranges = (float(scales[0]), float(scales[1]))

        def source(paths: Sequence[Path | PackedPicture], more: Sequence[Path] = ()) -> Source:
            written = (*matplotlib_fonts(), *more)
            parts = (Pictures(paths, ranges), TextScenes(font_paths=written), Text(written))
            return Mixture(parts, (1 - text, text / 2, text / 2))

        train = source(folder_paths(folders) if folders else embedded_paths("train"), fonts_in(fonts))
        val = source(folder_paths(val_folders) if val_folders else embedded_paths("test"))
        self.curriculum, self.simulator, self.drawn = curriculum, simulator, drawn
        if drawn and (simulator is None or simulator.get("model", "zernike") != "zernike"):
            raise ParameterError("drawn: data.simulator must be the exact simulator, '${simulator}'")
        self.pairs: PairMaker | None = None
        most = frames if isinstance(frames, int) else frames[-1]
        self.train = CleanClips(train, steps_per_epoch * batch_size, frames, size, size, moving, seed)
        # Another seed than training's, and the same whatever training's is.
        self.val = CleanClips(val, val_clips, most, size, size, moving, 2**31 - 1)

    def _loader(self, clips: CleanClips, sampler: EpochSampler | None) -> DataLoader[Any]:
        if self.simulator is not None and self.pairs is None:
            self.pairs = PairMaker(**self.simulator)
        made: Dataset[Any] = clips
        if self.pairs is not None:
            made = (DrawnClips if self.drawn else SimulatedClips)(clips, self.pairs)
        return DataLoader(
            made,
            batch_size=self.batch_size,
            sampler=sampler,
            num_workers=self.workers,
            persistent_workers=self.workers > 0,
        )

    def train_dataloader(self) -> DataLoader[Any]:
        """Fresh clips every epoch."""
        sampler = self._sampler()
        self.train.batch = self.batch_size * sampler.num_replicas
        self.train.curriculum = self.curriculum * self.train.batch
        return self._loader(self.train, sampler)

    def val_dataloader(self) -> DataLoader[Any]:
        """The same clips every time."""
        return self._loader(self.val, None)

    def _sampler(self) -> EpochSampler:
        """This process's share of an epoch."""
        ranks = (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)
        return EpochSampler(len(self.train), *ranks)
