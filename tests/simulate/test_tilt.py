import numpy as np
import pytest
import skimage.data
import torch

from turbnet.errors import InputError
from turbnet.simulate.tilt import carry, displacement, sample, splat, tilt, upsample


@pytest.fixture(scope="module")
def picture() -> torch.Tensor:
    camera = torch.from_numpy(skimage.data.camera()[64:193, 100:229].copy()).float() / 255
    return torch.nn.functional.avg_pool2d(camera[None, None], 5, 1, 2)


def smooth_tilt(height: int, width: int, stride: int, size: float, seed: int = 0) -> torch.Tensor:
    """A random tilt on the coarse grid, smooth over some 16 pixels, `size` pixels strong."""
    generator = torch.Generator().manual_seed(seed)
    shape = (1 + -(-(height - 1) // stride), 1 + -(-(width - 1) // stride))
    coarse = torch.randn(1, 2, 2 + shape[0] // 4, 2 + shape[1] // 4, generator=generator, dtype=torch.float64)
    return size * torch.nn.functional.interpolate(coarse, size=shape, mode="bicubic", align_corners=True)


def test_no_tilt_returns_the_picture(picture):
    torch.testing.assert_close(tilt(picture, torch.zeros(1, 2, 33, 33), 4), picture, rtol=0, atol=1e-6)


def test_tiny_tilt_is_no_jump(picture):
    """Half-pixel misregistration would show here."""
    out = tilt(picture, torch.full((1, 2, 33, 33), 1e-4), 4)
    # To the border, where light comes and goes.
    assert float((out - picture)[..., 2:-2, 2:-2].abs().max()) < 1e-4


def test_positive_tilt_moves_a_point_the_positive_way():
    point = torch.zeros(1, 1, 33, 33)
    point[..., 16, 16] = 1
    t = torch.zeros(1, 2, 9, 9)
    t[:, 0], t[:, 1] = 3.0, -5.0
    out = tilt(point, t, 4)
    assert np.unravel_index(int(out.argmax()), (33, 33)) == (16 - 5, 16 + 3)
    assert float(out.max()) == pytest.approx(1.0, abs=1e-4)


def test_displacement_inverts_the_tilt():
    t = smooth_tilt(129, 129, 4, 1.2)
    d = displacement(t, 4)
    residual = d - sample(t, -d / 4)
    assert float(residual.abs().max()) < 1e-3


def test_sampling_at_the_moved_points_undoes_it(picture):
    t = smooth_tilt(129, 129, 4, 1.5).float()
    moved = tilt(torch.cat((picture, torch.ones_like(picture)), 1), t, 4)
    moved = moved[:, :1] / moved[:, 1:].clamp(min=1e-3)
    back = sample(moved, upsample(t, 4, 129, 129))
    inner = (..., slice(8, -8), slice(8, -8))
    assert float((back - picture)[inner].square().mean()) < 0.01 * float((moved - picture)[inner].square().mean())


def test_energy_is_kept():
    scene = torch.zeros(1, 1, 129, 129, dtype=torch.float64)
    scene[..., 32:97, 32:97] = torch.rand(65, 65, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    out = tilt(scene, smooth_tilt(129, 129, 4, 1.5), 4)
    assert float(out.sum() / scene.sum()) == pytest.approx(1.0, abs=1e-10)


def test_points_that_cross_over_both_arrive():
    scene = torch.zeros(1, 1, 1, 33)
    scene[..., 12], scene[..., 20] = 1.0, 2.0
    t = torch.zeros(1, 2, 1, 33)
    t[:, 0, :, :16], t[:, 0, :, 16:] = 4.0, -4.0
    out = tilt(scene, t, 1)
    assert float(out[..., 16]) == pytest.approx(3.0, abs=1e-4)


def test_a_field_is_carried_to_where_its_points_went():
    t = torch.zeros(1, 2, 9, 9)
    t[:, 0] = 8.0
    f = torch.arange(9.0).expand(1, 1, 9, 9)
    torch.testing.assert_close(carry(f, t, 4)[..., 2:], f[..., :-2], atol=1e-4, rtol=0)


def test_gradients_in_picture_and_tilt():
    generator = torch.Generator().manual_seed(2)
    scene = torch.rand(1, 2, 9, 13, generator=generator, dtype=torch.float64, requires_grad=True)
    t = (0.5 * smooth_tilt(9, 13, 4, 1.0, 3)).requires_grad_()
    assert torch.autograd.gradcheck(lambda s, v: tilt(s, v, 4), (scene, t), atol=1e-4, fast_mode=True)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 17), (3, 3), (31, 18)])
def test_odd_sizes(height, width):
    scene = torch.rand(1, 3, height, width)
    t = torch.ones(1, 2, 1 + -(-(height - 1) // 4), 1 + -(-(width - 1) // 4))
    out = tilt(scene, t, 4)
    assert out.shape == scene.shape
    assert torch.isfinite(out).all()


def test_a_tilt_that_is_not_a_number_is_refused(picture):
    t = torch.zeros(1, 2, 33, 33)
    t[0, 0, 5, 5] = float("nan")
    with pytest.raises(InputError, match="tilt"):
        tilt(picture, t, 4)


@pytest.mark.parametrize("size", [(1, 1), (1, 17), (17, 1), (5, 4)])
def test_light_leaves_a_picture_of_one_pixel_as_it_leaves_others(size):
    away = torch.full((1, 2, *size), 40.0)
    assert float(splat(torch.ones(1, 1, *size), away).abs().sum()) == 0


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.uint8])
def test_numbers_too_coarse_for_places_are_refused(dtype):
    with pytest.raises(InputError, match="float32"):
        splat(torch.ones(1, 1, 9, 9).to(dtype), torch.ones(1, 2, 9, 9).to(dtype))
