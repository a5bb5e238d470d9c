"""Where text stands in a picture and what it says; kept as tab-separated values.

A table has the header `file left top width height text` (tabs between), one line a box, pixels from the top left
corner; lines that begin with # are remarks.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from turbnet.errors import InputError
from turbnet.media.atomic import atomic_path
from turbnet.media.guard import read_bytes, reading

COLUMNS = ("file", "left", "top", "width", "height", "text")
_LARGEST = 2**26  # bytes of a table


@dataclass(frozen=True)
class TextBox:
    """An upright rectangle around one word or line: pixels from the top left corner, and the text inside."""

    left: int
    top: int
    width: int
    height: int
    text: str

    def grown(self, margin: int) -> "TextBox":
        """The box with `margin` pixels more on every side."""
        return TextBox(
            self.left - margin, self.top - margin, self.width + 2 * margin, self.height + 2 * margin, self.text
        )


def read_boxes(path: str | Path) -> dict[str, list[TextBox]]:
    """Boxes by the entry of the column `file`, in the order of the table.

    Raises:
        InputError: names the table, the line and what is wrong with it.
    """
    data = read_bytes(path, _LARGEST, "the boxes ")
    with reading(f"the boxes {path}"):
        lines = data.decode("utf-8").splitlines()
    rows = [(number, line) for number, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
    if not rows or tuple(rows[0][1].split("\t")) != COLUMNS:
        raise InputError(f"{path}: the first line must name the columns {' '.join(COLUMNS)}, with tabs between")
    boxes: dict[str, list[TextBox]] = {}
    for number, line in rows[1:]:
        fields = line.split("\t")
        try:
            file, text = fields[0], fields[5]
            left, top, width, height = (int(value) for value in fields[1:5])
        except (ValueError, IndexError) as error:
            raise InputError(f"{path}, line {number}: not a file, four whole numbers and a text: {line!r}") from error
        if width < 1 or height < 1 or not text.strip():
            raise InputError(f"{path}, line {number}: the box is empty or has no text: {line!r}")
        boxes.setdefault(file, []).append(TextBox(left, top, width, height, text))
    if not boxes:
        raise InputError(f"{path}: there are no boxes below the header")
    return boxes


def write_boxes(path: str | Path, boxes: Mapping[str, Sequence[TextBox]]) -> None:
    """Write a table that `read_boxes` reads; the file appears whole or not at all."""
    lines = ["\t".join(COLUMNS)]
    for file, rows in boxes.items():
        lines += [f"{file}\t{box.left}\t{box.top}\t{box.width}\t{box.height}\t{box.text}" for box in rows]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
