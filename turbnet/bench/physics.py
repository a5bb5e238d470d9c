"""`turbnet bench physics`: the split-step reference and the theory, side by side.

Every measured quantity has its standard error; a row passes within 5 % (the screens 3 %) or three standard errors,
whichever is larger, two-sided. Rows without a verdict compare with a formula known to be approximate.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch

from turbnet.bench import one_point, screen_structure, split_step_speed, two_points
from turbnet.bench.measurement import Measurement, Panel, table
from turbnet.progress import progress_bar
from turbnet.report import Report, Row

SEED = 2026
BEGIN, END = "<!-- table: begin -->", "<!-- table: end -->"
"""What encloses the table in docs/theory/validation.md."""


@dataclass(frozen=True)
class Physics:
    """What the bench found."""

    measurements: list[Measurement]
    speed: list[Row]
    panels: list[Panel]

    @property
    def report(self) -> Report:
        report = Report()
        for row in [row for m in self.measurements for row in m.rows()] + self.speed:
            report.add(row)
        return report

    @property
    def text(self) -> str:
        """The table, and the speed below it."""
        verdicts = {True: " (ok)", False: " (FAIL)", None: ""}
        speed = [f"{row.name}: {row.value:.3g} {row.unit}".rstrip() + verdicts[row.ok] for row in self.speed]
        failed = [m.name for m in self.measurements if m.ok is False]
        judged = [m for m in self.measurements if m.ok is not None]
        summary = f"{len(judged) - len(failed)} of {len(judged)} rows within their tolerance."
        return "\n\n".join([table(self.measurements), *speed, summary])


@torch.no_grad()
def run(quick: bool = False, quiet: bool = False) -> Physics:
    """Measure everything: minutes, or about half a minute if `quick` (a smoke test with wide error bars)."""
    one, two, screens, pairs = (64, 40, 40, 8) if quick else (2400, 800, 1500, 40)
    speed = split_step_speed.measure(pairs, torch.get_num_threads())
    with _one_thread(), progress_bar(quiet) as progress:

        def bar(name: str, count: int) -> Iterator[int]:
            return iter(progress.track(range(count), count, description=name))

        families = [
            screen_structure.measure(screens, SEED),
            one_point.measure(SEED + 1, bar("one point", one // one_point.BATCH)),
            two_points.measure(SEED + 2, bar("two points", two // two_points.BATCH)),
        ]
    measurements = [m for found, _ in families for m in found]
    return Physics(measurements, speed, [panel for _, panels in families for panel in panels])


@contextmanager
def _one_thread() -> Iterator[None]:
    """Operations this small gain little from a second thread, and lose much where something else runs on its core."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def draw_figures(panels: list[Panel], folder: Path) -> list[Path]:
    """One file a panel."""
    folder.mkdir(parents=True, exist_ok=True)
    return [panel.draw(folder) for panel in panels]
