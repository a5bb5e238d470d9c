import numpy as np
import pytest
from PIL import Image

from turbnet.data.sources import EMBEDDED, Mixture, Pictures, Text, embedded_paths, folder_paths, load_picture
from turbnet.errors import InputError


@pytest.fixture(autouse=True)
def nothing_cached():
    load_picture.cache_clear()


@pytest.fixture
def folder(tmp_path):
    noise = np.random.default_rng(0).integers(256, size=(20, 31, 3), dtype=np.uint8)
    (tmp_path / "more").mkdir()
    Image.fromarray(noise).save(tmp_path / "b.png")
    Image.fromarray(noise).save(tmp_path / "more" / "a.JPG")
    (tmp_path / "notes.txt").write_text("no picture")
    return tmp_path


def test_embedded_pictures_exist_and_those_of_the_test_are_not_trained_on():
    train, test = embedded_paths("train"), embedded_paths("test")
    assert all(path.is_file() for path in train + test)
    assert test
    assert not set(train) & set(test)
    assert len(set(EMBEDDED["train"])) == len(train)


@pytest.mark.parametrize("source", [Pictures(embedded_paths("train")), Text(), Mixture([Text(), Text()], [1, 3])])
@pytest.mark.parametrize("size", [(32, 32), (17, 50)])
def test_crops_in_range_that_the_seed_decides(source, size):
    first, again, other = (source(np.random.default_rng(seed), *size) for seed in (3, 3, 4))
    assert first.shape == (*size, 3)
    assert first.dtype == np.float32
    assert 0 <= first.min() <= first.max() <= 1
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


@pytest.mark.parametrize("size", [(64, 64), (19, 64), (64, 20), (21, 32)])
def test_a_crop_larger_than_the_picture(folder, size):
    source = Pictures([folder / "b.png"])
    for seed in range(8):
        assert source(np.random.default_rng(seed), *size).shape == (*size, 3)


def test_a_picture_of_one_pixel(tmp_path):
    Image.new("RGB", (1, 1), (255, 128, 0)).save(tmp_path / "one.png")
    crop = Pictures([tmp_path / "one.png"])(np.random.default_rng(0), 9, 7)
    np.testing.assert_allclose(crop, np.broadcast_to(np.float32([1, 128 / 255, 0]), (9, 7, 3)), atol=1e-6)


def test_a_crop_at_full_scale_is_a_part_of_the_picture(folder):
    """Turned or mirrored, but every pixel one of the file's."""
    picture = load_picture(folder / "b.png")
    pixels = {tuple(p) for p in picture.reshape(-1, 3)}
    crop = Pictures([folder / "b.png"], scales=(1.0, 1.0))(np.random.default_rng(0), 8, 8)
    assert {tuple(p) for p in crop.reshape(-1, 3)} <= pixels


def test_a_mixture_draws_by_weight():
    def constant(value):
        return lambda rng, height, width: np.full((height, width, 3), value, dtype=np.float32)

    mixture = Mixture([constant(0.0), constant(1.0)], [1, 3])
    rng = np.random.default_rng(0)
    mean = np.mean([mixture(rng, 1, 1)[0, 0, 0] for _ in range(1000)])
    assert abs(mean - 0.75) < 4 * (0.75 * 0.25 / 1000) ** 0.5


def test_folders_are_searched_recursively_and_sorted(folder):
    assert [path.name for path in folder_paths([folder])] == ["b.png", "a.JPG"]


def test_folders_that_are_of_no_use(folder):
    with pytest.raises(InputError, match="there is no folder"):
        folder_paths([folder / "absent"])
    (folder / "empty").mkdir()
    with pytest.raises(InputError, match="no pictures in"):
        folder_paths([folder, folder / "empty"])


def test_grey_alpha_and_16_bit_pictures(tmp_path):
    Image.new("L", (4, 3), 51).save(tmp_path / "grey.png")
    Image.new("RGBA", (4, 3), (51, 51, 51, 255)).save(tmp_path / "alpha.png")
    Image.fromarray(np.full((3, 4), 51 * 257, dtype=np.uint16)).save(tmp_path / "deep.png")
    for name in ("grey", "alpha", "deep"):
        np.testing.assert_allclose(load_picture(tmp_path / f"{name}.png"), np.full((3, 4, 3), 0.2), atol=1e-6)


@pytest.mark.parametrize("damage", ["text", "empty", "cut"])
def test_a_corrupt_picture(folder, damage):
    path = folder / "b.png"
    content = {"text": b"this is no picture", "empty": b"", "cut": path.read_bytes()[:300]}[damage]
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"b\.png"):
        load_picture(path)
