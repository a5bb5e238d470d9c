"""What a plan leaves out and what it says of the error, beside the error that dense scatter shows."""

import math

import pytest
import skimage.data
import torch

from turbnet.atmosphere.path import OpticalPath
from turbnet.atmosphere.profiles import Constant
from turbnet.bench import dense_scatter
from turbnet.errors import ParameterError
from turbnet.media.colour import to_linear
from turbnet.optics.superposition import scatter
from turbnet.simulate.plan import Plan, Planner, contrast
from turbnet.simulate.simulator import Simulator

TOLERANCES = (15.0, 30.0, 45.0, 60.0)


def work(plan: Plan) -> float:
    return sum(own for _, own, _ in plan.work)


@pytest.fixture(scope="module")
def planner() -> Planner:
    return Planner(OpticalPath.from_d_over_r0(2.0), (2.0, 2.0), (160, 160), 4, 1.0)


@pytest.mark.parametrize(("strength", "q"), [(2.0, 3.0), (5.0, 1.0)])
def test_a_smaller_error_costs_more_and_is_one(strength, q):
    planner = Planner(OpticalPath.from_d_over_r0(strength), (strength, strength), (160, 160), 4, q)
    plans = [planner.plan(tolerance) for tolerance in TOLERANCES]
    costs, errors = [work(plan) for plan in plans], [plan.added for plan in plans]
    assert costs == sorted(costs)
    assert errors == sorted(errors, reverse=True)
    assert costs[0] < costs[-1]
    for plan in plans:
        assert all(error >= 0 for _, error in plan.errors)
        assert 0 <= plan.saved < 1
        assert plan.expected == pytest.approx(-10 * math.log10(sum(error for _, error in plan.errors)))
    # What can be reached is reached, with the reserve.
    assert all(plan.expected >= plan.tolerance for plan in plans[:3])


def test_less_contrast_allows_more_to_be_left_out(planner):
    costs = [work(planner.plan(45.0, contrast=value)) for value in (0.0, 0.02, 0.1, 0.4)]
    assert costs == sorted(costs)
    assert costs[0] < costs[2]


def test_a_scene_without_contrast_needs_nothing(planner):
    plan = planner.plan(contrast=0.0)
    assert (plan.tilt, plan.blur, plan.added, plan.expected) == (False, False, 0.0, math.inf)
    flat = torch.full((3, 20, 30), 0.4)
    assert contrast(flat) == 0


def test_still_air_needs_nothing():
    still = OpticalPath(0.2, 7000.0, Constant(0.0))
    plan = Planner(still, (0.0, 0.0), (160, 160), 4, 1.0).plan()
    assert (plan.modes, plan.components, plan.tilt, plan.blur, plan.network) == (3, 0, False, False, False)
    assert plan.added == 0
    assert plan.saved > 0.9


@pytest.mark.parametrize("tolerance", [20.0, 45.0])
def test_what_is_given_is_kept(planner, tolerance):
    assert planner.plan(tolerance, modes=30).modes == 30
    assert planner.plan(tolerance, components=7).components == 7
    assert planner.plan(tolerance, components=0).components == 0
    exact = planner.plan(tolerance, exact=True)
    assert (exact.network, exact.grid, exact.factor) == (False, 1, 1)
    both = planner.plan(tolerance, modes=15, components=90, exact=True)
    assert (both.modes, both.components) == (15, 90)


def test_modes_are_kept_where_nothing_blurs():
    """Pixels larger than any PSF."""
    planner = Planner(OpticalPath.from_d_over_r0(1.0), (1.0, 1.0), (160, 160), 4, 6.0)
    plan = planner.plan(25.0, modes=21)
    assert not plan.blur
    assert plan.modes == 21


def test_a_plan_says_what_it_does_and_leaves_out(planner):
    loose, tight = str(planner.plan(45.0)), str(planner.plan(45.0, exact=True))
    for line in ("45 dB", "modes", "tilt", "blur", "weights", "components left out", "half the resolution", "work of"):
        assert line in loose
    assert "phase-to-space network" in loose
    assert "exact" in tight
    assert "left out" in str(planner.plan(contrast=0.0))
    assert "no blur" in str(planner.plan(contrast=0.0))
    assert "one kernel" in str(planner.plan(components=0))


@pytest.mark.parametrize("bad", [9.0, 81.0, float("nan")])
def test_tolerances_out_of_reach_are_refused(planner, bad):
    with pytest.raises(ParameterError, match="tolerance"):
        planner.plan(bad)


def test_contrast_is_the_rms_gradient_of_what_is_not_flat():
    x = torch.arange(40.0)
    ramp = (0.01 * x + 0.02 * x[:, None])[None]
    assert contrast(ramp) == pytest.approx(math.hypot(0.01, 0.02), rel=1e-4)
    half = ramp.clone()
    half[..., 20:] = half[..., :1, 20:21]
    half[..., 20:] = 5.0
    assert contrast(half[..., :20]) == pytest.approx(contrast(ramp), rel=1e-4)
    wide = torch.cat((ramp, ramp[..., -1:, -1:].expand(1, 40, 200)), -1)
    assert contrast(wide) > 0.5 * contrast(ramp)  # nine tenths of it flat


def test_expected_error_is_the_measured_one():
    """D/r0 = 2 on one picture, two draws, with the picture's own contrast and with nothing kept in hand."""
    size, edge = dense_scatter.SIZE, dense_scatter.EDGE
    crop = torch.from_numpy(skimage.data.astronaut()[60 : 60 + size, 150 : 150 + size, 0].copy())
    scene = to_linear(crop.float() / 255)
    simulator = Simulator(OpticalPath.from_d_over_r0(2.0), size, size, margin=0, contrast=contrast(scene[None]))
    found = []
    for seed in (0, 1):
        draw = simulator.draw([seed])
        whole = dense_scatter.whole_psfs(draw, size, size)
        exact = scatter(scene, whole) / scatter(torch.ones_like(scene), whole)
        seen = simulator(scene[None, None, None], draw).frames[0, 0, 0]
        found.append(float((seen - exact)[edge:-edge, edge:-edge].square().mean()))
    measured = -10 * math.log10(sum(found) / len(found))
    assert measured == pytest.approx(simulator.plan().expected, abs=3.0)
    assert measured > 45
