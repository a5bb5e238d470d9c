"""A cell of the stress matrix: one piece of work, what is checked of its result, and how it ended.

A cell ends in one of three ways. *ok*: every check holds. *refused*: an `InputError` (or its kind, `ParameterError`) in one
line. *unexplained*: another exception, a numerical warning of NumPy's, or a figure out of its bound. A cell that must be
refused, such as NaN in a clip to restore, is unexplained if it is not.
"""

import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from turbnet.errors import InputError
from turbnet.report import Row


@dataclass(frozen=True)
class Check:
    """|value - reference| <= tolerance; NaN never holds."""

    what: str
    value: float
    reference: float = 0.0
    tolerance: float = 0.0
    unit: str = ""


@dataclass(frozen=True)
class Cell:
    """One place of the matrix.

    Args:
        part: of the library.
        name: size, content, strength and the like.
        work: does the part's work and returns what is to be checked.
        must_refuse: the only right answer is an `InputError`.
    """

    part: str
    name: str
    work: Callable[[], Iterable[Check]]
    must_refuse: bool = False


Cells = Callable[[bool], Iterator[Cell]]
"""All cells of a part; fewer of them if told to be quick."""


@dataclass(frozen=True)
class Outcome:
    """How a cell ended: `verdict` is ok, refused or unexplained, `reason` why not ok."""

    cell: Cell
    verdict: str
    reason: str
    rows: list[Row]


def judge(cell: Cell) -> Outcome:
    """Do a cell's work and judge what came of it."""
    name = f"{cell.part}, {cell.name}"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # NumPy's overflow and invalid value
            checks = list(cell.work())
    except InputError as error:
        reason = " ".join(str(error).split())
        return Outcome(cell, "refused", reason, [Row(name, f"refused: {reason}", ok=True)])
    except Exception as error:  # whatever a cell brings to light is its result
        return _unexplained(cell, f"{type(error).__name__}: {' '.join(str(error).split())}")
    if cell.must_refuse:
        return _unexplained(cell, "was not refused")
    rows = [Row.compared(f"{name}: {c.what}", c.value, c.reference, c.tolerance, c.unit) for c in checks]
    missed = [c for c, row in zip(checks, rows, strict=True) if not row.ok]
    reason = "; ".join(f"{c.what} is {c.value:.3g}, not {c.reference:.3g} +- {c.tolerance:.3g}" for c in missed)
    return Outcome(cell, "unexplained" if missed else "ok", reason, rows)


def _unexplained(cell: Cell, reason: str) -> Outcome:
    return Outcome(cell, "unexplained", reason, [Row(f"{cell.part}, {cell.name}", reason, ok=False)])


def finite(what: str, *values: Any) -> Check:
    """Nothing in these arrays, tensors or numbers is NaN or infinite."""
    return Check(f"{what}: values not finite", sum(int((~torch.isfinite(_tensor(v))).sum()) for v in values))


def not_hidden(what: str, value: Any) -> Check:
    """Of input that was not finite something is left to be seen: no finite number was made up in its place."""
    return Check(f"{what}: whether NaN or Inf was hidden", float(torch.isfinite(_tensor(value)).all()))


def within(what: str, value: Any, low: float, high: float, slack: float = 0.0) -> Check:
    """No value lies more than `slack` outside low to high."""
    tensor = _tensor(value)
    beyond = torch.stack((low - tensor.min(), tensor.max() - high)).max()
    # Not clamp, which would turn NaN into a number on some paths.
    return Check(
        f"{what}: how far outside {low:g} to {high:g}", max(float(beyond), 0.0) + 0 * float(beyond), 0.0, slack
    )


def close(what: str, value: Any, reference: Any, tolerance: float) -> Check:
    """Largest difference over the largest magnitude of the reference (over 1e-30 where that is 0)."""
    first, second = _tensor(value), _tensor(reference)
    if first.numel() == 0:
        return Check(what, 0.0)
    scale = max(float(second.abs().max()), 1e-30)
    return Check(f"{what}, relative to the largest value", float((first - second).abs().max()) / scale, 0.0, tolerance)


def same_on_two_threads(function: Callable[[], Any], tolerance: float) -> Check:
    """What one and what two processor threads of torch make of the same input."""
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            found.append(function())
    finally:
        torch.set_num_threads(threads)
    return close("difference of one thread and two", found[1], found[0], tolerance)


def _tensor(value: Any) -> Tensor:
    return torch.as_tensor(np.array(value) if isinstance(value, np.ndarray) else value, dtype=torch.float64).detach()
