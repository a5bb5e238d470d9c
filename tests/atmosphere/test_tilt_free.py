import numpy as np
import pytest
import torch

from turbnet.atmosphere.exposure import long_exposure_otf, short_exposure_otf
from turbnet.atmosphere.screens import PhaseScreen
from turbnet.atmosphere.tilt_free import tilt_free_otf
from turbnet.errors import ParameterError
from turbnet.optics.psf import diffraction_mtf
from turbnet.optics.pupil import circular, pupil_grid

FREQUENCY = np.arange(32) / 32


def test_without_turbulence_it_is_the_aperture_s():
    np.testing.assert_allclose(tilt_free_otf(32, 0.0)[0, :32], diffraction_mtf(FREQUENCY), atol=0.02)


@pytest.mark.parametrize("strength", [1.0, 3.0])
def test_it_lies_above_the_long_exposure_and_near_fried_s_short_one_at_low_frequency(strength):
    exact = tilt_free_otf(32, strength)
    np.testing.assert_allclose(exact, np.roll(exact[::-1, ::-1], 1, axis=(0, 1)), atol=1e-12)
    along, across = exact[0, :32], exact[:32, 0]
    np.testing.assert_allclose(along, across, rtol=1e-6)
    assert (along[2:24] > long_exposure_otf(FREQUENCY, strength)[2:24]).all()
    low = slice(0, 8)
    np.testing.assert_allclose(along[low], short_exposure_otf(FREQUENCY, strength)[low], rtol=0.08)


def test_it_agrees_with_drawn_tilt_free_phases():
    """Phases of screens, fitted tilt removed: the mean of e^{i difference} over the overlap, 400 draws."""
    points, strength = 24, 3.0
    phase = PhaseScreen((points, points), 1 / points, 1 / strength, dtype=torch.float64).draw(
        400, torch.Generator().manual_seed(0)
    )
    x, y = pupil_grid(points)
    inside = circular(points) > 0
    basis = np.stack([np.ones_like(x), x, y])[:, inside]
    inner = phase.numpy()[:, inside]
    wave = np.zeros((400, 2 * points, 2 * points), dtype=complex)
    full = np.zeros((400, points, points), dtype=complex)
    full[:, inside] = np.exp(1j * (inner - inner @ np.linalg.pinv(basis) @ basis))
    wave[:, :points, :points] = full
    otf = np.fft.ifft2(np.abs(np.fft.fft2(wave)) ** 2).real
    otf /= otf[:, :1, :1]
    shifts = [(0, 4), (6, 0), (5, 5), (0, 12)]
    for shift in shifts:
        drawn = otf[:, *shift]
        assert abs(drawn.mean() - tilt_free_otf(points, strength)[shift]) < 4 * drawn.std() / 20 + 0.005


def test_bad_parameters_are_named():
    with pytest.raises(ParameterError, match="D/r0"):
        tilt_free_otf(32, -1.0)
    with pytest.raises(ParameterError, match="pupil points"):
        tilt_free_otf(4, 1.0)
