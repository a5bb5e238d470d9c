import io

import numpy as np
import pytest
import skimage.data
import torch
from PIL import Image

from turbnet.errors import InputError, ParameterError
from turbnet.media.colour import to_linear, to_srgb
from turbnet.simulate.sensor import Sensor, compressed, exposed


@pytest.fixture(scope="module")
def picture() -> torch.Tensor:
    """sRGB, an odd size."""
    return torch.from_numpy(skimage.data.astronaut()[:133, 150:301].copy()).float().permute(2, 0, 1)[None] / 255


def pillow(picture: torch.Tensor, quality: int) -> torch.Tensor:
    file = io.BytesIO()
    eight_bit = (picture[0] * 255).round().byte().permute(1, 2, 0).squeeze(-1).numpy()
    Image.fromarray(eight_bit).save(file, "JPEG", quality=quality, subsampling="4:2:0")
    out = torch.from_numpy(np.array(Image.open(file))).float() / 255
    return out.reshape(*out.shape[:2], -1).permute(2, 0, 1)[None]


def test_ideal_sensor_changes_nothing():
    x = torch.rand(2, 3, 8, 8) * 3 - 1
    assert torch.equal(Sensor()(x), x)


class TestNoise:
    def test_it_has_the_variance_it_says(self):
        x = torch.full((400, 400), 0.4)
        noise = Sensor(full_well=1000.0, read_noise=0.02)(x, seed=1) - x
        expected = 0.4 / 1000 + 0.02**2
        # The variance of n samples has the relative error sqrt(2/n).
        assert float(noise.var()) == pytest.approx(expected, rel=4 * (2 / x.numel()) ** 0.5)
        assert abs(float(noise.mean())) < 4 * (expected / x.numel()) ** 0.5

    def test_shot_noise_grows_with_the_light(self):
        x = torch.tensor([0.1, 0.3, 0.7])[:, None].expand(3, 100_000)
        noise = Sensor(full_well=5000.0)(x) - x
        np.testing.assert_allclose(noise.var(1) * 5000, x[:, 0], rtol=4 * (2 / 100_000) ** 0.5)

    def test_a_seed_decides_it(self):
        x = torch.full((2, 2, 3, 9, 7), 0.5)
        camera = Sensor(full_well=100.0)
        assert torch.equal(camera(x, 3), camera(x, 3))
        assert not torch.equal(camera(x, 3), camera(x, 4))

    def test_gradients_are_finite_in_black_pixels(self):
        x = torch.zeros(10, requires_grad=True)
        Sensor(100.0, 0.01)(x).sum().backward()
        assert torch.isfinite(x.grad).all()

    def test_gradcheck(self):
        x = (0.3 + 0.4 * torch.rand(1, 4, 2, 3, 5, dtype=torch.float64)).requires_grad_()
        camera = Sensor(full_well=1e4, read_noise=0.01, exposures=2, gamma=True)
        assert torch.autograd.gradcheck(camera, (x,))


class TestExposure:
    def test_it_is_the_mean_of_neighbouring_instants(self):
        x = torch.rand(2, 6, 3, 5, 7)
        out = Sensor(exposures=3)(x)
        assert out.shape == (2, 2, 3, 5, 7)
        torch.testing.assert_close(out[:, 1], x[:, 3:].mean(1))

    def test_light_is_averaged_before_noise_comes_and_linearly_before_gamma(self):
        x = torch.stack((torch.zeros(1, 300, 300), torch.ones(1, 300, 300)))[None] * 0.8
        read = Sensor(read_noise=0.02, exposures=2)(x)
        assert float(read.std()) == pytest.approx(0.02, rel=4 * (0.5 / 90_000) ** 0.5)
        encoded = Sensor(exposures=2, gamma=True)(x)
        torch.testing.assert_close(encoded, to_srgb(torch.full_like(encoded, 0.4)))

    @pytest.mark.parametrize("shape", [(1, 5, 3, 4, 4), (4, 3, 4, 4)])
    def test_frames_that_do_not_divide_are_refused(self, shape):
        with pytest.raises(InputError, match="averaged 2 at a time"):
            exposed(torch.rand(shape), 2)


class TestDepth:
    def test_values(self):
        out = Sensor(bits=3)(torch.rand(1000))
        assert len(out.unique()) == 8

    def test_rounding_and_noise_pass_gradients(self):
        x = torch.zeros(10, requires_grad=True)
        Sensor(100.0, 0.0, 8)(x + 0.5).sum().backward()
        assert torch.isfinite(x.grad).all()
        assert x.grad.abs().min() > 0

    def test_gamma_comes_after_it(self):
        out = to_linear(Sensor(bits=4, gamma=True)(torch.rand(1000))) * 15
        torch.testing.assert_close(out, out.round(), atol=1e-4, rtol=0)


class TestCompression:
    @pytest.mark.parametrize("quality", [10, 50, 90])
    def test_values_are_pillow_s(self, picture, quality):
        torch.testing.assert_close(compressed(picture, quality), pillow(picture, quality), atol=1e-6, rtol=0)
        grey = picture.mean(1, keepdim=True)
        torch.testing.assert_close(compressed(grey, quality), pillow(grey, quality), atol=1e-6, rtol=0)

    def test_it_sees_srgb_whatever_it_returns(self, picture):
        linear = to_linear(picture)
        encoded = Sensor(jpeg=40, gamma=True)(linear)
        torch.testing.assert_close(encoded, pillow(picture, 40), atol=1e-6, rtol=0)
        torch.testing.assert_close(Sensor(jpeg=40)(linear), to_linear(encoded))

    def test_a_better_quality_loses_less(self, picture):
        losses = [float((compressed(picture, q) - picture).square().mean()) for q in (5, 20, 50, 80, 95)]
        assert losses == sorted(losses, reverse=True)

    @pytest.mark.parametrize("gamma", [False, True])
    def test_gradients_pass_straight_through(self, picture, gamma):
        """With gamma they are those of the curve; without, those of encoding there and decoding back: nearly one."""
        x = (0.1 + 0.8 * to_linear(picture)).requires_grad_()
        out = Sensor(jpeg=60, gamma=gamma)(x)
        torch.testing.assert_close(out.detach(), Sensor(jpeg=60, gamma=gamma)(x.detach()), atol=1e-6, rtol=0)
        (gradient,) = torch.autograd.grad(out.sum(), x)
        if gamma:
            (expected,) = torch.autograd.grad(to_srgb(x).sum(), x)
            torch.testing.assert_close(gradient, expected)
        else:
            assert float(gradient.mean()) == pytest.approx(1.0, abs=0.02)

    @pytest.mark.parametrize("size", [(1, 1), (1, 17), (16, 16), (31, 18)])
    def test_any_size_and_leading_axes(self, size):
        x = torch.rand(2, 3, 3, *size)
        assert compressed(x, 50).shape == x.shape

    @pytest.mark.parametrize("shape", [(2, 4, 8, 8), (8, 8)])
    def test_other_channels_are_refused(self, shape):
        with pytest.raises(InputError, match="JPEG takes"):
            compressed(torch.rand(shape), 50)


@pytest.mark.parametrize(
    "bad", [{"full_well": 0.0}, {"read_noise": -0.1}, {"bits": 99}, {"exposures": 0}, {"jpeg": 0}, {"jpeg": 101}]
)
def test_out_of_range(bad):
    with pytest.raises(ParameterError, match=next(iter(bad))):
        Sensor(**bad)


def test_any_brightness_saturates():
    seen = Sensor(bits=8)(torch.tensor([1e8, float("inf"), -1e8, 0.5]))
    torch.testing.assert_close(seen, torch.tensor([1.0, 1.0, 0.0, 128 / 255]))
