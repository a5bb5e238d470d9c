"""Every link of the theory pages leads to a file, and every function they name is in the file they name."""

import re
from pathlib import Path

import pytest

PAGES = sorted((Path(__file__).parents[2] / "docs" / "theory").glob("*.md"))
LINK = re.compile(r"\[(`?)([^\]`]+)`?\]\(([^)\s]+)\)")


def test_pages_are_there():
    names = {page.name for page in PAGES}
    assert {"zernike.md", "image-formation.md", "atmosphere.md", "zernike-space.md", "lucky.md"} <= names


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_where_they_say(page):
    links = [match.groups() for match in LINK.finditer(page.read_text(encoding="utf-8"))]
    assert links, "a theory page links to the functions it explains"
    for code, text, target in links:
        if "://" in target:
            continue
        file = (page.parent / target.partition("#")[0]).resolve()
        assert file.exists(), f"{page.name}: {target}"
        if code and file.suffix == ".py" and text.isidentifier():
            assert re.search(rf"^ *(def|class) {text}\b", file.read_text(encoding="utf-8"), re.M), f"{text} in {target}"
