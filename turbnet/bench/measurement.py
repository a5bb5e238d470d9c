"""A measured quantity beside its theory, and the curve it may be part of."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from turbnet.atmosphere.profiles import Array
from turbnet.media.atomic import atomic_path
from turbnet.report import Row

Index = NDArray[np.intp]


@dataclass(frozen=True)
class Measurement:
    """One quantity of the table.

    Attributes:
        name: of the quantity.
        theory: what it should be.
        measured: what it is.
        error: standard error of `measured`; 0 if no random draw is involved.
        allowed: relative deviation that passes even if the standard error is smaller; None for a mere comparison.
        unit: of theory, measured and error.
    """

    name: str
    theory: float
    measured: float
    error: float = 0.0
    allowed: float | None = 0.05
    unit: str = ""

    @property
    def deviation(self) -> float:
        """(measured - theory) / theory."""
        return (self.measured - self.theory) / self.theory

    @property
    def tolerance(self) -> float | None:
        """Largest accepted |measured - theory|: the allowed share, or three standard errors if that is more."""
        return None if self.allowed is None else max(self.allowed * abs(self.theory), 3 * self.error)

    @property
    def ok(self) -> bool | None:
        return None if self.tolerance is None else bool(abs(self.measured - self.theory) <= self.tolerance)

    def rows(self) -> list[Row]:
        """For the report: the quantity and, if it was drawn, its standard error."""
        row = Row(self.name, float(self.measured), self.unit, float(self.theory), self.tolerance, self.ok)
        error = Row(f"{self.name}: standard error", float(self.error), self.unit)
        return [row, error] if self.error else [row]

    def cells(self) -> list[str]:
        """Quantity, theory, measured, relative error, standard error, verdict."""
        verdict = {True: "ok", False: "FAIL", None: "compare"}[self.ok]
        error = f"{self.error:.2g}" if self.error else "-"
        return [
            self.name,
            f"{self.theory:.4g}",
            f"{self.measured:.4g}",
            f"{100 * self.deviation:+.1f} %",
            error,
            verdict,
        ]


HEADINGS = ["quantity", "theory", "measured", "relative error", "standard error", "verdict"]


def table(measurements: list[Measurement]) -> str:
    """As Markdown, columns aligned."""
    lines = [HEADINGS, *(m.cells() for m in measurements)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(HEADINGS))]
    texts = ["| " + " | ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True)) + " |" for line in lines]
    rule = "|" + "|".join("-" * (w + 2) for w in widths) + "|"
    return "\n".join([texts[0], rule, *texts[1:]])


@dataclass(frozen=True)
class Series:
    """One line of a panel: theory; with `error`, points with bars of two standard errors; or an approximation."""

    label: str
    x: Array
    y: Array
    error: Array | None = None
    approximate: bool = False


@dataclass(frozen=True)
class Panel:
    """A figure: its file name, what it shows, and its lines. `scale` is a matplotlib scale for (x, y)."""

    name: str
    title: str
    x_label: str
    y_label: str
    series: list[Series] = field(default_factory=list)
    scale: tuple[str, str] = ("linear", "linear")

    def draw(self, folder: Path) -> Path:
        """Write `folder`/`name`.png; points and approximations take the colour of the theory before them."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(5.6, 3.8), layout="constrained")
        axes = figure.subplots()
        colour, markers = None, iter("")
        for line in self.series:
            if line.error is not None:
                axes.errorbar(
                    line.x,
                    line.y,
                    2 * line.error,
                    fmt=next(markers),
                    color=colour,
                    label=line.label,
                    markersize=4,
                    elinewidth=0.8,
                )
            elif line.approximate:
                axes.plot(line.x, line.y, "--", color=colour, label=line.label, linewidth=1.0)
            else:
                (drawn,) = axes.plot(line.x, line.y, label=line.label, linewidth=1.3)
                colour, markers = drawn.get_color(), iter(".x+")
        axes.set(xlabel=self.x_label, ylabel=self.y_label, title=self.title, xscale=self.scale[0], yscale=self.scale[1])
        axes.title.set_fontsize(10)
        axes.legend(fontsize=7)
        axes.grid(alpha=0.3)
        path = folder / f"{self.name}.png"
        with atomic_path(path) as temporary:
            FigureCanvasAgg(figure).print_png(temporary, metadata={"Software": None})
        return path


def mean_and_error(samples: Array) -> tuple[Array, Array]:
    """Mean over the first axis and its standard error."""
    return samples.mean(axis=0), samples.std(axis=0, ddof=1) / np.sqrt(len(samples))


def ratio_and_error(top: Array, bottom: Array) -> tuple[Array, Array]:
    """mean(top) / mean(bottom) over the first axis and its standard error, to first order."""
    ratio = top.mean(axis=0) / bottom.mean(axis=0)
    return ratio, (top - ratio * bottom).std(axis=0, ddof=1) / np.sqrt(len(top)) / bottom.mean(axis=0)
