"""`turbnet stress`: a matrix of inputs that should break everything numerically, and what becomes of them.

Each part of the library has a module of its own, which says what is fed to it and what must hold: values and gradients that
are finite, the range, light that is kept, equivariance where the construction has it, agreement with float64, the same
answer on one thread and on two. See `turbnet.bench.stress_cell` for how a cell is judged.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from turbnet.bench import (
    stress_classical,
    stress_models,
    stress_nets,
    stress_optics,
    stress_paths,
    stress_scores,
    stress_simulator,
)
from turbnet.bench.stress_cell import Cells, Outcome, judge
from turbnet.progress import progress_bar
from turbnet.report import Report

PARTS: dict[str, Cells] = {
    "path": stress_paths.cells,
    "field": stress_optics.field_cells,
    "tilt": stress_optics.tilt_cells,
    "blur": stress_optics.blur_cells,
    "phase-to-space": stress_optics.network_cells,
    "sensor": stress_optics.sensor_cells,
    "simulator": stress_simulator.cells,
    "nets": stress_nets.cells,
    "models": stress_models.cells,
    "classical": stress_classical.cells,
    "scores": stress_scores.cells,
}
"""What is tried, by name."""


@dataclass(frozen=True)
class Found:
    """How every cell ended."""

    outcomes: list[Outcome]

    @property
    def report(self) -> Report:
        report = Report()
        for row in (row for outcome in self.outcomes for row in outcome.rows):
            report.add(row)
        return report

    @property
    def text(self) -> str:
        """A table of the parts as Markdown; below it what was refused and why, and what nothing explains."""
        parts = list(dict.fromkeys(o.cell.part for o in self.outcomes))
        lines = ["| part | cells | ok | refused | unexplained |", "|---|---|---|---|---|"]
        for part in [*parts, None]:
            ended = Counter(o.verdict for o in self.outcomes if part in (o.cell.part, None))
            counts = (ended.total(), ended["ok"], ended["refused"], ended["unexplained"])
            lines.append(f"| {part or 'all'} | " + " | ".join(map(str, counts)) + " |")
        refusals = Counter((o.cell.part, o.reason) for o in self.outcomes if o.verdict == "refused")
        lines += ["", *(f"refused: {part}: {reason} ({count})" for (part, reason), count in refusals.items())]
        unexplained = [o for o in self.outcomes if o.verdict == "unexplained"]
        lines += [f"UNEXPLAINED: {o.cell.part}, {o.cell.name}: {o.reason}" for o in unexplained]
        return "\n".join(lines)


def run(parts: Mapping[str, Cells] = PARTS, quick: bool = False, quiet: bool = False) -> Found:
    """Try all cells of the parts: minutes, or about one if `quick`."""
    outcomes = []
    with progress_bar(quiet) as progress:
        for name, cells in parts.items():
            found = list(cells(quick))
            outcomes += [judge(cell) for cell in progress.track(found, len(found), description=name)]
    return Found(outcomes)
