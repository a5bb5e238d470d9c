"""The one JSON schema of every command that measures.

`{"version", "command", "machine", "rows": [{"name", "value", "unit", "reference", "tolerance", "ok"}]}`, where
reference, tolerance and ok may be null.
"""

import json
import math
import os
import platform
import shlex
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from turbnet._version import __version__
from turbnet.media.atomic import atomic_path


@dataclass(frozen=True)
class Row:
    """One measured figure. With a `reference` and a `tolerance`, `ok` says whether they agree, two-sided."""

    name: str
    value: float | str | None
    unit: str = ""
    reference: float | None = None
    tolerance: float | None = None
    ok: bool | None = None

    @classmethod
    def compared(cls, name: str, value: float, reference: float, tolerance: float, unit: str = "") -> "Row":
        """A row whose verdict is |value - reference| <= tolerance."""
        return cls(name, value, unit, reference, tolerance, bool(abs(value - reference) <= tolerance))


def machine() -> dict[str, str | int]:
    """What the figures were measured on: processor, cores, Python."""
    return {
        "system": platform.system(),
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        "python": platform.python_version(),
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


@dataclass
class Report:
    """Rows measured by one command."""

    rows: list[Row] = field(default_factory=list)
    command: str = field(default_factory=lambda: shlex.join(["turbnet", *sys.argv[1:]]))

    def add(self, row: Row) -> Row:
        self.rows.append(row)
        return row

    @property
    def ok(self) -> bool:
        """False if any row with a reference missed it."""
        return all(row.ok is not False for row in self.rows)

    def write(self, path: str | Path) -> None:
        """Write the report as JSON; the file appears whole or not at all. Non-finite values are written as strings."""
        document = {
            "version": __version__,
            "command": self.command,
            "machine": machine(),
            "rows": [{key: _jsonable(value) for key, value in asdict(row).items()} for row in self.rows],
        }
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(document, indent=2) + "\n")


def _jsonable(value: Any) -> object:
    if hasattr(value, "item"):  # a NumPy or torch scalar
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value
