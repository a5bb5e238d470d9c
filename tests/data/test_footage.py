import numpy as np
import pytest
import torch
from PIL import Image

from turbnet.data.clips import CleanClips
from turbnet.data.footage import Alternating, Footage, footage_paths
from turbnet.data.sources import Text
from turbnet.errors import InputError, ParameterError
from turbnet.media.clip import write_clip


@pytest.fixture(scope="module")
def footage(tmp_path_factory):
    """A lossless video whose pixels tell frame, row and column; a folder of two frames; a text beside them."""
    folder = tmp_path_factory.mktemp("footage")
    t, y, x = np.meshgrid(np.arange(9), np.arange(24), np.arange(32), indexing="ij")
    write_clip(folder / "ramp.tif", np.stack((t * 20, y * 8, x * 6), -1).astype(np.float32) / 255)
    (folder / "movies").mkdir()
    write_clip(folder / "movies" / "ramp.mkv", np.stack((t * 20, y * 8, x * 6), -1).astype(np.float32) / 255)
    (folder / "stills").mkdir()
    for number in range(2):
        Image.new("RGB", (32, 24), (number, 0, 0)).save(folder / "stills" / f"{number}.png")
    (folder / "notes.txt").write_text("no clip")
    return folder


def test_videos_and_folders_of_frames_are_found(footage):
    assert footage_paths([footage / "movies"]) == [footage / "movies" / "ramp.mkv"]
    assert footage_paths([footage / "stills"]) == [footage / "stills"]
    assert footage_paths([footage]) == [footage, footage / "movies" / "ramp.mkv", footage / "stills"]


def test_a_cut_is_consecutive_frames_of_one_window(footage):
    clips = Footage([footage / "ramp.tif"], frames=4, height=8, width=16)
    seen = set()
    for index in range(60):
        scene = clips[index]["scene"]
        assert scene.shape == (4, 3, 8, 16)
        t, y, x = (scene * 255).round().unbind(1)
        assert torch.equal(t, t[:1, :1, :1] + 20 * torch.arange(4)[:, None, None].expand_as(t))
        assert torch.equal(y, y[:1, :1, :1] + 8 * torch.arange(8)[:, None].expand_as(y))
        assert torch.equal(x, x[:1, :1, :1] + 6 * torch.arange(16).expand_as(x))
        seen.add((int(t.min()) // 20, int(y.min()) // 8, int(x.min()) // 6))
    for axis, room in enumerate((5, 16, 16)):
        # Every start is equally likely: the first and the last frame are used, the mean lies in the middle.
        starts = [start[axis] for start in seen]
        assert min(starts) >= 0
        assert max(starts) <= room
        assert abs(np.mean(starts) - room / 2) < 4.5 * (room + 1) / (12 * len(seen)) ** 0.5
    assert {start[0] for start in seen} == set(range(6))


def test_clip_i_is_the_same_in_any_order(footage):
    first, second = (Footage([footage / "ramp.tif"], 2, 8, 8, seed=3) for _ in range(2))
    forwards = [first[i] for i in range(6)]
    for expected, index in zip(forwards[::-1], reversed(range(6)), strict=True):
        again = second[index]
        assert torch.equal(expected["scene"], again["scene"])
        assert expected["seed"] == again["seed"]
    assert len({int(clip["seed"]) for clip in forwards}) == 6
    assert Footage([footage / "ramp.tif"], 2, 8, 8, seed=4)[0]["seed"] != forwards[0]["seed"]


def test_sets_take_turns(footage):
    clips = Footage([footage / "ramp.tif"], 2, 16, 16)
    texts = CleanClips(Text(), 4, 2, 16, 16)
    both = Alternating([texts, clips])
    for index in range(4):
        assert torch.equal(both[index]["scene"], (texts, clips)[index % 2][index]["scene"])


def test_what_cannot_be_used(footage, tmp_path):
    with pytest.raises(InputError, match="there is no folder"):
        footage_paths([tmp_path / "absent"])
    with pytest.raises(InputError, match="no clips in"):
        footage_paths([tmp_path])
    for size in ((10, 8, 8), (2, 25, 8), (2, 8, 33)):
        with pytest.raises(InputError, match=r"ramp\.tif holds 9 frames of 32x24"):
            Footage([footage / "ramp.tif"], *size)
    with pytest.raises(ParameterError, match="frames"):
        Footage([footage / "ramp.tif"], 0, 8, 8)
