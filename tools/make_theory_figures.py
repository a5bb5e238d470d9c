"""Run `turbnet bench physics` in full and regenerate docs/theory/validation.md with its table and figures."""

from pathlib import Path

import torch

from turbnet.bench.physics import BEGIN, END, draw_figures, run
from turbnet.media.atomic import atomic_path

THEORY = Path(__file__).parent.parent / "docs" / "theory"


def main() -> None:
    """Replace what stands between the two marks of the page; draw the figures beside it."""
    found = run()
    draw_figures(found.panels, THEORY / "figures")
    page = THEORY / "validation.md"
    before, _, rest = page.read_text().partition(BEGIN)
    _, _, after = rest.partition(END)
    with atomic_path(page) as temporary:
        temporary.write_text(f"{before}{BEGIN}\n\n{found.text}\n\nMade with torch {torch.__version__}.\n\n{END}{after}")


if __name__ == "__main__":
    main()
