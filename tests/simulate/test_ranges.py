"""Conditions drawn from ranges: their distributions, two-sided, from the number of samples."""

import math
from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_module

from turbnet.atmosphere.covariance import zernike_covariance
from turbnet.errors import ParameterError
from turbnet.simulate.field import ZernikeField
from turbnet.simulate.ranges import Ranges

COUNT = 4000
SEVERAL = Ranges(
    independent=0.3,
    full_well=(5_000, 50_000),
    aperture=(0.1, 0.3),
    distance=(2000, 9000),
    wavelength=(4e-7, 8e-7),
    geometries=5,
)


def sample(ranges, count=COUNT, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [ranges.sample(generator) for _ in range(count)]


@pytest.fixture(scope="module")
def drawn():
    return sample(SEVERAL)


def assert_uniform(values, low, high):
    """Inside the range, and by the distance of Kolmogorov and Smirnov neither farther from uniform than chance takes it
    (one in ten thousand) nor nearer than it comes (as an even grid would be)."""
    u = (np.sort(values) - low) / (high - low)
    assert u[0] >= 0
    assert u[-1] <= 1
    steps = np.arange(len(u) + 1) / len(u)
    distance = max(np.abs(u - steps[:-1]).max(), np.abs(u - steps[1:]).max()) * math.sqrt(len(u))
    assert 0.25 < distance < 2.2  # both of probability below 1e-4


def test_strength_noise_and_wind_are_uniform(drawn):
    assert_uniform([c.d_over_r0 for c in drawn], 0.5, 6.0)
    assert_uniform([c.sensor.read_noise for c in drawn], 0.0, 0.02)
    winds = np.array([c.wind for c in drawn if c.wind])
    assert_uniform(np.hypot(*winds.T), 0.5, 8.0)
    assert_uniform(np.arctan2(*winds.T), -math.pi, math.pi)


def test_the_variance_of_shot_noise_is_uniform(drawn):
    assert_uniform([1 / c.sensor.full_well for c in drawn], 1 / 50_000, 1 / 5_000)
    assert {c.sensor.full_well for c in sample(replace(SEVERAL, full_well=(math.inf, math.inf)), 9)} == {math.inf}
    assert {c.sensor.full_well for c in sample(replace(SEVERAL, full_well=30_001), 9)} == {30_001.0}
    half = [c.sensor.full_well for c in sample(replace(SEVERAL, full_well=(1000, math.inf)), 400)]
    assert_uniform([1 / v for v in half], 0, 1e-3)


def test_the_fraction_of_independent_frames(drawn):
    found = np.mean([c.wind is None for c in drawn])
    assert abs(found - 0.3) < 4 * math.sqrt(0.3 * 0.7 / COUNT)
    for whole in (0.0, 1.0):
        assert {c.wind is None for c in sample(replace(SEVERAL, independent=whole), 50)} == {bool(whole)}


def test_geometries_are_equally_likely(drawn):
    counts = np.bincount([c.geometry for c in drawn], minlength=5)
    chi2 = float(((counts - COUNT / 5) ** 2 / (COUNT / 5)).sum())
    assert 0.02 < chi2 < 24  # four degrees of freedom: 1e-4 on either side


def test_quantities_are_drawn_apart(drawn):
    moving = [c for c in drawn if c.wind]
    table = np.array(
        [[c.d_over_r0, math.hypot(*c.wind), c.sensor.read_noise, 1 / c.sensor.full_well, c.geometry] for c in moving]
    )
    correlation = np.corrcoef(table.T)[np.triu_indices(5, 1)]
    assert np.abs(correlation).max() < 4.5 / math.sqrt(len(moving))
    assert len({c.draw_seed for c in drawn} | {c.noise_seed for c in drawn}) == 2 * COUNT


def test_the_generator_decides(drawn):
    assert sample(SEVERAL, 20) == drawn[:20]
    assert sample(SEVERAL, 20, seed=1) != drawn[:20]
    with pytest.raises(FrozenInstanceError):
        drawn[0].d_over_r0 = 1.0


class TestPaths:
    def test_one_stands_in_the_middle(self):
        (path,) = replace(SEVERAL, geometries=1).paths()
        middle = path.aperture, path.distance, path.wavelength
        assert middle == pytest.approx((math.sqrt(0.03), math.sqrt(1.8e7), math.sqrt(3.2e-13)))
        (path,) = Ranges().paths()
        assert (path.aperture, path.distance, path.wavelength) == (0.2034, 7000.0, 525e-9)

    def test_each_has_the_strongest_turbulence(self):
        assert [path.d_over_r0 for path in SEVERAL.paths()] == pytest.approx([6.0] * 5)

    def test_each_part_of_each_range_holds_one(self):
        for name, low, high in (("aperture", 0.1, 0.3), ("distance", 2000, 9000), ("wavelength", 4e-7, 8e-7)):
            parts = [5 * math.log(getattr(path, name) / low) / math.log(high / low) for path in SEVERAL.paths()]
            assert sorted(map(int, parts)) == [0, 1, 2, 3, 4]

    def test_over_many_draws_the_logarithm_is_uniform(self):
        paths = [path for seed in range(200) for path in replace(SEVERAL, geometry_seed=seed, geometries=2).paths()]
        values = np.log([path.distance for path in paths[::2]])
        assert_uniform(values, math.log(2000), math.log(9000))

    def test_the_seed_decides(self):
        assert SEVERAL.paths() == SEVERAL.paths()
        assert SEVERAL.paths() != replace(SEVERAL, geometry_seed=1).paths()

    def test_equal_apertures_in_pixels_hold_equal_turbulence(self):
        """Nothing but N = 2 D^2 / (lambda L) matters to still air: this is what makes a few geometries enough."""
        one, other = (
            Ranges(d_over_r0=3),
            Ranges(d_over_r0=3, aperture=2 * 0.2034, distance=2 * 7000, wavelength=1.05e-6),
        )
        fields = [ZernikeField(ranges.paths()[0], 32, 32, modes=10, stride=8) for ranges in (one, other)]
        for i, j, x in ((2, 2, 16), (4, 4, 8), (2, 8, 0)):
            first, second = (float(field.covariance(i, j, x)) for field in fields)
            assert first == pytest.approx(second, rel=1e-4)

    @pytest.mark.parametrize("pixels", [11.5, 139])
    def test_the_field_is_right_at_either_end_of_the_wide_ranges(self, pixels):
        (path,) = Ranges(d_over_r0=3, distance=2 * 0.2034**2 / (525e-9 * pixels)).paths()
        assert path.aperture / path.pixel == pytest.approx(pixels)
        field = ZernikeField(path, 96, 96, margin=8, modes=10, stride=4)
        for i, j, x in ((2, 2, 0), (2, 2, 64), (3, 3, 64), (4, 4, 0), (4, 4, 16), (2, 4, 16)):
            exact = float(zernike_covariance(path, i, j, x * path.pixel, 0.0))
            scale = math.sqrt(
                float(zernike_covariance(path, i, i, 0.0, 0.0)) * float(zernike_covariance(path, j, j, 0.0, 0.0))
            )
            assert float(field.covariance(i, j, x)) == pytest.approx(exact, abs=0.06 * scale), (i, j, x)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("d_over_r0", (3.0, 1.0)),
        ("d_over_r0", (-1.0, 1.0)),
        ("d_over_r0", (0.0, math.inf)),
        ("d_over_r0", (math.nan, 1.0)),
        ("d_over_r0", (1.0,)),
        ("d_over_r0", (1.0, 2.0, 3.0)),
        ("d_over_r0", "strong"),
        ("d_over_r0", ("1", "2")),
        ("d_over_r0", None),
        ("wind", (2.0, 1.0)),
        ("wind", -1.0),
        ("read_noise", (0.0, 2.0)),
        ("full_well", 0.0),
        ("full_well", (100.0, 10.0)),
        ("aperture", -1.0),
        ("distance", (0.0, 10.0)),
        ("wavelength", 525.0),
        ("independent", 1.5),
        ("independent", "half"),
        ("frame_rate", 0.0),
        ("frame_rate", math.nan),
        ("geometries", 0),
        ("geometries", 1.5),
        ("geometries", 2),  # of ranges that hold one geometry only
        ("geometry_seed", -1),
        ("subframes", 2),
    ],
)
def test_what_cannot_be_a_range(name, value):
    with pytest.raises(ParameterError, match=name) as caught:
        Ranges(**{name: value})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("group", ["path7km", "wide", "weak"])
def test_every_group_of_the_configuration(group):
    with initialize_config_module("turbnet.configs", version_base="1.3"):
        config = compose("train", overrides=[f"simulator={group}"]).simulator
    ranges = Ranges(**{name: value for name, value in config.items() if name in Ranges.__dataclass_fields__})
    paths = ranges.paths()
    assert len(paths) == {"path7km": 1, "wide": 4, "weak": 1}[group]
    assert all(path.fresnel_number > 1 for path in paths)  # the near field, where the simulator holds
    if group == "weak":
        assert paths[0].rytov_plane == pytest.approx(0.3, abs=0.01)
