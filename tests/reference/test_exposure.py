"""Mean transfer functions: theory beside the mean over drawn Zernike phases."""

import numpy as np
import pytest
import torch

from turbnet.atmosphere.exposure import long_exposure_otf, short_exposure_factor, tilt_free_otf
from turbnet.atmosphere.noll import noll_matrix, residual_variance
from turbnet.optics.psf import diffraction_mtf, otf, psf
from turbnet.optics.pupil import circular, zernike_modes

POINTS, ORDER, FRAMES = 32, 20, 1200
FREQUENCIES = np.arange(1, 10) / 10


def rings():
    axis = np.fft.fftfreq(2 * POINTS) / 0.5
    radius = np.hypot(axis[:, None], axis)
    return radius, [np.abs(radius - f) <= 0.03 for f in FREQUENCIES]


def ring_mean(values):
    return np.stack([values[..., ring].mean(-1) for ring in rings()[1]], -1)


def transfer(phases):
    return ring_mean(otf(psf(phases, torch.tensor(circular(POINTS)), 2 * POINTS)).real.numpy())


def theory(function, ratio):
    """Ring means of a radial function, relative to those of the clear aperture."""
    radius = rings()[0]
    fine = np.linspace(0, 1, 201)
    values = np.interp(radius, fine, function(fine, ratio), right=0.0)
    return ring_mean(values) / ring_mean(diffraction_mtf(radius))


@pytest.fixture(scope="module")
def draws():
    modes = range(2, (ORDER + 1) * (ORDER + 2) // 2 + 1)
    white = np.random.default_rng(0).standard_normal((FRAMES, len(modes)))
    return white @ np.linalg.cholesky(noll_matrix(modes)).T, torch.tensor(zernike_modes(modes, POINTS))


def measured(draws, ratio, first):
    """Mean over frames, and its standard error, with the modes before `first` left out."""
    coefficients, modes = draws
    still = transfer(torch.zeros(1, POINTS, POINTS, dtype=torch.float64))
    frames = np.concatenate(
        [
            transfer(torch.einsum("bj,jyx->byx", torch.tensor(part[:, first:] * ratio ** (5 / 6)), modes[first:]))
            for part in np.array_split(coefficients, 12)
        ]
    )
    frames = frames / still
    return frames.mean(0), frames.std(0) / np.sqrt(FRAMES)


@pytest.mark.parametrize("ratio", [1.0, 2.0])
@pytest.mark.parametrize(("function", "first"), [(long_exposure_otf, 0), (tilt_free_otf, 2)])
def test_mean_otf_of_drawn_phases(draws, ratio, function, first):
    mean, error = measured(draws, ratio, first)
    expected = theory(function, ratio)
    # Modes above the order drawn are missing: at most exp(2 residual) more contrast, never less.
    missing = expected * np.expm1(2 * residual_variance(ORDER) * ratio ** (5 / 3))
    assert np.all(mean - expected < 4 * error + missing)
    assert np.all(mean - expected > -4 * error - 0.002)


def test_fried_short_exposure_is_below_the_exact_one():
    middle = np.array([0.3, 0.5, 0.7])
    for ratio, low, high in ((1.0, -0.08, -0.01), (2.0, -0.25, -0.04), (4.0, -0.60, -0.15)):
        error = short_exposure_factor(middle, ratio) * diffraction_mtf(middle) / tilt_free_otf(middle, ratio) - 1
        assert np.all((low < error) & (error < high))


def test_still_air_leaves_the_aperture():
    f = np.linspace(0, 1, 11)
    np.testing.assert_allclose(tilt_free_otf(f, 0.0), diffraction_mtf(f), atol=1e-12)
