import numpy as np
import pytest

from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Constant, Tabulated
from turbnet.atmosphere.slabs import slabs
from turbnet.errors import ParameterError

PROFILES = [
    Constant(1e-15),
    Tabulated([0, 7000], [0, 2e-15]),
    Tabulated([0, 7000], [2e-15, 0]),
    Tabulated([0, 500, 501, 7000], [1e-14, 1e-14, 0, 0]),
]


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("count", [10, 13, 40])
def test_the_screens_have_the_path_s_fried_parameters(profile, count):
    path = OpticalPath(0.2034, 7000.0, profile)
    cut = slabs(path, count)
    nearness = (1 - cut.z / path.distance) ** (5 / 3)
    for weight, r0 in [(1.0, path.r0_plane), (nearness, path.r0)]:
        assert (0.423 * path.wavenumber**2 * np.sum(cut.cn2_dz * weight)) ** (-3 / 5) == pytest.approx(r0, rel=1e-9)
    if profile is PROFILES[3]:
        return  # all the air in one slab: theta0 needs slabs finer than the layer
    theta0 = (2.914 * path.wavenumber**2 * np.sum(cut.cn2_dz * cut.z ** (5 / 3))) ** (-3 / 5)
    assert theta0 == pytest.approx(path.theta0, rel=0.02)


def test_each_screen_lies_in_its_slab_in_the_order_of_the_light():
    cut = slabs(OpticalPath(0.2034, 7000.0, PROFILES[3]), 10)
    edges = np.linspace(7000, 0, 11)
    assert np.all((cut.z < edges[:-1]) & (cut.z > edges[1:]))
    assert np.isinf(cut.r0[:-1]).all()
    assert np.isfinite(cut.r0[-1])


def test_a_count_out_of_range_is_named():
    with pytest.raises(ParameterError, match="slabs = 0"):
        slabs(OpticalPath(0.2034, 7000.0, Constant(1e-15)), 0)
