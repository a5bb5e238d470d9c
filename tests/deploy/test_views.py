"""Several views of a clip, and their mean."""

import numpy as np
import pytest

from turbnet.deploy.method import ClassicalMethod
from turbnet.deploy.restore import restore_clip, views_of
from turbnet.deploy.restorer import Restorer
from turbnet.deploy.session import Model
from turbnet.deploy.views import Views
from turbnet.errors import InputError, ParameterError
from turbnet.media.clip import read_clip, write_clip


@pytest.fixture
def frames() -> np.ndarray:
    return np.random.default_rng(0).random((1, 3, 3, 12, 20), dtype=np.float32)


@pytest.mark.parametrize("count", range(1, 9))
def test_what_knows_no_direction_is_left_as_it_is(frames, count):
    np.testing.assert_allclose(Views(lambda x: 0.5 * x + 0.1, count)(frames), 0.5 * frames + 0.1, rtol=0, atol=1e-6)


def test_every_view_is_another_one(frames):
    """All eight, each once: what a network saw of one square."""
    square, seen = frames[..., :12], []

    def network(x):
        seen.append(x.tobytes())
        return x

    Views(network, 8)(square)
    wanted = [np.rot90(m, k, (-2, -1)).tobytes() for m in (square, square[..., ::-1]) for k in range(4)]
    assert sorted(seen) == sorted(wanted)


def test_the_mean_of_eight_knows_no_direction(frames):
    """A network that shifts to the right, all views averaged, commutes with turning and mirroring."""
    views = Views(lambda x: np.roll(x, 1, axis=-1), 8)
    for change in (lambda x: x[..., ::-1], lambda x: x.swapaxes(-1, -2), lambda x: np.rot90(x, 1, (-2, -1))):
        np.testing.assert_allclose(views(np.ascontiguousarray(change(frames))), change(views(frames)), atol=1e-6)


def test_errors_of_a_network_are_averaged(frames):
    """Independent errors of variance 1: of the mean of four, 1/4; 2160 samples, a standard error of 3 %."""
    rng = np.random.default_rng(1)
    error = Views(lambda x: x + rng.standard_normal(x.shape).astype(np.float32), 4)(frames) - frames
    assert abs(error.var() - 0.25) < 5 * 0.25 * np.sqrt(2 / error.size)


@pytest.mark.parametrize("count", [0, 9])
def test_no_such_number(count):
    with pytest.raises(ParameterError, match=f"views = {count}"):
        Views(lambda x: x, count)


def test_a_clip_of_several_views(model_file, tmp_path):
    """In a file as in memory, of tiles that are no squares."""
    clip = np.random.default_rng(0).random((8, 37, 70, 3), dtype=np.float32)
    write_clip(tmp_path / "in.tiff", clip)
    model = Model.load(model_file, 1)
    restored = {}
    for views in (1, 3):
        restore_clip(tmp_path / "in.tiff", tmp_path / "out.tiff", model, tile=32, views=views)
        restored[views] = read_clip(tmp_path / "out.tiff")[0]
        memory = Restorer(model_file, threads=1, tile=32, views=views)(clip)
        np.testing.assert_allclose(restored[views], memory, rtol=0, atol=1e-4)  # the files have 16 bits
    assert np.abs(restored[3] - restored[1]).max() > 0.01


def test_what_has_no_views(tmp_path):
    with pytest.raises(InputError, match="views = 2: a method without learning"):
        views_of(ClassicalMethod("mean"), 2)
