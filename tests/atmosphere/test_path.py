import math

import numpy as np
import pytest

from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Constant, HufnagelValley, Tabulated
from turbnet.errors import ParameterError

SCENE = OpticalPath(0.2034, 7000.0, Constant(1e-15), 525e-9)


def test_published_scene():
    assert SCENE.r0 == pytest.approx(0.0478, rel=5e-3)
    assert SCENE.r0_plane == pytest.approx(0.0266, rel=5e-3)
    assert SCENE.r0 / SCENE.r0_plane == pytest.approx((8 / 3) ** (3 / 5), rel=1e-9)
    assert SCENE.d_over_r0 == pytest.approx(4.26, rel=5e-3)
    assert SCENE.theta0 == pytest.approx(2.147e-6, rel=5e-3)
    assert SCENE.theta0 * SCENE.distance == pytest.approx(15.0e-3, rel=5e-3)
    assert SCENE.theta0_pixels == pytest.approx(1.66, rel=5e-3)


def test_theta0_is_the_formula_to_the_last_digit():
    k, distance = 2 * np.pi / 525e-9, 7000.0
    expected = (2.914 * k**2 * 1e-15 * distance ** (8 / 3) * 3 / 8) ** (-3 / 5)
    assert SCENE.theta0 == pytest.approx(expected, rel=1e-9)
    assert expected == pytest.approx(2.1434e-6, rel=1e-4)


def test_spherical_weight_carries_its_exponent():
    without = (0.423 * SCENE.wavenumber**2 * 1e-15 * 7000 / 2) ** (-3 / 5)  # (L-z)/L to the power 1
    assert without == pytest.approx(0.0403, rel=5e-3)
    assert SCENE.r0 > 1.15 * without


def test_hufnagel_valley_at_zenith():
    zenith = OpticalPath(1.0, 30e3, HufnagelValley(), 500e-9)
    assert zenith.r0_plane == pytest.approx(0.0497, rel=5e-3)
    assert zenith.theta0 == pytest.approx(6.9e-6, rel=5e-3)


def test_ramps_are_told_apart():
    near = OpticalPath(0.2, 5000.0, Tabulated((0, 5000), (2e-15, 0)))
    far = OpticalPath(0.2, 5000.0, Tabulated((0, 5000), (0, 2e-15)))
    # int (1-s) s^(5/3) ds = 9/88 against int s^(8/3) ds = 3/11
    assert far.r0 / near.r0 == pytest.approx(((3 / 11) / (9 / 88)) ** (3 / 5), rel=1e-9)
    assert near.theta0 / far.theta0 == pytest.approx(far.r0 / near.r0, rel=1e-9)
    assert near.r0_plane == pytest.approx(far.r0_plane, rel=1e-9)


def test_a_thin_layer_of_a_table_is_not_missed():
    thin = Tabulated((0, 3000, 3000.5, 3001, 7000), (0, 0, 1e-12, 0, 0))
    path = OpticalPath(0.2, 7000.0, thin)
    expected = (0.423 * path.wavenumber**2 * 0.5e-12 * (1 - 3000.5 / 7000) ** (5 / 3)) ** (-3 / 5)
    assert path.r0 == pytest.approx(expected, rel=1e-6)


def test_rytov_variances_of_a_uniform_path():
    expected = 1.23 * SCENE.wavenumber ** (7 / 6) * 1e-15 * 7000 ** (11 / 6)
    assert SCENE.rytov_plane == pytest.approx(expected, rel=5e-3)
    assert SCENE.rytov_spherical / SCENE.rytov_plane == pytest.approx(0.404, rel=5e-3)


def test_rytov_variance_counts_air_far_from_the_aperture():
    near = OpticalPath(0.2, 5000.0, Tabulated((0, 5000), (2e-15, 0)))
    far = OpticalPath(0.2, 5000.0, Tabulated((0, 5000), (0, 2e-15)))
    assert far.rytov_plane / near.rytov_plane == pytest.approx((6 / 17) / (6 / 11 - 6 / 17), rel=1e-6)


@pytest.mark.parametrize(
    ("cn2", "words"), [(1e-17, "weak fluctuation"), (1e-15, "moderate fluctuation"), (1e-14, "outside the validity")]
)
def test_validity_says_what_holds(cn2, words):
    statement = OpticalPath(0.2034, 7000.0, Constant(cn2), 525e-9).validity()
    assert words in statement
    assert "near field" in statement


def test_small_aperture_far_away_is_in_the_far_field():
    assert "far field" in OpticalPath(0.01, 7000.0, Constant(1e-16)).validity()


def test_coherence_time():
    assert SCENE.coherence_time(5.0) == pytest.approx(0.314 * SCENE.r0_plane / 5, rel=2e-3)
    sheared = SCENE.coherence_time(lambda z: 2 + 6 * z / 7000)
    assert SCENE.coherence_time(8.0) < sheared < SCENE.coherence_time(2.0)
    assert math.isinf(SCENE.coherence_time(0.0))


def test_still_air():
    still = OpticalPath(0.2, 1000.0, Constant(0.0))
    assert math.isinf(still.r0)
    assert math.isinf(still.theta0)
    assert still.d_over_r0 == 0
    assert still.rytov_plane == 0


def test_layers_and_quadrature_agree_on_a_smooth_profile():
    path = OpticalPath(0.2, 3000.0, Tabulated((0, 3000), (3e-15, 1e-15)))
    for z, weight in (path.layers(12), path.quadrature()):
        assert weight.sum() == pytest.approx(6e-12, rel=1e-9)
        assert (weight * z).sum() == pytest.approx(3000**2 * (1.5e-15 - 2e-15 / 3), rel=1e-9)


def test_from_d_over_r0():
    for ratio in (0.0, 1.0, 4.5):
        assert OpticalPath.from_d_over_r0(ratio).d_over_r0 == pytest.approx(ratio, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"distance": 0.0}, "distance = 0 m is outside the accepted range 1 to 1e"),
        ({"distance": -5.0}, "distance = -5 m"),
        ({"wavelength": 525.0}, "wavelength = 525 m is outside the accepted range 1e-07 to 2e-05 m"),
        ({"aperture": 203.4}, "aperture = 203.4 m"),
        ({"aperture": float("nan")}, "aperture = nan"),
    ],
)
def test_values_out_of_any_physical_range_are_named(change, message):
    good = {"aperture": 0.2, "distance": 1000.0, "profile": Constant(1e-15), "wavelength": 525e-9}
    with pytest.raises(ParameterError, match=message):
        OpticalPath(**(good | change))


@pytest.mark.parametrize("wind", [-1.0, 500.0, float("nan")])
def test_impossible_wind_is_refused(wind):
    with pytest.raises(ParameterError, match="wind"):
        SCENE.coherence_time(wind)
