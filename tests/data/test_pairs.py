import math
from dataclasses import replace

import pytest
import skimage.data
import torch

from turbnet.data.pairs import PairMaker, defocused
from turbnet.errors import InputError, ParameterError
from turbnet.media.colour import to_linear
from turbnet.simulate.tilt import sample

SMALL = {"modes": 10, "components": 3}
SILENT = {"read_noise": (0.0, 0.0), "full_well": float("inf")}


@pytest.fixture(scope="module")
def scene():
    picture = torch.from_numpy(skimage.data.astronaut()[96:160, 176:240].copy()).float().permute(2, 0, 1) / 255
    return picture.expand(1, 4, 3, 64, 64)


@pytest.fixture(scope="module")
def maker():
    return PairMaker(64, 64, **SMALL)


def test_shapes_and_range(maker, scene):
    pair = maker(scene.expand(2, -1, -1, -1, -1), [0, 1])
    for clip in (pair.frames, pair.target, pair.blur_only):
        assert clip.shape == (2, 4, 3, 64, 64)
        assert clip.min() >= 0
        assert clip.max() <= 1
    assert pair.tilt.shape == (2, 4, 2, 64, 64)
    assert torch.equal(pair.target, scene.expand(2, -1, -1, -1, -1))
    assert not torch.equal(pair.tilt[0], pair.tilt[1])


def test_the_seed_decides_alone_or_in_a_batch(maker, scene):
    torch.manual_seed(0)
    batch = maker(scene.expand(3, -1, -1, -1, -1), [7, 8, 9])
    torch.manual_seed(1)
    alone = maker(scene, [8])
    for name in ("frames", "blur_only", "tilt"):
        assert torch.equal(getattr(batch, name)[1:2], getattr(alone, name)), name


@pytest.mark.parametrize("model", ["zernike", "direct-to-image", "warp-blur"])
def test_clips_of_one_geometry_can_be_simulated_together(scene, monkeypatch, model):
    """As on a GPU: the same pairs but for the order of sums."""
    maker = PairMaker(64, 64, geometries=2, aperture=(0.17, 0.24), model=model, blurred=0.5, **SMALL)
    scenes, seeds = scene.expand(5, -1, -1, -1, -1), [3, 4, 5, 6, 7]
    each = maker(scenes, seeds)
    batches = PairMaker._batches
    monkeypatch.setattr(PairMaker, "_batches", lambda self, conditions, together: batches(conditions, True))
    together = maker(scenes, seeds)
    assert len({maker.conditions(seed).geometry for seed in seeds}) == 2
    for name in ("frames", "blur_only", "tilt"):
        torch.testing.assert_close(getattr(together, name), getattr(each, name), rtol=0, atol=1e-4)


def test_still_air_returns_the_clean_clip(scene):
    pair = PairMaker(64, 64, d_over_r0=(0.0, 0.0), **SMALL, **SILENT)(scene, [0])
    torch.testing.assert_close(pair.frames, scene, rtol=0, atol=1e-5)
    torch.testing.assert_close(pair.blur_only, scene, rtol=0, atol=1e-5)
    assert not pair.tilt.any()


def test_the_tilt_map_takes_the_frames_to_the_blur_only_frames(scene):
    pair = PairMaker(64, 64, d_over_r0=(2.0, 2.0), **SMALL, **SILENT)(scene, [3])
    frames, truth, tilt = (x.flatten(0, 1) for x in (to_linear(pair.frames), to_linear(pair.blur_only), pair.tilt))
    inner = (..., slice(8, -8), slice(8, -8))

    def distance(clip):
        return float((clip - truth)[inner].square().mean())

    assert distance(sample(frames, tilt)) < 0.1 * distance(frames)
    assert distance(sample(frames, -tilt)) > distance(frames)
    assert not torch.allclose(pair.blur_only, pair.target, atol=0.01)  # it is blurred


def test_settled_is_what_registered_frames_show_on_average(scene):
    """In the clip's mean geometry true tilts have no mean, and bring the frames to the truth, which elsewhere they miss."""
    pair = PairMaker(64, 64, d_over_r0=(3.0, 3.0), independent=1.0, **SMALL, **SILENT)(scene, [4])
    settled, inner = pair.settled(), (..., slice(12, -12), slice(12, -12))
    assert torch.equal(settled.frames, pair.frames)
    assert pair.tilt.mean(1)[inner].abs().max() > 0.5  # four frames
    assert settled.tilt.mean(1)[inner].abs().max() < 1e-3

    def distance(truth, tilt):
        registered = sample(to_linear(pair.frames).flatten(0, 1), tilt.flatten(0, 1)).view_as(truth)
        return float((registered - to_linear(truth))[inner].square().mean())

    there = distance(settled.blur_only, settled.tilt)
    assert there < 0.2 * distance(pair.blur_only, settled.tilt)
    assert there < 2 * distance(pair.blur_only, pair.tilt)  # as well as in the scene's own geometry


def test_settled_without_air_is_the_scene(scene):
    pair = PairMaker(64, 64, d_over_r0=(0.0, 0.0), **SMALL, **SILENT)(scene, [0])
    settled = pair.settled()
    torch.testing.assert_close(settled.target, scene, rtol=0, atol=1e-6)
    assert not settled.tilt.any()


@pytest.mark.parametrize("model", ["direct-to-image", "warp-blur"])
def test_the_simple_models_stand_in_for_the_simulator(scene, model):
    """The same contract: the true tilt takes the frames to the blur-only frames, and the camera points at the mean."""
    pair = PairMaker(64, 64, d_over_r0=(2.0, 2.0), model=model, **SMALL, **SILENT)(scene, [3])
    frames, truth, tilt = (x.flatten(0, 1) for x in (to_linear(pair.frames), to_linear(pair.blur_only), pair.tilt))
    inner = (..., slice(8, -8), slice(8, -8))
    before, after = ((x - truth)[inner].square().mean() for x in (frames, sample(frames, tilt)))
    assert after < 0.15 * before
    assert tilt.mean((0, 2, 3)).abs().max() < 0.3  # pixels; the grid reaches beyond the picture
    again = PairMaker(64, 64, d_over_r0=(2.0, 2.0), model=model, **SMALL, **SILENT)(scene, [3])
    assert torch.equal(again.frames, pair.frames)


def test_no_such_model():
    with pytest.raises(ParameterError, match="warp-blur"):
        PairMaker(64, 64, model="cheap")


def test_tilts_are_about_the_mean_aim(scene):
    """What all frames share is taken out; the grid reaches a little beyond the picture, so nearly."""
    pair = PairMaker(64, 64, d_over_r0=(3.0, 3.0), **SMALL)(scene, [4])
    common, spread = pair.tilt.mean((1, 3, 4)).abs().max(), pair.tilt.std()
    assert common < 0.2 * spread


@pytest.mark.parametrize("independent", [0.0, 1.0])
def test_frames_are_coherent_or_independent(scene, independent):
    """Between frames air at 0.5 m/s travels 1.7 mm, next to nothing beside the 20 cm aperture."""
    maker = PairMaker(
        64, 64, d_over_r0=(3.0, 3.0), wind=(0.5, 0.5), independent=independent, frame_rate=300.0, **SMALL, **SILENT
    )
    tilt = maker(scene, [5]).tilt[0]
    change = tilt.diff(dim=0).square().mean() / tilt.var()
    assert (change > 0.5) == bool(independent)
    assert (change < 0.2) == (not independent)


def test_noise_is_that_of_the_sensor():
    grey = torch.full((1, 4, 3, 64, 64), 0.5)
    maker = PairMaker(64, 64, d_over_r0=(0.0, 0.0), read_noise=(0.02, 0.02), full_well=1000.0, **SMALL)
    level = float(to_linear(torch.tensor(0.5)))
    noise = to_linear(maker(grey, [0]).frames) - level
    expected = 0.02**2 + level / 1000
    assert float(noise.var()) == pytest.approx(expected, rel=4 * (2 / noise.numel()) ** 0.5 + 1e-3)


def test_strengths_span_their_range(scene):
    maker = PairMaker(32, 32, d_over_r0=(1.0, 4.0), **SMALL, **SILENT)
    spread = [float(maker(scene[..., :32, :32], [seed]).tilt.var()) ** 0.5 for seed in range(24)]
    # Tilts grow as strength^(5/6), 3.2 times over the range, and scatter from clip to clip.
    assert max(spread) > 3 * min(spread)


def test_each_clip_is_seen_through_the_geometry_of_its_conditions(scene):
    several = PairMaker(32, 32, d_over_r0=3.0, distance=(1000, 16_000), geometries=2, independent=1.0, **SMALL)
    assert len(several.simulators) == 2
    seeds = [next(s for s in range(99) if several.conditions(s).geometry == wanted) for wanted in (0, 1)]
    for geometry, seed in enumerate(seeds):
        path = several.ranges.paths()[geometry]
        alone = PairMaker(32, 32, d_over_r0=3.0, distance=path.distance, independent=1.0, **SMALL)
        batch = several(scene[..., :32, :32].expand(2, -1, -1, -1, -1), seeds)
        expected = alone(scene[..., :32, :32], [seed])
        # Conditions are drawn alike but for the geometry, which alone has only one of.
        torch.testing.assert_close(batch.tilt[geometry], expected.tilt[0], rtol=0, atol=1e-4)
        assert not torch.allclose(batch.tilt[geometry], several(scene[..., :32, :32], [seeds[1 - geometry]]).tilt[0])


def test_the_conditions_of_a_seed_are_those_it_is_seen_through(scene):
    maker = PairMaker(32, 32, d_over_r0=(1.0, 4.0), independent=1.0, **SMALL, **SILENT)
    conditions = maker.conditions(5)
    draw = maker.simulators[0].draw([conditions.draw_seed], 4, d_over_r0=torch.tensor([conditions.d_over_r0]))
    seen = maker.simulators[0](to_linear(scene[..., :32, :32]), draw.centred())
    assert torch.equal(maker(scene[..., :32, :32], [5]).tilt, seen.tilt)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("d_over_r0", (3.0, 1.0)),
        ("d_over_r0", (-1.0, 1.0)),
        ("d_over_r0", (0.0, float("inf"))),
        ("d_over_r0", (float("nan"), 1.0)),
        ("d_over_r0", (1.0,)),
        ("wind", (2.0, 1.0)),
        ("read_noise", (0.0, 2.0)),
        ("independent", 1.5),
        ("frame_rate", 0.0),
        ("full_well", 0.0),
        ("aperture", -1.0),
        ("distance", 0.0),
        ("wavelength", 0.0),
        ("geometries", 3),
        ("modes", 1),
        ("modes", "many"),
        ("stride", 1.5),
        ("components", -1),
        ("margin", "wide"),
    ],
)
def test_out_of_range(name, value):
    with pytest.raises(ParameterError):
        PairMaker(32, 32, **{name: value})


def test_clips_of_another_size(maker):
    with pytest.raises(InputError, match="expects"):
        maker(torch.rand(1, 2, 3, 32, 64), [0])


def test_defocus_is_a_gaussian_of_its_width():
    """The variance of a point's picture is sigma^2 in each axis (less than 2 % lies beyond three sigma)."""
    point = torch.zeros(1, 1, 1, 41, 41)
    point[..., 20, 20] = 1
    seen = defocused(point, 2.5)[0, 0, 0]
    x = torch.arange(41.0) - 20
    assert float(seen.sum()) == pytest.approx(1, abs=1e-5)
    assert float((seen.sum(0) * x**2).sum()) == pytest.approx(2.5**2, rel=0.04)


def test_a_blur_with_tails_has_the_width_and_the_tails():
    """exp(-sqrt(3) r / sigma): the variance is sigma^2 along either axis (0.7 % of the light lies beyond four sigma)."""
    point = torch.zeros(1, 1, 1, 61, 61)
    point[..., 30, 30] = 1
    tails, bell = (defocused(point, 2.5, tails=tails)[0, 0, 0] for tails in (True, False))
    x = torch.arange(61.0) - 30
    assert float(tails.sum()) == pytest.approx(1, abs=1e-5)
    assert float((tails.sum(0) * x**2).sum()) == pytest.approx(2.5**2, rel=0.06)
    assert float(tails[30, 37] / tails[30, 30]) == pytest.approx(math.exp(-math.sqrt(3) * 7 / 2.5), rel=1e-3)
    assert tails[30, 30] > bell[30, 30]
    assert tails[30, 38] > 1.5 * bell[30, 38] > 0


def test_a_frame_smaller_than_its_blur():
    frames = torch.rand(1, 2, 3, 6, 9)
    seen = defocused(frames, 4.0, tails=True)
    assert seen.shape == frames.shape
    assert frames.min() < seen.min() < seen.max() < frames.max()
    torch.testing.assert_close(defocused(torch.full_like(frames, 0.3), 4.0, tails=True), torch.full_like(frames, 0.3))


def test_tails_are_drawn_last():
    """Clips of ranges without them are what they were before these came."""
    plain, with_tails = (PairMaker(16, 16, modes=6, components=2, blurred=0.5, tails=tails) for tails in (0.0, 0.4))
    pairs = [(plain.conditions(seed), with_tails.conditions(seed)) for seed in range(200)]
    assert all(replace(b, tails=a.tails) == a for a, b in pairs)
    # Two fifths of 200: 3.5 deviations of sqrt(48).
    assert sum(b.tails for _, b in pairs) == pytest.approx(80, abs=24)
    assert not any(a.tails for a, _ in pairs)


def test_hardness_narrows_the_range_of_strengths():
    maker = PairMaker(16, 16, modes=6, components=2, d_over_r0=(1.0, 5.0), blurred=0.5, compressed=0.5)
    drawn = [maker.conditions(seed, 0.25) for seed in range(200)]
    assert 1 <= min(c.d_over_r0 for c in drawn) < 1.1 < 1.9 < max(c.d_over_r0 for c in drawn) <= 2
    # Half of 200: 3.5 deviations of sqrt(50).
    assert sum(c.defocus > 0 for c in drawn) == pytest.approx(100, abs=25)
    assert sum(c.sensor.jpeg is not None for c in drawn) == pytest.approx(100, abs=25)
    with pytest.raises(ParameterError, match="hardness"):
        maker.conditions(0, 1.5)
