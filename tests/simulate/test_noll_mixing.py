import numpy as np
import pytest
import torch

from turbnet.atmosphere.approximations import noll_mixing
from turbnet.atmosphere.covariance import zernike_covariance
from turbnet.atmosphere.noll import noll_matrix
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Constant
from turbnet.errors import ParameterError
from turbnet.simulate.field import ZernikeField
from turbnet.simulate.noll_mixing import NollMixing

SCENE = OpticalPath(0.2034, 7000.0, Constant(1e-15), 525e-9)
STRENGTH = SCENE.d_over_r0 ** (5 / 3)


@pytest.fixture(scope="module")
def mixing() -> NollMixing:
    return NollMixing(SCENE, 129, 129, modes=11)


def spatial_means(field, pair, lag: int, draws: int) -> tuple[float, float]:
    """E[a_i(u) a_j(u')], u - u' = (lag, 0) pixels, and its standard error over independent draws."""
    i, j = pair
    step, values = lag // 4, []
    for seed in range(draws):
        a = field.draw([seed]).coefficients[0, 0].double()
        values.append(float((a[i - 2][:, step:] * a[j - 2][:, : a.shape[2] - step]).mean()))
    return float(np.mean(values)), float(np.std(values) / np.sqrt(draws))


def test_it_holds_noll_s_matrix_in_every_point(mixing):
    held = np.array([[mixing.covariance(i, j, 0.0) for j in mixing.noll] for i in mixing.noll])
    np.testing.assert_allclose(held, noll_matrix(mixing.noll) * STRENGTH, rtol=1e-5, atol=1e-6)


def test_draws_have_noll_s_matrix_in_every_point(mixing):
    """4000 independent frames, one point of each: entry (i, j) has the error sqrt((N_ii N_jj + N_ij^2) / n)."""
    small, n = NollMixing(SCENE, 1, 1, modes=11), 4000
    a = small.draw([0], n).coefficients[0, :, :, 0, 0].double().numpy()
    expected = noll_matrix(small.noll) * STRENGTH
    variance = np.diag(expected)
    error = np.sqrt((np.outer(variance, variance) + expected**2) / n)
    assert np.abs((a.T @ a / n - expected) / error).max() < 4.5
    # The wrong side of the factor, z L, would fail: its covariance is L^T L.
    factor = np.linalg.cholesky(expected)
    assert np.abs((factor.T @ factor - expected) / error).max() > 20


@pytest.mark.parametrize("pair", [(2, 2), (3, 3), (4, 4), (2, 8), (5, 5), (4, 11)])
@pytest.mark.parametrize("lag", [(8, 0), (0, 32), (32, 32)])
def test_between_points_it_holds_what_the_book_s_model_says(mixing, pair, lag):
    """Closed form of the mixed covariance; clipping the spectrum and wrapping the lags cost some percent."""
    i, j = pair
    model = noll_mixing(SCENE, mixing.noll, lag[0] * SCENE.pixel, lag[1] * SCENE.pixel)[i - 2, j - 2]
    scale = np.sqrt(noll_matrix([i])[0, 0] * noll_matrix([j])[0, 0]) * STRENGTH
    assert abs(mixing.covariance(i, j, *lag) - model) < 0.03 * scale


def test_defocus_of_a_point_knows_nothing_of_the_tilt_of_another(mixing):
    """Theory ties a2 to a4 32 pixels away by 0.198 rad^2: the exact field does, mixing does not."""
    exact = ZernikeField(SCENE, 129, 129, modes=4)
    theory = float(zernike_covariance(SCENE, 2, 4, 32 * SCENE.pixel))
    assert theory == pytest.approx(0.198, abs=0.001)
    right, right_error = spatial_means(exact, (2, 4), 32, 600)
    wrong, wrong_error = spatial_means(mixing, (2, 4), 32, 600)
    assert abs(right - theory) < 4 * right_error
    assert abs(wrong) < 4 * wrong_error
    assert theory > 8 * max(right_error, wrong_error), "too few draws to tell them apart"
    assert exact.covariance(2, 4, 32.0) == pytest.approx(theory, rel=0.02)
    assert abs(mixing.covariance(2, 4, 32.0)) < 1e-6


def test_what_was_clipped_is_reported(mixing):
    assert mixing.clipped.shape == (10,)
    assert bool((mixing.clipped >= 0).all())
    assert float(mixing.clipped.max()) > 0, "a wrapped covariance always has negative bins"
    assert float(mixing.clipped.max()) < 0.05


def test_a_seed_gives_the_same_atmosphere_alone_in_a_batch_and_piece_by_piece(mixing):
    whole = mixing.draw([5, 9], 3).coefficients
    torch.testing.assert_close(mixing.draw([9], 3).coefficients[0], whole[1], rtol=0, atol=0)
    torch.testing.assert_close(mixing.draw([9], 1, start=2).coefficients[0, 0], whole[1, 2], rtol=0, atol=0)
    assert not torch.equal(whole[0, 0], whole[0, 1])


def test_strength_scales_the_same_atmosphere_and_none_is_still(mixing):
    one, two, still = mixing.draw([1, 1, 1], d_over_r0=torch.tensor([1.0, 2.0, 0.0])).coefficients
    torch.testing.assert_close(two, one * 2 ** (5 / 6))
    assert not still.any()


def test_its_draws_go_where_the_exact_field_s_go():
    mixing, exact = (kind(SCENE, 33, 45, margin=8, modes=8) for kind in (NollMixing, ZernikeField))
    draws = [field.draw([0, 1], 2) for field in (mixing, exact)]
    assert draws[0].coefficients.shape == draws[1].coefficients.shape
    assert (draws[0].stride, draws[0].margin) == (draws[1].stride, draws[1].margin)


@pytest.mark.parametrize("bad", [{"height": 0}, {"modes": 2}, {"stride": 0}, {"padding": 1.0}])
def test_bad_geometry_is_refused(bad):
    with pytest.raises(ParameterError, match=next(iter(bad))):
        NollMixing(**{"path": SCENE, "height": 16, "width": 16, **bad})


def test_still_air_and_negative_strength_are_refused(mixing):
    with pytest.raises(ParameterError, match="still air"):
        NollMixing(OpticalPath(0.2, 1000.0, Constant(0.0)), 16, 16)
    with pytest.raises(ParameterError, match="D/r0"):
        mixing.draw([0], d_over_r0=torch.tensor([-1.0]))
