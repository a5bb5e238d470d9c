import math

import pytest
import torch
import torch.nn.functional as F

from turbnet.nets.restorer import Past, Restored
from turbnet.nets.tilt import SCALES, Registered
from turbnet.tasks.losses import (
    charbonnier,
    frequency_loss,
    gate_loss,
    moving_weights,
    psnr,
    registration_loss,
    tilt_error,
    tilt_loss,
)


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
        """-log p up to a constant: |e| e^z / b_0 - z, the error being the length of a vector."""
        truth = torch.randn(1, 3, 2, 32, 32)
        exact = [F.avg_pool2d(truth[0], s)[None] for s in SCALES]
        zero = [torch.zeros_like(t[:, :, :1]) for t in exact]

        def loss(tilts, logits):
            return float(tilt_loss(Registered(truth, tilts, logits, truth, truth, truth), truth))

        assert loss(exact, zero) == pytest.approx(0.05 / 0.5, rel=1e-4)
        off = [t + 3 for t in exact]
        assert loss(off, zero) == pytest.approx(math.hypot(3, 3, 0.05) / 0.5, rel=1e-4)
        assert loss([off[0], *exact[1:]], zero) == pytest.approx((math.hypot(3, 3, 0.05) + 0.1) / 0.5 / 3, rel=1e-4)
        # The right scale of the error, b = |e|, is the best.
        right = math.log(0.5 / math.hypot(3, 3))
        best, *worse = (loss(off, [z + right + shift for z in zero]) for shift in (0.0, -0.5, 0.5))
        assert best == pytest.approx(1 - right, rel=1e-3)
        assert all(other > best for other in worse)

    def test_tilt_error(self):
        truth = torch.randn(1, 3, 2, 32, 32)
        off = [F.avg_pool2d(truth[0], s)[None] + 2 for s in SCALES]
        assert float(tilt_error(Registered(truth, off, [], truth, truth, truth), truth)) == pytest.approx(2, rel=1e-5)

    def test_frequency_loss(self):
        """Of white noise of deviation s: each coefficient is complex normal, its mean modulus s sqrt(pi) / 2."""
        a = torch.rand(1, 2, 3, 64, 64)
        assert float(frequency_loss(a, a)) == pytest.approx(1e-4, rel=1e-3)
        noise = 0.1 * torch.randn(4, 4, 3, 64, 64, generator=torch.Generator().manual_seed(0))
        expected = 0.1 * math.sqrt(math.pi) / 2
        # 100,000 moduli, relative deviation 0.52 each; few frequencies are real and have another mean.
        assert float(frequency_loss(a[:, :1] + noise, a[:, :1].expand_as(noise))) == pytest.approx(expected, rel=0.01)


def test_what_moves_counts_more():
    clip = torch.full((1, 4, 3, 6, 8), 0.5)
    clip[:, 1, :, 2, 3] = 0.9  # its mean over time is 0.6: it is seen to move in every frame
    weights = moving_weights(clip, 6.0)
    assert weights.shape == (1, 4, 1, 6, 8)
    assert (weights[..., 2, 3] == 6).all()
    assert float(weights.sum()) == 4 * (6 * 8 - 1) + 4 * 6
    error = charbonnier(clip + 0.1, clip, epsilon=0.0, weight=weights)
    assert float(error) == pytest.approx(0.1 * (47 + 6) / 48, rel=1e-5)


def gated(gate: float, own: tuple[float, float], scene: float) -> Restored:
    """What a restorer returns for a black clip of two frames if its parts are off by so much."""
    flat = torch.zeros(1, 2, 3, 8, 8)
    logit = torch.full((1, 2, 1, 8, 8), gate)
    registered = Registered(flat, [], [], flat[:, :1], flat, flat)
    errors = torch.tensor(own).view(1, 2, 1, 1, 1)
    return Restored(flat, flat[:, :1] + scene, flat + errors, logit, registered, Past(flat, flat, flat, flat, flat))


@pytest.mark.parametrize(
    ("own", "scene", "share"), [((0.0, 0.12), 0.1, 0.1 / 0.12), ((0.1, 0.13), 0.11, 1 / 3), ((0.0, 0.2), 0.1, 0.5)]
)
def test_the_gate_wants_what_is_nearer_by_what_it_matters(own, scene, share):
    """Of one gate for two frames, the first nearer by d_1, the second further off by d_2, the best is d_1 / (d_1 + d_2)."""
    logits = torch.linspace(-4, 4, 161)
    losses = torch.stack([gate_loss(gated(float(z), own, scene), torch.zeros(1, 2, 3, 8, 8)) for z in logits])
    best = torch.sigmoid(logits[losses.argmin()])
    assert float(best) == pytest.approx(share, abs=0.02)


def test_the_gate_is_free_where_both_are_as_good():
    made = gated(0.0, (0.1, 0.1), 0.1)
    made.gate.requires_grad_()
    gate_loss(made, torch.zeros(1, 2, 3, 8, 8)).backward()
    assert made.gate.grad.abs().max() < 1e-6


def test_the_gates_loss_of_a_batch_is_the_mean_of_its_clips():
    """Or two processes would not take the step of one."""
    clips = [gated(0.3, (0.0, 0.12), 0.1), gated(-0.5, (0.1, 0.4), 0.2)]
    both = Restored(*(torch.cat(parts) for parts in list(zip(*clips, strict=True))[:4]), *clips[0][4:])
    black = torch.zeros(1, 2, 3, 8, 8)
    single = torch.stack([gate_loss(clip, black) for clip in clips]).mean()
    torch.testing.assert_close(gate_loss(both, black.expand(2, -1, -1, -1, -1)), single)


def test_the_gates_loss_moves_the_gate_alone():
    made = gated(0.0, (0.1, 0.1), 0.2)
    parts = [part.requires_grad_() for part in (made.gate, made.own, made.scene)]
    gate_loss(made, torch.zeros(1, 2, 3, 8, 8)).backward()
    assert parts[0].grad.abs().sum() > 0
    assert parts[1].grad is None
    assert parts[2].grad is None
