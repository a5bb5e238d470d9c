"""Datasets written by the library: what is in a shard is what the pair maker made."""

import json
import math

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file
from torch.utils.data import DataLoader, Dataset

from turbnet.data.clips import CleanClips
from turbnet.data.dataset import write_dataset
from turbnet.data.pairs import PairMaker
from turbnet.data.shards import Shards, read_manifest, verify
from turbnet.data.sources import Text
from turbnet.errors import InputError, ParameterError

COUNT, SHARD, FRAMES, HEIGHT, WIDTH = 7, 3, 2, 16, 24
SETTINGS = {"version": "1", "seed": 0}


@pytest.fixture(scope="module")
def scenes():
    return CleanClips(Text(), COUNT, FRAMES, HEIGHT, WIDTH, moving=0.5)


@pytest.fixture(scope="module")
def maker():
    ranges = {"distance": (4000, 8000), "geometries": 2, "full_well": (1000, math.inf)}
    return PairMaker(HEIGHT, WIDTH, modes=10, components=2, **ranges)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, scenes, maker):
    path = tmp_path_factory.mktemp("data") / "set"
    write_dataset(path, scenes, maker, SETTINGS, COUNT, SHARD)
    return path


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_sample_is_the_pair_of_its_clip(folder, scenes, maker):
    shards = Shards(folder)
    assert len(shards) == COUNT
    for index in range(COUNT):
        clip, sample = scenes[index], shards[index]
        pair = maker(clip["scene"][None], [int(clip["seed"])])
        for name in ("frames", "target", "blur_only"):
            assert sample[name].dtype == torch.float32
            assert sample[name].shape == (FRAMES, 3, HEIGHT, WIDTH)
            assert (sample[name] - getattr(pair, name)[0]).abs().max() <= 0.5 / 255 + 1e-6
        assert sample["tilt"].shape == (FRAMES, 2, HEIGHT, WIDTH)
        torch.testing.assert_close(sample["tilt"], pair.tilt[0], rtol=2**-11, atol=1e-6)
        conditions = maker.conditions(int(clip["seed"]))
        assert float(sample["d_over_r0"]) == conditions.d_over_r0
        assert int(sample["geometry"]) == conditions.geometry
        assert int(sample["draw_seed"]) == conditions.draw_seed
        assert float(sample["full_well"]) == conditions.sensor.full_well
        if conditions.wind is None:
            assert sample["wind"].isnan().all()
        else:
            assert tuple(sample["wind"].tolist()) == conditions.wind


def test_the_manifest_lists_what_is_there(folder, maker):
    manifest = read_manifest(folder)
    assert manifest["complete"]
    assert [shard["samples"] for shard in manifest["shards"]] == [3, 3, 1]
    assert {path.name for path in folder.iterdir()} == {"manifest.json", *(s["file"] for s in manifest["shards"])}
    assert [(row["index"], row["row"]) for row in manifest["samples"]] == [(i, i % SHARD) for i in range(COUNT)]
    for row in manifest["samples"]:
        conditions = maker.conditions(row["seed"])
        assert row["wind"] == (None if conditions.wind is None else list(conditions.wind))
        assert row["read_noise"] == conditions.sensor.read_noise
        assert load_file(folder / row["shard"])["seed"][row["row"]] == row["seed"]
    pixels = [geometry["aperture_pixels"] for geometry in manifest["geometries"]]
    assert pixels == [pytest.approx(path.aperture / path.pixel) for path in maker.ranges.paths()]
    assert all(row.ok for row in verify(folder))


@pytest.mark.parametrize("workers", [1, 3])
def test_the_files_do_not_depend_on_the_number_of_workers(folder, tmp_path, scenes, maker, workers):
    write_dataset(tmp_path / "set", scenes, maker, SETTINGS, COUNT, SHARD, workers)
    assert contents(tmp_path / "set") == contents(folder)


def test_the_files_do_not_depend_on_the_number_of_threads(folder, tmp_path, scenes, maker):
    torch.set_num_threads(2)
    try:
        write_dataset(tmp_path / "set", scenes, maker, SETTINGS, COUNT, SHARD)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)
    assert contents(tmp_path / "set") == contents(folder)


class Failing(Dataset):
    """Good scenes up to a bad one."""

    def __init__(self, scenes, good):
        self.scenes, self.good, self.asked = scenes, good, []

    def __getitem__(self, index):
        self.asked.append(index)
        if index >= self.good:
            raise InputError(f"scene {index} is bad")
        return self.scenes[index]


@pytest.mark.parametrize("workers", [0, 2])
def test_a_stopped_run_goes_on_and_ends_with_the_same_files(folder, tmp_path, scenes, maker, workers):
    begun = tmp_path / "set"
    with pytest.raises(InputError, match="^scene 4 is bad$"):
        write_dataset(begun, Failing(scenes, 4), maker, SETTINGS, COUNT, SHARD, workers)
    assert set(contents(begun)) == {"manifest.json", "shard-00000.safetensors"}  # the second shard was never whole
    with pytest.raises(InputError, match="is incomplete"):
        Shards(begun)
    assert [row.ok for row in verify(begun)] == [True, False]
    (begun / ".shard-00001.0a1b2c3d.partial.safetensors").write_bytes(b"left by a killed run")
    rest = Failing(scenes, COUNT)
    write_dataset(begun, rest, maker, SETTINGS, COUNT, SHARD)
    assert rest.asked == [3, 4, 5, 6]
    assert contents(begun) == contents(folder)


def test_a_run_that_fails_before_its_first_shard_leaves_nothing(tmp_path, scenes, maker):
    with pytest.raises(InputError, match="scene 1 is bad"):
        write_dataset(tmp_path / "set", Failing(scenes, 1), maker, SETTINGS, COUNT, SHARD)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("harm", ["flip", "cut", "remove"])
def test_damage_is_found_and_mended(folder, tmp_path, scenes, maker, harm):
    for name, data in contents(folder).items():
        (tmp_path / name).write_bytes(data)
    shard = tmp_path / "shard-00001.safetensors"
    data = bytearray(shard.read_bytes())
    data[-5] ^= 1
    if harm == "remove":
        shard.unlink()
    else:
        shard.write_bytes(data if harm == "flip" else data[:100])
    assert [row.name for row in verify(tmp_path) if not row.ok] == [shard.name]
    if harm != "flip":
        with pytest.raises(InputError, match="cannot read"):
            Shards(tmp_path)[3]
    again = Failing(scenes, COUNT)
    write_dataset(tmp_path, again, maker, SETTINGS, COUNT, SHARD)
    assert again.asked == [3, 4, 5]
    assert contents(tmp_path) == contents(folder)


def test_a_finished_run_is_left_as_it_is(folder, scenes, maker):
    before = contents(folder)
    asked = Failing(scenes, 0)
    write_dataset(folder, asked, maker, SETTINGS, COUNT, SHARD)
    assert not asked.asked
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"settings": {**SETTINGS, "seed": 1}}, "its seed is 0, not 1"),
        ({"count": 6}, "count"),
        ({"shard_size": 2}, "size"),
    ],
)
def test_another_run_is_refused(folder, scenes, maker, change, says):
    before = contents(folder)
    with pytest.raises(InputError, match=says):
        write_dataset(
            **{"folder": folder, "scenes": scenes, "maker": maker, "settings": SETTINGS, "count": COUNT}
            | {"shard_size": SHARD}
            | change
        )
    assert contents(folder) == before


def test_folders_that_hold_something_else(tmp_path, scenes, maker):
    (tmp_path / "file").write_text("")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("dear")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "manifest.json").write_text('{"format": "of others"}')
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "manifest.json").write_text('{"format": ')
    for name in ("file", "full", "foreign", "broken", "no/such"):
        with pytest.raises(InputError, match=name):
            write_dataset(tmp_path / name, scenes, maker, SETTINGS, COUNT, SHARD)
    with pytest.raises(InputError, match="holds no manifest"):
        list(verify(tmp_path))


@pytest.mark.parametrize("bad", [{"count": 0}, {"shard_size": 0}, {"workers": -1}])
def test_numbers_out_of_range(tmp_path, scenes, maker, bad):
    with pytest.raises(ParameterError):
        write_dataset(tmp_path / "set", scenes, maker, SETTINGS, **{"count": COUNT, **bad})
    assert not list(tmp_path.iterdir())


def test_batches_of_a_loader_with_workers(folder):
    batches = list(DataLoader(Shards(folder), batch_size=4, num_workers=1))
    assert [len(batch["frames"]) for batch in batches] == [4, 3]
    assert batches[0]["wind"].shape == (4, 2)
    with pytest.raises(IndexError):
        Shards(folder)[COUNT]


def test_the_manifest_is_strict_json(folder):
    text = (folder / "manifest.json").read_text()

    def refuse(constant):
        raise AssertionError(constant)

    manifest = json.loads(text, parse_constant=refuse)
    wells = [row["full_well"] for row in manifest["samples"]]
    assert all(well is None or np.isfinite(well) for well in wells)
