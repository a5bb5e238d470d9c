"""Put the rows of `turbnet bench simulator --json FILE --figures docs/images` into docs/guide/simulator-accuracy.md.

python tools/make_simulator_page.py FILE
"""

import json
import sys
from pathlib import Path

PAGE = Path("docs/guide/simulator-accuracy.md")
BEGIN, END = "<!-- table: begin -->", "<!-- table: end -->"


def table(document: dict) -> str:
    """The rows as Markdown, standard errors beside what they belong to."""
    errors = {
        r["name"].removesuffix(": standard error"): r["value"]
        for r in document["rows"]
        if "standard error" in r["name"]
    }
    lines = ["| quantity | measured | reference | verdict |", "|---|---|---|---|"]
    for row in document["rows"]:
        if row["name"].endswith("standard error"):
            continue
        value = f"{row['value']:.3g} {row['unit']}".strip()
        if row["name"] in errors:
            value += f" (SE {errors[row['name']]:.2g})"
        reference = "" if row["reference"] is None else f"{row['reference']:.3g}"
        verdict = {True: "ok", False: "**missed**", None: ""}[row["ok"]]
        lines.append(f"| {row['name']} | {value} | {reference} | {verdict} |")
    judged = [row for row in document["rows"] if row["ok"] is not None]
    missed = sum(not row["ok"] for row in judged)
    machine = ", ".join(f"{key} {value}" for key, value in document["machine"].items())
    return "\n".join(
        [*lines, "", f"{len(judged) - missed} of {len(judged)} rows within their limits. Machine: {machine}."]
    )


def main() -> None:
    document = json.loads(Path(sys.argv[1]).read_text())
    head, rest = PAGE.read_text().split(BEGIN)
    _, tail = rest.split(END)
    PAGE.write_text(f"{head}{BEGIN}\n\n{table(document)}\n\n{END}{tail}")


if __name__ == "__main__":
    main()
