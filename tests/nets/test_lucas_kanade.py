import pytest
import torch

from turbnet.nets.blocks import warp
from turbnet.nets.lucas_kanade import LARGEST_STEP, lucas_kanade

PRIOR = torch.tensor(1e-6)


def waves(x: float = 0.0, y: float = 0.0) -> torch.Tensor:
    """A smooth pattern with contrast in every direction, whose point u is at u + (x, y)."""
    columns = torch.arange(32.0) - x
    rows = torch.arange(24.0)[:, None] - y
    a, b = torch.sin(0.35 * columns + 0.1 * rows), torch.sin(0.3 * rows - 0.15 * columns)
    return torch.stack((0.5 + 0.2 * a + 0.2 * b, 0.5 + 0.3 * a, 0.5 + 0.3 * b))[None]


@pytest.mark.parametrize(("x", "y"), [(0.5, 0.0), (-0.4, 0.0), (0.0, 0.5), (0.0, -0.3), (0.3, -0.4)])
def test_a_known_shift_is_found(x, y):
    """The pattern moved by (x, y): sampling at +(x, y) brings it back. The step is linear, so right to a few percent."""
    moved, reference = waves(x, y), waves()
    shift = lucas_kanade(moved, reference, PRIOR)
    inner = shift[..., 4:-4, 4:-4]
    torch.testing.assert_close(inner.mean((0, 2, 3)), torch.tensor([x, y]), rtol=0, atol=0.03)
    before = (moved - reference)[..., 4:-4, 4:-4].abs().mean()
    after = (warp(moved, shift) - reference)[..., 4:-4, 4:-4].abs().mean()
    assert after < 0.15 * before


def test_a_flat_picture_stays_still():
    flat = torch.full((1, 3, 8, 8), 0.5)
    assert not lucas_kanade(flat, flat, PRIOR).any()
    assert not lucas_kanade(flat + 0.1, flat, PRIOR).any()


def test_an_edge_moves_across_itself_only():
    """What a straight edge does along itself cannot be seen; the prior takes it as nothing."""
    x = torch.arange(24.0)

    def edge(at: float) -> torch.Tensor:
        return torch.sigmoid((x - at) / 2).expand(1, 3, 16, 24)

    shift = lucas_kanade(edge(12.4), edge(12.0), PRIOR)[..., 8:16]
    torch.testing.assert_close(shift[:, 0], torch.full_like(shift[:, 0], 0.4), rtol=0, atol=0.05)
    assert shift[:, 1].abs().max() < 1e-4


def test_the_prior_holds_back():
    loose, tight = (lucas_kanade(waves(0.4), waves(), torch.tensor(p)).abs().mean() for p in (1e-6, 1.0))
    assert tight < 0.2 * loose


def test_no_step_is_larger_than_it_can_see():
    shift = lucas_kanade(torch.rand(1, 3, 16, 16), torch.rand(1, 3, 16, 16), PRIOR)
    assert shift.abs().max() <= LARGEST_STEP


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_computed_in_float32(dtype):
    moved, reference = waves(0.3).to(dtype), waves().to(dtype)
    shift = lucas_kanade(moved, reference, PRIOR)
    assert shift.dtype == torch.float32
    torch.testing.assert_close(shift, lucas_kanade(moved.float(), reference.float(), PRIOR))


@pytest.mark.parametrize("scene", ["waves", "flat", "black"])
def test_gradients_are_finite(scene):
    image = {"waves": waves(0.3), "flat": torch.full((1, 3, 24, 32), 0.5), "black": torch.zeros(1, 3, 24, 32)}[scene]
    image = image.clone().requires_grad_()
    prior = torch.tensor(1e-5, requires_grad=True)
    lucas_kanade(image, waves(), prior).square().sum().backward()
    assert torch.isfinite(image.grad).all()
    assert torch.isfinite(prior.grad)


@pytest.mark.filterwarnings("ignore:.*double precision")
def test_gradient_is_that_of_finite_differences():
    """In float32, in which the step is always computed; steps and tolerances are chosen for that."""
    image = waves(0.3)[..., :6, :6].clone().requires_grad_()
    prior = torch.tensor(0.05, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda a, p: lucas_kanade(a, waves()[..., :6, :6], p), (image, prior), eps=1e-2, atol=3e-2, rtol=3e-2
    )


@pytest.mark.parametrize("brightness", [1.0, 1e3, 1e6])
def test_edges_of_any_brightness_give_a_finite_step(brightness):
    """All gradients run one way: the determinant is zero but for the prior, and rounding takes the prior away."""
    slope = torch.arange(16.0) + torch.arange(12.0)[:, None]
    image = (brightness * (slope > 11).float()).expand(1, 3, -1, -1)
    step = lucas_kanade(image, image.roll(1, -1), PRIOR)
    assert torch.isfinite(step).all()
    assert float(step.abs().max()) <= LARGEST_STEP
