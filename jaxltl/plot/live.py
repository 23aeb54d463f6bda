"""SVG drawings for interactive pages; lengths are pixels.

Each part has a class and data attributes (``data-memory``, ``data-from`` and ``data-to``,
``data-state``, ``data-run``) for scripts, and takes its colours from the page's style.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, TYPE_CHECKING, Unpack

import numpy as np
from matplotlib.colors import to_hex, to_rgb
from numpy.typing import ArrayLike, NDArray

from jaxltl.core import validation
from jaxltl.core.automata.automaton import Automaton
from jaxltl.plot import layout
from jaxltl.plot.automata import edge_texts, on_the_host
from jaxltl.plot.board import STEPS
from jaxltl.plot.maps import kind_colors, kind_marks
from jaxltl.plot.style import MapOptions, SCALE
from jaxltl.plot.worlds import TINTS

if TYPE_CHECKING:
    from jaxltl.envs.temporal_gridworld import World

CELL = 40
_MARGIN = 22
_NAMED = 24  # cells a side, beyond which cells have marks and a legend
_INCH = 96.0


def live_automaton(automaton: Automaton, name: str) -> str:
    """The graph of an automaton as SVG in which each state is a button.

    A state is ``g.state#NAME-qQ`` with ``data-memory``, an arrow ``g.edge`` with ``data-from`` and
    ``data-to``; classes ``final`` and ``doomed`` are as in :func:`jaxltl.plot.automaton`.

    Args:
      automaton: the automaton.
      name: prefix of the ids.

    Example:
      >>> from jaxltl import to_automaton
      >>> live_automaton(to_automaton("F a"), "task").count("data-memory")
      2
    """
    table = on_the_host(automaton)
    doomed = layout.rejecting(table)
    graph = layout.arrange(table.delta, int(table.initial), doomed, edge_texts(table, doomed))
    height = graph.size[1]

    def at(points: ArrayLike) -> NDArray[np.float64]:
        """Converts inches with y up to pixels with y down."""
        return (np.asarray(points, float) * [1, -1] + [0, height]) * _INCH

    labels = {label.key: label for label in graph.labels}
    parts = []
    for edge in graph.edges:
        source, target, _ = edge.key
        kind = "edge doomed" if doomed[target] else "edge"
        if table.is_buchi and edge.key[2] == 0:
            kind += " accepting"
        text = ""
        if edge.key in labels:
            center = at(labels[edge.key].center)
            text = _lines(labels[edge.key].rows, center)
        parts.append(
            f'<g class="{kind}" data-from="{source}" data-to="{target}">'
            f"{_arrow(at(edge.curve))}{text}</g>"
        )
    final = table.final if table.has_final_states else doomed & False
    names = table.state_names or ("",) * len(table.delta)
    radius = layout.RADIUS * _INCH
    start = at(graph.position[int(table.initial)])
    tail = start - [radius + 40, 0]
    rim = start - [radius + 2, 0]
    parts.append(f'<g class="edge">{_arrow(np.array([tail, (tail + rim) / 2, rim]))}</g>')
    for q, center in enumerate(at(graph.position)):
        x, y = center
        kind = f"state{' final' * bool(final[q])}{' doomed' * bool(doomed[q])}"
        told = html.escape(f"memory {q}: {names[q]}" if names[q] else f"memory {q}")
        inner = f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius - 5:.1f}"/>' if final[q] else ""
        parts.append(
            f'<g class="{kind}" id="{name}-q{q}" data-memory="{q}" role="button" tabindex="0" '
            f'aria-pressed="false" aria-label="{told}"><title>{told}</title>'
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}"/>{inner}'
            f'<text x="{x:.1f}" y="{y:.1f}">{q}</text></g>'
        )
    wide, high = np.array(graph.size) * _INCH
    return _svg(
        f"{name}-automaton",
        "automaton",
        (0, 0, wide, high),
        parts,
        f"An automaton of {len(table.delta)} states; a table follows",
    )


def _lines(rows: layout.Rows, center: NDArray[np.float64]) -> str:
    """The guards of an edge, one per line, with their marks."""
    step, found = 16.0, []
    for i, (mark, line) in enumerate(rows):
        y = center[1] + (i - (len(rows) - 1) / 2) * step
        told = f'<tspan class="mark">{html.escape(mark)}</tspan> ' if mark else ""
        found.append(f'<text x="{center[0]:.1f}" y="{y:.1f}">{told}{html.escape(line)}</text>')
    return "".join(found)


def _arrow(curve: NDArray[np.float64]) -> str:
    """SVG of a Bezier curve with an arrow head."""
    along = curve[-1] - curve[-2]
    along = along / max(float(np.hypot(*along)), 1e-9)
    side, end = np.array([-along[1], along[0]]) * 4, curve[-1]
    base = end - along * 9
    first, *rest = [f"{x:.1f} {y:.1f}" for x, y in [*curve[:-1], base]]
    head = " L".join(f"{x:.1f} {y:.1f}" for x, y in (base + side, end, base - side))
    kind = "Q" if len(curve) == 3 else "C"
    return f'<path class="line" d="M{first} {kind}{" ".join(rest)}"/><path d="M{head}Z"/>'


class _Ground(NamedTuple):
    """The background of a map: S colours, empty for plain cells, and S names."""

    shape: tuple[int, int]
    colors: list[str]
    names: list[str]
    walls: list[int]
    ring: list[tuple[int, int, str]]  # row, column and colour of cells that are only seen


def _ground(place: NDArray[np.str_] | World, wall: str) -> _Ground:
    if isinstance(place, np.ndarray):
        kinds = [str(kind) for kind in place.ravel()]
        special = kind_colors(place, wall)
        return _Ground(
            (place.shape[0], place.shape[1]),
            [special.get(kind, "") for kind in kinds],
            [kind if kind in special else "" for kind in kinds],
            [state for state, kind in enumerate(kinds) if kind == wall],
            [],
        )
    (rows, columns), margin = place.shape, place.margin
    tints = np.array(TINTS)[np.asarray(place.colors)]
    inside = tints[margin : margin + rows, margin : margin + columns]
    label = np.asarray(place.mdp.label)
    names = [", ".join(np.array(place.mdp.propositions)[row]) for row in label]
    ring = [
        (r - margin, c - margin, str(tints[r, c]))
        for r, c in np.ndindex(*tints.shape)
        if not (0 <= r - margin < rows and 0 <= c - margin < columns)
    ]
    return _Ground((rows, columns), inside.ravel().tolist(), names, [], ring)


def live_map(
    place: NDArray[np.str_] | World,
    name: str,
    layers: Mapping[str, tuple[ArrayLike | None, ArrayLike | None]],
    *,
    runs: Sequence[Sequence[int]] = (),
    marked: Iterable[tuple[int, int, int]] = (),
    pieces: int = 1,
    **look: Unpack[MapOptions],
) -> str:
    """A map as SVG, with one layer per memory state, the first of which is visible.

    Args:
      place: the cells of a text map, ``str[rows, columns]``, or a coloured world.
      name: prefix of the ids.
      layers: by ``data-memory``, values ``[S]`` in [0, 1] as colours (NaN is blank) and a policy
        ``[S, A]`` as arrows as long as an action is likely; or None.
      runs: the cells of each run, a line from a dot, ``data-run``.
      marked: (state, memory, action) to be highlighted: ``g.marked``.
      actions, wall: as for :func:`jaxltl.plot.grid`.
      pieces: number of moving pieces, ``circle.token``.

    Example:
      >>> text = live_map(np.array([[".", "g"]]), "map", {"0": ([0.5, 1.0], None)}, runs=[[0, 1]])
      >>> text.startswith("<svg"), "data-run" in text
      (True, True)
    """
    actions, wall = validation.options("live_map", look, actions=tuple(STEPS), wall="#")
    ground = _ground(place, wall)
    rows, columns = ground.shape
    parts = ['<g class="ground">']
    parts += [_cell(row, column, "ring", color) for row, column, color in ground.ring]
    for state, color in enumerate(ground.colors):
        kind = "wall" if state in ground.walls else "cell"
        parts.append(_cell(*divmod(state, columns), kind, color))
    parts.append("</g>")
    for i, (key, (values, policy)) in enumerate(layers.items()):
        hidden = ' style="display:none"' if i else ""
        parts.append(f'<g class="layer" data-memory="{key}"{hidden}>')
        parts += _layer(ground, values, policy, actions)
        parts.append("</g>")
    # Numbers and marks grow with the map, so that they can be read where it is scaled down.
    zoom = max(1.0, max(ground.shape) / 16)
    large = max(ground.shape) > _NAMED
    texts = {name: name for name in ground.names if name}
    marks = kind_marks(texts) if large else texts
    font = 10.5 * zoom if large else 10.5
    for state, text in enumerate(ground.names):
        if text:
            row, column = divmod(state, columns)
            parts.append(_name(marks[text], column * CELL + 3, row * CELL + font / 2 + 5.75, font))
    for state, memory, action in marked:
        row, column = divmod(int(state), columns)
        parts.append(
            f'<g class="marked" data-memory="{memory}" data-state="{state}" data-action="{action}">'
            f"{_cell(row, column, 'frame', '')}"
            f'<path d="{_triangle(row, column, actions[action], 1.0)}"/></g>'
        )
    parts += [_track(i, cells, columns) for i, cells in enumerate(runs)]
    parts.append(_cell(0, 0, "cursor", ""))
    parts += [
        f'<circle class="token piece-{i}" r="{CELL * (0.28 - 0.04 * i):g}"/>' for i in range(pieces)
    ]
    stride = -(-max(ground.shape) // 16)
    beyond = max([0, *(-row for row, _, _ in ground.ring)]) * CELL
    margin = _MARGIN * zoom
    for axis, count in enumerate((columns, rows)):
        for i in range(0, count, stride):
            along, off = i * CELL + CELL / 2, -beyond - margin / 2
            x, y = (along, off) if axis == 0 else (off, along)
            parts.append(f'<text class="number" x="{x:g}" y="{y:g}">{i + 1}</text>')
    low, more = -beyond - margin, 2 * beyond + margin + 2
    keys = [f"{mark}: {text}" for text, mark in marks.items() if mark != text]
    x, y = 0.0, rows * CELL + beyond + 1.5 * font
    for key in keys:
        if x and x + 0.62 * font * len(key) > columns * CELL:
            x, y = 0.0, y + 1.5 * font
        parts.append(_name(key, x, y, font))
        x += 0.62 * font * (len(key) + 3)
    below = y + font - rows * CELL - beyond if keys else 0
    box = (low, low, columns * CELL + more, rows * CELL + more + below)
    return _svg(
        f"{name}-map",
        "map",
        box,
        parts,
        f"A map of {rows} rows and {columns} columns; a table follows",
        zoom,
    )


def _name(text: str, x: float, y: float, font: float) -> str:
    style = "" if font == 10.5 else f' style="font-size:{font:.3g}px"'
    return f'<text class="name" x="{x:g}" y="{y:g}"{style}>{html.escape(text)}</text>'


def _cell(row: int, column: int, kind: str, color: str, more: str = "") -> str:
    fill = f' fill="{color}"' if color else ""
    return (
        f'<rect class="{kind}" x="{column * CELL}" y="{row * CELL}" width="{CELL}" '
        f'height="{CELL}"{fill}{more}/>'
    )


def _layer(
    ground: _Ground, values: ArrayLike | None, policy: ArrayLike | None, actions: Sequence[str]
) -> list[str]:
    """SVG of one layer: values as colours, and the arrows of a policy."""
    parts, columns, beneath = [], ground.shape[1], list(ground.colors)
    if values is not None:
        shown = np.asarray(values, float)
        for state in np.flatnonzero(np.isfinite(shown)).tolist():
            beneath[state] = to_hex(SCALE(shown[state]))
            parts.append(_cell(*divmod(state, columns), "value", beneath[state]))
    heads: dict[str, list[str]] = {}
    chances = np.zeros((0, 0)) if policy is None else np.asarray(policy, float)
    for state, action in np.argwhere(chances > 0.04).tolist():
        color = beneath[state]
        # Where nothing is beneath, an arrow takes the ink of the page.
        tone = "" if not color else " light" if np.mean(to_rgb(color)) < 0.5 else " dark"
        heads.setdefault(tone, []).append(
            _triangle(*divmod(state, columns), actions[action], chances[state, action])
        )
    return parts + [f'<path class="arrows{k}" d="{"".join(d)}"/>' for k, d in heads.items()]


def _triangle(row: int, column: int, action: str, chance: float) -> str:
    """SVG of an arrow head with a length proportional to the probability of its action."""
    step = np.array(STEPS[action], float)
    side = step[::-1] * (0.055 + 0.085 * chance)
    middle = np.array([column + 0.5, row + 0.5])
    corners = (
        middle + step * 0.03 + side,
        middle + step * (0.12 + 0.34 * chance),
        middle + step * 0.03 - side,
    )
    return "M" + "L".join(f"{x * CELL:.1f} {y * CELL:.1f}" for x, y in corners) + "Z"


def _track(number: int, cells: Sequence[int], columns: int) -> str:
    """SVG of a trajectory, from a dot."""
    points = [
        (state % columns * CELL + CELL / 2, state // columns * CELL + CELL / 2) for state in cells
    ]
    line = " ".join(f"{x:g},{y:g}" for x, y in points)
    (x, y), *_ = points
    return (
        f'<g class="track" data-run="{number}" style="display:none"><polyline points="{line}"/>'
        f'<circle cx="{x:g}" cy="{y:g}" r="5"/></g>'
    )


def live_curve(name: str, values: ArrayLike, steps: ArrayLike) -> str:
    """A learning curve as SVG: the median over seeds as a line, their range as a band.

    The scale is logarithmic where positive values span more than a hundredfold.

    Args:
      name, values, steps: the prefix of the id, ``float[T, N]`` and ``int[T]``.

    Example:
      >>> live_curve("loss", [[4.0, 5.0], [2.0, 3.0]], [1, 2]).startswith("<svg")
      True
    """
    wide, high, left, below = 320.0, 180.0, 64.0, 26.0
    shown, x = np.asarray(values, float), np.asarray(steps, float)
    shown = np.where(np.isfinite(shown), shown, np.nan)
    kept = np.isfinite(shown).any(axis=1)
    shown, x = shown[kept], x[kept]
    least, most = float(np.nanmin(shown)), float(np.nanmax(shown))
    logs = least > 0 and most > 100 * least
    scaled = np.log10(shown) if logs else shown
    low, high_value = float(np.nanmin(scaled)), float(np.nanmax(scaled))
    span = (high_value - low) or 1.0

    def across(step: NDArray[np.float64]) -> NDArray[np.float64]:
        return left + (step - x[0]) / max(x[-1] - x[0], 1) * (wide - left - 10)

    def down(value: NDArray[np.float64]) -> NDArray[np.float64]:
        return 10 + (1 - (value - low) / span) * (high - below - 20)

    def path(value: NDArray[np.float64]) -> list[str]:
        return [f"{a:.1f} {b:.1f}" for a, b in zip(across(x), down(value), strict=True)]

    parts = []
    if scaled.shape[1] > 1:
        edge = path(np.nanmax(scaled, axis=1)) + path(np.nanmin(scaled, axis=1))[::-1]
        parts.append(f'<path class="band" d="M{"L".join(edge)}Z"/>')
    parts.append(f'<path class="curve" d="M{"L".join(path(np.nanmedian(scaled, axis=1)))}"/>')
    parts.append(f'<path class="axis" d="M{left} 6V{high - below}H{wide - 6}"/>')
    for value in (low, (low + high_value) / 2, high_value):
        real = 10**value if logs else value
        told = f"{real:.4g}" if abs(real) >= 1000 else f"{real:.3g}"
        y = float(down(np.array(value)))
        parts.append(f'<text x="{left - 6}" y="{y:.1f}" class="tick end">{told}</text>')
    for step, anchor in ((x[0], "start"), (x[-1], "end")):
        told = f"{'step ' if anchor == 'end' else ''}{step:g}"
        parts.append(
            f'<text x="{float(across(step)):.1f}" y="{high - 9}" class="tick {anchor}">'
            f"{told}</text>"
        )
    return _svg(f"{name}-curve", "plot", (0, 0, wide, high), parts, f"{name}; a table follows")


def _svg(
    name: str, kind: str, box: Sequence[float], parts: Iterable[str], label: str, zoom: float = 1.0
) -> str:
    sides = " ".join(f"{x:.0f}" for x in box)
    return (
        f'<svg id="{name}" class="{kind}" viewBox="{sides}" width="{box[2]:.0f}" '
        f'height="{box[3]:.0f}" style="--wide:{box[2]:.0f}px;--zoom:{zoom:.2g}" role="group" '
        f'aria-label="{html.escape(label)}">'
        f"{''.join(parts)}</svg>"
    )
