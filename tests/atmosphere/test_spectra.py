import numpy as np
import pytest
from scipy.special import gamma, kv

from turbnet.atmosphere import structure
from turbnet.atmosphere.spectra import phase_spectrum, refractive_spectrum
from turbnet.errors import ParameterError

KAPPA = np.logspace(-2, 4, 25)
R = np.array([1e-4, 1e-3, 0.01, 0.1, 1.0, 10.0])


def test_kolmogorov_is_a_power_law():
    np.testing.assert_allclose(refractive_spectrum(KAPPA, 1e-14), 0.033 * 1e-14 * KAPPA ** (-11 / 3))
    np.testing.assert_allclose(phase_spectrum(KAPPA, 0.1), 0.490 * 0.1 ** (-5 / 3) * KAPPA ** (-11 / 3))


def test_scales_act_at_their_own_end():
    plain, scaled = (
        refractive_spectrum(KAPPA, 1e-14),
        refractive_spectrum(KAPPA, 1e-14, outer_scale=10, inner_scale=5e-3),
    )
    ratio = scaled / plain
    middle = (KAPPA > 10) & (KAPPA < 50)
    np.testing.assert_allclose(ratio[middle], 1.0, atol=0.02)
    assert ratio[0] < 1e-3
    assert ratio[-1] < 1e-10


def test_phase_spectrum_is_that_of_a_slab():
    # F = 2 pi k^2 dz Phi_n with r0 = (0.423 k^2 Cn2 dz)^(-3/5)
    k, cn2, thickness = 2 * np.pi / 525e-9, 1e-15, 300.0
    r0 = (0.423 * k**2 * cn2 * thickness) ** (-3 / 5)
    slab = 2 * np.pi * k**2 * thickness * refractive_spectrum(KAPPA, cn2, 20.0, 1e-3)
    np.testing.assert_allclose(phase_spectrum(KAPPA, r0, 20.0, 1e-3), slab, rtol=1e-3)


def test_quadrature_of_the_spectra_gives_kolmogorov_structure_functions():
    # A scale no r can feel sends the closed form's numbers through the integral. Constants are printed to 3 digits.
    np.testing.assert_allclose(
        structure.phase_structure(R, 0.05, inner_scale=1e-9), structure.phase_structure(R, 0.05), rtol=2e-3
    )
    np.testing.assert_allclose(
        structure.refractive_structure(R, 1e-15, inner_scale=1e-9), 1e-15 * R ** (2 / 3), rtol=1e-3
    )


@pytest.mark.parametrize("outer", [0.5, 2.0, 100.0])
def test_von_karman_phase_structure_has_its_closed_form(outer):
    r0, x = 0.05, 2 * np.pi * R / outer
    scale = (
        (outer / r0) ** (5 / 3) * 2 ** (1 / 6) * gamma(11 / 6) / np.pi ** (8 / 3) * (24 / 5 * gamma(6 / 5)) ** (5 / 6)
    )
    expected = scale * (gamma(5 / 6) / 2 ** (1 / 6) - x ** (5 / 6) * kv(5 / 6, x))
    np.testing.assert_allclose(structure.phase_structure(R, r0, outer), expected, rtol=2e-3)


def test_inner_scale_makes_the_structure_function_quadratic():
    short = np.array([1e-5, 2e-5])
    assert np.divide(*structure.refractive_structure(short, 1e-14, 10.0, 5e-3)) == pytest.approx(1 / 4, rel=1e-3)
    assert np.divide(*structure.phase_structure(short, 0.1, 10.0, 5e-3)) == pytest.approx(1 / 4, rel=1e-3)


def test_outer_scale_makes_it_level_off():
    far = structure.phase_structure(np.array([50.0, 500.0]), 0.1, outer_scale=1.0)
    assert far[1] == pytest.approx(far[0], rel=1e-3)
    assert structure.phase_structure(np.array([0.0]), 0.1, outer_scale=1.0)[0] == 0


def test_shape_is_kept():
    assert structure.phase_structure(np.ones((2, 3)), 0.1, 5.0).shape == (2, 3)
    assert structure.refractive_structure(np.array(0.3), 1e-15, 5.0).shape == ()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: refractive_spectrum(KAPPA, -1e-15), "Cn2 = -1e-15"),
        (lambda: phase_spectrum(KAPPA, 0.0), "r0 = 0 m"),
        (lambda: phase_spectrum(KAPPA, 0.1, outer_scale=0.0), "outer scale = 0 m"),
        (lambda: phase_spectrum(KAPPA, 0.1, inner_scale=-1e-3), "inner scale = -0.001 m"),
        (lambda: structure.phase_structure(R, -0.1), "r0 = -0.1 m"),
        (lambda: structure.refractive_structure(R, -1e-15), "Cn2 = -1e-15"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(ParameterError, match=message):
        call()
