"""A picture carries its text to where pages are made of it, and stands for what moves."""

import base64
import html

import pytest
from matplotlib.figure import Figure

from jaxltl.plot.style import described

TEXT = 'Two paths, "short" & long.'


def test_the_text_goes_with_the_picture():
    picture = described(Figure(figsize=(2, 1)), f" {TEXT} ")
    data, told = picture._repr_mimebundle_()
    assert data["text/plain"] == repr(picture) == TEXT and set(data) == {"text/plain", "image/png"}
    assert base64.b64decode(data["image/png"])[:4] == b"\x89PNG"
    assert told == {"image/png": {"alt": TEXT, "width": 192, "height": 96}}


def test_what_moves_is_framed_beside_the_picture():
    page = '<p title="a">moves</p>'
    data, _ = described(Figure(figsize=(2, 1)), TEXT, page=page)._repr_mimebundle_()
    frame = data["text/html"]
    assert "image/png" in data and 'sandbox="allow-scripts"' in frame
    assert html.escape(page) in frame and html.escape(TEXT) in frame and page not in frame


@pytest.mark.parametrize("text", ["", "  ", "a [link]", "two\nlines"])
def test_texts_that_places_do_not_take_are_refused(text):
    with pytest.raises(ValueError, match=r"text: .*; say in one line"):
        described(Figure(), text)
