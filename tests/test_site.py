"""Links, pictures and contents of the pages hold together; the site itself is built elsewhere."""

import fnmatch
import re
from urllib.parse import unquote

import nbformat
import pytest

from tests.pages import PAGES, ROOT, anchors, entries, links, name_of, without_code

NOTEBOOKS = sorted(ROOT.glob("notebooks/*.ipynb"))
MADE = ("docs/reference/",)  # by the site, of the docstrings


def texts(path):
    """What is Markdown in a page or a notebook."""
    if path.suffix != ".ipynb":
        return path.read_text()
    cells = nbformat.read(path, as_version=4).cells
    return "\n\n".join(cell.source for cell in cells if cell.cell_type == "markdown")


@pytest.mark.parametrize("page", [*PAGES, *NOTEBOOKS], ids=name_of)
def test_links_lead_somewhere_and_pictures_are_told(page):
    broken = []
    for picture, shown, target in links(texts(page)):
        if picture and not re.search(r"\w{3}", shown):
            broken.append(f"{target}: no text in its place")
        if re.match(r"https?://|mailto:", target):
            continue
        path, _, anchor = unquote(target).partition("#")
        place = (page.parent / path).resolve() if path else page
        if place.is_relative_to(ROOT) and name_of(place).startswith(MADE):
            continue
        if not place.exists():
            broken.append(f"{target}: there is no such file")
        elif anchor and place.suffix in (".md", ".ipynb") and anchor not in anchors(texts(place)):
            broken.append(f"{target}: there is no such heading")
    assert not broken


@pytest.mark.parametrize("page", [*PAGES, *NOTEBOOKS], ids=name_of)
def test_pictures_in_html_are_told(page):
    for tag in re.findall(r"<img\b[^>]*>", without_code(texts(page))):
        assert re.search(r'\balt="[^"]{3,}"', tag), tag


def test_every_page_is_in_the_contents():
    listed = set()
    for page in PAGES:
        for entry in entries(page.read_text()):
            place = ROOT / entry[1:] if entry.startswith("/") else page.parent / entry
            listed.add(place.resolve().relative_to(ROOT).as_posix())
    pages = [p for p in [*PAGES, *NOTEBOOKS] if p.parent != ROOT or p.name != "README.md"]
    names = [p.relative_to(ROOT).with_suffix("").as_posix() for p in pages]
    lost = [
        n for n in names if n != "docs/index" and not any(fnmatch.fnmatch(n, x) for x in listed)
    ]
    assert not lost, "name them in a toctree of docs/index.md"
    there = [*names, "docs/reference/index"]
    missing = [x for x in listed if "guides" not in x and not fnmatch.filter(there, x)]
    assert not missing, "the contents name what is not there"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("# A *b* `c_d`, e\n## A *b* `c_d`, e\n", {"a-b-c_d-e", "a-b-c_d-e-1"}),
        ("```sh\n# no heading\n```\n### Storm's [package](x.md)\n", {"storms-package"}),
    ],
)
def test_anchors_are_those_of_headings(text, expected):
    assert anchors(text) == expected


def test_code_holds_no_links():
    text = "`[a](b)` [c](d.md) ![e f](g.png)\n```\n[h](i)\n```\n[![j](k.svg)](l.md)\n"
    assert links(text) == [("", "c", "d.md"), ("!", "e f", "g.png"), ("", "![j](k.svg)", "l.md")]
