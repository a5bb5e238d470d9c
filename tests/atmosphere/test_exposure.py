import numpy as np
import pytest

from turbnet.atmosphere.exposure import (
    long_exposure_factor,
    long_exposure_otf,
    short_exposure_factor,
    short_exposure_otf,
)
from turbnet.atmosphere.structure import phase_structure
from turbnet.errors import ParameterError
from turbnet.optics.psf import diffraction_mtf

F = np.linspace(0, 1, 21)


def test_long_exposure_is_half_the_structure_function():
    aperture, ratio = 0.2, 4.0
    np.testing.assert_allclose(
        long_exposure_factor(F, ratio), np.exp(-0.5 * phase_structure(F * aperture, aperture / ratio))
    )


def test_long_exposure_falls_to_r0():
    assert long_exposure_factor(np.array(1 / 5), 5.0) == pytest.approx(np.exp(-3.44))


def test_short_exposure_keeps_more_and_at_the_cutoff_all():
    assert np.all(short_exposure_factor(F[1:], 3.0) > long_exposure_factor(F[1:], 3.0))
    assert short_exposure_factor(np.array(1.0), 3.0) == pytest.approx(1.0)
    near, far = short_exposure_factor(F[1:], 3.0), short_exposure_factor(F[1:], 3.0, alpha=0.5)
    np.testing.assert_allclose(np.log(far[-1]) / np.log(long_exposure_factor(F[-1], 3.0)), 0.5)
    assert np.all(far < near)


def test_still_air_leaves_the_aperture():
    np.testing.assert_allclose(long_exposure_otf(F, 0.0), diffraction_mtf(F))
    np.testing.assert_allclose(short_exposure_otf(F, 0.0), diffraction_mtf(F))
    assert short_exposure_otf(np.array([1.5]), 3.0) == 0


def test_sign_of_the_frequency_does_not_matter():
    np.testing.assert_allclose(short_exposure_otf(-F, 2.0), short_exposure_otf(F, 2.0))
    np.testing.assert_allclose(long_exposure_otf(-F, 2.0), long_exposure_otf(F, 2.0))


def test_bad_input_is_named():
    with pytest.raises(ParameterError, match="D/r0 = -1"):
        long_exposure_otf(F, -1.0)
    with pytest.raises(ParameterError, match="alpha = 2"):
        short_exposure_factor(F, 1.0, 2.0)
