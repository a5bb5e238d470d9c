import math

import numpy as np
import pytest
import torch
from scipy.signal import fftconvolve
from scipy.special import gamma, kv

from turbnet.atmosphere.noll import noll_covariance
from turbnet.atmosphere.screens import PhaseScreen
from turbnet.errors import ParameterError
from turbnet.optics.zernike import zernike_basis

R0 = 0.1
SPACING = 0.01


@pytest.fixture(autouse=True)
def one_thread():
    """Operations this small lose more than they gain by a second thread where another process has its core."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def kolmogorov(r):
    return 6.8839 * (r / R0) ** (5 / 3)


def von_karman(r, outer):
    """Closed form of D(r) with an outer scale; Conan, in: Optics in Atmospheric Propagation (2000)."""
    x = 2 * np.pi * r / outer
    scale = (24 / 5 * gamma(6 / 5)) ** (5 / 6) * gamma(11 / 6) / np.pi ** (8 / 3) * 2 ** (1 / 6)
    return scale * (outer / R0) ** (5 / 3) * (gamma(5 / 6) / 2 ** (1 / 6) - x ** (5 / 6) * kv(5 / 6, x))


def separations(height, width):
    """From one sample to the far corner, along several directions."""
    size = np.unique(np.geomspace(1, min(height, width) - 1, 20).astype(int))
    dy = np.concatenate([0 * size, size, size, size, size // 2, [height - 1]])
    dx = np.concatenate([size, 0 * size, size, -size, size, [width - 1]])
    return dy, dx


@pytest.mark.parametrize("shape", [(256, 256), (63, 63), (200, 61)])
def test_represented_structure_function_is_kolmogorov(shape):
    dy, dx = separations(*shape)
    represented = PhaseScreen(shape, SPACING, R0).structure_function(dy, dx)
    np.testing.assert_allclose(represented, kolmogorov(SPACING * np.hypot(dy, dx)), rtol=0.005)


@pytest.mark.parametrize("outer", [0.5, 2.0, 3.0, 20.0, 1000.0])
def test_represented_structure_function_is_von_karman(outer):
    dy, dx = separations(200, 200)
    represented = PhaseScreen((200, 200), SPACING, R0, outer).structure_function(dy, dx)
    np.testing.assert_allclose(represented, von_karman(SPACING * np.hypot(dy, dx), outer), rtol=0.006)


def test_inner_scale_smooths_small_separations_only():
    r = np.array([1, 2, 100])
    smooth = PhaseScreen((200, 200), SPACING, R0, inner_scale=0.05).structure_function(0 * r, r)
    ratio = smooth / kolmogorov(SPACING * r)
    assert ratio[0] < 0.7
    assert ratio[0] < ratio[1] < 0.95
    assert ratio[2] == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("shape", [(64, 64), (60, 90)])
def test_drawn_structure_function_within_its_standard_error(shape):
    screens = PhaseScreen(shape, SPACING, R0).draw(3000, torch.Generator().manual_seed(3)).double()
    for dy, dx in [(0, 2), (2, 0), (5, 5), (0, 16), (16, -16), (0, 32), (30, 0)]:
        first = screens[:, : shape[0] - dy, max(0, -dx) : shape[1] - max(0, dx)]
        second = screens[:, dy:, max(0, dx) : shape[1] + min(0, dx)]
        each = ((first - second) ** 2).mean(dim=(1, 2))
        theory = kolmogorov(SPACING * math.hypot(dy, dx))
        assert abs(each.mean() / theory - 1) < max(0.01, 4 * each.std() / math.sqrt(3000) / theory)


def test_represented_zernike_variances_are_nolls():
    """E[a_j^2] = -1/2 sum w_j(x) w_j(x') D(x - x'), with a_j = sum w_j phi: tilt needs the lowest frequencies."""
    count = 65
    axis = (np.arange(count) - count // 2) / (0.5 * count)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    inside = np.hypot(y, x) <= 1
    fit = np.linalg.pinv(zernike_basis(range(1, 37), np.hypot(y, x)[inside], np.arctan2(y, x)[inside]).T)
    shift = np.arange(-count + 1, count)
    structure = PhaseScreen((512, 512), SPACING, R0).structure_function(*np.meshgrid(shift, shift, indexing="ij"))
    strength = (count * SPACING / R0) ** (5 / 3)
    for j, tolerance in [(2, 0.005), (3, 0.005), (4, 0.01), (5, 0.01), (6, 0.01), (7, 0.02), (11, 0.03), (15, 0.03)]:
        weights = np.zeros((count, count))
        weights[inside] = fit[j - 1]
        variance = -0.5 * np.sum(weights * fftconvolve(structure, weights, mode="valid"))
        assert variance == pytest.approx(noll_covariance(j, j) * strength, rel=tolerance), j


def test_opposite_edges_are_not_tied_together():
    screens = PhaseScreen((64, 64), SPACING, R0).draw(400, torch.Generator().manual_seed(2))
    difference = ((screens[:, :, 0] - screens[:, :, -1]) ** 2).mean(1)
    assert difference.mean() == pytest.approx(kolmogorov(63 * SPACING), rel=4 * math.sqrt(2 / 400))


def test_draws_are_seeded_independent_and_of_the_asked_type():
    source = PhaseScreen((40, 33), SPACING, R0, dtype=torch.float64)
    one = source.draw(2, torch.Generator().manual_seed(3))
    again = source.draw(2, torch.Generator().manual_seed(3))
    assert one.shape == (2, 40, 33)
    assert one.dtype == torch.float64
    assert torch.equal(one, again)
    assert not torch.equal(one[0], one[1])
    generator = torch.Generator().manual_seed(3)
    assert not torch.equal(source.draw(2, generator), source.draw(2, generator))
    wide = source.draw(800, generator)
    centred = (wide - wide.mean(dim=(1, 2), keepdim=True)).flatten(1)
    pairs = torch.nn.functional.cosine_similarity(centred[0::2], centred[1::2])
    assert abs(pairs.mean()) < 4 * pairs.std() / math.sqrt(400)


def test_still_air_is_flat():
    assert not PhaseScreen((16, 16), SPACING, math.inf).draw(2, torch.Generator()).any()


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (dict(r0=0.0), "r0"),
        (dict(r0=-1.0), "r0"),
        (dict(r0=math.nan), "r0"),
        (dict(spacing=0.0), "spacing"),
        (dict(outer_scale=0.0), "outer_scale"),
        (dict(inner_scale=-1.0), "inner_scale"),
        (dict(shape=(4, 64)), "screen height"),
    ],
)
def test_bad_parameters_are_named(arguments, name):
    with pytest.raises(ParameterError, match=name):
        PhaseScreen(**{"shape": (64, 64), "spacing": SPACING, "r0": R0, **arguments})
