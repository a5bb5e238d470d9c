import numpy as np
import pytest
import torch

from turbnet.media.colour import to_linear, to_srgb


def test_known_values():
    # IEC 61966-2-1: mid grey 0.5 encodes 0.21404; 18 % grey is encoded as 0.46136; the straight part has slope 12.92.
    np.testing.assert_allclose(to_linear(np.array([0.0, 0.02, 0.5, 1.0])), [0, 0.02 / 12.92, 0.2140411, 1], atol=1e-7)
    np.testing.assert_allclose(to_srgb(np.array([0.0, 0.001, 0.18, 1.0])), [0, 0.01292, 0.4613561, 1], atol=1e-7)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_round_trip(dtype):
    values = np.linspace(-0.1, 1.2, 100_001, dtype=dtype)
    for there, back in ((to_linear, to_srgb), (to_srgb, to_linear)):
        result = back(there(values))
        assert result.dtype == dtype
        np.testing.assert_allclose(result, values, atol=1e-6)


def test_tensors_agree_with_arrays():
    values = np.linspace(-0.1, 1.2, 1001)
    for curve in (to_linear, to_srgb):
        tensor = curve(torch.from_numpy(values))
        np.testing.assert_allclose(tensor.numpy(), curve(values), rtol=1e-14)


def test_gradients_are_finite_and_right():
    values = torch.tensor([-0.2, 0.0, 0.001, 0.02, 0.3, 1.0, 1.5], dtype=torch.float64, requires_grad=True)
    for curve, at_zero in ((to_linear, 1 / 12.92), (to_srgb, 12.92)):
        assert torch.autograd.gradcheck(curve, values)
        (gradient,) = torch.autograd.grad(curve(values).sum(), values)
        assert gradient[1].item() == pytest.approx(at_zero)
