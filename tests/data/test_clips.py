import numpy as np
import pytest
import torch
from torch.utils.data import default_collate

from turbnet.data.clips import CleanClips, DrawnClips, EpochSampler, SimulatedClips
from turbnet.data.module import ClipData
from turbnet.data.pairs import PairMaker
from turbnet.data.sources import Text
from turbnet.errors import InputError, ParameterError


def clips(**more) -> CleanClips:
    return CleanClips(Text(), **{"length": 5, "frames": 3, "height": 16, "width": 24, "moving": 0.5, **more})


def test_a_clip_and_its_seed():
    clip = clips()[0]
    assert clip["scene"].shape == (3, 3, 16, 24)
    assert clip["scene"].dtype == torch.float32
    assert clip["scene"].min() >= 0
    assert clip["scene"].max() <= 1 + 1e-6
    assert 0 <= int(clip["seed"]) < 2**62


def test_clip_i_is_the_same_in_any_order_and_beyond_the_epoch():
    forwards, backwards = clips(), clips()
    first = [forwards[i] for i in range(8)]
    last = [backwards[i] for i in reversed(range(8))][::-1]
    for a, b in zip(first, last, strict=True):
        assert torch.equal(a["scene"], b["scene"])
        assert a["seed"] == b["seed"]
    assert len({int(clip["seed"]) for clip in first}) == 8


def test_the_seed_of_the_set_decides():
    assert not torch.equal(clips(seed=0)[2]["scene"], clips(seed=1)[2]["scene"])


class Alternating:
    """A black picture, then a white one, and so on."""

    def __init__(self):
        self.calls = 0

    def __call__(self, rng, height, width):
        self.calls += 1
        return np.full((height, width, 3), self.calls % 2 == 0, dtype=np.float32)


@pytest.mark.parametrize("index", [0, 2, 3])
def test_a_sprite_moves_steadily(index):
    scene = CleanClips(Alternating(), 1, frames=5, height=96, width=128, moving=1.0, seed=3)[index]["scene"]
    weight = scene[:, 0] / scene[:, 0].sum((1, 2), keepdim=True)
    x = (weight * torch.arange(128.0)).sum((1, 2))
    y = (weight * torch.arange(96.0)[:, None]).sum((1, 2))
    steps = torch.stack((x.diff(), y.diff()))
    assert steps.abs().max() > 0.1
    assert steps.abs().max() <= 1.55
    torch.testing.assert_close(steps, steps.mean(1, keepdim=True).expand_as(steps), rtol=0, atol=0.1)


def test_still_scenes_stay_still():
    scene = clips(moving=0.0)[0]["scene"]
    assert torch.equal(scene, scene[:1].expand_as(scene))


def test_the_fraction_that_moves():
    moved = [not torch.equal(scene[0], scene[1]) for scene in (clips()[i]["scene"] for i in range(200))]
    assert abs(np.mean(moved) - 0.5) < 4 * (0.25 / 200) ** 0.5


@pytest.mark.parametrize(
    "bad", [{"length": 0}, {"frames": 0}, {"moving": 1.5}, {"moving": float("nan")}, {"height": 0}, {"seed": -1}]
)
def test_out_of_range(bad):
    with pytest.raises(ParameterError, match="is outside the accepted range"):
        clips(**bad)


class TestEpochSampler:
    def test_every_epoch_brings_fresh_indices(self):
        sampler, seen = EpochSampler(6), []
        for epoch in range(3):
            sampler.set_epoch(epoch)
            assert len(sampler) == 6
            seen += list(sampler)
        assert seen == list(range(18))

    def test_two_processes_share_an_epoch(self):
        parts = []
        for rank in range(2):
            sampler = EpochSampler(6, rank, 2)
            sampler.set_epoch(4)
            parts.append(list(sampler))
        assert len(parts[0]) == len(parts[1]) == 3
        assert sorted(parts[0] + parts[1]) == list(range(24, 30))


class TestClipData:
    small = {"frames": 2, "size": 16, "batch_size": 2, "steps_per_epoch": 2, "val_clips": 2}

    def batches(self, workers):
        loader = ClipData(**self.small, moving=0.5, workers=workers).train_dataloader()
        for epoch in range(2):
            loader.sampler.set_epoch(epoch)
            yield from loader

    def test_clips_do_not_depend_on_the_number_of_workers(self):
        alone, helped = list(self.batches(0)), list(self.batches(2))
        assert len(alone) == len(helped) == 4
        for a, b in zip(alone, helped, strict=True):
            assert torch.equal(a["scene"], b["scene"])
            assert torch.equal(a["seed"], b["seed"])

    def test_validation_clips_are_of_other_pictures_and_always_the_same(self):
        first, second = ClipData(**self.small, seed=0), ClipData(**self.small, seed=1)
        assert not torch.equal(first.train[0]["scene"], second.train[0]["scene"])
        for a, b in zip(first.val_dataloader(), second.val_dataloader(), strict=True):
            assert torch.equal(a["scene"], b["scene"])
            assert torch.equal(a["seed"], b["seed"])
        train, val = (set(part.source.sources[0].paths) for part in (first.train, first.val))
        assert train
        assert val
        assert not train & val

    @pytest.mark.parametrize(
        ("bad", "says"),
        [
            ({"text": 2}, "text"),
            ({"batch_size": 0}, "batch_size"),
            ({"workers": -1}, "workers"),
            ({"scales": [1]}, "scales"),
            ({"scales": [0.9, 0.5]}, "scales"),
            ({"scales": [0.0, 1.0]}, "scales"),
            ({"steps_per_epoch": 0}, "clips of an epoch"),
            ({"folders": "/"}, "must be a list"),
            ({"val_folders": "pictures"}, "must be a list"),
            ({"folders": ["/no/such/folder"]}, "there is no folder"),
        ],
    )
    def test_bad_settings(self, bad, says):
        with pytest.raises(InputError, match=says):
            ClipData(**{**self.small, **bad})


class TestFramesAndHardness:
    source = staticmethod(lambda rng, height, width: rng.random((height, width, 3), dtype=np.float32))

    def test_the_clips_of_a_batch_share_their_number_of_frames_and_batches_differ(self):
        clips = CleanClips(self.source, 40, (1, 9), 8, 8, batch=4)
        counts = [len(clips[index]["scene"]) for index in range(400)]
        assert all(len(set(counts[k : k + 4])) == 1 for k in range(0, 400, 4))
        assert set(counts) == set(range(1, 10))

    def test_hardness_rises_from_a_quarter_to_one(self):
        clips = CleanClips(self.source, 40, 1, 8, 8, curriculum=10)
        found = [float(clips[index]["hardness"]) for index in (0, 5, 10, 1000)]
        assert found == pytest.approx([0.25, 0.625, 1.0, 1.0])
        assert float(CleanClips(self.source, 40, 1, 8, 8)[0]["hardness"]) == 1

    def test_simulated_where_they_are_made_they_are_the_same_pairs(self):
        clips = CleanClips(self.source, 4, 2, 16, 16, moving=0.5)
        maker = PairMaker(16, 16, modes=6, components=2, d_over_r0=(1.0, 4.0), blurred=1.0, compressed=1.0)
        for index in range(2):
            clean, seen = clips[index], SimulatedClips(clips, maker)[index]
            pair = maker(clean["scene"][None], [int(clean["seed"])])
            for name in ("frames", "target", "blur_only", "tilt"):
                assert torch.equal(seen[name], getattr(pair, name)[0]), name

    def test_drawn_where_they_are_made_they_are_the_same_pairs(self):
        clips = CleanClips(self.source, 4, 2, 16, 16, moving=0.5)
        maker = PairMaker(
            16, 16, modes=6, components=2, d_over_r0=(0.0, 4.0), blurred=1.0, geometries=2, aperture=(0.17, 0.24)
        )
        drawn = default_collate([DrawnClips(clips, maker)[index] for index in range(3)])
        arguments = drawn["scene"], drawn["seed"].tolist(), drawn["hardness"].tolist()
        there, here = maker(*arguments, drawn["coefficients"]), maker(*arguments)
        for name in ("frames", "target", "blur_only", "tilt"):
            assert torch.equal(getattr(there, name), getattr(here, name)), name

    @pytest.mark.parametrize("frames", [(3, 2), (0, 2)])
    def test_a_range_that_is_none(self, frames):
        with pytest.raises(ParameterError, match="frames"):
            CleanClips(self.source, 4, frames, 8, 8)


def test_drawing_alone_needs_the_exact_simulator():
    for simulator in (None, {"model": "warp-blur"}):
        with pytest.raises(ParameterError, match="drawn"):
            ClipData(simulator=simulator, drawn=True)
