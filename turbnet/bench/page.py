"""`turbnet bench all`: every suite on one page."""

from collections.abc import Callable
from pathlib import Path

from turbnet.bench import deployment, physics, restoration, simulator
from turbnet.deploy.weights import released_models
from turbnet.media.atomic import atomic_path
from turbnet.report import Report


def write(folder: Path, quick: bool = False, quiet: bool = False) -> Report:
    """Run the suites one after the other; bench.md, bench.json and the figures lie in the folder after each of them."""
    report, parts = Report(), ["# Measured by `turbnet bench all`\n"]
    suites: dict[str, Callable[[], tuple[Report, str]]] = {
        "Physics": lambda: _physics(folder, quick, quiet),
        "Simulator": lambda: _simulator(folder, quick, quiet),
        "Restoration": lambda: _restoration(folder, quick, quiet),
        "Deployment": lambda: _deployment(quick, quiet),
    }
    for title, suite in suites.items():
        drawn = set(folder.glob("*.png"))
        found, text = suite()
        report.rows += found.rows
        figures = sorted(path.name for path in set(folder.glob("*.png")) - drawn)
        parts += [f"## {title}\n", text, "", *(f"![{Path(name).stem}]({name})\n" for name in figures)]
        with atomic_path(folder / "bench.md") as temporary:
            temporary.write_text("\n".join(parts))
        report.write(folder / "bench.json")
    return report


def _physics(folder: Path, quick: bool, quiet: bool) -> tuple[Report, str]:
    found = physics.run(quick=quick, quiet=quiet)
    physics.draw_figures(found.panels, folder)
    return found.report, found.text


def _simulator(folder: Path, quick: bool, quiet: bool) -> tuple[Report, str]:
    found = simulator.run(simulator.FAMILIES, quick=quick, quiet=quiet)
    simulator.draw_figures(found.panels, folder)
    return found.report, found.text


def _restoration(folder: Path, quick: bool, quiet: bool) -> tuple[Report, str]:
    results = restoration.run(restoration.entrants((), (), ()), "quick" if quick else "standard", quiet)
    restoration.draw_figure(results, folder / "restoration-time-error.png")
    return restoration.report(results), restoration.table(results)


def _deployment(quick: bool, quiet: bool) -> tuple[Report, str]:
    report = deployment.run(list(released_models()), quick=quick, quiet=quiet)
    return report, deployment.table(report)
