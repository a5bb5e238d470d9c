"""A camera: what decides how many pixels turbulence of a path is wide."""

from dataclasses import dataclass

from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Profile
from turbnet.errors import check_range


@dataclass(frozen=True)
class Camera:
    """A lens before a sensor.

    Args:
        aperture: diameter D of the entrance pupil, m.
        focal_length: f, m.
        pixel_pitch: p, distance of neighbouring pixels on the sensor, m.
        wavelength: lambda, m; the middle of the band.

    Raises:
        ParameterError: a value outside its physical range, such as a pixel pitch given in micrometres.
    """

    aperture: float
    focal_length: float
    pixel_pitch: float
    wavelength: float = 525e-9

    def __post_init__(self) -> None:
        check_range("aperture", self.aperture, 1e-3, 50.0, "m")
        check_range("focal length", self.focal_length, 1e-3, 1e3, "m")
        check_range("pixel pitch", self.pixel_pitch, 1e-7, 1e-3, "m")
        check_range("wavelength", self.wavelength, 1e-7, 2e-5, "m")

    @property
    def sampling(self) -> float:
        """q, the pixel in Nyquist pixels: 2 D p / (lambda f). Below 1 the lens limits the image, above 1 the sensor."""
        return 2 * self.aperture * self.pixel_pitch / (self.wavelength * self.focal_length)

    def path(self, distance: float, profile: Profile) -> OpticalPath:
        """The path it looks along.

        Args:
            distance: from the aperture to the scene, m.
            profile: Cn2 along it, m^(-2/3).
        """
        return OpticalPath(self.aperture, distance, profile, self.wavelength)
