"""Layered graph layout of automata: positions of states, curves and labels, in inches.

Each position is the candidate of the best score with respect to the parts placed before.
"""

from __future__ import annotations

import shutil
import subprocess
import textwrap
from collections.abc import Mapping
from functools import cache
from typing import NamedTuple

import numpy as np
from matplotlib.textpath import TextPath
from numpy.typing import NDArray

from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.runs import live_states
from jaxltl.core.sparse.graph.components import strong_components

RADIUS = 0.24
FONT_SIZE = 9.5
MARKED_HEIGHT = FONT_SIZE * 1.5 / 72  # of a line with a mark
MARK_WIDTH = 0.22  # of the column of marks before the lines of a label
_MARGIN = 0.35
_ROW = 1.4
_SAMPLES = np.linspace(0, 1, 61)[:, None]

Points = NDArray[np.float64]
Key = tuple[int, int, int]  # source, target, and which of the curves between the two
Rows = tuple[tuple[str, str], ...]  # a mark and a guard


class Edge(NamedTuple):
    """A transition as a Bezier curve ``float[3 or 4, 2]`` between the rims of its states."""

    key: Key
    curve: Points


class Label(NamedTuple):
    """The label of an edge: guards with their marks, and its position."""

    key: Key
    rows: Rows
    center: Points


class GraphLayout(NamedTuple):
    """A drawing: positions ``float[Q, 2]``, curves, labels, and its width and height."""

    position: Points
    edges: list[Edge]
    labels: list[Label]
    size: tuple[float, float]


class Rectangle(NamedTuple):
    """An axis-parallel rectangle, by its centre and half its sides."""

    center: Points
    half: Points

    def holds(self, points: Points) -> int:
        return int(np.sum(np.all(np.abs(points - self.center) < self.half, axis=1)))

    def overlapped(self, others: Points) -> NDArray[np.bool_]:
        """``bool[B]`` for boxes ``float[B, 2, 2]``."""
        return np.all((np.abs(others[:, 0] - self.center) - others[:, 1]) < self.half, axis=1)

    def num_within(self, centers: Points, distance: float) -> int:
        gap = np.maximum(np.abs(centers - self.center) - self.half, 0)
        return int(np.sum(np.hypot(gap[:, 0], gap[:, 1]) < distance))


def rejecting(automaton: Automaton) -> NDArray[np.bool_]:
    """``bool[Q]``: states from which no word is accepted any more."""
    return ~live_states(automaton)


def arrange(
    delta: NDArray[np.integer],
    initial: int,
    doomed: NDArray[np.bool_],
    texts: Mapping[Key, Rows],
    position: Points | None = None,
) -> GraphLayout:
    """The layout of a transition graph, with `doomed` states below the others."""
    texts = {key: _wrapped(rows) for key, rows in texts.items()}
    if position is None:
        position = _positions(delta, initial, doomed, texts)
    keys = sorted(
        (k for k in texts if k[0] != k[1]),
        key=lambda k: float(np.sum((position[k[0]] - position[k[1]]) ** 2)),
    )
    # Loops go first, clear of the straight lines that the other edges would like to take.
    wishes = {k: _along(_curve(position[k[0]], position[k[1]], 0)) for k in keys}
    placed: list[Points] = [position[initial] - [[RADIUS + 0.2, 0]]]
    edges: list[Edge] = []
    boxes: list[Rectangle] = []
    labels: list[Label] = []
    for key in sorted(k for k in texts if k[0] == k[1]):
        # The self-loop of a sink has no information, and its label takes space.
        if texts[key] == (("", "⊤"),):
            continue
        lines = [line for k, line in wishes.items() if key[0] in k[:2]]
        curve, box = _best_loop(position, key[0], texts[key], placed + lines, boxes)
        placed.append(_along(curve))
        boxes.append(box)
        edges.append(Edge(key, curve))
        labels.append(Label(key, texts[key], box.center))
    for key in keys:
        crowded = sum({*k[:2]} == {*key[:2]} for k in keys) > 1
        curve = _best_curve(position, key[0], key[1], crowded, placed, boxes)
        placed.append(_along(curve))
        edges.append(Edge(key, curve))
    straight = [e for e in edges if e.key[0] != e.key[1]]
    for edge in sorted(straight, key=lambda e: -sum(len(text) for _, text in texts[e.key])):
        box = _best_label(position, edge, texts[edge.key], placed, boxes)
        boxes.append(box)
        labels.append(Label(edge.key, texts[edge.key], box.center))
    return _framed(position, edges, labels, boxes, initial)


def graphviz_positions(count: int, initial: int, texts: Mapping[Key, Rows]) -> Points | None:
    """``float[count, 2]``: positions by graphviz, or None if it cannot be run."""
    program = shutil.which("dot")
    if program is None:
        return None
    lines = [
        "digraph {",
        "rankdir=LR; nodesep=0.8; ranksep=0.7;",
        f"node [shape=circle, fixedsize=true, width={2 * RADIUS}];",
        f"edge [fontsize={FONT_SIZE}];",
        f"{initial};",
        *map(str, range(count)),  # the first name is on the left
    ]
    for (source, target, _), rows in texts.items():
        # Only the size of the label counts.
        text = "\\n".join("m" * (len(line) + 2) for _, line in _wrapped(rows))
        lines.append(f'{source} -> {target} [label="{text}"];')
    try:
        done = subprocess.run(
            [program, "-Tplain"],
            input="\n".join([*lines, "}"]),
            text=True,
            capture_output=True,
            check=True,
            timeout=60,
        )
        nodes = [line.split()[1:4] for line in done.stdout.splitlines() if line.startswith("node ")]
        places = {int(name): (float(x), float(y)) for name, x, y in nodes}
        return np.array([places[q] for q in range(count)])
    except (OSError, subprocess.SubprocessError, ValueError, KeyError):
        return None


def _framed(
    position: Points, edges: list[Edge], labels: list[Label], boxes: list[Rectangle], initial: int
) -> GraphLayout:
    points = [position - RADIUS, position + RADIUS, position[[initial]] - [RADIUS + 0.42, 0]]
    points += [_along(e.curve) for e in edges]
    points += [np.array([b.center - b.half, b.center + b.half]) for b in boxes]
    low = np.min(np.concatenate(points), axis=0) - _MARGIN / 2
    high = np.max(np.concatenate(points), axis=0) + _MARGIN / 2
    return GraphLayout(
        position - low,
        [e._replace(curve=e.curve - low) for e in edges],
        [label._replace(center=label.center - low) for label in labels],
        (float(high[0] - low[0]), float(high[1] - low[1])),
    )


# --- states ---------------------------------------------------------------------------------


def _positions(
    delta: NDArray[np.integer], initial: int, doomed: NDArray[np.bool_], texts: Mapping[Key, Rows]
) -> Points:
    layer = _layers(delta, initial)
    upper = [np.flatnonzero((layer == i) & ~doomed) for i in range(layer.max() + 1)]
    upper = [states for states in upper if states.size]
    order = _ordered(delta, upper)
    column = np.zeros(len(delta))
    x, last = 0.0, -1
    place = {q: i for i, states in enumerate(order) for q in states}
    for i, states in enumerate(order):
        if i:
            # Room for the widest label between this layer and the one before.
            between = [
                label_size(t)[0]
                for (a, b, _), t in texts.items()
                if a != b and {place.get(a), place.get(b)} == {i - 1, i}
            ]
            x += max(1.6, 2 * RADIUS + 0.75 + max(between, default=0.0))
        column[states] = x
        last = i
    position = np.zeros((len(delta), 2))
    position[:, 0] = column
    row = _ROW * max(1.0, (len(texts) / len(delta) / 2) ** 0.5)  # more room for more labels
    for states in order:
        height = row * (len(states) - 1) / 2
        position[states, 1] = np.linspace(height, -height, len(states)) if len(states) > 1 else 0
    sinks = np.flatnonzero(doomed)
    if sinks.size:
        lowest = min((position[~doomed, 1]).min(initial=0), 0) - 1.35 * _ROW
        middle = column[~doomed].mean() if (~doomed).any() and last > 0 else 0.0
        offset = 1.6 * (np.arange(sinks.size) - (sinks.size - 1) / 2)
        position[sinks] = np.stack([middle + offset, np.full(sinks.size, lowest)], axis=1)
    return position


def _layers(delta: NDArray[np.integer], initial: int) -> NDArray[np.int64]:
    """Longest paths between components, breadth-first inside each: ``int[Q]``."""
    count = len(delta)
    component = strong_components(np.repeat(np.arange(count), delta.shape[1]), delta.ravel(), count)
    layer = np.full(count, -1)
    layer[initial] = 0
    for _ in range(count):  # longest paths need at most as many rounds as states
        before = layer.copy()
        for q in np.flatnonzero(layer >= 0):
            for t in delta[q]:
                if component[t] != component[q]:
                    layer[t] = max(layer[t], layer[q] + 1)
                elif layer[t] < 0:
                    layer[t] = layer[q] + 1
        if (layer == before).all():
            break
    return np.maximum(layer, 0)


def _ordered(delta: NDArray[np.integer], layers: list[NDArray[np.int64]]) -> list[list[int]]:
    """Each layer from top to bottom, by the mean place of its neighbours (Sugiyama)."""
    order = [states.tolist() for states in layers]
    linked = np.zeros((len(delta),) * 2, bool)
    linked[np.repeat(np.arange(len(delta)), delta.shape[1]), delta.ravel()] = True
    linked |= linked.T
    for _ in range(4):
        for i in [*range(1, len(order)), *range(len(order) - 2, -1, -1)]:
            place = {
                q: k - (len(states) - 1) / 2
                for j, states in enumerate(order)
                if j != i
                for k, q in enumerate(states)
            }

            def mean(q: int, place: dict[int, float] = place) -> float:
                neighbours = [place[t] for t in np.flatnonzero(linked[q]).tolist() if t in place]
                return sum(neighbours) / len(neighbours) if neighbours else 0.0

            order[i].sort(key=mean)
    return order


# --- curves and labels ----------------------------------------------------------------------


def _along(curve: Points) -> Points:
    t = _SAMPLES
    if len(curve) == 3:
        return (1 - t) ** 2 * curve[0] + 2 * t * (1 - t) * curve[1] + t**2 * curve[2]
    return (
        (1 - t) ** 3 * curve[0]
        + 3 * t * (1 - t) ** 2 * curve[1]
        + 3 * t**2 * (1 - t) * curve[2]
        + t**3 * curve[3]
    )


def _best_curve(
    position: Points,
    source: int,
    target: int,
    crowded: bool,
    placed: list[Points],
    boxes: list[Rectangle],
) -> Points:
    bends = (
        (0.22, -0.22, 0.4, -0.4) if crowded else (0, 0.12, -0.12, 0.25, -0.25, 0.4, -0.4, 0.6, -0.6)
    )
    others = np.delete(position, [source, target], axis=0)
    drawn = np.concatenate(placed)

    def cost(bend: float) -> float:
        inside = _along(_curve(position[source], position[target], bend))[6:-6]
        points, close = _reachable(inside, 0.1, drawn, boxes)
        gap = np.min(_distances(inside, others), initial=np.inf)
        hits = np.sum(_distances(inside, points).min(axis=1, initial=np.inf) < 0.07)
        hits += 4 * sum(Rectangle(*box).holds(inside) for box in close)
        return 60 * max(0, RADIUS + 0.14 - gap) + 0.25 * hits + 3 * abs(bend) + 0.01 * (bend < 0)

    return _curve(position[source], position[target], min(bends, key=cost))


def _curve(start: Points, end: Points, bend: float) -> Points:
    """A quadratic curve between two rims, its control point off the line by `bend` lengths."""
    along = end - start
    control = (start + end) / 2 + bend * np.array([-along[1], along[0]])
    first, last = control - start, control - end
    return np.array(
        [
            start + first / np.hypot(*first) * (RADIUS + 0.01),
            control,
            end + last / np.hypot(*last) * (RADIUS + 0.02),
        ]
    )


def _best_loop(
    position: Points, q: int, rows: Rows, placed: list[Points], boxes: list[Rectangle]
) -> tuple[Points, Rectangle]:
    half = label_size(rows) / 2
    drawn, others = np.concatenate(placed), np.delete(position, q, axis=0)
    reach = 4 * RADIUS + 2 * float(half.sum())
    drawn, close_boxes = _reachable(position[[q]], reach, drawn, boxes)

    def candidate(angle: float) -> tuple[Points, Rectangle]:
        def rim(turn: float, reach: float) -> Points:
            return position[q] + reach * np.array([np.cos(angle + turn), np.sin(angle + turn)])

        curve = np.array(
            [
                rim(0.42, RADIUS + 0.01),
                rim(0.5, 3 * RADIUS),
                rim(-0.5, 3 * RADIUS),
                rim(-0.42, RADIUS + 0.02),
            ]
        )
        way = np.array([np.cos(angle), np.sin(angle)])
        tip = position[q] + 2.33 * RADIUS * way
        return curve, Rectangle(tip + way * (half * np.abs(way) + 0.06), half)

    at_rim = drawn[np.hypot(*(drawn - position[q]).T) < RADIUS + 0.12] - position[q]
    taken = np.arctan2(at_rim[:, 1], at_rim[:, 0])

    def cost(angle: float) -> float:
        curve, box = candidate(angle)
        beside = np.abs((taken - angle + np.pi) % (2 * np.pi) - np.pi) < 0.62
        points = _along(curve)[6:-6]
        return (
            2 * np.sum(_distances(points, drawn).min(axis=1, initial=np.inf) < 0.08)
            + 60 * np.sum(_distances(points, others) < RADIUS + 0.08)
            + _label_cost(box, others, drawn, close_boxes)
            + 3 * np.sum(beside)
            + (0.0 if np.isclose(angle, np.pi / 2) else 1.0)
        )

    return candidate(min(np.pi / 2 + np.arange(12) * np.pi / 6, key=cost))


def _best_label(
    position: Points, edge: Edge, rows: Rows, placed: list[Points], boxes: list[Rectangle]
) -> Rectangle:
    half = label_size(rows) / 2
    own = _along(edge.curve)
    drawn = np.concatenate([p for p in placed if not np.array_equal(p, own)])
    drawn, close_boxes = _reachable(own, 2 * float(half.sum()) + 0.3, drawn, boxes)
    best, least = None, np.inf
    for i in range(9, 52, 2):
        along = own[i + 1] - own[i - 1]
        normal = np.array([-along[1], along[0]]) / np.hypot(*along)
        clear = np.abs(normal) @ half + 0.05
        for shift in (0.0, clear, -clear, clear + 0.1, -clear - 0.1):
            box = Rectangle(own[i] + shift * normal, half)
            cost = _label_cost(box, position, drawn, close_boxes) + abs(i - 30) * 0.05
            # A label hides the line under it, so a position next to the line is better.
            cost += 6.0 if shift == 0 else 2.0 * box.holds(own) + 2.0 * (abs(shift) > clear)
            if cost < least:
                best, least = box, cost
    assert best is not None
    return best


def _reachable(
    around: Points, reach: float, drawn: Points, boxes: list[Rectangle]
) -> tuple[Points, Points]:
    """Of points and boxes, all that come so near to some points, for speed, and perhaps more."""
    low, high = around.min(axis=0) - reach, around.max(axis=0) + reach
    region = Rectangle((low + high) / 2, (high - low) / 2)
    inside = np.all(np.abs(drawn - region.center) < region.half, axis=1)
    stacked = np.array(boxes).reshape(-1, 2, 2)
    return drawn[inside], stacked[region.overlapped(stacked)]


def _label_cost(box: Rectangle, nodes: Points, drawn: Points, boxes: Points) -> float:
    grown = Rectangle(box.center, box.half + 0.03)
    clashes = int(box.overlapped(boxes).sum())
    return 60 * box.num_within(nodes, RADIUS + 0.04) + 40 * clashes + 2.0 * grown.holds(drawn)


def _distances(points: Points, others: Points) -> NDArray[np.float64]:
    difference = points[:, None] - others[None]
    return np.hypot(difference[..., 0], difference[..., 1])


def _wrapped(rows: Rows) -> Rows:
    """Rows of one line each; the mark of a guard precedes its first line."""
    return tuple(
        (mark if i == 0 else "", line) for mark, text in rows for i, line in enumerate(_wrap(text))
    )


def _wrap(text: str, width: int = 22) -> list[str]:
    lines = textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False)
    if len(lines) > 4:
        lines = [*lines[:3], lines[3] + " …"]
    # A sign of logic starts a line rather than ending it.
    for i in range(len(lines) - 1):
        if lines[i][-2:] in (" ∧", " ∨"):
            lines[i], lines[i + 1] = lines[i][:-2], lines[i][-1] + " " + lines[i + 1]
    return lines


@cache
def _line_width(line: str) -> float:
    path = TextPath((0, 0), line.replace("$", "\\$") or " ", size=FONT_SIZE)
    return float(path.get_extents().width)


def text_width(rows: Rows) -> float:
    """Width of the widest line, without marks."""
    return max(_line_width(line) for _, line in rows) / 72


def is_marked(rows: Rows) -> bool:
    """True if a line has a mark."""
    return any(mark for mark, _ in rows)


def label_size(rows: Rows) -> Points:
    """Width and height of a drawn label."""
    if is_marked(rows):
        return np.array([text_width(rows) + MARK_WIDTH + 0.06, len(rows) * MARKED_HEIGHT + 0.02])
    return np.array([text_width(rows) + 0.06, len(rows) * FONT_SIZE * 1.2 / 72 + 0.04])
