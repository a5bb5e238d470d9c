"""Calibration of uncertainty maps, on errors whose distribution is known."""

import numpy as np
import pytest

from turbnet.errors import InputError
from turbnet.metrics.calibration import (
    LEVELS,
    STEPS,
    ause,
    calibration_error,
    rank_correlation,
    reliability,
    sparsification,
    temperature,
)

N = 40_000


@pytest.fixture
def errors():
    """Laplace errors whose scale varies by a factor of ten from pixel to pixel."""
    rng = np.random.default_rng(0)
    scale = 10 ** rng.uniform(-2, -1, N)
    return rng.laplace(scale=scale), scale


def test_the_true_scale_is_calibrated(errors):
    """The share at level p is binomial, of standard deviation below 0.5 / sqrt(N); 19 levels within four of them."""
    residual, scale = errors
    np.testing.assert_allclose(reliability(residual, scale), LEVELS, rtol=0, atol=4 * 0.5 / np.sqrt(N))
    assert calibration_error(residual, scale) < 0.005


@pytest.mark.parametrize("factor", [0.3, 1.0, 4.0])
def test_temperature_undoes_a_wrong_factor(errors, factor):
    """|r| / b is exponential: its mean over N is known to 1 / sqrt(N)."""
    residual, scale = errors
    tau = temperature(residual, scale / factor)
    assert tau == pytest.approx(factor, rel=4 / np.sqrt(N))
    assert calibration_error(residual, tau * scale / factor) < 0.005
    if factor != 1:
        assert calibration_error(residual, scale / factor) > 0.1


def test_a_constant_scale_is_found_wanting(errors):
    residual, scale = errors
    constant = np.full(N, np.abs(residual).mean())
    assert calibration_error(residual, constant) > 5 * calibration_error(residual, scale)


def test_sparsification_of_a_known_order():
    error = np.repeat([0.0, 1.0], N // 2)
    rising = np.linspace(0, 1, N)
    curve = sparsification(error, rising)
    share = np.arange(STEPS) / STEPS  # taken away; the worst half goes first
    np.testing.assert_allclose(curve, np.maximum(0.5 - share, 0) / (1 - share) / 0.5, atol=1e-3)
    assert ause(error, rising) == pytest.approx(0, abs=1e-9)
    assert ause(error, -rising) > 0.5
    assert ause(error, np.random.default_rng(0).random(N)) == pytest.approx(1 - curve.mean(), abs=0.02)


def test_ranks(errors):
    residual, scale = errors
    assert rank_correlation(np.abs(residual), np.abs(residual) ** 3) == pytest.approx(1)
    assert rank_correlation(np.abs(residual), -np.abs(residual)) == pytest.approx(-1)
    assert 0.3 < rank_correlation(np.abs(residual), scale) < 0.8
    assert rank_correlation(np.abs(residual), np.ones(N)) == 0


def test_no_errors_at_all():
    assert sparsification(np.zeros(10), np.arange(10.0)).tolist() == [1.0] * STEPS


@pytest.mark.parametrize(
    ("first", "second", "says"),
    [
        (np.ones(3), np.ones(4), "shape"),
        (np.ones(0), np.ones(0), "empty"),
        (np.array([1.0, np.nan]), np.ones(2), "finite"),
        (np.ones(2), np.array([1.0, 0.0]), "positive"),
    ],
)
def test_bad_input(first, second, says):
    with pytest.raises(InputError, match=says):
        calibration_error(first, second)


def test_negative_errors_are_refused():
    with pytest.raises(InputError, match="absolute"):
        sparsification(np.array([-1.0, 1.0]), np.ones(2))
