"""The plane waves of a spectrum, beside integrals over the plane of frequencies."""

import numpy as np
import pytest
from scipy.integrate import dblquad

from turbnet.simulate.waves import _LEVELS, grid_waves, held, low_waves

STEP = (0.7, 1.3)  # dK along x and y, rad/m


def test_cells_below_the_grid_tile_the_block_that_it_gives_up():
    """3 x 3 bins less the smallest block of all; a wave stands for a pair of cells."""
    waves = low_waves(STEP)
    assert 2 * waves.area.sum() == pytest.approx((9 - 9.0**-_LEVELS) * STEP[0] * STEP[1], rel=1e-12)
    bins = grid_waves((16, 16), STEP)
    assert (~held(bins)).sum() == 6  # ky = -1, 0, 1 of kx = 0, 1


def test_waves_below_the_grid_are_one_of_each_pair():
    waves = low_waves(STEP)
    both = {(round(x, 9), round(y, 9), w) for x, y, w in zip(waves.x, waves.y, waves.width, strict=True)}
    assert len(both) == len(waves.x)
    assert not both & {(-x, -y, w) for x, y, w in both}


@pytest.mark.parametrize("k0", [0.0, 0.5, 5.0])
def test_a_cell_carries_the_energy_of_a_tilt_in_it(k0):
    """Its weight times its area times what a tilt sees at its middle is the integral over the cell."""
    waves = low_waves(STEP)
    weights = waves.weight(k0)

    def seen(x, y):
        return (x**2 + y**2 + k0**2) ** (-11 / 6) * (x**2 + y**2)

    for index in range(0, len(waves.x), 29):
        x, y, half = waves.x[index], waves.y[index], waves.width[index] / 2
        (x0, x1), (y0, y1) = ((v - half * s, v + half * s) for v, s in zip((x, y), STEP, strict=True))
        exact, _ = dblquad(seen, y0, y1, x0, x1, epsrel=1e-6)
        assert weights[index] * waves.area[index] * seen(x, y) == pytest.approx(exact, rel=0.02)


def test_half_a_grid_is_the_rows_of_positive_frequency():
    whole, half = (grid_waves((12, 10), STEP, half=h) for h in (False, True))
    np.testing.assert_array_equal(half.x, whole.x[:7])
    np.testing.assert_array_equal(half.y[:6], whole.y[:6])
    assert half.y[6, 0] == -whole.y[6, 0]  # Nyquist's row is its own mirror image
