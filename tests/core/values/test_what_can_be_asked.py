"""The page of what can be asked says what the table of engines has."""

from pathlib import Path

from jaxltl.core.values.door.listing import listing

PAGE = Path(__file__).parents[3] / "docs" / "what-can-be-asked.md"


def test_the_page_has_the_table():
    assert listing() in PAGE.read_text(), "write listing() of values.door.listing into the page"
