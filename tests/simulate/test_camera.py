import pytest

from turbnet.atmosphere.profiles import Constant
from turbnet.errors import ParameterError
from turbnet.simulate.camera import Camera


def test_q_is_the_pixel_over_that_of_nyquist():
    camera = Camera(aperture=0.1, focal_length=2.0, pixel_pitch=5e-6, wavelength=500e-9)
    nyquist = 500e-9 * 2.0 / (2 * 0.1)  # lambda f / (2 D) on the sensor
    assert camera.sampling == pytest.approx(5e-6 / nyquist)
    assert camera.sampling == pytest.approx(1.0)
    # In the scene: the pixel's image there over the Nyquist pixel of the path.
    path = camera.path(3000.0, Constant(1e-15))
    assert camera.sampling * path.pixel == pytest.approx(5e-6 * 3000.0 / 2.0)


def test_the_path_is_seen_through_its_aperture():
    path = Camera(0.1, 2.0, 5e-6, 600e-9).path(3000.0, Constant(1e-15))
    assert (path.aperture, path.distance, path.wavelength, path.profile) == (0.1, 3000.0, 600e-9, Constant(1e-15))


@pytest.mark.parametrize(
    ("bad", "name"),
    [
        ({"aperture": 100.0}, "aperture"),  # mm
        ({"focal_length": 2000.0}, "focal length"),  # mm
        ({"pixel_pitch": 5.0}, "pixel pitch"),  # um
        ({"wavelength": 525.0}, "wavelength"),  # nm
        ({"aperture": float("nan")}, "aperture"),
    ],
)
def test_values_in_other_units_are_refused(bad, name):
    with pytest.raises(ParameterError, match=name):
        Camera(**{"aperture": 0.1, "focal_length": 2.0, "pixel_pitch": 5e-6, **bad})
