import math

import pytest
import torch
import torch.nn.functional as F

from turbnet.nets.tilt import SCALES
from turbnet.tasks.losses import charbonnier, psnr, registration_loss, tilt_loss


def test_charbonnier():
    a = torch.tensor([0.0, 0.3, 1.0])
    assert float(charbonnier(a, a)) == pytest.approx(1e-3)
    assert float(charbonnier(a, a + 0.3)) == pytest.approx(math.hypot(0.3, 1e-3))
    assert float(charbonnier(a, a + torch.tensor([1.0, 0.0, 0.0]), epsilon=0.1)) == pytest.approx(
        (math.hypot(1, 0.1) + 0.2) / 3
    )


def test_charbonnier_is_smooth_at_zero():
    a = torch.zeros(3, requires_grad=True)
    charbonnier(a, torch.zeros(3)).backward()
    assert not a.grad.any()


@pytest.mark.parametrize(("error", "expected"), [(0.1, 20.0), (0.01, 40.0), (1.0, 0.0)])
def test_psnr_of_a_constant_error(error, expected):
    a = torch.zeros(2, 3, 3, 4, 4)
    assert float(psnr(a + error, a)) == pytest.approx(expected, abs=1e-4)


def test_psnr_is_the_mean_over_clips_and_cuts_to_full_scale():
    truth = torch.zeros(2, 1, 1, 4, 4)
    off = torch.stack((truth[0] + 0.1, truth[1] + 0.001))
    assert float(psnr(off, truth)) == pytest.approx((20 + 60) / 2, abs=1e-3)
    assert float(psnr(truth + 7, truth + 1)) == pytest.approx(120)


def waves(x):
    """(1, T, 3, 32, 32) of a smooth pattern whose point u is at u + x_t, for the shifts x (T,) along x."""
    columns = torch.arange(32.0) - x[:, None, None, None]
    return (0.5 + 0.4 * torch.sin(0.2 * columns)).expand(len(x), 3, 32, 32)[None]


def constant_tilts(x):
    """What `TiltNet` returns if it is right about shifts x (T,) along x."""
    maps = torch.stack((x, torch.zeros_like(x)), dim=1)[None, :, :, None, None]
    return [maps.expand(1, len(x), 2, 32 // s, 32 // s) for s in SCALES]


class TestAtTheTruth:
    x = torch.tensor([1.0, -2.0, 0.0])

    def test_registration_loss(self):
        """Small: what is left is interpolation, and the border that came from outside. Wrong signs are far worse."""
        frames, truth = waves(self.x), waves(torch.zeros(3))
        right = registration_loss(frames, truth, constant_tilts(self.x))
        still = registration_loss(frames, truth, constant_tilts(0 * self.x))
        wrong = registration_loss(frames, truth, constant_tilts(-self.x))
        assert right < 0.25 * still < 0.25 * wrong
        exact = registration_loss(truth, truth, constant_tilts(0 * self.x))
        assert float(exact) == pytest.approx(1e-3, rel=1e-3)

    def test_every_scale_takes_part(self):
        frames, truth = waves(self.x), waves(torch.zeros(3))
        for scale in range(3):
            tilts = constant_tilts(self.x)
            tilts[scale] = -tilts[scale]
            assert registration_loss(frames, truth, tilts) > 2 * registration_loss(
                frames, truth, constant_tilts(self.x)
            )

    def test_tilt_loss(self):
        truth = torch.randn(1, 3, 2, 32, 32)
        tilts = [F.avg_pool2d(truth[0], s)[None] for s in SCALES]
        assert float(tilt_loss(tilts, truth)) == pytest.approx(0.1, rel=1e-5)  # epsilon
        off = [t + 3 for t in tilts]
        assert float(tilt_loss(off, truth)) == pytest.approx(math.hypot(3, 0.1), rel=1e-4)
        assert float(tilt_loss([off[0], *tilts[1:]], truth)) == pytest.approx((math.hypot(3, 0.1) + 0.2) / 3, rel=1e-4)
