import numpy as np
import torch

from turbnet.atmosphere.path import OpticalPath
from turbnet.bench.field_statistics import SEPARATIONS, _covariances
from turbnet.simulate.field import ZernikeField


def test_covariances_are_those_of_the_draws_in_the_order_stated(monkeypatch):
    """a_i at u and a_j at u + s, means over points."""
    field = ZernikeField(OpticalPath.from_d_over_r0(1.0), 9, 513, modes=11)
    a = torch.randn(10, field.rows, field.columns, generator=torch.Generator().manual_seed(0))
    draw = field.draw([0])
    monkeypatch.setattr(field, "draw", lambda seeds: type(draw)(a[None, None], 4, 0))
    found = _covariances(field, range(1))
    lag = SEPARATIONS[2] // 4
    expected = (a[0, :, :-lag] * a[3, :, lag:]).mean()
    np.testing.assert_allclose(found[0, 3, 2], expected, rtol=1e-4)
