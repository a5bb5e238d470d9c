"""What a network is spared, on scenes whose turbulence is known."""

from itertools import cycle

import numpy as np
import pytest
import skimage.data
import torch

from turbnet.data.pairs import PairMaker
from turbnet.deploy.restore import restore_frames
from turbnet.deploy.skipping import ENOUGH, STILL, Skipped, Skipping, around, dance
from turbnet.deploy.tiling import Tiling

SIZE = 96


@pytest.fixture(scope="module")
def scene():
    return (skimage.data.astronaut()[64 : 64 + SIZE, 160 : 160 + SIZE] / 255).astype(np.float32)


def seen(scene, strength, frames, seed=0):
    """(T, H, W, 3) through independent air with a camera's noise."""
    ranges = {"d_over_r0": (strength, strength), "independent": 1.0, "read_noise": (0.01, 0.01), "full_well": 20_000.0}
    clip = torch.from_numpy(scene).permute(2, 0, 1).expand(1, frames, 3, SIZE, SIZE)
    return PairMaker(SIZE, SIZE, **ranges)(clip, [seed]).frames[0].permute(0, 2, 3, 1).numpy()


def through(frames, skipped, window=12, network=lambda x: 0.5 * x):
    return np.stack(list(restore_frames(frames, Skipping(network, 1, skipped), Tiling(128, 8, 8), window)))


@pytest.mark.parametrize("strength", [1.0, 3.0])
def test_the_dance_is_that_of_the_air(scene, strength):
    """sqrt(0.4489) 4 / pi (D/r0)^(5/6) pixels; a picture bends, and blurs with it: within a third."""
    expected = 0.853 * strength ** (5 / 6)
    assert dance(seen(scene, strength, 12).mean(-1)) == pytest.approx(expected, rel=0.35)


def test_noise_does_not_dance(scene):
    assert dance(seen(scene, 0.0, 12).mean(-1)) < STILL
    assert dance(np.repeat(scene.mean(-1)[None], 5, 0)) == 0
    assert dance(np.full((4, 32, 32), 0.3)) == 0


def test_what_moves_of_itself_does_not_dance(scene):
    frames = np.repeat(scene.mean(-1)[None], 12, 0)
    for number, frame in enumerate(frames):
        frame[20:40, 10 + 4 * number : 30 + 4 * number] = 0.9
    assert dance(frames) < STILL


def test_a_clean_clip_passes_as_it_is(scene):
    frames, skipped = seen(scene, 0.0, 20), Skipped()
    np.testing.assert_allclose(through(frames, skipped), frames, atol=1e-6)
    assert skipped.restored == skipped.still == 0
    assert skipped.saved == 1


def test_a_still_background_is_restored_in_two_windows(scene):
    frames, skipped = seen(scene, 2.0, 84), Skipped()
    out = through(frames, skipped, network=lambda x: x.mean(1, keepdims=True).repeat(x.shape[1], 1))
    # Twelve frames tell how much a block fluctuates to a fifth: a few blocks are restored again though nothing has changed.
    assert skipped.clean == 0
    assert ENOUGH == 2
    assert 2 <= skipped.restored < 4
    assert skipped.restored + skipped.still == pytest.approx(9)
    expected = np.mean([frames[start : start + 12].mean(0) for start in (0, 9)], axis=0)
    assert np.mean(np.abs(out[-1] - expected) < 1e-5) > 0.5
    # The mean of 21 frames is nearer the scene's own geometry than that of 12.
    truth = frames.mean(0)
    assert np.mean((out[-1] - truth) ** 2) < 0.8 * np.mean((frames[:12].mean(0) - truth) ** 2)


def test_where_the_background_ends_nothing_jumps(scene):
    """The network answers with another grey every time: no step from pixel to pixel beyond that of the fading."""
    frames, skipped = seen(scene, 2.0, 48), Skipped()
    frames[:, 40:56, 40:56] = np.random.default_rng(0).random((48, 1, 1, 1), np.float32)
    greys = cycle((0.0, 1.0))
    out = through(frames, skipped, network=lambda x: np.full_like(x, next(greys)))
    assert np.ptp(out) > 0.4
    steps = max(np.abs(np.diff(out, axis=axis)).max() for axis in (1, 2))
    assert steps < 2.05 / 17  # a mean over 17 pixels changes by no more than a 17th, and there are two


@pytest.mark.parametrize("at", [10, 20, 30])
def test_what_comes_into_the_scene_is_seen(scene, at):
    """A shadow of 12 x 12 pixels, as strong as a block's mean may fluctuate: every window that shows it is restored."""
    frames, skipped = seen(scene, 2.0, 48), Skipped()
    frames[at : at + 6, 40:52, 30:42] *= 0.3
    out = through(frames, skipped, network=lambda x: x)
    shown = out[at + 1 : at + 5, 40:52, 30:42]
    np.testing.assert_allclose(shown, frames[at + 1 : at + 5, 40:52, 30:42], atol=0.05)
    assert skipped.restored >= 2


def test_what_passes_by_does_not_wipe_out_the_background(scene):
    """It hides a quarter of the scene for a window; behind it the background is known as before."""
    frames, skipped, shares = seen(scene, 2.0, 108), Skipped(), []
    frames[50:62, 8:56, 8:56] = np.random.default_rng(0).random((12, 1, 1, 3), np.float32)

    def network(x):
        shares.append(x.shape[3] * x.shape[4] / SIZE**2)
        return x.mean(1, keepdims=True).repeat(x.shape[1], 1)

    out = through(frames, skipped, network=network)
    assert skipped.restored < 8  # of 12: two for the background, three that show it pass, blocks that fluctuate
    # Blocks in which it was taken for the background for a window are restored anew; nothing of it is left.
    before, after = out[40, 16:48, 16:48], out[100, 16:48, 16:48]
    assert np.sqrt(np.mean((before - after) ** 2)) < 0.02


def test_what_comes_to_stay_is_the_background_from_then_on(scene):
    frames, skipped = seen(scene, 2.0, 108), Skipped()
    frames[50:, 8:56, 8:56] = 0.25 + 0.5 * frames[50:, 40:88, 40:88]
    out = through(frames, skipped, network=lambda x: x.mean(1, keepdims=True).repeat(x.shape[1], 1))
    assert skipped.restored < 8
    inside = np.s_[20:44, 20:44]
    assert np.mean((out[100][inside] - frames[60:].mean(0)[inside]) ** 2) < 1e-3
    assert np.mean(np.abs(out[100][inside] - out[90][inside]) < 1e-5) > 0.5


@pytest.mark.parametrize("corner", [(0, 0), (80, 80), (40, 0)])
def test_only_what_changes_is_restored_again(scene, corner):
    """Something flickers in one place all the time: the network sees that place and what surrounds it, no more."""
    frames, skipped, sizes = seen(scene, 2.0, 84), Skipped(), []
    place = np.s_[:, corner[0] : corner[0] + 16, corner[1] : corner[1] + 16]
    frames[place] = np.random.default_rng(0).random((84, 1, 1, 1), np.float32)

    def network(x):
        sizes.append(x.shape[3:])
        assert all(side % 8 == 0 for side in x.shape[3:])
        return x

    out = through(frames, skipped, network=network)
    assert sizes[:ENOUGH] == [(SIZE, SIZE)] * ENOUGH
    areas = [height * width / SIZE**2 for height, width in sizes[ENOUGH:]]
    assert np.median(areas) < 0.9
    assert skipped.restored < 8.5
    np.testing.assert_allclose(out[place], frames[place], atol=1e-6)
    far = np.ptp(out[30:], axis=0).max(-1)
    assert np.mean(far < 1e-6) > 0.3  # settled


def test_a_camera_that_changes_its_exposure_shows_the_same_background(scene):
    """A fifth darker and lighter again: no block is seen anew, and the background is as light as each frame."""
    exposure = 0.9 + 0.1 * np.cos(np.arange(60) / 8)
    frames, skipped = (exposure[:, None, None, None] * seen(scene, 1.0, 60)).astype(np.float32), Skipped()
    out = through(frames, skipped, network=lambda x: x)
    assert skipped.restored == pytest.approx(ENOUGH)
    assert skipped.still >= 3
    levels = out[30:].mean((1, 2, 3)) / frames[30:].mean((1, 2, 3))
    np.testing.assert_allclose(levels, 1, atol=0.02)  # the air alone moves the means of blocks by as much
    still = out[30:] / exposure[30:, None, None, None]
    assert np.sqrt(still.var(0).mean()) < 0.2 * np.sqrt((frames / exposure[:, None, None, None]).var(0).mean())


@pytest.mark.parametrize("kind", ["exposure", "another scene"])
def test_what_changes_everywhere_does_not_look_still(scene, kind):
    """Weak gradients then vary as strong ones do, as they would in clear air."""
    frames = seen(scene, 1.0, 24)
    if kind == "exposure":
        frames = frames * np.linspace(1, 0.5, 24, dtype=np.float32)[:, None, None, None]
    else:
        frames[8:16] = frames[8:16, ::-1, ::-1]
    skipped = Skipped()
    through(frames, skipped)
    assert skipped.clean == 0


@pytest.mark.filterwarnings("error")
def test_where_no_dance_can_be_told_all_is_restored_and_nothing_kept():
    """A flat picture of which a third flickers has no slopes that a dance could be seen by."""
    frames, skipped = np.full((36, SIZE, SIZE, 3), 0.5, np.float32), Skipped()
    frames[::2, :, : SIZE // 3], frames[1::2, :, : SIZE // 3] = 0.3, 0.7
    assert dance(frames[:12].mean(-1)) == np.inf
    np.testing.assert_allclose(through(frames, skipped), 0.5 * frames, atol=1e-6)
    assert skipped.clean == skipped.still == 0


def test_rectangles_hold_what_has_changed_and_little_else():
    rng = np.random.default_rng(0)
    for _ in range(20):
        sides = tuple(int(side) for side in 8 * rng.integers(8, 60, 2))
        changed = np.zeros([side // 16 for side in sides], bool)
        for row, column in zip(*(rng.integers(0, n, 3) for n in changed.shape), strict=True):
            changed[row, column : column + 3] = True
        boxes, seen = around(changed, sides, 8), np.zeros(sides, bool)
        for down, across in boxes:
            assert not any(end % 8 for part in (down, across) for end in (part.start, part.stop))
            seen[down, across] = True
        for row, column in np.argwhere(changed):  # with 32 pixels around each block; the last one takes what is left
            bottom = sides[0] if row == changed.shape[0] - 1 else 16 * row + 48
            right = sides[1] if column == changed.shape[1] - 1 else 16 * column + 48
            assert seen[max(16 * row - 32, 0) : bottom, max(16 * column - 32, 0) : right].all()
    assert around(np.zeros((4, 4), bool), (64, 64), 8) == []
    corners = np.zeros((30, 30), bool)
    corners[0, 0] = corners[-1, -1] = True
    assert len(around(corners, (480, 480), 8)) == 2


def test_frames_alone_are_restored(scene):
    skipped = Skipped()
    np.testing.assert_allclose(through(scene[None], skipped), 0.5 * scene[None], atol=1e-6)
    assert skipped == Skipped(restored=1)


@pytest.mark.parametrize(("expected", "passes"), [(0.003, True), (0.02, False)])
def test_a_frame_of_which_no_change_is_expected_passes(scene, expected, passes):
    """What a few pixels need does not count; frames that have neighbours are judged by their dance."""

    def maps(x):
        found = np.full((1, x.shape[1], 3, *x.shape[3:]), expected, np.float32)
        found[..., :4, :4] = 1.0
        return found

    skipped = Skipped()
    out = Skipping(lambda x: 0.5 * x, 1, skipped, maps=maps)(scene.transpose(2, 0, 1)[None, None])[0, 0]
    np.testing.assert_array_equal(out, scene.transpose(2, 0, 1) * (1 if passes else 0.5))
    assert skipped == (Skipped(clean=1) if passes else Skipped(restored=1))
    frames, skipped = seen(scene, 3.0, 8).transpose(0, 3, 1, 2), Skipped()
    Skipping(lambda x: x, 1, skipped, maps=maps)(frames[None])
    assert skipped == Skipped(restored=1)


def test_tiles_keep_to_themselves(scene):
    """Two tiles, of which only the left one dances."""
    moving = seen(scene, 3.0, 16)
    frames = np.concatenate((moving, np.repeat(scene[None], 16, 0)), axis=2)
    tiling, skipped = Tiling(104, 16, 8), Skipped()
    assert tiling.count(SIZE, 2 * SIZE) == 2
    list(restore_frames(frames, Skipping(lambda x: x, 2, skipped), tiling, 8))
    assert skipped.clean >= 1
    assert skipped.restored >= 1
