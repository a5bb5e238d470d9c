"""The restorer used recurrently."""

import math

import pytest
import torch

from turbnet.errors import ParameterError
from turbnet.nets import build
from turbnet.nets.restorer import Restorer
from turbnet.nets.streaming import StreamingRestorer

CONFIG = {
    "name": "restorer",
    "tilt": {"widths": [4, 4, 4]},
    "tcja": {"width": 8, "depth": 2},
    "scene": {"widths": [8, 8, 8], "depths": [1, 1, 1]},
}


def unregistered() -> Restorer:
    """A net as before training, which takes frames as they are."""
    net = build(CONFIG).eval()
    with torch.no_grad():
        for level in net.tilt.levels:
            level.gate.bias.fill_(-20.0)
    return net


def run(streaming: StreamingRestorer, clip: torch.Tensor, sizes: list[int]) -> torch.Tensor:
    past = streaming.nothing(len(clip), *clip.shape[-2:])
    out = []
    for part in clip.split(sizes, dim=1):
        frames, *past = streaming(part, *past)
        out.append(frames)
    return torch.cat(out, dim=1)


@torch.no_grad()
def test_the_first_part_is_what_the_restorer_makes_of_it(trained):
    """Zeros carried along are nothing seen."""
    net, clip = trained(CONFIG), torch.rand(2, 3, 3, 16, 24)
    torch.testing.assert_close(run(StreamingRestorer(net), clip, [3]), net(clip), rtol=0, atol=1e-5)


@torch.no_grad()
def test_a_restorer_without_learned_corrections_gathers_the_same_frame_by_frame_as_at_once():
    """Without registration all that matters is how frames are weighed: with nothing fading, all alike."""
    net, noisy = unregistered(), torch.rand(1, 6, 3, 16, 24)
    whole = net.stages(noisy)
    streaming = StreamingRestorer(net, horizon=math.inf)
    past = streaming.nothing(1, 16, 24)
    for frame in noisy.split(1, dim=1):
        _, *past = streaming(frame, *past)
    reference, recent, memory, sums, pictures = past
    torch.testing.assert_close(reference[:, :-1], whole.registered.reference[:, 0], rtol=0, atol=1e-5)
    torch.testing.assert_close(reference[:, -1:], whole.registered.confidence.sum(1), rtol=0, atol=1e-4)
    torch.testing.assert_close(recent[:, -1:], torch.full_like(recent[:, -1:], 4.0))
    torch.testing.assert_close(sums, whole.seen.dance, rtol=0, atol=1e-4)
    torch.testing.assert_close(pictures, whole.seen.pictures, rtol=0, atol=1e-4)
    torch.testing.assert_close(memory[:, :, 0], torch.ones_like(memory[:, :, 0]))


@torch.no_grad()
def test_attention_to_what_is_remembered_is_attention_to_the_frames():
    """The last block sees the earlier frames' keys and values as if they were there; one block, so they are the same."""
    torch.manual_seed(0)
    net = build({**CONFIG, "tcja": {"width": 8, "depth": 1}}).tcja.eval()
    reference, frames = torch.rand(1, 1, 3, 8, 12), torch.rand(1, 5, 3, 8, 12)
    sure = torch.full_like(frames[:, :, :1], 0.7)
    _, _, memory = net(reference, frames[:, :3], sure[:, :3])
    empty = torch.zeros(1, 2, *memory.shape[2:])
    still, own, _ = net(reference, frames[:, 3:], sure[:, 3:], torch.cat((empty, memory), dim=1))
    still_whole, own_whole, _ = net(reference, frames, sure)
    torch.testing.assert_close(still, still_whole, rtol=0, atol=1e-5)
    torch.testing.assert_close(own, own_whole[:, 3:], rtol=0, atol=1e-5)


@torch.no_grad()
def test_what_is_carried_keeps_its_size_and_stays_finite(trained):
    streaming, past = StreamingRestorer(trained(CONFIG), horizon=5, remember=3), None
    past = streaming.nothing(1, 16, 16)
    shapes = [part.shape for part in past]
    for _ in range(40):
        frames, *past = streaming(torch.rand(1, 1, 3, 16, 16), *past)
        assert frames.isfinite().all()
    assert [part.shape for part in past] == shapes
    assert all(part.isfinite().all() for part in past)
    assert past[0][:, -1].max() < 5  # confidence of at most one a frame, fading


@torch.no_grad()
def test_what_was_seen_long_ago_is_forgotten():
    streaming = StreamingRestorer(unregistered(), horizon=2, remember=2)
    end = torch.rand(1, 1, 3, 16, 16).expand(1, 40, 3, 16, 16)
    one, other = (run(streaming, torch.cat((start, end), 1), [1] * 43) for start in torch.rand(2, 1, 3, 3, 16, 16))
    assert (one[:, 3] - other[:, 3]).abs().max() > 1e-3
    torch.testing.assert_close(one[:, -1], other[:, -1], rtol=0, atol=1e-4)


@torch.no_grad()
def test_more_frames_reduce_the_noise():
    scene = torch.rand(1, 1, 3, 32, 32)
    out = run(StreamingRestorer(unregistered()), scene + 0.02 * torch.randn(1, 20, 3, 32, 32), [1] * 20)
    error = (out - scene).square().mean((0, 2, 3, 4)).sqrt()
    assert error[-1] < 0.5 * error[0]


@pytest.mark.parametrize("wrong", [{"horizon": 0.5}, {"remember": 0}, {"horizon": math.nan}])
def test_values_out_of_range(wrong):
    with pytest.raises(ParameterError):
        StreamingRestorer(build(CONFIG), **wrong)
