"""Matplotlib figures with a text alternative in notebooks, and an optional HTML animation."""

from __future__ import annotations

import base64
import html
from collections.abc import Collection
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from jaxltl.plot.style import to_bytes

_DPI, _SCREEN = 144, 96  # of saved images, and of widths in pages


class Described(NamedTuple):
    """A figure with a text alternative, as a notebook displays it."""

    figure: Figure  # the figure
    text: str  # a description in one or two sentences
    # HTML that shows the same and moves, or None. Notebooks show it in a frame where they run;
    # where it was not saved, or is not trusted, the picture stands in its place
    page: str | None = None

    def __repr__(self) -> str:
        return self.text

    def _repr_mimebundle_(
        self, include: Collection[str] | None = None, exclude: Collection[str] | None = None
    ) -> tuple[dict[str, str], dict[str, Any]]:
        png = to_bytes(self.figure, "png", dpi=_DPI)
        data = {"text/plain": self.text, "image/png": base64.b64encode(png).decode("ascii")}
        if self.page is not None:
            data["text/html"] = (
                f'<iframe title="{html.escape(self.text)}" srcdoc="{html.escape(self.page)}" '
                'sandbox="allow-scripts" width="100%" height="640" style="border:0"></iframe>'
            )
        width, height = (round(x * _SCREEN) for x in self.figure.get_size_inches())
        return data, {"image/png": {"alt": self.text, "width": width, "height": height}}


def described(figure: Figure, text: str, *, page: str | None = None) -> Described:
    """A figure with a text alternative, shown as a picture by notebooks.

    Args:
      figure: the figure.
      text: the text alternative: the objects in the figure and its main result.
      page: HTML of an animation, such as that of :func:`~jaxltl.plot.episodes.play_episode`.

    Raises:
      ValueError: the text is empty or has brackets or line breaks.

    >>> from matplotlib.figure import Figure
    >>> described(Figure(), "Nothing yet: white paper.")
    Nothing yet: white paper.
    """
    if not text.strip() or any(x in text for x in "[]\n"):
        raise ValueError(
            f"text: {text!r}; say in one line, without square brackets, what the figure shows."
        )
    return Described(figure, text.strip(), page)
