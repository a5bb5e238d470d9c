import pytest
import skimage.data
import torch
import torch.nn.functional as F

from turbnet.data.pairs import PairMaker
from turbnet.nets.blocks import warp
from turbnet.nets.lucas_kanade import lucas_kanade
from turbnet.nets.tilt import ERROR_AT_HALF, SCALES, TiltNet, mean_free, neighbours, weighted_mean


def trained(seed: int = 0) -> TiltNet:
    """A net whose every weight takes part, as after training."""
    torch.manual_seed(seed)
    net = TiltNet(widths=(6, 5, 4))
    with torch.no_grad():
        for level in net.levels:
            level.correction.weight.normal_(std=0.1)
            level.gate.weight.normal_(std=0.1)
            level.certainty.weight.normal_(std=0.1)
    return net.eval()


@pytest.mark.parametrize(("batch", "frames", "height", "width"), [(1, 1, 8, 8), (3, 2, 24, 40), (1, 7, 72, 8)])
def test_shapes(batch, frames, height, width):
    out = trained()(torch.rand(batch, frames, 3, height, width))
    assert out.frames.shape == (batch, frames, 3, height, width)
    assert [tuple(t.shape) for t in out.tilts] == [(batch, frames, 2, height // s, width // s) for s in SCALES]
    assert [tuple(z.shape) for z in out.logits] == [(batch, frames, 1, height // s, width // s) for s in SCALES]
    assert out.confidence.shape == (batch, frames, 1, height, width)
    assert out.reference.shape == (batch, 1, 3, height, width)


@torch.no_grad()
def test_which_way_time_runs_does_not_matter():
    net, clip = trained(), torch.rand(1, 7, 3, 24, 24)
    out, reverse = net(clip), net(clip.flip(1))
    torch.testing.assert_close(reverse.frames, out.frames.flip(1), rtol=0, atol=1e-4)
    torch.testing.assert_close(reverse.tilts[-1], out.tilts[-1].flip(1), rtol=0, atol=1e-3)


@torch.no_grad()
def test_the_tilts_of_a_clip_have_no_mean():
    out = trained()(torch.rand(2, 5, 3, 24, 32))
    for tilt, logit in zip(out.tilts, out.logits, strict=True):
        assert tilt.abs().max() > 0.1
        torch.testing.assert_close(
            (torch.sigmoid(logit) * tilt).mean(1), torch.zeros_like(tilt[:, 0]), rtol=0, atol=1e-5
        )


@torch.no_grad()
def test_what_was_seen_before_keeps_the_geometry_where_it_is():
    """One frame after nothing is the geometry; after three as sure it moves it by a quarter of its tilt."""
    tilt, logit = torch.full((1, 1, 2, 4, 4), 2.0), torch.zeros(1, 1, 1, 4, 4)
    assert not mean_free(tilt, logit, torch.zeros(1, 1, 4, 4)).any()
    torch.testing.assert_close(mean_free(tilt, logit, torch.full((1, 1, 4, 4), 1.5)), 0.75 * tilt)


@torch.no_grad()
def test_the_drift_is_a_mean_over_five_frames_less_the_reference():
    net, clip = TiltNet(widths=(4, 4, 4)), torch.rand(1, 7, 3, 16, 16)
    out = net(clip)
    half = F.avg_pool2d(out.frames[0], 2)
    for frame, near in ((0, half[:3]), (3, half[1:6]), (6, half[4:])):
        expected = near.mean(0) - F.avg_pool2d(out.reference[0], 2)[0]
        torch.testing.assert_close(out.drift[0, frame], expected, rtol=0, atol=1e-6)


@torch.no_grad()
def test_frames_of_the_past_stand_in_for_those_missing():
    clip = torch.rand(1, 7, 3, 4, 4)
    whole = neighbours(clip)
    recent = torch.cat((clip[:, 1:5].mean(1), torch.full((1, 1, 4, 4), 4.0)), dim=1)
    # One frame and four of the past: those five, whose middle one is frame 3 of the whole.
    torch.testing.assert_close(neighbours(clip[:, 5:6], recent)[:, 0], whole[:, 3], rtol=0, atol=1e-6)
    torch.testing.assert_close(neighbours(clip[:, 5:], torch.zeros(1, 4, 4, 4)), neighbours(clip[:, 5:]))


@torch.no_grad()
def test_clips_of_a_batch_do_not_mix():
    net, clips = trained(), torch.rand(2, 3, 3, 16, 24)
    torch.testing.assert_close(net(clips).frames[1:], net(clips[1:]).frames, rtol=0, atol=1e-5)


def test_channels_of_the_frames():
    assert TiltNet(widths=(4, 4, 4), channels=1)(torch.rand(1, 2, 1, 16, 16)).frames.shape == (1, 2, 1, 16, 16)


def lucas_kanade_pyramid(frames: torch.Tensor) -> torch.Tensor:
    """Tilt at half resolution (T, 2, H/2, W/2) by coarse-to-fine Lucas-Kanade steps to the frames' mean, without mean."""
    tilt = None
    for scale in (8, 4, 2):
        small = F.avg_pool2d(frames, scale)
        if tilt is None:
            tilt = torch.zeros(len(frames), 2, *small.shape[-2:])
        else:
            tilt = F.interpolate(tilt, scale_factor=2, mode="bilinear", align_corners=False)
        registered = warp(small, tilt / scale)
        step = lucas_kanade(registered, registered.mean(0, keepdim=True), torch.tensor(-7.0).exp())
        tilt = tilt + scale * torch.sigmoid(torch.tensor(3.0)) * step
        tilt = tilt - tilt.mean(0)
    return tilt


@pytest.fixture(scope="module")
def pair():
    scene = torch.from_numpy(skimage.data.astronaut()[96:192, 160:256].copy()).float().permute(2, 0, 1) / 255
    maker = PairMaker(96, 96, d_over_r0=(2.0, 2.0), independent=1.0, read_noise=(0.0, 0.0), modes=15, components=4)
    return maker(scene.expand(2, 10, 3, 96, 96), seeds=[5, 6])


@torch.no_grad()
def test_untrained_it_is_a_lucas_kanade_pyramid(pair):
    out = TiltNet()(pair.frames)
    for clip in range(2):
        torch.testing.assert_close(out.tilts[-1][clip], lucas_kanade_pyramid(pair.frames[clip]), rtol=0, atol=1e-5)


@torch.no_grad()
def test_untrained_it_halves_the_tilt_and_the_distance_to_the_blur_only_frames(pair):
    estimate = TiltNet()(pair.frames)
    truth = F.avg_pool2d(pair.tilt.flatten(0, 1), 2).view_as(estimate.tilts[-1])
    inner = (..., slice(4, -4), slice(4, -4))

    def rms(x):
        # What all frames share is another aim of the camera, and cannot be seen.
        return float((x - x.mean(1, keepdim=True))[inner].square().mean().sqrt())

    assert rms(estimate.tilts[-1] - truth) < 0.6 * rms(truth)
    before = (pair.frames - pair.blur_only)[inner].square().mean()
    after = (estimate.frames - pair.blur_only)[inner].square().mean()
    assert after < 0.5 * before


def test_every_weight_learns(pair):
    net = trained()
    out = net(pair.frames[:1, :3])
    (out.reference.square().mean() + sum(t.square().mean() for t in out.tilts) + out.logits[-1].mean()).backward()
    for name, parameter in net.named_parameters():
        assert parameter.grad is not None, name
        assert torch.isfinite(parameter.grad).all(), name
        assert parameter.grad.abs().sum() > 0, name


@torch.no_grad()
def test_what_passes_through_weighs_little_in_the_reference():
    """One frame of three is another picture; where confidence says so, the reference is the mean of the other two."""
    still, other = torch.rand(1, 1, 3, 8, 8), torch.rand(1, 1, 3, 8, 8)
    clip, logits = torch.cat((still, other, still), 1), torch.tensor([4.0, -20.0, 4.0]).view(1, 3, 1, 1, 1)
    torch.testing.assert_close(weighted_mean(clip, logits.expand(1, 3, 1, 8, 8)), still, rtol=0, atol=1e-6)
    torch.testing.assert_close(weighted_mean(clip, 0 * logits), clip.mean(1, keepdim=True))


@torch.no_grad()
def test_confidence_is_one_half_where_the_expected_error_is_half_a_pixel():
    out = TiltNet(widths=(4, 4, 4))(torch.rand(1, 2, 3, 16, 16))
    torch.testing.assert_close(out.confidence, torch.full((1, 2, 1, 16, 16), 0.5))
    assert ERROR_AT_HALF == 0.5


@torch.no_grad()
def test_a_single_frame_is_its_own_reference_and_stays():
    frame = torch.rand(1, 1, 3, 24, 24)
    out = TiltNet()(frame)
    torch.testing.assert_close(out.frames, frame, rtol=0, atol=1e-5)
    torch.testing.assert_close(out.reference, out.frames, rtol=0, atol=1e-6)
