"""`turbnet bench simulator`: the in-loop simulator against theory, dense scatter and split-step; its speed.

A row with a limit passes on the stated side of it, a row with a tolerance two-sided. Timings are those of this machine.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import torch

from turbnet.bench import dense_scatter, exposures, field_statistics, simulator_speed
from turbnet.bench.measurement import Panel
from turbnet.progress import progress_bar
from turbnet.report import Report, Row

FAMILIES = ("field", "picture", "split-step", "speed", "curve")


@dataclass(frozen=True)
class Found:
    """What the bench found."""

    rows: list[Row]
    panels: list[Panel]

    @property
    def report(self) -> Report:
        report = Report()
        for row in self.rows:
            report.add(row)
        return report

    @property
    def text(self) -> str:
        """As a Markdown table."""
        verdicts = {True: "ok", False: "FAIL", None: ""}
        lines = ["| quantity | value | reference | verdict |", "|---|---|---|---|"]
        for row in self.rows:
            value = f"{row.value:.3g}" if isinstance(row.value, float) else str(row.value)
            reference = "" if row.reference is None else f"{row.reference:.3g}"
            lines.append(f"| {row.name} | {value} {row.unit} | {reference} | {verdicts[row.ok]} |")
        judged = [row for row in self.rows if row.ok is not None]
        missed = sum(row.ok is False for row in judged)
        return "\n".join([*lines, "", f"{len(judged) - missed} of {len(judged)} rows within their limits."])


@torch.no_grad()
def run(families: Iterable[str] = FAMILIES, quick: bool = False, quiet: bool = False) -> Found:
    """Measure the families: some ten minutes, or a minute or two if `quick` (a smoke test with wide error bars)."""
    wanted = set(families)
    rows: list[Row] = []
    panels: list[Panel] = []
    with progress_bar(quiet) as progress:

        def track(name: str, count: int) -> Iterable[int]:
            return progress.track(range(count), count, description=name)

        # Speed first: later the machine is warm and its memory in pieces.
        if "speed" in wanted:
            rows += simulator_speed.measure(2 if quick else 7, track, large=not quick)
        if "field" in wanted:
            rows += field_statistics.measure(60 if quick else 2000, track)
        if "picture" in wanted:
            rows += dense_scatter.measure(track, (1.0, 3.0), (0,)) if quick else dense_scatter.measure(track)
        if "split-step" in wanted:
            rows += exposures.measure(80 if quick else 1600, track)
        if "curve" in wanted and not quick:
            points = simulator_speed.curve(5, track)
            rows += simulator_speed.rows(points)
            panels.append(simulator_speed.panel(points))
    return Found(rows, panels)


def draw_figures(panels: list[Panel], folder: Path) -> list[Path]:
    """One file a panel."""
    folder.mkdir(parents=True, exist_ok=True)
    return [panel.draw(folder) for panel in panels]
