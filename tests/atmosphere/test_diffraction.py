import numpy as np
import pytest

from turbnet.atmosphere.covariance import zernike_covariance
from turbnet.atmosphere.diffraction import diffracted_covariance
from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Tabulated

FAR = OpticalPath.from_d_over_r0(1.5)


@pytest.mark.parametrize(("i", "j"), [(2, 2), (3, 3), (4, 4), (2, 4), (2, 8), (4, 11)])
def test_in_the_near_field_it_is_the_geometric_covariance(i, j):
    path = OpticalPath(2.0, 100.0, Tabulated([0, 100], [1e-15, 3e-15]))
    separation = np.array([-0.3, 0.0, 0.05, 0.7])
    expected = zernike_covariance(path, i, j, separation)
    scale = np.sqrt(zernike_covariance(path, i, i, 0.0) * zernike_covariance(path, j, j, 0.0))
    np.testing.assert_allclose(diffracted_covariance(path, i, j, separation), expected, atol=2e-3 * scale)


def test_far_away_tilts_keep_their_variance_and_neighbours_grow_alike():
    geometric, diffracted = (
        sum(f(FAR, j, j, np.array([0.0, FAR.pixel])) for j in (2, 3))
        for f in (zernike_covariance, diffracted_covariance)
    )
    assert diffracted[0] / geometric[0] == pytest.approx(0.997, abs=0.001)
    assert np.diff(diffracted)[0] / np.diff(geometric)[0] == pytest.approx(0.718, abs=0.01)
    assert diffracted_covariance(FAR, 15, 15, 0.0) / zernike_covariance(FAR, 15, 15, 0.0) == pytest.approx(
        0.82, abs=0.01
    )
