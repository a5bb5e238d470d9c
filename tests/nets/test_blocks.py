import pytest
import torch
from torch import nn

from turbnet.nets.blocks import ChannelNorm, ResidualBlock, each_frame, warp


class TestChannelNorm:
    def test_is_layer_normalisation_of_each_pixel(self):
        x = torch.randn(2, 6, 3, 5)
        ours, theirs = ChannelNorm(6), nn.LayerNorm(6)
        with torch.no_grad():
            for mine, other in zip(ours.parameters(), theirs.parameters(), strict=True):
                other.copy_(torch.randn(6))
                mine.copy_(other)
        torch.testing.assert_close(ours(x), theirs(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2), rtol=1e-5, atol=1e-5)

    def test_half_precision_input_is_normalised_in_float32(self):
        """300 squared is above half precision's largest number, 65504."""
        x = (torch.randn(1, 8, 2, 2) * 300).half()
        out = ChannelNorm(8)(x)
        assert out.dtype == torch.float16
        torch.testing.assert_close(out.float(), ChannelNorm(8)(x.float()), rtol=0, atol=2e-3)


class TestWarp:
    image = torch.rand(2, 3, 7, 9)

    def test_no_flow_returns_the_image(self):
        torch.testing.assert_close(warp(self.image, torch.zeros(2, 2, 7, 9)), self.image, rtol=0, atol=1e-6)

    @pytest.mark.parametrize(("x", "y"), [(2, 0), (0, 3), (-1, 2)])
    def test_whole_pixels_shift_and_the_border_goes_on(self, x, y):
        flow = torch.tensor([float(x), float(y)]).view(1, 2, 1, 1).expand(2, 2, 7, 9)
        rows, columns = (torch.arange(7) + y).clamp(0, 6), (torch.arange(9) + x).clamp(0, 8)
        expected = self.image[..., rows, :][..., columns]
        torch.testing.assert_close(warp(self.image, flow), expected, rtol=0, atol=1e-5)

    def test_half_a_pixel_is_the_mean_of_neighbours(self):
        flow = torch.zeros(2, 2, 7, 9)
        flow[:, 0] = 0.5
        expected = (self.image[..., :-1] + self.image[..., 1:]) / 2
        torch.testing.assert_close(warp(self.image, flow)[..., :-1], expected, rtol=0, atol=1e-5)

    def test_dtype_is_kept_and_coordinates_stay_in_float32(self):
        """In half precision a coordinate of 2000 has a step of one pixel; flow is added in float32."""
        image = torch.arange(2048.0).div(2048).expand(1, 1, 2, 2048)
        out = warp(image.bfloat16(), torch.full((1, 2, 2, 2048), 0.25).bfloat16())
        assert out.dtype == torch.bfloat16
        torch.testing.assert_close(out.float(), warp(image, torch.full((1, 2, 2, 2048), 0.25)), rtol=0.01, atol=1e-3)

    @pytest.mark.filterwarnings("ignore:.*double precision")
    def test_gradients_of_image_and_flow(self):
        generator = torch.Generator().manual_seed(0)
        image = torch.rand(1, 1, 4, 5, generator=generator, requires_grad=True)
        # Between whole pixels, where bilinear interpolation has kinks.
        flow = (0.2 + 0.5 * torch.rand(1, 2, 4, 5, generator=generator)).requires_grad_()
        assert torch.autograd.gradcheck(warp, (image, flow), eps=1e-2, atol=2e-2, rtol=1e-2)


def test_residual_block_keeps_the_shape():
    assert ResidualBlock(6)(torch.rand(2, 6, 5, 3)).shape == (2, 6, 5, 3)


def test_each_frame_sees_frames_alone():
    clip = torch.rand(2, 3, 4, 5, 5)
    layer = nn.Conv2d(4, 6, 3)
    out = each_frame(layer, clip)
    assert out.shape == (2, 3, 6, 3, 3)
    torch.testing.assert_close(out[1, 2], layer(clip[1, 2:3])[0])


def test_a_flow_that_is_not_a_number_harms_no_memory():
    """Torch's own gradient of bilinear sampling at NaN ends the process."""
    image, flow = torch.rand(1, 3, 48, 32, requires_grad=True), torch.zeros(1, 2, 48, 32)
    flow[0, :, 5] = float("nan")
    (slope,) = torch.autograd.grad(warp(image, flow).sum(), image)
    torch.testing.assert_close(slope, torch.ones_like(slope))
