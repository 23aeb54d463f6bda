"""Graphs as SVG for interactive pages; lengths are pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.io.templates import render
from jaxltl.plot import layout

_INCH = 96.0


def live_graph(
    graph: layout.GraphLayout,
    name: str,
    initial: int,
    states: Sequence[tuple[str, str]],
    kind_of_edge: Callable[[layout.Key], str],
    label: str,
) -> str:
    """A graph as SVG in which each state is a button.

    Args:
      graph, name, initial: the layout, the prefix of the ids, and the state with an arrow from outside.
      states: the classes and the title of each state.
      kind_of_edge: the classes of an edge.
      label: the text alternative.

    Example:
      >>> texts = {(0, 0, 0): (("", "a"),)}
      >>> graph = layout.arrange(np.array([[0]]), 0, np.array([False]), texts)
      >>> live_graph(graph, "g", 0, [("state", "memory 0")], lambda key: "edge", "one").count("<text")
      2
    """
    height = graph.size[1]

    def at(points: ArrayLike) -> NDArray[np.float64]:
        """Converts inches with y up to pixels with y down."""
        return (np.asarray(points, float) * [1, -1] + [0, height]) * _INCH

    labels = {label.key: label for label in graph.labels}
    edges = []
    for edge in graph.edges:
        source, target, _ = edge.key
        lines = _lines(labels[edge.key], at) if edge.key in labels else []
        edges.append((kind_of_edge(edge.key), source, target, _arrow(at(edge.curve)), lines))
    radius = layout.RADIUS * _INCH
    start = at(graph.position[initial])
    tail, rim = start - [radius + 40, 0], start - [radius + 2, 0]
    places = at(graph.position).tolist()
    return svg(
        "automaton",
        f"{name}-automaton",
        (0, 0, *np.array(graph.size) * _INCH),
        label,
        prefix=name,
        edges=edges,
        start=_arrow(np.array([tail, (tail + rim) / 2, rim])),
        states=[(kind, x, y, text) for (kind, text), (x, y) in zip(states, places, strict=True)],
        radius=radius,
    )


def _lines(
    label: layout.Label, at: Callable[[ArrayLike], NDArray[np.float64]]
) -> list[tuple[float, float, str, str]]:
    """The guards of an edge, one per line, with their places and marks."""
    x, y = at(label.center).tolist()
    middle = (len(label.rows) - 1) / 2
    return [(x, y + (i - middle) * 16, *row) for i, row in enumerate(label.rows)]


def _arrow(curve: NDArray[np.float64]) -> tuple[str, str]:
    """Paths of a Bezier curve and of its arrow head."""
    along = curve[-1] - curve[-2]
    along = along / max(float(np.hypot(*along)), 1e-9)
    side, end = np.array([-along[1], along[0]]) * 4, curve[-1]
    base = end - along * 9
    first, *rest = [f"{x:.1f} {y:.1f}" for x, y in [*curve[:-1], base]]
    head = " L".join(f"{x:.1f} {y:.1f}" for x, y in (base + side, end, base - side))
    return f"M{first} {'Q' if len(curve) == 3 else 'C'}{' '.join(rest)}", f"M{head}Z"


def svg(
    template: str, name: str, box: Sequence[float], label: str, zoom: float = 1.0, **parts: object
) -> str:
    """SVG text of a template of this package in a frame: its box, an accessible label and the zoom."""
    frame = {"name": name, "kind": template, "box": box, "label": label, "zoom": zoom}
    return render("jaxltl.plot", f"{template}.svg", **frame | parts)
