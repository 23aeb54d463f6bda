"""Version, metadata and contents of the distribution agree."""

import re
import tomllib
from pathlib import Path

import pytest

import jaxltl

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
HOOK = PROJECT["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]


def test_the_version_is_one():
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    latest = re.search(r"^## (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    page = re.search(r"version = \{(\S+)\}", (ROOT / "docs/cite.md").read_text())
    assert cited[1] == latest[1] == page[1] == jaxltl.__version__


def test_the_page_on_installing_has_every_extra():
    rows = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs/install.md").read_text(), re.MULTILINE)
    assert sorted(rows) == sorted(PROJECT["project"]["optional-dependencies"])


def test_gymnax_is_installed_with_six_which_it_does_not_declare():
    extra = PROJECT["project"]["optional-dependencies"]["gymnax"]
    assert any(x.startswith("six") for x in extra)


def test_citations_agree():
    page, cited = ((ROOT / x).read_text() for x in ("docs/cite.md", "CITATION.cff"))
    for text in ("Reinforcement Learning With High-Level Task Specifications", "2019", "Wen"):
        assert text in page and text in cited


def test_types_are_promised_and_there():
    assert "Typing :: Typed" in PROJECT["project"]["classifiers"]
    assert (ROOT / "jaxltl" / "py.typed").exists()


def test_what_tests_read_is_in_the_sdist():
    given = {x.strip("/") for x in PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]}
    assert all((ROOT / name).exists() for name in given)
    read = {
        "jaxltl",
        "tests",
        "examples",
        "benchmarks",
        "docs",
        "notebooks",
        "README.md",
        "CHANGELOG.md",
        "CITATION.cff",
        "CONTRIBUTING.md",
        "LICENSE",
        "conftest.py",
    }
    assert given >= read


def alone(text: str) -> str:
    """A page as an index shows it."""
    for change in HOOK["substitutions"]:
        text = re.sub(change["pattern"], change["replacement"], text)
    return text


def test_the_readme_leads_nowhere_that_an_index_has_not():
    text = alone((ROOT / "README.md").read_text())
    assert not re.findall(r"\]\((?!https?:|#)[^)]*\)|<img\b|<picture", text)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("![a map](docs/a.svg)\n\nText", "Text"),
        ('<img src="a.svg" alt="x">\nText', "Text"),
        ("see [the\npage](docs/a.md).", "see the\npage."),
        ("[up](#up)", "[up](#up)"),
        ("[site](https://a.b/c)", "[site](https://a.b/c)"),
        ('<picture>\n<source srcset="b.svg"><img src="a.svg"></picture>\nText', "Text"),
    ],
)
def test_pictures_and_links_to_files_are_left_out(text, shown):
    assert alone(text) == shown


def test_the_quick_tests_are_there():
    given = (ROOT / "tests" / "quick.txt").read_text().split()
    assert given and all((ROOT / name).exists() for name in given)
