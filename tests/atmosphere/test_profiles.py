import numpy as np
import pytest

from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import SLCD, Constant, GroundLayer, HufnagelValley, Slant, Tabulated
from turbnet.errors import ParameterError


def test_hufnagel_valley_near_the_ground_and_at_its_peak():
    model = HufnagelValley()
    assert model(np.array(0.0)) == pytest.approx(1.7e-14 + 2.7e-16)
    heights = np.linspace(5e3, 20e3, 1501)
    assert heights[np.argmax(model(heights))] == pytest.approx(10e3, abs=200)  # h^10 exp(-h/1000) peaks at 10 km
    assert HufnagelValley(wind=42)(np.array(12e3)) == pytest.approx(4 * model(np.array(12e3)), rel=0.05)


def test_slcd_follows_its_laws():
    heights = np.array([5.0, 100.0, 500.0, 2000.0, 10e3, 25e3])
    expected = [1.7e-14, 3.13e-13 / 100**1.05, 1.3e-15, 8.87e-7 / 2000**3, 2e-16 / 100, 0.0]
    np.testing.assert_allclose(SLCD()(heights), expected)
    jumps = SLCD()(np.array(SLCD.knots) * (1 - 1e-9)) / np.maximum(SLCD()(np.array(SLCD.knots)), 1e-30)
    np.testing.assert_allclose(jumps[:4], 1.0, atol=0.3)  # the laws nearly meet


def test_slcd_integral_to_the_ground():
    path = OpticalPath(1.0, 20e3, SLCD(), 500e-9)
    powers = [
        1.7e-14 * 18.5,
        3.13e-13 / -0.05 * (240**-0.05 - 18.5**-0.05),
        1.3e-15 * (880 - 240),
        8.87e-7 / -2 * (7200.0**-2 - 880.0**-2),
        2e-16 / 0.5 * (20e3**0.5 - 7200**0.5),
    ]
    assert path.quadrature()[1].sum() == pytest.approx(sum(powers), rel=1e-5)


def test_ground_layer():
    layer = GroundLayer(1e-13, height=2.0)
    np.testing.assert_allclose(layer(np.array([2.0, 16.0])), [1e-13, 1e-13 / 16])
    assert layer(np.array(0.0)) == layer(np.array(0.1)) == pytest.approx(1e-13 * 20 ** (4 / 3))


def test_slant_looks_up_and_down_the_same_air():
    layer = GroundLayer(1e-13)
    up, down = Slant(layer, 2.0, 40.0, 3000.0), Slant(layer, 40.0, 2.0, 3000.0)
    z = np.linspace(0, 3000, 31)
    np.testing.assert_allclose(up(z), down(z[::-1]))
    path_up, path_down = OpticalPath(0.1, 3000.0, up), OpticalPath(0.1, 3000.0, down)
    assert path_up.r0_plane == pytest.approx(path_down.r0_plane)
    assert path_up.r0 < path_down.r0  # turbulence at the aperture bends a spherical wave most
    assert path_up.theta0 > path_down.theta0


def test_slant_at_one_height_is_constant_and_zenith_is_the_model():
    z = np.linspace(0, 3000, 7)
    np.testing.assert_allclose(Slant(GroundLayer(1e-13), 5.0, 5.0, 3000.0)(z), 1e-13 * 5 ** (-4 / 3))
    np.testing.assert_allclose(Slant(HufnagelValley(), 0.0, 3000.0, 3000.0)(z), HufnagelValley()(z))


@pytest.mark.parametrize("elevation", [30, 60])
def test_slanted_path_through_the_whole_air_scales_with_the_secant(elevation):
    sine = np.sin(np.radians(elevation))
    zenith = OpticalPath(1.0, 30e3, HufnagelValley(), 500e-9)
    slanted = OpticalPath(1.0, 30e3 / sine, Slant(HufnagelValley(), 0.0, 30e3, 30e3 / sine), 500e-9)
    assert slanted.r0_plane == pytest.approx(zenith.r0_plane * sine ** (3 / 5), rel=1e-6)
    assert slanted.theta0 == pytest.approx(zenith.theta0 * sine ** (8 / 5), rel=1e-6)


def test_knots_of_a_slanted_model_fall_where_the_path_meets_them():
    slant = Slant(SLCD(), 1000.0, 0.0, 4000.0)
    assert list(slant.knots) == sorted(slant.knots)
    assert 4 * (1000 - 240.0) in slant.knots


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Constant(-1e-15), r"Cn2 = -1e-15 m\^\(-2/3\) is outside the accepted range 0 to"),
        (lambda: Constant(float("nan")), "Cn2 = nan"),
        (lambda: Tabulated((0, 100, 50), (1e-15,) * 3), r"must increase: z\[1\] = 100, z\[2\] = 50"),
        (lambda: Tabulated((0, 0), (1e-15, 1e-15)), "must increase"),
        (lambda: Tabulated((0, 100), (1e-15, -1e-15)), r"Cn2\[1\] = -1e-15"),
        (lambda: Tabulated((0, 100), (1e-15,)), "as many z"),
        (lambda: GroundLayer(-1.0), "Cn2 = -1"),
        (lambda: GroundLayer(1e-14, height=0.0), "height of the ground layer = 0"),
        (lambda: HufnagelValley(wind=-3.0), "wind = -3 m/s"),
        (lambda: HufnagelValley(ground=-1e-14), "ground Cn2"),
        (lambda: Slant(SLCD(), -1.0, 10.0, 100.0), "aperture height = -1 m"),
        (lambda: Slant(SLCD(), 2.0, 500.0, 100.0), "scene height = 500 m is outside the accepted range 0 to 102"),
        (lambda: Slant(SLCD(), 2.0, 5.0, 0.0), "distance = 0 m"),
    ],
)
def test_bad_profiles_are_named(build, message):
    with pytest.raises(ParameterError, match=message):
        build()
