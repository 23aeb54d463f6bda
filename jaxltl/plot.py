"""Pictures, one call each: automata, grid maps, games of two robots, learning curves.

Each function returns a new matplotlib ``Figure`` and touches no global state, so it works
without a display and in any thread. ``figure.savefig("name.svg")`` writes it.
"""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyArrowPatch, Polygon, Rectangle
from matplotlib.path import Path
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike, NDArray

from jaxltl import drawing
from jaxltl.core.automaton import Automaton, edge_guards
from jaxltl.envs.gridworld import parse_map
from jaxltl.envs.temporal_gridworld import World

INK, MUTED, FAINT = "#1f2a37", "#6b7785", "#d5dae0"
ACCENT, GOOD, PAPER = "#1f6f8b", "#e4f1ea", "#ffffff"
_SERIES = ("#1f6f8b", "#c2571a", "#5b7f2b", "#7a4f9a", "#a23b5b", "#4a5a6a")
_KINDS = ("#dfd0ea", "#f5d6b3", "#d3e6e8", "#e3ddd0", "#f0d3df", "#dbe3b8")
# Cells are often named for a colour, and then have it.
_NAMED = {"r": "#f0b9b1", "y": "#f7e08e", "g": "#bfe3c4", "b": "#bcd3f2"}
# What is well is light, so that the cells that are not stand out.
_SCALE = LinearSegmentedColormap.from_list(
    "probability", ["#2f2b57", "#4a5a92", "#7f9cc0", "#bfd3df", "#f6f8f4"]
)
_NOTES = {
    "buchi": "●: accepting; a word is accepted if its run takes such arrows infinitely often",
    "parity": "a word is accepted if the least number that its run meets infinitely often is even",
}
_STEPS = {"up": (0, -1), "down": (0, 1), "left": (-1, 0), "right": (1, 0)}


def to_bytes(figure: Figure, kind: str = "svg", dpi: int = 150) -> bytes:
    """A figure as the bytes of a file.

    Args:
      figure: the figure.
      kind: ``"svg"``, ``"png"`` or ``"pdf"``.
      dpi: dots per inch of a PNG.
    """
    buffer = io.BytesIO()
    # Without a date, the same figure gives the same bytes.
    metadata = {"Date": None} if kind == "svg" else None
    figure.savefig(buffer, format=kind, dpi=dpi, metadata=metadata, facecolor=PAPER)
    return buffer.getvalue()


# --- automata -------------------------------------------------------------------------------


def automaton(
    automaton: Automaton,
    *,
    names: bool = True,
    layout: Literal["auto", "graphviz", "matplotlib"] = "auto",
) -> Figure:
    """An automaton as a graph from left to right.

    Final states have a double circle. Accepting transitions of a Buchi automaton are coloured
    and have a dot before their guard; in a parity automaton each guard has its priority there,
    filled if it is even. States in which the word is already rejected are grey, and no mark
    counts on the way to them.

    Args:
      automaton: the automaton.
      names: list the formula that each state has left to satisfy under the graph.
      layout: who places the states: ``"graphviz"``, ``"matplotlib"`` for our own way, which needs
        nothing else and puts rejecting states below, or ``"auto"``, which is graphviz if its
        program ``dot`` is there.

    Returns:
      The figure, in inches that suit the graph.

    Raises:
      ValueError: graphviz is asked for and cannot be run.
    """
    table = _on_the_host(automaton)
    doomed = drawing.rejecting(table)
    texts = _edge_texts(table, doomed)
    graph = drawing.arrange(
        table.delta, int(table.initial), doomed, texts, _places(table, texts, layout)
    )
    width, height = graph.size
    lines = _notes(table, texts, width) if names else []
    # As wide as the notes, at 8 points a character of a monospaced font.
    full = max([width, *(0.5 + 0.602 * 8 / 72 * len(line) for line in lines)])
    below = 0.19 * len(lines) + (0.25 if lines else 0.0)
    figure = Figure(figsize=(full, height + below), facecolor=PAPER)
    axes = figure.add_axes((0, below / (height + below), 1, height / (height + below)))
    axes.set(xlim=((width - full) / 2, (width + full) / 2), ylim=(0, height), aspect="equal")
    axes.axis("off")
    for edge in graph.edges:
        _edge(axes, edge.curve, _edge_color(table, edge.key, doomed))
    for label in graph.labels:
        _label(axes, label, MUTED if doomed[label.key[1]] else INK)
    start = graph.position[int(table.initial)]
    tail = start - [drawing.RADIUS + 0.42, 0]
    _edge(axes, np.array([tail, (tail + start) / 2, start - [drawing.RADIUS, 0]]), INK)
    final = table.final if table.acceptance in ("cosafe", "safety") else doomed & False
    for q, center in enumerate(graph.position):
        _state(axes, center, str(q), bool(final[q]), bool(doomed[q]))
    for i, line in enumerate(lines):
        figure.text(
            0.25 / full, (below - 0.19 * (i + 0.5)) / (height + below), line, fontsize=8,
            color=MUTED, va="center", family="monospace", parse_math=False,
        )
    return figure


def _on_the_host(automaton: Automaton) -> Automaton:
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
    return re.sub(
        r'"(?:[^"\\]|\\.)*"|!|&|\||\btrue\b', lambda m: signs.get(m[0], m[0]), text
    )


def _edge_texts(
    table: Automaton, doomed: NDArray[np.bool_]
) -> dict[drawing.Key, drawing.Rows]:
    """The marks and guards on each curve.

    Two states have one curve from one to the other, with a guard for each priority; but
    accepting transitions of a Buchi automaton have their own. The longest guard of each state
    says "else", which is shorter and exact.
    """
    # Nothing is accepted after an arrow to a doomed state, whatever its priority.
    priority = np.where(doomed[table.delta], 1, table.priority)
    texts = {k: pretty_guard(t) for k, t in edge_guards(replace(table, priority=priority)).items()}
    for q in range(len(table.delta)):
        mine = [key for key in texts if key[0] == q]
        longest = max(mine, key=lambda key: (len(texts[key]), key[0] == key[1], key[2]))
        if len(mine) > 1 and len(texts[longest]) > 8:
            texts[longest] = "else"
    curves: dict[drawing.Key, drawing.Rows] = {}
    for (source, target, number), text in texts.items():
        mark, curve = "", 0
        if table.acceptance == "buchi":
            mark, curve = ("●", 0) if number == 0 else ("", 1)
        elif table.acceptance == "parity" and not doomed[target]:
            mark = str(number)
        key = (source, target, curve)
        curves[key] = (*curves.get(key, ()), (mark, text))
    return curves


def _notes(
    table: Automaton, texts: Mapping[drawing.Key, drawing.Rows], width: float
) -> list[str]:
    """What stands under the graph."""
    lines = _state_lines(table, width)
    if table.acceptance in _NOTES:
        lines += textwrap.wrap(_NOTES[table.acceptance], max(44, int(width * 13.5)))
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
    return ACCENT if table.acceptance == "buchi" and curve == 0 else INK


def _label(axes: Axes, label: drawing.Label, color: str) -> None:
    """The lines of a label in the middle; if some have marks, to the left, after the marks."""
    rows, (x, y) = label.rows, label.center
    style: dict[str, Any] = {
        "fontsize": drawing.FONT_SIZE, "color": color, "zorder": 4, "parse_math": False,
        "bbox": {"facecolor": PAPER, "edgecolor": "none", "pad": 0.8},
    }
    if not drawing.is_marked(rows):
        text = "\n".join(line for _, line in rows)
        axes.text(x, y, text, ha="center", va="center", linespacing=1.15, **style)
        return
    left = x - (drawing.text_width(rows) - drawing.MARK_WIDTH) / 2
    for i, (mark, line) in enumerate(rows):
        row = y + drawing.MARKED_HEIGHT * ((len(rows) - 1) / 2 - i)
        axes.text(left, row, line, ha="left", va="center_baseline", **style)
        if mark:
            _mark(axes, (left - drawing.MARK_WIDTH / 2 - 0.02, row), mark)


def _mark(axes: Axes, center: tuple[float, float], mark: str) -> None:
    """A dot, or a priority in a circle that is filled if it is even."""
    filled = mark == "●" or int(mark) % 2 == 0
    axes.add_patch(
        Circle(center, 0.04 if mark == "●" else 0.078, facecolor=ACCENT if filled else PAPER,
               edgecolor=ACCENT if filled else MUTED, lw=0.8, zorder=4.5)
    )
    if mark != "●":
        axes.text(*center, mark, ha="center", va="center_baseline", fontsize=7,
                  color=PAPER if filled else INK, zorder=5)


def _edge(axes: Axes, curve: NDArray[np.float64], color: str) -> None:
    codes = [Path.MOVETO] + [Path.CURVE3 if len(curve) == 3 else Path.CURVE4] * (len(curve) - 1)
    axes.add_patch(
        FancyArrowPatch(
            path=Path(curve, codes), arrowstyle="-|>,head_length=5,head_width=2.4",
            mutation_scale=1, color=color, linewidth=1.1, zorder=2, joinstyle="miter",
        )
    )


def _state(axes: Axes, center: NDArray[np.float64], text: str, final: bool, doomed: bool) -> None:
    line, fill = (MUTED, "#f2f3f5") if doomed else (INK, GOOD if final else PAPER)
    axes.add_patch(
        Circle(tuple(center), drawing.RADIUS, facecolor=fill, edgecolor=line, lw=1.3, zorder=5)
    )
    if final:
        inner = drawing.RADIUS - 0.05
        axes.add_patch(
            Circle(tuple(center), inner, facecolor="none", edgecolor=line, lw=1, zorder=5)
        )
    axes.text(center[0], center[1], text, ha="center", va="center_baseline", fontsize=11,
              color=line, zorder=6)


# --- grids ----------------------------------------------------------------------------------


def grid(
    cells: str | NDArray[np.str_],
    values: ArrayLike | None = None,
    policy: ArrayLike | None = None,
    *,
    titles: Sequence[str] | str = "",
    label: str = "",
    limits: tuple[float, float] | None = (0.0, 1.0),
    actions: Sequence[str] = ("up", "down", "left", "right"),
    wall: str = "#",
) -> Figure:
    """A map, with a value in each cell as a colour, and a policy as arrows.

    Args:
      cells: a text map (see :func:`jaxltl.envs.gridworld.parse_map`) or its cells.
      values: ``float[S]``, or ``float[M, S]`` for M panels; NaN leaves a cell blank.
      policy: ``float[S, A]`` or ``int[S]``, or with M panels first; arrows are as long as
        their action is likely, and a row of NaN has none.
      titles: one per panel.
      label: what the colours mean.
      limits: values at the ends of the scale; None takes the data's.
      actions: the name of each action, of up, down, left and right.
      wall: the kind of cell that is not a place.

    Returns:
      The figure.

    Raises:
      ValueError: values or policy do not fit the map, or an action has no direction.
    """
    kinds = parse_map(cells) if isinstance(cells, str) else np.asarray(cells)
    panels, arrows = _panels(kinds, values, policy, len(actions))
    for name in actions:
        if policy is not None and name not in _STEPS:
            raise ValueError(f"action {name!r} has no direction; use {', '.join(_STEPS)}.")
    count = next((len(x) for x in (panels, arrows) if x is not None), 1)
    titles = [titles] * count if isinstance(titles, str) else list(titles)
    rows, columns = kinds.shape
    across = 2 if count == 4 else min(count, 3)
    down = -(-count // across)
    size = float(np.clip(5.2 / max(rows, columns), 0.16, 0.52))
    figure = Figure(
        figsize=(across * (columns * size + 0.35) + (0.75 if panels is not None else 0.1),
                 down * (rows * size + 0.55)),
        layout="constrained", facecolor=PAPER,
    )
    all_axes = np.atleast_1d(figure.subplots(down, across, squeeze=False)).ravel()
    if limits is None and panels is not None:
        limits = (float(np.nanmin(panels)), float(np.nanmax(panels)))
    low, high = limits or (0.0, 1.0)
    for axes in all_axes[count:]:
        axes.axis("off")
    for m, axes in enumerate(all_axes[:count]):
        shown = None if panels is None else panels[m]
        image = _cells(axes, kinds, shown, low, high, wall, arrows is None)
        if arrows is not None:
            _arrows(axes, kinds.shape, arrows[m], shown, low, high, actions)
        axes.set_title(titles[m], fontsize=9.5, color=INK, pad=5, loc="left", parse_math=False)
    if panels is not None:
        bar = figure.colorbar(
            image, ax=all_axes.tolist(), shrink=0.6, pad=0.015, aspect=24
        )
        bar.set_label(label, fontsize=9, color=INK)
        bar.outline.set_visible(False)
        bar.ax.tick_params(labelsize=8, color=MUTED, labelcolor=INK, length=2)
    return figure


def _panels(
    kinds: NDArray[np.str_], values: ArrayLike | None, policy: ArrayLike | None, num_actions: int
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """Values as ``[M, S]`` and policies as ``[M, S, A]``."""
    size = kinds.size
    panels = arrows = None
    if values is not None:
        panels = np.atleast_2d(np.asarray(values, float))
        if panels.ndim != 2 or panels.shape[1] != size:
            raise ValueError(
                f"values have shape {np.shape(values)}; the map has {size} cells, so pass "
                f"[{size}] or [panels, {size}]."
            )
    if policy is not None:
        given = np.asarray(policy)
        if given.dtype.kind in "iu":
            given = np.eye(num_actions)[given]
        arrows = given[None] if given.ndim == 2 else given
        if arrows.shape[1:] != (size, num_actions):
            raise ValueError(
                f"policy has shape {np.shape(policy)}; the map has {size} cells and there are "
                f"{num_actions} actions, so pass [{size}, {num_actions}], or panels of that."
            )
    if panels is not None and arrows is not None and len(panels) != len(arrows):
        raise ValueError(f"values have {len(panels)} panels and the policy {len(arrows)}.")
    return panels, arrows


def _cells(
    axes: Axes, kinds: NDArray[np.str_], values: NDArray[np.float64] | None,
    low: float, high: float, wall: str, numbers: bool,
) -> Any:
    rows, columns = kinds.shape
    names, counts = np.unique(kinds, return_counts=True)
    plain = "." if "." in names else str(names[np.argmax(counts)])
    special = [str(k) for k in names if k not in (plain, wall)]
    shown: NDArray[np.float64] = np.full(kinds.shape, np.nan)
    if values is not None:
        shown = values.reshape(kinds.shape)
    image = axes.imshow(
        np.ma.masked_invalid(shown), cmap=_SCALE, vmin=low, vmax=high,
        extent=(0, columns, rows, 0), interpolation="nearest",
    )
    tiny = max(rows, columns) > 16
    for (r, c), kind in np.ndenumerate(kinds):
        blank = np.isnan(shown[r, c])
        if kind == wall:
            axes.add_patch(Rectangle((c, r), 1, 1, facecolor="#55606c", lw=0))
        elif kind in special:
            color = _NAMED.get(
                re.sub(r"\d+$", "", str(kind)).lower()[:1] if len(str(kind)) < 3 else "",
                _KINDS[special.index(str(kind)) % len(_KINDS)],
            )
            if blank:
                axes.add_patch(Rectangle((c, r), 1, 1, facecolor=color, lw=0))
            if not tiny and blank:
                axes.text(c + 0.5, r + 0.5, kind, ha="center", va="center", fontsize=9, color=INK,
                          parse_math=False)
            elif not tiny:
                axes.text(c + 0.06, r + 0.06, kind, ha="left", va="top", fontsize=6.5, color=INK,
                          weight="bold", parse_math=False, zorder=5,
                          bbox={"facecolor": color, "edgecolor": "none", "pad": 0.9})
        if numbers and not blank and not tiny:
            dark = shown[r, c] < low + 0.5 * (high - low)
            axes.text(c + 0.5, r + 0.58, _short_number(float(shown[r, c])), ha="center",
                      va="center", fontsize=7, color=PAPER if dark else INK)
    lines = [((0, r), (columns, r)) for r in range(rows + 1)]
    lines += [((c, 0), (c, rows)) for c in range(columns + 1)]
    axes.add_collection(LineCollection(lines, colors=FAINT, linewidths=0.6))
    axes.set(xlim=(0, columns), ylim=(rows, 0), aspect="equal")
    _number_cells(axes, rows, columns)
    return image


def _short_number(value: float) -> str:
    """Three places; a probability goes without its leading zero."""
    return f"{value:.3f}".removeprefix("0") if 0 <= value < 1 else f"{value:.3g}"


def _number_cells(axes: Axes, rows: int, columns: int) -> None:
    for axis, count in ((axes.xaxis, columns), (axes.yaxis, rows)):
        stride = max(1, count // 10)
        axis.set_ticks(np.arange(0, count, stride) + 0.5, labels=[
            str(i + 1) for i in range(0, count, stride)])
    axes.xaxis.tick_top()
    axes.tick_params(length=0, labelsize=6.5, labelcolor=MUTED, pad=2)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _arrows(
    axes: Axes, shape: tuple[int, int], policy: NDArray[np.float64],
    values: NDArray[np.float64] | None, low: float, high: float, actions: Sequence[str],
) -> None:
    """Triangles from the centre of each cell, as long as the action is likely."""
    shapes: list[Any] = []
    colors: list[str] = []
    for state, chances in enumerate(policy):
        row, column = divmod(state, shape[1])
        dark = values is not None and values[state] < low + 0.5 * (high - low)
        for a, chance in enumerate(chances):
            if not chance > 0.04:
                continue
            step = np.array(_STEPS[actions[a]], float)
            side = step[::-1]
            center = np.array([column + 0.5, row + 0.5])
            tip = center + step * (0.1 + 0.34 * chance)
            base = center + step * 0.03
            width = 0.045 + 0.075 * chance
            shapes.append([base + side * width, tip, base - side * width])
            colors.append(PAPER if dark else INK)
    axes.add_collection(PolyCollection(shapes, facecolors=colors, lw=0, alpha=0.92, zorder=4))


def strategies(
    cells: str | NDArray[np.str_],
    play: ArrayLike,
    *,
    marked: ArrayLike | None = None,
    mark: str = "",
    titles: Sequence[str] | str = "",
    across: int = 4,
    seldom: float = 0.01,
    actions: Sequence[str] = ("up", "down", "left", "right"),
    wall: str = "#",
) -> Figure:
    """Mixed strategies on a map: big arrows for what is played often, small ones for the rest.

    For strategies with moves so rare that :func:`grid` would not show them.

    Args:
      cells: a text map (see :func:`jaxltl.envs.gridworld.parse_map`) or its cells.
      play: ``float[S, A]``, or ``float[M, S, A]`` for M panels: the probability of each move;
        zero draws nothing, and a cell whose row is NaN is grey, since it is never reached.
      marked: ``bool[S]``, or with M panels first: cells with a coloured background.
      mark: what that colour means.
      titles: one per panel.
      across: panels in a row, at most.
      seldom: moves of a smaller probability get a small arrow.
      actions: the name of each action, of up, down, left, right and stay.
      wall: the kind of cell that is not a place.

    Returns:
      The figure.

    Raises:
      ValueError: an array does not fit the map, or an action has no direction.
    """
    _require_directions(actions)
    kinds = parse_map(cells) if isinstance(cells, str) else np.asarray(cells)
    world = _Board(kinds, np.argwhere(np.ones(kinds.shape, bool)), wall)
    panels = np.asarray(play, float)
    panels = panels[None] if panels.ndim == 2 else panels
    if panels.ndim != 3 or panels.shape[1:] != (kinds.size, len(actions)):
        raise ValueError(
            f"play has shape {np.shape(play)}; the map has {kinds.size} cells and there are "
            f"{len(actions)} actions, so pass [{kinds.size}, {len(actions)}], or panels of that."
        )
    colored = np.zeros(panels.shape[:2], bool) if marked is None else np.asarray(marked, bool)
    if colored.shape not in (panels.shape[:2], panels.shape[1:2]):
        raise ValueError(
            f"marked has shape {colored.shape}; play has {len(panels)} panels of {kinds.size} "
            f"cells, so pass [{kinds.size}] or [{len(panels)}, {kinds.size}]."
        )
    colored = np.broadcast_to(colored, panels.shape[:2])
    titles = [titles] * len(panels) if isinstance(titles, str) else list(titles)
    figure, every = _rows_of_maps(kinds.shape, len(panels), min(len(panels), across))
    for axes, chance, here, title in zip(every, panels, colored, titles, strict=True):
        blank = np.isnan(chance).any(-1)
        _fill(axes, world, [
            _NEVER if never else _MARKED if good else PAPER
            for never, good in zip(blank, here, strict=True)
        ], FAINT)
        _number_cells(axes, *kinds.shape)
        _moves(axes, world, chance >= seldom, actions, scale=1.15)
        _moves(axes, world, (chance > 0) & (chance < seldom), actions, scale=0.5)
        axes.set_title(title, fontsize=9.5, color=INK, pad=5, loc="left", parse_math=False)
    rare = ((panels > 0) & (panels < seldom)).any()
    _note(figure, [
        *([(_MARKED, mark, "s")] if mark else []),
        *([(_NEVER, "never reached", "s")] if np.isnan(panels).any() else []),
        *([(INK, "often", "^", 7), (INK, "seldom", "^", 4)] if rare else []),
    ])
    return figure


_MARKED, _NEVER = "#f9e69a", "#e4e7eb"


def _cell_size(shape: tuple[int, ...]) -> float:
    """The inches of a cell that holds arrows."""
    return float(np.clip(5.2 / max(shape), 0.3, 0.6))


def _rows_of_maps(
    shape: tuple[int, ...], count: int, across: int
) -> tuple[Figure, NDArray[Any]]:
    """A figure with so many axes of maps, in rows."""
    (rows, columns), size = shape, _cell_size(shape)
    down = -(-count // across)
    figure = Figure(
        figsize=(max(across * (columns * size + 0.4), 3.4), down * (rows * size + 0.55) + 0.6),
        layout=ConstrainedLayoutEngine(h_pad=0.1), facecolor=PAPER,
    )
    every = figure.subplots(down, across, squeeze=False).ravel()
    for axes in every[count:]:
        axes.axis("off")
    return figure, every[:count]


# --- coloured worlds ------------------------------------------------------------------------


# Of temporal_gridworld.COLORS: paler than their names, so that what is drawn on them shows.
_TINTS = ("#e79a8c", "#f5db80", "#fdfcf8", "#c3add8", "#4a4f58")
_IS_LIGHT = np.array([1.0, 1.0, 1.0, 1.0, 0.0])


def temporal_gridworld(
    world: World,
    policy: ArrayLike | None = None,
    memory: int | Sequence[int] = 0,
    trajectories: Any = None,
    value: ArrayLike | None = None,
    *,
    title: str | Sequence[str] = "",
    label: str = "value",
    limits: tuple[float, float] | None = None,
    actions: Sequence[str] = ("up", "down", "left", "right"),
) -> Figure:
    """A coloured world and its objects, with a policy as arrows and trajectories as lines.

    Objects and obstacles have a frame and their name; the ring that only patches show is pale.

    Args:
      world: a :class:`jaxltl.envs.temporal_gridworld.World`.
      policy: ``float[S, A]``, or ``float[S, Q, A]`` by the task's memory.
      memory: the memory state to show, or several, with a panel for each.
      trajectories: of the world, drawn from a dot to a square, side by side where they overlap.
      value: ``float[S]`` or ``float[S, Q]``, as colours in a second row of panels.
      title: one per panel.
      label: what the value is.
      limits: values at the ends of the scale; default the data's.
      actions: the name of each action, of up, down, left and right.

    Returns:
      The figure.

    Raises:
      ValueError: policy, value, memory or trajectories do not fit the world.
    """
    chosen = [memory] if isinstance(memory, int | np.integer) else list(memory)
    size, shape = int(np.prod(world.shape)), world.shape
    moves = _of_memory(policy, chosen, size, (len(actions),), "policy")
    values = _of_memory(value, chosen, size, (), "value")
    for name in actions:
        if policy is not None and name not in _STEPS:
            raise ValueError(f"action {name!r} has no direction; use {', '.join(_STEPS)}.")
    titles = [title] * len(chosen) if isinstance(title, str) else list(title)
    lines = _walks(trajectories, world)
    wide = max(shape) + 2 * world.margin
    inches = float(np.clip(5.4 / wide, 0.06, 0.42)) * wide
    down = 1 if values is None else 2
    figure = Figure(
        figsize=(len(chosen) * (inches + 0.3) + (0.8 if down == 2 else 0.1),
                 down * (inches * (shape[0] + 2 * world.margin) / wide + 0.55)
                 + (0.3 if lines else 0)),
        layout=ConstrainedLayoutEngine(h_pad=0.1), facecolor=PAPER,
    )
    every = figure.subplots(down, len(chosen), squeeze=False)
    for i, (axes, name) in enumerate(zip(every[0], titles, strict=True)):
        light = _color_cells(axes, world)
        if moves is not None:
            _arrows(axes, shape, moves[i], light, 0.0, 1.0, actions)
        _draw_walks(axes, lines)
        _name_kinds(axes, world)
        axes.set_title(name, fontsize=9.5, color=INK, pad=5, loc="left", parse_math=False)
    if values is not None:
        _value_panels(figure, every[1], world, values, moves, limits, label, actions)
    if lines:
        _note(figure, [(ACCENT, "first cell", "o"), (ACCENT, "last cell", "s")])
    return figure


def _of_memory(
    array: ArrayLike | None, chosen: Sequence[int], size: int, rest: tuple[int, ...], name: str
) -> NDArray[np.float64] | None:
    """An array over states, or states and memory, as panels ``[M, S, ...]``."""
    if array is None:
        return None
    given = np.asarray(array, float)
    if given.shape == (size, *rest):
        return np.repeat(given[None], len(chosen), axis=0)
    if given.ndim != 2 + len(rest) or (given.shape[0], *given.shape[2:]) != (size, *rest):
        wanted = ", ".join(map(str, rest))
        raise ValueError(
            f"{name} has shape {given.shape}; the world has {size} cells, so pass "
            f"({size}, {wanted}) or ({size}, memory{', ' if rest else ''}{wanted})."
        )
    for q in chosen:
        if not 0 <= q < given.shape[1]:
            raise ValueError(f"memory {q} does not exist; {name} has 0 to {given.shape[1] - 1}.")
    return np.moveaxis(given[:, list(chosen)], 1, 0)


def _color_cells(axes: Axes, world: World) -> NDArray[np.float64]:
    """The colours of a world and its ring; returns which cells are light, ``[S]``."""
    (rows, columns), margin = world.shape, world.margin
    colors = np.asarray(world.colors)
    axes.imshow(
        np.array([to_rgb(tint) for tint in _TINTS])[colors],
        extent=(-margin, columns + margin, rows + margin, -margin), interpolation="nearest",
    )
    for corner, width, height in (
        ((-margin, -margin), columns + 2 * margin, margin),
        ((-margin, rows), columns + 2 * margin, margin),
        ((-margin, 0), margin, rows), ((columns, 0), margin, rows),
    ):
        axes.add_patch(Rectangle(corner, width, height, facecolor=PAPER, alpha=0.62, lw=0))
    if max(rows, columns) <= 32:
        grid = [((0, r), (columns, r)) for r in range(rows + 1)]
        grid += [((c, 0), (c, rows)) for c in range(columns + 1)]
        axes.add_collection(LineCollection(grid, colors=PAPER, linewidths=0.7))
    axes.add_patch(Rectangle((0, 0), columns, rows, fill=False, edgecolor=INK, lw=1.1))
    _number_cells(axes, rows, columns)
    axes.set(xlim=(-margin, columns + margin), ylim=(rows + margin, -margin), aspect="equal")
    inner = colors[margin : margin + rows, margin : margin + columns]
    return _IS_LIGHT[inner.ravel()]


def _name_kinds(axes: Axes, world: World) -> None:
    """A frame around each object and obstacle, and its name where there is room."""
    kinds = np.asarray(world.mdp.label)
    tiny = max(world.shape) > 16
    for state, number in np.argwhere(kinds):
        row, column = divmod(int(state), world.shape[1])
        name = world.mdp.propositions[number]
        inset = 0.05
        axes.add_patch(Rectangle(
            (column + inset, row + inset), 1 - 2 * inset, 1 - 2 * inset, fill=False,
            edgecolor=_SERIES[1], lw=0.9 if tiny else 1.6, zorder=5,
        ))
        # Where cells are tiny, the name of what is rare stands beside it.
        if not tiny or kinds[:, number].sum() <= 3:
            x, y = (column + 1.2, row + 0.04) if tiny else (column + 0.04, row + 0.04)
            axes.text(x, y, name, ha="left", va="top", fontsize=6.5,
                      color=PAPER, weight="bold", parse_math=False, zorder=7,
                      bbox={"facecolor": _SERIES[1], "edgecolor": "none", "pad": 0.9})


def _walks(trajectories: Any, world: World) -> list[NDArray[np.float64]]:
    """Points ``[T, 2]``, column and row, of each trajectory."""
    if trajectories is None:
        return []
    states, lengths = np.asarray(trajectories.state), np.asarray(trajectories.length)
    size = int(np.prod(world.shape))
    if states.size and not 0 <= states.min() <= states.max() < size:
        raise ValueError(
            f"trajectories have states {states.min()} to {states.max()}; the world's cells are 0 "
            f"to {size - 1}. Pass trajectories of the world, not of a product."
        )
    count = len(states)
    # Beside one another, so that what many do looks broad.
    offset = np.linspace(-0.22, 0.22, count) if count > 1 else np.zeros(1)
    points = []
    for row, length, shift in zip(states, lengths, offset, strict=True):
        down, across = np.divmod(row[:length], world.shape[1])
        points.append(np.stack([across, down], 1) + 0.5 + shift)
    return [p for p in points if len(p)]


def _draw_walks(axes: Axes, walks: Sequence[NDArray[np.float64]]) -> None:
    faint = float(np.clip(4 / max(len(walks), 1), 0.25, 1.0))
    halo = [withStroke(linewidth=2.6, foreground=PAPER, alpha=faint)]
    for walk in walks:
        axes.plot(*walk.T, color=ACCENT, lw=1.3, alpha=faint, zorder=5.5, path_effects=halo)
        for point, marker in ((walk[0], "o"), (walk[-1], "s")):
            axes.plot(*point, marker, color=ACCENT, ms=4.5, mec=PAPER, mew=0.8, zorder=6,
                      alpha=max(faint, 0.6))


def _value_panels(
    figure: Figure, every: Sequence[Axes], world: World, values: NDArray[np.float64],
    moves: NDArray[np.float64] | None, limits: tuple[float, float] | None, label: str,
    actions: Sequence[str],
) -> None:
    if limits is None:
        finite = values[np.isfinite(values)]
        limits = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
        limits = limits if limits[0] < limits[1] else (limits[0] - 1, limits[1])
    rows, columns = world.shape
    image: Any = None
    for i, axes in enumerate(every):
        image = axes.imshow(
            np.ma.masked_invalid(values[i].reshape(rows, columns)), cmap=_SCALE, vmin=limits[0],
            vmax=limits[1], extent=(0, columns, rows, 0), interpolation="nearest",
        )
        if moves is not None:
            _arrows(axes, world.shape, moves[i], values[i], *limits, actions)
        _number_cells(axes, rows, columns)
        axes.set(xlim=(0, columns), ylim=(rows, 0), aspect="equal")
        _name_kinds(axes, world)
    bar = figure.colorbar(image, ax=list(every), shrink=0.7, pad=0.015, aspect=24)
    bar.set_label(label, fontsize=9, color=INK)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8, color=MUTED, labelcolor=INK, length=2)


# --- games of two robots --------------------------------------------------------------------


_ROBOT, _LOSES, _WALL = "#c2571a", "#ead0cb", "#55606c"
_TURNS = {**_STEPS, "stay": (0, 0)}
_CELLS = "The cells of a map are those of the system's robot."


class _Board(NamedTuple):
    """The cells of a game's map, and where its C places lie."""

    cells: NDArray[np.str_]
    places: NDArray[np.int_]  # [C, 2], row and column from 0 at the top left
    wall: str


def game_values(
    values: ArrayLike,
    board: int | str,
    *,
    policy: ArrayLike | None = None,
    actions: Sequence[str] = (*_STEPS, "stay"),
    environment: Sequence[int] | None = None,
    label: str = "",
    limits: tuple[float, float] | None = None,
    wall: str = "#",
) -> Figure:
    """A value where the system moves: for each cell of the environment a map of the system's.

    Args:
      values: ``float[2 * C * C]``, of the states of :func:`jaxltl.envs.robots.robots` or
        :func:`jaxltl.envs.robots.grid_game`; NaN leaves a cell blank.
      board: the size of the former, or the text map of the latter.
      policy: ``int[S]``, the system's moves, as arrows instead of figures; negative for none. Or
        ``bool[S, A]``, several moves.
      actions: the name of each action, of up, down, left, right and stay.
      environment: numbers of the environment's places to show; default all, laid out as they lie.
      label: what the colours mean.
      limits: values at the ends of the scale; default the data's.
      wall: the kind of cell that is not a place.

    Returns:
      The figure, with one scale for all maps.

    Raises:
      ValueError: values or policy do not fit the board, or an action has no direction.
    """
    world = _board(board, wall)
    table = _of_turns(np.asarray(values, float), world, "values")
    allowed = None
    if policy is not None:
        _require_directions(actions)
        allowed = _of_turns(_as_mask(policy, len(actions)), world, "policy")
    finite = table[np.isfinite(table)]
    if limits is None:
        limits = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
        limits = limits if limits[0] < limits[1] else (limits[0] - 1, limits[1])
    figure, maps, size = _small_multiples(world, environment, bar=0.75)
    image: Any = None
    for place, axes in maps.items():
        image = _shade(axes, world, table[place], limits)
        _robot(axes, world, place)
        if allowed is not None:
            _moves(axes, world, allowed[place], actions, table[place] < sum(limits) / 2)
        elif size >= 0.27:
            _figures(axes, world, table[place], place, sum(limits) / 2)
    bar = figure.colorbar(image, ax=list(maps.values()), shrink=0.6, pad=0.015, aspect=28)
    bar.set_label(label, fontsize=9, color=INK)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8, color=MUTED, labelcolor=INK, length=2)
    _note(figure, [(_ROBOT, "the environment's robot", "o")], _CELLS)
    return figure


def game_region(
    region: ArrayLike,
    board: int | str,
    *,
    environment: Sequence[int] | None = None,
    wall: str = "#",
) -> Figure:
    """From where the system wins on its turn: for each cell of the environment a map.

    Args:
      region: ``bool[2 * C * C]``, see :func:`game_values`.
      board, environment, wall: as there.

    Returns:
      The figure.

    Raises:
      ValueError: the region does not fit the board.
    """
    world = _board(board, wall)
    table = _of_turns(np.asarray(region, bool), world, "region")
    figure, maps, _ = _small_multiples(world, environment)
    for place, axes in maps.items():
        _paint(axes, world, table[place])
        _robot(axes, world, place)
    _note(figure, _REGION_MARKS, _CELLS)
    return figure


_REGION_MARKS = [
    ("#cfe6d6", "the system wins", "s"),
    (_LOSES, "the environment wins", "s"),
    (_ROBOT, "the environment's robot", "o"),
]


def game_moves(
    allowed: ArrayLike,
    board: int | str,
    environment: int,
    *,
    region: ArrayLike | None = None,
    available: ArrayLike | None = None,
    system: int | None = None,
    actions: Sequence[str] = (*_STEPS, "stay"),
    titles: Sequence[str] | str = "",
    wall: str = "#",
) -> Figure:
    """What the system may do in each cell while the environment's robot is in a certain one.

    Args:
      allowed: ``bool[2 * C * C, A]``, or with M panels first, such as one for each memory
        state of a strategy; see :func:`game_values` for the states.
      board, actions, wall: as there.
      environment: the number of the environment's place.
      region: ``bool[2 * C * C]``, or with M panels first: where the system wins.
      available: ``bool[2 * C * C, A]``: those that are not allowed get a hollow mark.
      system: the number of the system's place, to be ringed.
      titles: one per panel.

    Returns:
      The figure. A triangle is an allowed move, a dot is staying.

    Raises:
      ValueError: an array does not fit the board, or an action has no direction.
    """
    world = _board(board, wall)
    _require_place(world, environment)
    _require_directions(actions)
    panels = np.asarray(allowed, bool)
    panels = panels[None] if panels.ndim == 2 else panels
    regions = None if region is None else np.asarray(region, bool)
    if regions is not None and regions.ndim == 1:
        regions = np.broadcast_to(regions, (len(panels), *regions.shape))
    titles = [titles] * len(panels) if isinstance(titles, str) else list(titles)
    rows, columns = world.cells.shape
    most = 3 if columns * _cell_size((rows, columns)) > 1.5 else 4
    figure, every = _rows_of_maps((rows, columns), len(panels), min(len(panels), most))
    for m, axes in enumerate(every):
        mask = _of_turns(panels[m], world, "allowed")[environment]
        wins = mask.any(-1)
        if regions is not None:
            wins = _of_turns(regions[m], world, "region")[environment]
        _paint(axes, world, wins)
        _number_cells(axes, rows, columns)
        if available is not None:
            can = _of_turns(np.asarray(available, bool), world, "available")[environment]
            _moves(axes, world, can & ~mask & wins[:, None], actions, hollow=True)
        _moves(axes, world, mask, actions)
        _robot(axes, world, environment)
        if system is not None:
            row, column = world.places[system]
            axes.add_patch(Circle((column + 0.5, row + 0.5), 0.44, fill=False, lw=1.6,
                                  edgecolor=ACCENT, zorder=6))
        axes.set_title(titles[m], fontsize=9.5, color=INK, pad=5, loc="left", parse_math=False)
    marks = [*_REGION_MARKS, (INK, "allowed", "^")]
    _note(figure, marks + ([(PAPER, "not allowed", "^")] if available is not None else []))
    return figure


def _board(board: int | str, wall: str) -> _Board:
    if isinstance(board, str):
        cells = parse_map(board)
        return _Board(cells, np.argwhere(cells != wall), wall)
    row, column = np.divmod(np.arange(board * board), board)  # numbered from the lower left
    places = np.stack([board - 1 - row, column], axis=-1)
    return _Board(np.full((board, board), "."), places, wall)


def _require_directions(actions: Sequence[str]) -> None:
    for name in actions:
        if name not in _TURNS:
            raise ValueError(f"action {name!r} has no direction; use {', '.join(_TURNS)}.")


def _require_place(world: _Board, number: int) -> int:
    if not 0 <= number < len(world.places):
        raise ValueError(
            f"environment {number} is no place of the board, whose places are 0 to "
            f"{len(world.places) - 1}."
        )
    return int(number)


def _of_turns(array: NDArray[Any], world: _Board, name: str) -> NDArray[Any]:
    """An array over states as ``[environment, system, ...]``, where the system moves."""
    count = len(world.places)
    if array.ndim < 1 or len(array) != 2 * count**2:
        raise ValueError(
            f"{name} has shape {array.shape}; the board has {count} places, so that the game has "
            f"2 * {count}**2 = {2 * count**2} states."
        )
    return np.asarray(array.reshape(count, count, 2, *array.shape[1:])[:, :, 1])


def _as_mask(policy: ArrayLike, num_actions: int) -> NDArray[np.bool_]:
    given = np.asarray(policy)
    if given.dtype.kind in "iu":
        return np.asarray(given[:, None] == np.arange(num_actions))
    return given.astype(bool)


def _small_multiples(
    world: _Board, environment: Sequence[int] | None, bar: float = 0.0
) -> tuple[Figure, dict[int, Axes], float]:
    """A figure, its axes by the environment's place, and the inches of a cell."""
    rows, columns = world.cells.shape
    if environment is None:
        down, across = rows, columns
        spots = [int(r * columns + c) for r, c in world.places]
        chosen = list(range(len(spots)))
    else:
        chosen = [_require_place(world, e) for e in environment]
        across = min(int(np.ceil(np.sqrt(len(chosen)))), 4)
        down, spots = -(-len(chosen) // across), list(range(len(chosen)))
    size = float(np.clip(8.5 / max(across * columns, down * rows), 0.085, 0.42))
    gap = 0.18 if environment is None else 0.32
    width = across * (columns * size + 0.14) + bar + 0.2
    figure = Figure(
        figsize=(max(width, 3.4), down * (rows * size + gap) + 0.5), layout="constrained",
        facecolor=PAPER,
    )
    every = figure.subplots(down, across, squeeze=False).ravel()
    maps = {place: every[spot] for place, spot in zip(chosen, spots, strict=True)}
    for axes in every:
        if all(axes is not shown for shown in maps.values()):
            axes.axis("off")
    if environment is not None:
        for place, axes in maps.items():
            row, column = world.places[place] + 1
            axes.set_title(f"row {row}, column {column}", fontsize=8, color=MUTED, pad=3)
    return figure, maps, size


def _on_board(world: _Board, values: NDArray[np.float64]) -> NDArray[np.float64]:
    shown: NDArray[np.float64] = np.full(world.cells.shape, np.nan)
    shown[tuple(world.places.T)] = values
    return shown


def _shade(
    axes: Axes, world: _Board, values: NDArray[np.float64], limits: tuple[float, float]
) -> Any:
    rows, columns = world.cells.shape
    image = axes.imshow(
        np.ma.masked_invalid(_on_board(world, values)), cmap=_SCALE, vmin=limits[0],
        vmax=limits[1], extent=(0, columns, rows, 0), interpolation="nearest",
    )
    _frame(axes, world)
    return image


def _paint(axes: Axes, world: _Board, wins: NDArray[np.bool_]) -> None:
    _fill(axes, world, [_REGION_MARKS[0][0] if good else _LOSES for good in wins])


def _fill(axes: Axes, world: _Board, colors: Sequence[str], lines: str = PAPER) -> None:
    """A colour for each place, and the names of cells in their corners."""
    for (row, column), color in zip(world.places, colors, strict=True):
        axes.add_patch(Rectangle((column, row), 1, 1, facecolor=color, lw=0))
        kind = world.cells[row, column]
        if kind not in (".", world.wall) and max(world.cells.shape) <= 16:
            axes.text(column + 0.07, row + 0.07, kind, ha="left", va="top", fontsize=6.5,
                      color=MUTED, weight="bold", parse_math=False, zorder=5)
    _frame(axes, world, lines)


def _frame(axes: Axes, world: _Board, color: str = PAPER) -> None:
    rows, columns = world.cells.shape
    for row, column in np.argwhere(world.cells == world.wall):
        axes.add_patch(Rectangle((column, row), 1, 1, facecolor=_WALL, lw=0))
    lines = [((0, r), (columns, r)) for r in range(rows + 1)]
    lines += [((c, 0), (c, rows)) for c in range(columns + 1)]
    axes.add_collection(LineCollection(lines, colors=color, linewidths=0.6, zorder=2))
    axes.set(xlim=(0, columns), ylim=(rows, 0), aspect="equal", xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set(color=FAINT, lw=0.8)


def _robot(axes: Axes, world: _Board, place: int) -> None:
    row, column = world.places[place]
    axes.add_patch(Circle((column + 0.5, row + 0.5), 0.3, facecolor=_ROBOT, lw=0, zorder=5))


def _figures(
    axes: Axes, world: _Board, values: NDArray[np.float64], robot: int, middle: float
) -> None:
    for place, (row, column) in enumerate(world.places):
        if place != robot and np.isfinite(values[place]):
            axes.text(column + 0.5, row + 0.5, f"{values[place]:.3g}", ha="center", va="center",
                      fontsize=6.5, color=PAPER if values[place] < middle else INK, zorder=4)


def _moves(
    axes: Axes, world: _Board, mask: NDArray[np.bool_], actions: Sequence[str],
    dark: NDArray[np.bool_] | None = None, *, hollow: bool = False, scale: float = 1.0,
) -> None:
    """A triangle towards each neighbour that a mask allows, and a dot for staying."""
    for place, a in np.argwhere(mask):
        # Above the environment's robot, whose cell may be shared.
        color = PAPER if dark is not None and dark[place] else INK
        face, edge = ("none", MUTED) if hollow else (color, "none")
        row, column = world.places[place]
        center, step = np.array([column + 0.5, row + 0.5]), np.array(_TURNS[actions[a]], float)
        if not step.any():
            axes.add_patch(Circle(tuple(center), 0.09 * scale, facecolor=face, edgecolor=edge,
                                  lw=0.7, zorder=6))
            continue
        side = step[::-1] * 0.12 * scale
        base, tip = center + step * 0.18, center + step * (0.18 + 0.24 * scale)
        axes.add_patch(Polygon([base + side, tip, base - side], facecolor=face, edgecolor=edge,
                               lw=0.7, zorder=6))


def _note(figure: Figure, marks: Sequence[tuple[Any, ...]], title: str = "") -> None:
    """What colours and marks mean, under the maps: colour, text, marker and, if not 7, its size."""
    handles = [
        Line2D([], [], ls="", marker=marker, color=color, markersize=size[0] if size else 7,
               label=text, markeredgecolor=MUTED if color == PAPER else "none")
        for color, text, marker, *size in marks
    ]
    if not handles:
        return
    across = max(1, min(len(handles), int(figure.get_figwidth() / 1.6)))
    legend = figure.legend(
        handles=handles, loc="outside lower left", ncols=across, frameon=False, fontsize=8,
        labelcolor=INK, handletextpad=0.1, columnspacing=1.2, title=title, alignment="left",
    )
    legend.get_title().set(fontsize=8, color=MUTED)


# --- values side by side --------------------------------------------------------------------


def compare(
    values: Mapping[str, ArrayLike],
    *,
    groups: Sequence[str] | None = None,
    label: str = "value",
) -> Figure:
    """Values of the same states under several strategies, a column of marks for each state.

    Args:
      values: ``float[S]`` by the name of the strategy. States are sorted by the first, then by
        the second, and so on; those that come first are drawn on top.
      groups: the name of each state's group; groups stand side by side as they first occur.
      label: what the values are.

    Returns:
      The figure.

    Raises:
      ValueError: there is nothing to show, or lengths differ.
    """
    series = {name: np.asarray(value, float) for name, value in values.items()}
    sizes = {len(value) for value in series.values()}
    if len(sizes) != 1 or 0 in sizes:
        found = ", ".join(f"{name}: {len(value)}" for name, value in series.items())
        raise ValueError(f"compare needs values of the same states; it has {found or 'none'}.")
    count = sizes.pop()
    names = [""] * count if groups is None else list(groups)
    if len(names) != count:
        raise ValueError(f"groups has {len(names)} names; there are {count} states.")
    kinds = list(dict.fromkeys(names))
    group = np.array([kinds.index(name) for name in names])
    order = np.lexsort((*reversed(series.values()), group))
    place = np.arange(count) + 1.5 * group[order]
    figure = Figure(
        figsize=(float(np.clip(0.085 * count + 1.2, 4, 10)), 3.2),
        layout=ConstrainedLayoutEngine(h_pad=0.1), facecolor=PAPER,
    )
    axes = figure.subplots()
    styles = [("_", 8), ("o", 4.5), ("x", 4), ("D", 3.5), ("v", 4), ("s", 3.5)]
    for i, (name, value) in reversed(list(enumerate(series.items()))):
        marker, size = styles[i % len(styles)]
        axes.plot(place, value[order], ls="", marker=marker, ms=size, label=name,
                  color=_SERIES[i % len(_SERIES)], mew=1.4 if marker in "_x" else 0)
    for i, name in enumerate(kinds):
        here = place[group[order] == i]
        axes.text(here.mean(), 1.02, name, transform=axes.get_xaxis_transform(), ha="center",
                  va="bottom", fontsize=8.5, color=MUTED, parse_math=False)
        if i:
            axes.axvline(here[0] - 1.25, color=FAINT, lw=1)
    axes.set_ylabel(label, fontsize=9, color=INK)
    axes.set(xticks=[], ylim=(min(0, axes.get_ylim()[0]), None))
    _plain_axes(axes)
    handles, texts = axes.get_legend_handles_labels()
    figure.legend(handles[::-1], texts[::-1], loc="outside lower left", ncols=len(series),
                  frameon=False, fontsize=8.5, labelcolor=INK, handletextpad=0.2)
    return figure


def _plain_axes(axes: Axes) -> None:
    axes.tick_params(labelsize=8, color=FAINT, labelcolor=INK, length=3)
    axes.grid(color=FAINT, lw=0.5)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(FAINT)


# --- curves ---------------------------------------------------------------------------------


def curves(
    metrics: Mapping[str, ArrayLike] | Any,
    *,
    steps: ArrayLike | None = None,
    show: Sequence[str] | None = None,
) -> Figure:
    """Learning curves, one panel per figure: the median over seeds, and their spread.

    Args:
      metrics: figures ``[T]`` or ``[N, T]`` by name, or a learner's ``Metrics``.
      steps: ``[T]``, the step of each figure; default 1, 2, ...
      show: names in order; default all that are not wholly NaN.

    Returns:
      The figure. The band holds all the seeds; it is left out for a single one.

    Raises:
      ValueError: there is nothing to show.
    """
    if not isinstance(metrics, Mapping):
        metrics = {name: getattr(metrics, name) for name in metrics.__dataclass_fields__}
    series = {k: np.atleast_2d(np.asarray(v, float)) for k, v in metrics.items()}
    chosen = [
        k for k in (show or series) if k in series and np.isfinite(series[k]).any()
    ]
    if not chosen:
        raise ValueError(f"curves: nothing to show among {', '.join(series) or 'no figures'}.")
    figure = Figure(figsize=(3.1 * len(chosen) + 0.2, 2.5), layout="constrained", facecolor=PAPER)
    for i, (name, axes) in enumerate(
        zip(chosen, figure.subplots(1, len(chosen), squeeze=False)[0], strict=True)
    ):
        _curve(axes, series[name], steps, name.replace("_", " "), _SERIES[i % len(_SERIES)])
    return figure


def _curve(
    axes: Axes, rows: NDArray[np.float64], steps: ArrayLike | None, name: str, color: str
) -> None:
    x = np.arange(1, rows.shape[1] + 1) if steps is None else np.asarray(steps)
    rows = np.where(np.isfinite(rows), rows, np.nan)
    middle = np.nanmedian(rows, axis=0) if len(rows) > 1 else rows[0]
    if len(rows) > 1:
        axes.fill_between(x, np.nanmin(rows, axis=0), np.nanmax(rows, axis=0), color=color,
                          alpha=0.18, lw=0)
    axes.plot(x, middle, color=color, lw=1.6)
    positive = rows[rows > 0]
    if positive.size and np.nanmin(rows) > 0 and positive.max() > 100 * positive.min():
        axes.set_yscale("log")
    axes.set_title(name, fontsize=9.5, color=INK, loc="left")
    axes.set_xlabel("step", fontsize=8.5, color=MUTED)
    _plain_axes(axes)


def bands(
    rows: Mapping[str, Mapping[str, Mapping[str, tuple[ArrayLike, ArrayLike, ArrayLike]]]],
    *,
    limits: Mapping[str, Mapping[str, float]] | None = None,
    label: str = "step",
) -> Figure:
    """Learning curves of several methods: a row of panels for each task.

    Args:
      rows: by the titles of row and column and the name of the series, the horizontal places
        ``[T]``, a mean ``[T]``, and how far the band goes to either side ``[T]``.
      limits: by the titles of row and column, a number at which a dashed line is drawn.
      label: of the horizontal axis.

    Raises:
      ValueError: there is nothing to show.
    """
    figure, panels = _panel_rows(rows, "bands", (3.6, 1.9))
    names = list(dict.fromkeys(n for row in rows.values() for cell in row.values() for n in cell))
    for (row, column), axes in panels.items():
        for name, (x, mean, spread) in rows[row][column].items():
            color = _SERIES[names.index(name) % len(_SERIES)]
            place, middle, width = (np.asarray(v, float) for v in (x, mean, spread))
            axes.fill_between(place, middle - width, middle + width, color=color, alpha=0.15, lw=0)
            axes.plot(place, middle, color=color, lw=1.4, label=name)
        if limits and column in limits.get(row, {}):
            axes.axhline(limits[row][column], color=INK, lw=1, ls="--")
    _bottom_labels(panels, [label] * len(panels))
    handles = [Line2D([], [], color=_SERIES[i % len(_SERIES)]) for i in range(len(names))]
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), frameon=False,
                  fontsize=8.5, labelcolor=INK)
    return figure


def lines(
    rows: Mapping[str, Mapping[str, tuple[ArrayLike, ArrayLike | None]]],
    *,
    labels: Sequence[str] = (),
    names: tuple[str, str] = ("found", "reference"),
) -> Figure:
    """Many runs over time, and one to compare them with: a row of panels for each setting.

    Args:
      rows: by the titles of row and column, runs ``[K, T]`` and a reference ``[T]`` or None.
      labels: of the horizontal axes, one for each column.
      names: of the runs and of the reference.

    Raises:
      ValueError: there is nothing to show.
    """
    figure, panels = _panel_rows(rows, "lines", (2.1, 1.5))
    for (row, column), axes in panels.items():
        runs, reference = rows[row][column]
        several = np.asarray(runs, float)
        axes.plot(several.T, color=ACCENT, lw=1.4 if len(several) == 1 else 0.7,
                  alpha=1 if len(several) == 1 else 0.35)
        if reference is not None:
            axes.plot(np.asarray(reference, float), color=_SERIES[1], lw=1.3, ls="--")
    _bottom_labels(panels, labels)
    figure.legend(
        [Line2D([], [], color=ACCENT), Line2D([], [], color=_SERIES[1], ls="--")], names,
        loc="outside lower center", ncols=2, frameon=False, fontsize=8.5, labelcolor=INK)
    return figure


def paths(
    maps: Mapping[str, tuple[ArrayLike, ArrayLike]],
    boxes: Mapping[str, ArrayLike],
    *,
    bounds: ArrayLike,
    columns: int = 4,
) -> Figure:
    """Trajectories in the plane, a map for each title.

    Args:
      maps: by title, coordinates x and y of M trajectories, ``[M, T]`` each.
      boxes: by name, regions ``((x, y), (x, y))``, the lower left corner first; drawn in all maps.
      bounds: the box that is shown.
      columns: of maps.

    Raises:
      ValueError: there is nothing to show.
    """
    if not maps:
        raise ValueError("paths: nothing to show; give at least one map.")
    columns = min(columns, len(maps))
    count = -(-len(maps) // columns)
    figure = Figure(figsize=(2.3 * columns, 2.4 * count + 0.3), layout="constrained",
                    facecolor=PAPER)
    every = figure.subplots(count, columns, squeeze=False).ravel()
    low, high = np.asarray(bounds, float)
    handles: list[Any] = []
    for i, axes in enumerate(every):
        axes.set_axis_off()
        if i >= len(maps):
            continue
        title, (x, y) = list(maps.items())[i]
        handles = []
        for j, (corner, end) in enumerate(np.asarray(list(boxes.values()), float)):
            box = Rectangle(tuple(corner), *(end - corner), lw=0, color=_KINDS[(j + 2) % 6])
            handles.append(axes.add_patch(box))
        axes.add_patch(Rectangle(tuple(low), *(high - low), fill=False, color=FAINT, lw=1.5))
        xs, ys = np.asarray(x, float), np.asarray(y, float)
        axes.plot(xs.T, ys.T, color=ACCENT, lw=0.9, alpha=0.75)
        axes.plot(xs[:, 0], ys[:, 0], "o", color=INK, ms=2.2)
        axes.plot(xs[:, -1], ys[:, -1], "s", color=_SERIES[1], ms=2.6)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.set_title(title, fontsize=8.5, color=INK, loc="left", parse_math=False)
    ends = [Line2D([], [], ls="", marker=m, color=c, ms=4) for m, c in (
        ("o", INK), ("s", _SERIES[1]))]
    figure.legend([*handles, *ends], [*boxes, "first", "last"], loc="outside lower center",
                  ncols=len(boxes) + 2, frameon=False, fontsize=8.5, labelcolor=INK)
    return figure


def _panel_rows(
    rows: Mapping[str, Mapping[str, Any]], name: str, size: tuple[float, float]
) -> tuple[Figure, dict[tuple[str, str], Axes]]:
    """Empty panels by the titles of row and column."""
    columns = list(dict.fromkeys(column for row in rows.values() for column in row))
    if not columns:
        raise ValueError(f"{name}: nothing to show; give at least one row with a panel.")
    figure = Figure(
        figsize=(size[0] * len(columns), size[1] * len(rows) + 0.5), layout="constrained",
        facecolor=PAPER)
    grid = figure.subplots(len(rows), len(columns), squeeze=False)
    found = {}
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            axes = grid[i, j]
            _plain_axes(axes)
            if i == 0:
                axes.set_title(column, fontsize=9.5, color=INK, loc="left")
            if j == 0:
                axes.set_ylabel(row, fontsize=9.5, color=INK)
            if column in rows[row]:
                found[row, column] = axes
            else:
                axes.set_visible(False)
    return figure, found


def _bottom_labels(panels: Mapping[tuple[str, str], Axes], labels: Sequence[str]) -> None:
    last, columns = list(panels)[-1][0], list(dict.fromkeys(column for _, column in panels))
    for column, label in zip(columns, labels, strict=False):
        if (last, column) in panels:
            panels[last, column].set_xlabel(label, fontsize=8.5, color=MUTED)
