"""What notebooks show of objects: small pictures, each with its text; none where it would crowd."""

from __future__ import annotations

import html
import warnings

import numpy as np
from matplotlib.figure import Figure

from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.show import picture
from jaxltl.plot.automata import automaton
from jaxltl.plot.style import to_bytes

_STATES, _ARROWS = 40, 120  # of an automaton, up to which it is drawn


def svg(figure: Figure, text: str) -> str:
    """A figure as an SVG that stands in a page, with a text for who does not see it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of signs that the font lacks, which stay boxes
        found = to_bytes(figure, "svg").decode()
    told = html.escape(" ".join(text.split()))
    head = f'<svg role="img" aria-label="{told}" style="max-width:100%;height:auto"'
    opening, rest = found[found.index("<svg") + 4 :].split(">", 1)
    return f"{head}{opening}><title>{told}</title>{rest}"


@picture.register
def _(value: Automaton) -> str | None:
    if value.delta.ndim > 2:
        return None
    arrows = sum(len(set(row)) for row in np.asarray(value.delta).tolist())
    if len(value.delta) > _STATES or arrows > _ARROWS:
        return None
    return svg(automaton(value), repr(value))
