import numpy as np
import pytest
from scipy.stats import chi2

from turbnet.atmosphere.lucky import (
    karhunen_loeve,
    lucky_karhunen_loeve,
    lucky_monte_carlo,
    lucky_probability,
    tilt_free_modes,
)
from turbnet.atmosphere.noll import noll_covariance, noll_matrix, residual_variance
from turbnet.errors import ParameterError


def test_residual_variances_of_noll():
    # JOSA 66, 207, table IV: 1.0299, 0.134 with both tilts removed, then 0.0648 and 0.0401 after orders 2 and 3.
    measured = [residual_variance(order) for order in range(4)]
    np.testing.assert_allclose(measured, [1.0299, 0.134, 0.0648, 0.0401], rtol=7e-3)


def test_residual_is_the_sum_of_what_follows():
    modes = tilt_free_modes(4)
    assert residual_variance(1) - residual_variance(4) == pytest.approx(np.trace(noll_matrix(modes)), rel=1e-9)
    assert list(modes) == list(range(4, 16))


@pytest.mark.parametrize("ratio", [2.0, 3.5, 5.0, 6.0])
def test_monte_carlo_agrees_with_the_inversion(ratio):
    probability, error = lucky_monte_carlo(ratio, 40_000, seed=1)
    assert abs(probability - lucky_karhunen_loeve(ratio)) < 4 * error


def test_three_equal_modes_are_chi_square():
    # At order 2 the modes 4, 5, 6 have one variance, so P is a chi-square distribution with three degrees of freedom.
    scale = 2.0 ** (5 / 3)
    expected = chi2.cdf((1 - scale * residual_variance(2)) / (scale * noll_covariance(4, 4)), 3)
    assert lucky_karhunen_loeve(2.0, order=2) == pytest.approx(expected, rel=1e-6)


def test_limits():
    assert lucky_karhunen_loeve(0.0) == 1.0
    assert lucky_karhunen_loeve(0.5) == pytest.approx(1.0, abs=1e-9)
    assert lucky_karhunen_loeve(60.0, order=4) == 0.0  # the modes not counted are alone above 1 rad^2


def test_fried_found_the_same_at_two():
    assert lucky_karhunen_loeve(2.0) == pytest.approx(0.986, abs=0.006)  # with the error he gives


def test_fried_formula_follows_the_computed_curve():
    # A fit to eleven decades: within a factor 2 where it is used, always on the high side.
    for ratio in (3.5, 4.0, 5.0, 6.0, 7.0, 10.0):
        assert 0.5 < lucky_karhunen_loeve(ratio, order=16) / lucky_probability(ratio) < 0.9
    assert lucky_probability(1.0) == 1.0


def test_counting_more_modes_changes_little():
    assert lucky_karhunen_loeve(5.0, order=10) == pytest.approx(lucky_karhunen_loeve(5.0, order=16), rel=4e-3)


def test_karhunen_loeve_modes_are_uncorrelated_and_lead():
    modes = range(4, 37)
    variances, vectors = karhunen_loeve(modes)
    covariance = noll_matrix(modes)
    np.testing.assert_allclose(vectors.T @ covariance @ vectors, np.diag(variances), atol=1e-12)
    assert np.all(np.diff(variances) <= 0)
    zernike = np.sort(np.diag(covariance))[::-1]
    assert np.all(np.cumsum(variances) >= np.cumsum(zernike) - 1e-12)
    assert variances[0] > 1.02 * zernike[0]  # defocus gathers the radial modes it is correlated with


def test_seeds_differ():
    assert lucky_monte_carlo(4.0, 5000, seed=0) != lucky_monte_carlo(4.0, 5000, seed=1)
    assert lucky_monte_carlo(4.0, 5000, seed=0) == lucky_monte_carlo(4.0, 5000, seed=0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: lucky_monte_carlo(-1.0, 10), "D/r0 = -1"),
        (lambda: lucky_monte_carlo(3.0, 0), "samples = 0"),
        (lambda: lucky_karhunen_loeve(3.0, order=1), "radial order = 1"),
        (lambda: residual_variance(-1), "radial order = -1"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(ParameterError, match=message):
        call()
