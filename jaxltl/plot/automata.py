"""Automata as pictures."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, Patch, Rectangle
from matplotlib.path import Path
from numpy.typing import NDArray

from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.text import edge_guards
from jaxltl.plot import layout as drawing
from jaxltl.plot.style import ACCENT, FAINT, GOOD, INK, MUTED, PAPER, write

_EVEN = "a word is accepted if the least number that its run meets infinitely often is even"
_MARKED = {  # by the parity of the marked transitions
    0: "●: accepting; a word is accepted if its run takes such arrows infinitely often",
    1: "●: rejecting; a word is accepted if its run takes such arrows finitely often",
}


def automaton(
    automaton: Automaton,
    *,
    names: bool = True,
    layout: Literal["auto", "graphviz", "matplotlib"] = "auto",
) -> Figure:
    """The graph of an automaton, from left to right.

    Final states have a double circle, rejecting ones are grey. Accepting transitions of a Buchi
    automaton are coloured, with a dot before their guard; guards of a parity automaton have their
    priority there, filled if even.

    Args:
      automaton: the automaton.
      names: list the residual formula of each state under the graph.
      layout: ``"graphviz"``, ``"matplotlib"`` for the built-in layout, or ``"auto"``: graphviz if
        its program ``dot`` is installed.

    Raises:
      ValueError: ``layout="graphviz"`` and graphviz cannot be run.

    Example:
      >>> from jaxltl import to_automaton
      >>> len(automaton(to_automaton("F a"), layout="matplotlib").axes)
      1
    """
    table = on_the_host(automaton)
    doomed = drawing.rejecting(table)
    texts = edge_texts(table, doomed)
    graph = drawing.arrange(
        table.delta, int(table.initial), doomed, texts, _places(table, texts, layout)
    )
    figure, axes = draw_graph(
        graph,
        _notes(table, texts, graph.size[0]) if names else [],
        lambda key: _edge_color(table, key, doomed),
        lambda key: MUTED if doomed[key[1]] else INK,
    )
    draw_start(axes, graph.position[int(table.initial)])
    final = table.final if table.has_final_states else doomed & False
    for q, center in enumerate(graph.position):
        draw_state(axes, center, str(q), final=bool(final[q]), doomed=bool(doomed[q]))
    return figure


def draw_graph(
    graph: drawing.GraphLayout,
    lines: Sequence[str],
    edge_color: Callable[[drawing.Key], str],
    label_color: Callable[[drawing.Key], str],
) -> tuple[Figure, Axes]:
    """Draws the edges and labels of a graph, with lines of notes below."""
    width, height = graph.size
    # As wide as the notes, at 8 points a character of a monospaced font.
    full = max([width, *(0.5 + 0.602 * 8 / 72 * len(line) for line in lines)])
    below = 0.19 * len(lines) + (0.25 if lines else 0.0)
    figure = Figure(figsize=(full, height + below), facecolor=PAPER)
    axes = figure.add_axes((0, below / (height + below), 1, height / (height + below)))
    axes.set(xlim=((width - full) / 2, (width + full) / 2), ylim=(0, height), aspect="equal")
    axes.axis("off")
    for i, line in enumerate(lines):
        figure.text(
            0.25 / full,
            (below - 0.19 * (i + 0.5)) / (height + below),
            line,
            fontsize=8,
            color=MUTED,
            va="center",
            family="monospace",
            parse_math=False,
        )
    for edge in graph.edges:
        draw_edge(axes, edge.curve, edge_color(edge.key))
    for label in graph.labels:
        draw_label(axes, label, label_color(label.key))
    return figure, axes


def on_the_host(automaton: Automaton) -> Automaton:
    """The automaton with NumPy arrays."""
    return replace(
        automaton,
        delta=np.asarray(automaton.delta),
        priority=np.asarray(automaton.priority),
        letters=np.asarray(automaton.letters),
        initial=int(automaton.initial),
    )


def _places(
    table: Automaton, texts: Mapping[drawing.Key, drawing.Rows], layout: str
) -> NDArray[np.float64] | None:
    if layout not in ("auto", "graphviz", "matplotlib"):
        raise ValueError(f"layout = {layout!r}. Pass one of auto, graphviz, matplotlib.")
    if layout == "matplotlib":
        return None
    places = drawing.graphviz_positions(len(table.delta), int(table.initial), texts)
    if places is None and layout == "graphviz":
        raise ValueError(
            "layout = 'graphviz', but its program dot is not on the path or fails. Install "
            "graphviz, or pass layout='matplotlib'."
        )
    return places


def pretty_guard(text: str) -> str:
    """A guard in the signs of logic; quoted names stay as they are.

    >>> pretty_guard('!a & b | "x & y"')
    '¬a ∧ b ∨ "x & y"'
    """
    signs = {"!": "¬", "&": "∧", "|": "∨", "true": "⊤"}
    return re.sub(r'"(?:[^"\\]|\\.)*"|!|&|\||\btrue\b', lambda m: signs.get(m[0], m[0]), text)


def edge_texts(table: Automaton, doomed: NDArray[np.bool_]) -> dict[drawing.Key, drawing.Rows]:
    """Marks and guards of each curve: one for each pair of states, and one for accepting transitions."""
    # No word is accepted after a transition to a rejecting state, for any priority.
    priority = np.where(doomed[table.delta], 1, table.priority)
    texts = {k: pretty_guard(t) for k, t in edge_guards(replace(table, priority=priority)).items()}
    for q in range(len(table.delta)):
        mine = [key for key in texts if key[0] == q]
        longest = max(mine, key=lambda key: (len(texts[key]), key[0] == key[1], key[2]))
        if len(mine) > 1 and len(texts[longest]) > 8:
            texts[longest] = "else"
    curves: dict[drawing.Key, drawing.Rows] = {}
    marked = table.marked_priority
    for (source, target, number), text in texts.items():
        mark, curve = "", 0
        if marked is not None:
            mark, curve = ("●", 0) if number == marked else ("", 1)
        elif table.is_parity and not doomed[target]:
            mark = str(number)
        key = (source, target, curve)
        curves[key] = (*curves.get(key, ()), (mark, text))
    return curves


def _notes(table: Automaton, texts: Mapping[drawing.Key, drawing.Rows], width: float) -> list[str]:
    """Lines of text below the graph."""
    lines = _state_lines(table, width)
    if not table.has_final_states:
        marked = table.marked_priority
        note = _EVEN if marked is None else _MARKED[marked % 2]
        lines += textwrap.wrap(note, max(44, int(width * 13.5)))
    if any(text == "else" for rows in texts.values() for _, text in rows):
        lines.append("else: every letter that no other arrow of the state reads")
    return lines


def _state_lines(table: Automaton, width: float) -> list[str]:
    lines = []
    for q, name in enumerate(table.state_names):
        wrapped = textwrap.wrap(name, max(30, int(width * 13.5)), max_lines=3, placeholder=" …")
        indent = " " * (len(str(q)) + 2)
        lines += [f"{q}: {wrapped[0]}", *(indent + w for w in wrapped[1:])]
    return lines


def _edge_color(table: Automaton, key: drawing.Key, doomed: NDArray[np.bool_]) -> str:
    source, target, curve = key
    if doomed[source]:
        return FAINT
    if doomed[target]:
        return MUTED
    return ACCENT if table.marked_priority is not None and curve == 0 else INK


def draw_label(axes: Axes, label: drawing.Label, color: str) -> None:
    """Draws the lines of a label: centred, or left-aligned after acceptance marks."""
    rows, (x, y) = label.rows, label.center
    style: dict[str, Any] = {
        "fontsize": drawing.FONT_SIZE,
        "color": color,
        "zorder": 4,
        "parse_math": False,
        "bbox": {"facecolor": PAPER, "edgecolor": "none", "pad": 0.8},
    }
    if not drawing.is_marked(rows):
        text = "\n".join(line for _, line in rows)
        axes.text(x, y, text, ha="center", va="center", linespacing=1.15, **style)
        return
    begin = x - (drawing.text_width(rows) - drawing.MARK_WIDTH) / 2
    for i, (mark, line) in enumerate(rows):
        row = y + drawing.MARKED_HEIGHT * ((len(rows) - 1) / 2 - i)
        axes.text(begin, row, line, ha="left", va="center_baseline", **style)
        if mark:
            _mark(axes, (begin - drawing.MARK_WIDTH / 2 - 0.02, row), mark)


def _mark(axes: Axes, center: tuple[float, float], mark: str) -> None:
    """Draws an acceptance mark: a dot, or a priority in a circle, filled if even."""
    filled = mark == "●" or int(mark) % 2 == 0
    axes.add_patch(
        Circle(
            center,
            0.04 if mark == "●" else 0.078,
            fc=ACCENT if filled else PAPER,
            ec=ACCENT if filled else MUTED,
            lw=0.8,
            zorder=4.5,
        )
    )
    if mark != "●":
        color = PAPER if filled else INK
        write(axes, center, mark, 7, color, va="center_baseline", zorder=5)


def draw_edge(axes: Axes, curve: NDArray[np.float64], color: str) -> None:
    """Draws an arrow along a Bezier curve."""
    codes = [Path.MOVETO] + [Path.CURVE3 if len(curve) == 3 else Path.CURVE4] * (len(curve) - 1)
    axes.add_patch(
        FancyArrowPatch(
            path=Path(curve, codes),
            arrowstyle="-|>,head_length=5,head_width=2.4",
            mutation_scale=1,
            color=color,
            linewidth=1.1,
            zorder=2,
            joinstyle="miter",
        )
    )


def draw_start(axes: Axes, center: NDArray[np.float64]) -> None:
    """Draws the arrow of the initial state."""
    tail = center - [drawing.RADIUS + 0.42, 0]
    draw_edge(axes, np.array([tail, (tail + center) / 2, center - [drawing.RADIUS, 0]]), INK)


def draw_state(
    axes: Axes,
    center: NDArray[np.float64],
    text: str,
    *,
    final: bool = False,
    doomed: bool = False,
    square: bool = False,
) -> None:
    """Draws a state: a circle, double if final, grey if rejecting; or a square."""
    line, fill = (MUTED, "#f2f3f5") if doomed else (INK, GOOD if final else PAPER)
    half = drawing.RADIUS * 0.9
    shape: Patch = Circle(tuple(center), drawing.RADIUS, fc=fill)
    if square:
        shape = Rectangle(tuple(center - half), 2 * half, 2 * half, fc=FAINT)
    axes.add_patch(shape).set(ec=line, lw=1.3, zorder=5)
    if final:
        inner = drawing.RADIUS - 0.05
        axes.add_patch(Circle(tuple(center), inner, fc="none", ec=line, lw=1, zorder=5))
    write(axes, center, text, 11, line, va="center_baseline", zorder=6)
