"""The stress matrix: what is right passes, what is broken is told."""

import numpy as np
import pytest
import torch

from turbnet.bench import stress, stress_nets, stress_optics
from turbnet.bench.stress_cell import Cell, Check, close, finite, judge, not_hidden, same_on_two_threads, within
from turbnet.bench.stress_content import BRIGHTEST, CONTENTS, clip
from turbnet.cli.stress import main
from turbnet.errors import InputError, ParameterError
from turbnet.nets import NETS


@pytest.mark.parametrize("part", ["path", "tilt", "sensor", "phase-to-space"])
def test_parts_stand_up_to_the_quick_matrix(part):
    found = stress.run({part: stress.PARTS[part]}, quick=True, quiet=True)
    assert [f"{o.cell.name}: {o.reason}" for o in found.outcomes if o.verdict == "unexplained"] == []
    assert found.report.ok
    assert sum(o.verdict == "ok" for o in found.outcomes) > sum(o.verdict == "refused" for o in found.outcomes)


def raise_(error):
    raise error


BROKEN = {
    "another exception": lambda: raise_(RuntimeError("shapes")),
    "a warning of NumPy": lambda: [finite("x", np.exp(-np.log(np.zeros(2)) * 0 + 1))],
    "out of bound": lambda: [Check("light", 0.9, 1.0, 0.05)],
    "not finite": lambda: [finite("x", torch.tensor([1.0, float("nan")]))],
    "NaN against a bound": lambda: [within("x", torch.tensor([0.5, float("nan")]), 0.0, 1.0)],
    "NaN against a reference": lambda: [close("x", float("nan"), 1.0, 1e9)],
    "NaN hidden": lambda: [not_hidden("x", torch.zeros(3))],
    "one check of two": lambda: [Check("a", 0.0), Check("b", 1.0)],
}


@pytest.mark.parametrize("work", BROKEN.values(), ids=BROKEN)
def test_what_is_broken_is_unexplained(work, monkeypatch, capsys):
    monkeypatch.setattr(stress, "PARTS", {"broken": lambda quick: iter([Cell("broken", "cell", work)])})
    assert main(["--only", "broken", "--quiet"]) == 1
    printed = capsys.readouterr().out
    assert "UNEXPLAINED: broken, cell: " in printed
    assert "| broken | 1 | 0 | 0 | 1 |" in printed


def test_a_refusal_is_typed_and_where_it_is_due_it_is_asked_for():
    refusing = [Cell("p", "x", lambda error=error: raise_(error("no")), True) for error in (InputError, ParameterError)]
    assert [judge(cell).verdict for cell in refusing] == ["refused", "refused"]
    assert judge(Cell("p", "x", lambda: raise_(ValueError("no")), True)).verdict == "unexplained"
    assert judge(Cell("p", "x", lambda: [Check("fine", 0.0)], True)).reason == "was not refused"


def test_a_defect_of_the_library_is_found(monkeypatch):
    """Light lost in splatting, one part in a thousand."""
    whole = stress_optics.splat
    monkeypatch.setattr(stress_optics, "splat", lambda image, shift: 0.999 * whole(image, shift))
    found = stress.run({"tilt": stress_optics.tilt_cells}, quick=True, quiet=True)
    reasons = [o.reason for o in found.outcomes if o.verdict == "unexplained"]
    assert len(reasons) > 10
    assert all("light" in reason for reason in reasons)


def test_threads_are_as_they_were():
    before = torch.get_num_threads()
    assert same_on_two_threads(torch.get_num_threads, 0.0).value == 1.0  # 2 against 1
    assert torch.get_num_threads() == before


def test_every_network_has_a_place_in_the_matrix():
    assert set(stress_nets.SMALL) == set(NETS)


@pytest.mark.parametrize("content", CONTENTS)
def test_contents_are_what_they_say(content):
    frames = clip(content, 5, 4, 2)
    assert frames.shape == (1, 2, 3, 5, 4)
    broken = ~torch.isfinite(frames)
    assert int(broken.sum()) == (6 if content in ("NaN", "Inf") else 0)
    if content not in ("NaN", "Inf"):
        assert 0 <= float(frames.min()) <= float(frames.max()) <= (BRIGHTEST if content == "HDR" else 1)
