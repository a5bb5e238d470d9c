"""What a scene lets out: flat regions, channels that are alike."""

import pytest
import skimage.data
import torch
from torch import Tensor

from turbnet.atmosphere.path import OpticalPath
from turbnet.simulate import look
from turbnet.simulate import simulator as simulator_module
from turbnet.simulate.look import Region, busy_region, equal_channels, reflect
from turbnet.simulate.simulator import Simulator

SIZE = (120, 260)


@pytest.fixture(scope="module")
def island() -> Tensor:
    """A piece of a picture on a flat wall, right of the middle, (1, 1, 1, 120, 260)."""
    scene = torch.full((1, 1, 1, *SIZE), 0.3)
    scene[..., 40:70, 190:230] = torch.from_numpy(skimage.data.camera()[100:130, 200:240].copy()).float() / 255
    return scene


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator(OpticalPath.from_d_over_r0(2.0), *SIZE, modes=15, components=8)


def test_a_region_keeps_clear_of_what_is_not_flat():
    picture = torch.zeros(2, 1, 100, 200)
    picture[0, 0, 50, 60], picture[1, 0, 55, 80] = 1, 1
    region = busy_region(picture, 10, 4)
    # The steps lie between 49 and 51, 59 and 61: the last pixels on either side are 49..56 and 59..81.
    assert region == Region((36, 67), (48, 92))
    assert busy_region(torch.zeros(1, 1, 100, 200), 10, 4).area == 0


@pytest.mark.parametrize("axis", [-1, -2])
def test_an_edge_all_across_is_found(axis):
    picture = torch.zeros(1, 1, 160, 160)
    picture.narrow(axis, 0, 40)[:] = 1
    region = busy_region(picture, 8, 4)
    spans = (region.columns, region.rows) if axis == -1 else (region.rows, region.columns)
    assert spans == ((28, 49), (0, 160))


def test_a_busy_picture_is_simulated_whole():
    picture = torch.rand(1, 1, 60, 60, generator=torch.Generator().manual_seed(0))
    assert busy_region(picture, 4, 4) == Region.whole(picture)
    assert busy_region(0.5 + 1e-7 * picture, 4, 4).area == 0


def test_a_grid_of_a_region_reaches_past_its_last_pixel():
    grid = torch.arange(30.0).expand(20, 30)
    part = Region((8, 21), (12, 40)).of(grid, 4)
    assert part[0].tolist() == list(range(3, 11))
    assert len(part) == 1 + 6 - 2


@pytest.mark.parametrize(("exact", "error"), [(True, 1e-5), (False, 5e-4)])
def test_flat_regions_stay_as_they_are_and_the_rest_is_that_of_the_whole(island, monkeypatch, exact, error):
    """Components at half the resolution ring a little from the edges of the region."""
    simulator = Simulator(OpticalPath.from_d_over_r0(2.0), *SIZE, modes=15, components=8, exact=exact)
    draw = simulator.draw([0, 1])
    cut = simulator(island, draw)
    seen = (cut.frames, cut.tilt_only, cut.blur_only)
    # What surrounds the island moves and blurs; the left half of the wall has nothing to do with it.
    assert all(torch.equal(clip[..., :110], island[..., :110].expand(2, 1, 1, -1, -1)) for clip in seen)
    assert float((cut.frames - island).abs().max()) > 0.05
    monkeypatch.setattr(look, "_WORTH", 0.0)
    whole = simulator(island, draw)
    for one, other in zip(seen, (whole.frames, whole.tilt_only, whole.blur_only), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=error)
    assert torch.equal(cut.tilt, whole.tilt)


def test_only_the_region_is_simulated(simulator, island, monkeypatch):
    sizes = []

    class Watched(look.Look):
        def __init__(self, padded_BCHW: Tensor, *more) -> None:
            sizes.append(padded_BCHW.shape[-2:].numel())
            super().__init__(padded_BCHW, *more)

    monkeypatch.setattr(simulator_module, "Look", Watched)
    draw = simulator.draw([0])
    simulator(island, draw)
    simulator(torch.full_like(island, 0.5), draw)
    whole = (SIZE[0] + 2 * simulator.margin) * (SIZE[1] + 2 * simulator.margin)
    assert len(sizes) == 1
    assert sizes[0] < 0.7 * whole


def test_points_whose_energy_counts_are_never_cut_out(island):
    """Without a uniform scene to compare with, flat surfaces flicker too."""
    simulator = Simulator(OpticalPath.from_d_over_r0(2.0), *SIZE, modes=15, components=8, uniform=False)
    frames = simulator(island, simulator.draw([0])).frames
    assert float((frames - island)[..., :110].abs().max()) > 1e-3


def test_equal_channels_are_simulated_once_and_give_the_same(simulator, monkeypatch):
    grey = torch.from_numpy(skimage.data.camera()[:120, 100:360].copy()).float()[None, None, None] / 255
    draw = simulator.draw([3], 2)
    colour = grey.expand(1, 1, 3, *SIZE)
    assert equal_channels(colour)
    once = simulator(colour, draw)
    assert once.frames.shape == (1, 2, 3, *SIZE)
    monkeypatch.setattr(simulator_module, "equal_channels", lambda scene: False)
    thrice = simulator(colour, draw)
    for one, other in ((once.frames, thrice.frames), (once.blur_only, thrice.blur_only)):
        torch.testing.assert_close(one, other, rtol=0, atol=2e-6)


def test_channels_that_differ_in_one_pixel_are_not_equal():
    scene = torch.rand(1, 1, 1, 8, 8).repeat(1, 1, 3, 1, 1)
    assert equal_channels(scene)
    scene[0, 0, 1, 3, 3] += 1e-3
    assert not equal_channels(scene)


@pytest.mark.parametrize(("size", "margin"), [((5, 9), 3), ((3, 4), 20), ((1, 7), 5), ((1, 1), 8)])
def test_reflection_keeps_the_picture_in_its_middle(size, margin):
    picture = torch.rand(1, 2, *size)
    padded = reflect(picture, margin)
    assert padded.shape[-2:] == (size[0] + 2 * margin, size[1] + 2 * margin)
    assert torch.equal(padded[..., margin : margin + size[0], margin : margin + size[1]], picture)
    if min(size) > 1:
        assert torch.equal(padded[..., margin - 1, :], padded[..., margin + 1, :])
