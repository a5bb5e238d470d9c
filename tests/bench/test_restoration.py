"""The frozen benchmark and its tables."""

import numpy as np
import pytest

from turbnet.bench.restoration import Entrant, Result, Score, _by_command, entrants, report, table
from turbnet.bench.suite import SIZE, make_clip
from turbnet.errors import InputError


@pytest.mark.parametrize("kind", ["static", "dynamic", "text"])
def test_a_clip_is_the_same_every_time_and_begins_alike_at_any_length(kind):
    short, long = (make_clip(kind, 0, 1.5, frames) for frames in (1, 2))
    assert long.frames.shape == long.target.shape == (2, SIZE, SIZE, 3)
    np.testing.assert_array_equal(long.first(1).frames, short.frames)
    np.testing.assert_array_equal(long.first(1).target, short.target)
    assert bool(long.boxes) == (kind == "text")
    assert bool(long.moving.any()) == (kind == "dynamic")
    np.testing.assert_allclose(long.frames * 255, np.round(long.frames * 255), atol=1e-3)  # 8 bits
    assert 1e-4 < float(((long.frames - long.target) ** 2).mean()) < 0.1


def test_a_clip_settles_to_its_own_geometry():
    """The mean of the frames is nearer the clean picture in their mean geometry than the clean picture as it is."""
    clip = make_clip("static", 0, 3.0, 2)
    mean, inner = clip.frames.mean(0), (slice(8, -8), slice(8, -8))
    settled, plain = (((mean - x[0]) ** 2)[inner].mean() for x in (clip.settled(), clip.target))
    assert settled < 0.8 * plain
    np.testing.assert_array_equal(clip.first(1).tilt, clip.tilt[:1])


def test_something_moves_where_it_is_said_to():
    clip = make_clip("dynamic", 1, 1.5, 2)
    change = np.abs(np.diff(clip.target, axis=0))[0].max(-1) > 0.02
    about = clip.moving.any(0)
    assert change.any()
    assert (change & about).sum() > 0.7 * change.sum()


def test_an_outside_command_takes_part():
    frames = (np.random.default_rng(0).integers(0, 256, (2, 16, 24, 3)) / 255).astype(np.float32)
    peaks = []
    np.testing.assert_allclose(_by_command("cp {in} {out}", frames, peaks), frames, atol=1e-6)
    assert 0 < peaks[0] < 0.1  # GiB
    with pytest.raises(InputError, match="ended with"):
        _by_command("false {in} {out}", frames, [])
    with pytest.raises(InputError, match="cannot be run"):
        _by_command("no-such-command {in} {out}", frames, [])


@pytest.mark.parametrize(
    ("asked", "complaint"),
    [(("alchemy", (), ()), "alchemy"), (((), ("no.onnx",), ()), "no.onnx"), (((), (), ("cp {in}",)), "{out}")],
)
def test_unknown_entrants_are_refused(asked, complaint):
    methods, models, commands = ((a,) if isinstance(a, str) else a for a in asked)
    with pytest.raises(InputError, match=complaint.replace("{", r"\{")):
        entrants(methods, models, commands)


def test_everybody_takes_part_unless_told_otherwise():
    names = [entrant.name for entrant in entrants((), (), ())]
    assert names[:2] == ["input", "settled"]
    assert {"pipeline", "mean", "s"} <= set(names)


def test_tables_hold_means_and_intervals():
    scores = [Score("static", 3.0, 12, psnr, 0.5, seconds=1.2) for psnr in (20.0, 22.0, 24.0)]
    result = Result(Entrant("method", "mean"), scores, 0.5)
    # 1.96 standard deviations of 2 over the root of 3.
    assert "| mean | 22.0 ± 2.3 | 0.50 ± 0.00 |" in table([result])
    rows = {row.name: row.value for row in report([result]).rows}
    assert rows["mean, static, D/r0 = 3, 12 frames: PSNR"] == pytest.approx(22.0)
    assert rows["mean: time a frame"] == pytest.approx(100.0)
