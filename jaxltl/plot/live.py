"""SVG drawings for interactive pages; lengths are pixels.

Each part has a class and data attributes (``data-memory``, ``data-from`` and ``data-to``,
``data-state``, ``data-run``) for scripts, and takes its colours from the page's style.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, TYPE_CHECKING

import numpy as np
from matplotlib.colors import to_hex, to_rgb
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.automata import Automaton
from jaxltl.envs.text_map import parse_map
from jaxltl.io.templates import render
from jaxltl.plot import layout
from jaxltl.plot.live_graph import live_graph, svg
from jaxltl.plot.machines import Transition, live_controller
from jaxltl.plot.automata import edge_texts, on_the_host
from jaxltl.plot.board import STEPS, triangle
from jaxltl.plot.maps import kind_colors, kind_marks, TINTS
from jaxltl.plot.style import ACCENT, FAINT, GOOD, INK, MUTED, PAPER, SCALE

if TYPE_CHECKING:
    from jaxltl.envs.temporal_gridworld import World

CELL = 40
_MARGIN = 22
_NAMED = 24  # cells a side, beyond which cells have marks and a legend


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
    final = table.final if table.has_final_states else doomed & False
    names = table.state_names or ("",) * len(table.delta)
    return live_graph(
        graph,
        name,
        int(table.initial),
        [
            (
                f"state{' final' * bool(final[q])}{' doomed' * bool(doomed[q])}",
                f"memory {q}: {text}" if text else f"memory {q}",
            )
            for q, text in enumerate(names)
        ],
        # Accepting transitions are the first of two curves.
        lambda key: (
            f"edge{' doomed' * bool(doomed[key[1]])}"
            f"{' accepting' * (table.marked_priority is not None and key[2] == 0)}"
        ),
        f"An automaton of {len(table.delta)} states; a table follows",
    )


class _Ground(NamedTuple):
    """The background of a map: S colours, empty for plain cells, and S names."""

    shape: tuple[int, int]
    colors: list[str]
    names: list[str]
    walls: set[int]
    ring: list[tuple[int, int, str]]  # row, column and colour of cells that are only seen


def _ground(place: NDArray[np.str_] | World, wall: str) -> _Ground:
    if isinstance(place, np.ndarray):
        kinds = [str(kind) for kind in place.ravel()]
        special = kind_colors(place, wall)
        return _Ground(
            (place.shape[0], place.shape[1]),
            [special.get(kind, "") for kind in kinds],
            [kind if kind in special else "" for kind in kinds],
            {state for state, kind in enumerate(kinds) if kind == wall},
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
    return _Ground((rows, columns), inside.ravel().tolist(), names, set(), ring)


def live_map(
    place: NDArray[np.str_] | World,
    name: str,
    layers: Mapping[str, tuple[ArrayLike | None, ArrayLike | None]],
    *,
    runs: Sequence[Sequence[int]] = (),
    marked: Iterable[tuple[int, int, int]] = (),
    num_pieces: int = 1,
    window: int = 0,
    actions: Sequence[str] = tuple(STEPS),
    wall: str = "#",
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
      num_pieces: number of moving pieces, ``circle.token``.
      window: side of the frame of cells that a robot sees, ``rect.window``, with room for beliefs in
        ``g.belief``; 0 for none.

    Example:
      >>> text = live_map(np.array([[".", "g"]]), "map", {"0": ([0.5, 1.0], None)}, runs=[[0, 1]])
      >>> text.startswith("<svg"), "data-run" in text
      (True, True)
    """
    ground = _ground(place, wall)
    rows, columns = ground.shape
    # Numbers and marks grow with the map, so that they can be read where it is scaled down.
    zoom = max(1.0, max(ground.shape) / 16)
    large = max(ground.shape) > _NAMED
    texts = {name: name for name in ground.names if name}
    marks = kind_marks(texts) if large else texts
    font = 10.5 * zoom if large else 10.5
    beyond = max([0, *(-row for row, _, _ in ground.ring)]) * CELL
    margin = _MARGIN * zoom
    names: list[tuple[str, float, float]] = [
        (marks[text], s % columns * CELL + 3, s // columns * CELL + font / 2 + 5.75)
        for s, text in enumerate(ground.names)
        if text
    ]
    keys = [f"{mark}: {text}" for text, mark in marks.items() if mark != text]
    x, y = 0.0, rows * CELL + beyond + 1.5 * font
    for key in keys:
        if x and x + 0.62 * font * len(key) > columns * CELL:
            x, y = 0.0, y + 1.5 * font
        names.append((key, x, y))
        x += 0.62 * font * (len(key) + 3)
    below = y + font - rows * CELL - beyond if keys else 0
    low, more = -beyond - margin, 2 * beyond + margin + 2
    return svg(
        "map",
        f"{name}-map",
        (low, low, columns * CELL + more, rows * CELL + more + below),
        f"A map of {rows} rows and {columns} columns; a table follows",
        zoom,
        ground=ground,
        rows=rows,
        columns=columns,
        size=CELL,
        layers=[(key, *_layer(ground, *layer, actions)) for key, layer in layers.items()],
        names=names,
        font=font,
        marked=[
            (int(s), q, a, _triangle(*divmod(int(s), columns), actions[a], 1.0))
            for s, q, a in marked
        ],
        tracks=[
            [(s % columns * CELL + CELL // 2, s // columns * CELL + CELL // 2) for s in cells]
            for cells in runs
        ],
        pieces=num_pieces,
        window=window,
        stride=-(-max(ground.shape) // 16),
        edge=-beyond - margin / 2,
    )


def _layer(
    ground: _Ground, values: ArrayLike | None, policy: ArrayLike | None, actions: Sequence[str]
) -> tuple[list[tuple[int, str]], dict[str, list[str]]]:
    """Colours of the values of states, and the arrows of a policy by tone."""
    numbers = np.zeros(0) if values is None else np.asarray(values, float)
    colors = {s: to_hex(SCALE(numbers[s])) for s in np.flatnonzero(np.isfinite(numbers)).tolist()}
    heads: dict[str, list[str]] = {}
    chances = np.zeros((0, 0)) if policy is None else np.asarray(policy, float)
    for state, action in np.argwhere(chances > 0.04).tolist():
        color = colors.get(state) or ground.colors[state]
        # Where nothing is beneath, an arrow takes the ink of the page.
        tone = "" if not color else " light" if np.mean(to_rgb(color)) < 0.5 else " dark"
        place = divmod(state, ground.shape[1])
        head = _triangle(*place, actions[action], chances[state, action])
        heads.setdefault(tone, []).append(head)
    return list(colors.items()), heads


def _triangle(row: int, column: int, action: str, chance: float) -> str:
    """SVG of an arrow head with a length proportional to the probability of its action."""
    middle, step = np.array([column + 0.5, row + 0.5]), np.array(STEPS[action], float)
    corners = triangle(middle, step, 0.03, 0.12 + 0.34 * chance, 0.055 + 0.085 * chance)
    return "M" + "L".join(f"{x * CELL:.1f} {y * CELL:.1f}" for x, y in corners) + "Z"


def live_curve(name: str, values: ArrayLike, steps: ArrayLike) -> str:
    """A learning curve as SVG: the median over seeds as a line, their range as a band.

    The scale is logarithmic where positive values span more than a hundredfold.

    Args:
      name, values, steps: the prefix of the id, ``float[T, N]`` and ``int[T]``.

    Example:
      >>> live_curve("loss", [[4.0, 5.0], [2.0, 3.0]], [1, 2]).startswith("<svg")
      True
    """
    wide, high, margin, below = 320.0, 180.0, 64.0, 26.0
    rows = np.where(np.isfinite(values), values, np.nan)
    finite = np.isfinite(rows).any(axis=1)
    rows, x = rows[finite], np.asarray(steps, float)[finite]
    least, upper = float(np.nanmin(rows)), float(np.nanmax(rows))
    logs = least > 0 and upper > 100 * least
    scaled = np.log10(rows) if logs else rows
    low, high_value = float(np.nanmin(scaled)), float(np.nanmax(scaled))
    span = (high_value - low) or 1.0

    def across(step: NDArray[np.float64]) -> NDArray[np.float64]:
        return margin + (step - x[0]) / max(x[-1] - x[0], 1) * (wide - margin - 10)

    def down(value: NDArray[np.float64]) -> NDArray[np.float64]:
        return 10 + (1 - (value - low) / span) * (high - below - 20)

    def path(value: NDArray[np.float64]) -> list[str]:
        return [f"{a:.1f} {b:.1f}" for a, b in zip(across(x), down(value), strict=True)]

    edge = path(np.nanmax(scaled, axis=1)) + path(np.nanmin(scaled, axis=1))[::-1]
    ticks: list[tuple[float | str, float | str, str, str]] = []
    for value in (low, (low + high_value) / 2, high_value):
        real = 10**value if logs else value
        text = f"{real:.4g}" if abs(real) >= 1000 else f"{real:.3g}"
        ticks.append((margin - 6, f"{float(down(np.array(value))):.1f}", "end", text))
    for step, anchor, text in ((x[0], "start", ""), (x[-1], "end", "step ")):
        ticks.append((f"{float(across(step)):.1f}", high - 9, anchor, f"{text}{step:g}"))
    return svg(
        "curve",
        f"{name}-curve",
        (0, 0, wide, high),
        f"{name}; a table follows",
        kind="plot",
        band=edge if scaled.shape[1] > 1 else [],
        curve=path(np.nanmedian(scaled, axis=1)),
        axis=f"M{margin} 6V{high - below}H{wide - 6}",
        ticks=ticks,
    )


# --- animated trajectories ----------------------------------------------------------------


_RUN, _GAP, _REST = "#c2571a", 24.0, 2.0
_COLORS = {"run": _RUN, "ink": INK, "faint": FAINT, "paper": PAPER, "muted": MUTED}
_COLORS |= {"accent": ACCENT, "good": GOOD}


def playback(
    cells: str | NDArray[np.str_],
    states: ArrayLike,
    *,
    automaton: Automaton | Sequence[Transition] | None = None,
    memory: ArrayLike | None = None,
    actions: Sequence[str] = tuple(STEPS),
    beliefs: ArrayLike | None = None,
    window: int = 0,
    label: str = "",
    wait: float = 0.4,
    num_plays: int = 3,
    wall: str = "#",
) -> str:
    """An animated SVG of a trajectory on a map, next to the state of the task's automaton.

    It plays `num_plays` times and then shows the whole way; at once if reduced motion is preferred.

    Args:
      cells: a text map (see :func:`jaxltl.envs.text_map.parse_map`) or its cells.
      states: ``int[T]``, the cells of the run, in order.
      automaton, memory: an automaton and ``int[T]``, its state at each of the steps; or neither. In its
        place also the transitions of a controller, as for :func:`jaxltl.plot.controller`, and `actions`.
      beliefs, window: ``float[T, S]``, shades of the cells where the robot may be at each step, and the
        side of the frame of cells that it sees.
      label: the text alternative; default the number of steps.
      wait, num_plays, wall: seconds for each step, the number of repetitions, and the kind of walls.

    Raises:
      ValueError: the run is empty or leaves the map, or the automaton and its states do not fit.

    Example:
      >>> "from a to b" in playback("a . b", [0, 1, 2], label="from a to b")
      True
    """
    kinds = parse_map(cells) if isinstance(cells, str) else np.asarray(cells)
    run = _whole("states", states, kinds.size, "cells")
    shades = _belief_groups(beliefs, len(run), kinds.shape)
    panes = [
        _plain(live_map(kinds, "run", {}, runs=[run], window=window or bool(shades), wall=wall))
    ]
    panes[0] = panes[0].replace('<g class="belief"></g>', shades)
    place = np.stack(np.divmod(run, kinds.shape[1])[::-1], 1) * CELL + CELL // 2
    done = np.cumsum([0.0, *np.hypot(*np.diff(place, axis=0).T)])
    animations = [
        ("go", ".token", [f"transform:translate({x}px,{y}px)" for x, y in place], "linear"),
        (
            "draw",
            ".track polyline",
            [f"stroke-dashoffset:{done[-1] - d:.0f}" for d in done],
            "linear",
        ),
    ]
    corner = place - CELL // 2 - (window // 2) * CELL
    if window:
        frames = [f"transform:translate({x}px,{y}px)" for x, y in corner]
        animations.append(("see", ".window", frames, "linear"))
    if shades:
        animations += [
            (
                f"belief{t}",
                f".belief{t}",
                [f"opacity:{int(t == now)}" for now in range(len(run))],
                "step-end",
            )
            for t in range(len(run))
        ]
    if automaton is not None:
        if isinstance(automaton, Automaton):
            count, pane = len(automaton.delta), live_automaton(automaton, "task")
        else:
            count = 1 + max((x[1] for x in automaton), default=0)
            pane = live_controller(automaton, "task", actions)
        states_of_it = _whole("memory", memory, count, "states of the automaton")
        if len(states_of_it) != len(run):
            raise ValueError(
                f"memory has {len(states_of_it)} steps and the run {len(run)}; give "
                "the automaton's state at each step of the run."
            )
        panes.append(_plain(pane))
        animations += [
            (
                f"{tag}{q}",
                f"#task-q{q} {tag}",
                [on if x == q else off for x in states_of_it],
                "step-end",
            )
            for q in sorted(set(states_of_it))
            for tag, on, off in (
                ("circle", f"fill:{_RUN}", "fill:var(--off)"),
                ("text", f"fill:{PAPER}", f"fill:{INK}"),
            )
        ]
    elif memory is not None:
        raise ValueError(
            "memory is given without automaton; give the automaton whose states "
            "these are, or neither."
        )
    sizes = [re.findall(r'viewBox="\S+ \S+ (\S+) (\S+)"', pane)[0] for pane in panes]
    wide, high = np.array(sizes, float).T
    begins, high_of_all = _GAP + np.cumsum([0.0, *wide + _GAP]), high.max() + 2 * _GAP
    return render(
        "jaxltl.plot",
        "playback.svg",
        panes=[
            pane.replace("<svg ", f'<svg x="{x:.0f}" y="{(high_of_all - h) / 2:.0f}" ', 1)
            for pane, x, h in zip(panes, begins, high, strict=False)
        ],
        wide=begins[-1],
        high=high_of_all,
        label=label or f"A run of {len(run) - 1} steps on a map",
        animations=[(n, p, _timed(f, wait), f[-1], how) for n, p, f, how in animations],
        seconds=(len(run) - 1) * wait + _REST,
        times=num_plays,
        length=max(done[-1], 1),
        **_COLORS,
    )


def _belief_groups(beliefs: ArrayLike | None, steps: int, shape: tuple[int, ...]) -> str:
    """Groups of shaded cells, one for each step."""
    if beliefs is None:
        return ""
    rows = np.asarray(beliefs, float)
    if rows.shape != (steps, shape[0] * shape[1]):
        raise ValueError(
            f"beliefs has shape {list(rows.shape)}; give [{steps}, {shape[0] * shape[1]}], a distribution "
            "over the cells of the map for each step."
        )
    groups = []
    for t, row in enumerate(rows):
        cells = "".join(
            f'<rect x="{s % shape[1] * CELL}" y="{s // shape[1] * CELL}" width="{CELL}" height="{CELL}" '
            f'fill-opacity="{0.12 + 0.78 * row[s]:.2f}"/>'
            for s in np.flatnonzero(row > 5e-5).tolist()
        )
        groups.append(f'<g class="belief belief{t}">{cells}</g>')
    return "".join(groups)


def _whole(name: str, values: ArrayLike | None, count: int, noun: str) -> list[int]:
    array = np.asarray(() if values is None else values)
    if array.ndim != 1 or not array.size or array.dtype.kind not in "iu":
        raise ValueError(
            f"{name} has shape {array.shape} and type {array.dtype}; give int[T], "
            "one number for each step, at least one."
        )
    if array.min() < 0 or array.max() >= count:
        raise ValueError(
            f"{name} has numbers from {array.min()} to {array.max()}; there are "
            f"{count} {noun}, so give 0 to {count - 1}."
        )
    return [int(x) for x in array]


def _plain(text: str) -> str:
    """A live picture without its interactive attributes."""
    return re.sub(r' (?:role|tabindex|aria-pressed|aria-label)="[^"]*"', "", text)


def _timed(frames: Sequence[str], wait: float) -> str:
    """Keyframes of an attribute: one per change, and a pause at the end."""
    total = (len(frames) - 1) * wait + _REST
    keyframes = [
        f"{100 * t * wait / total:.2f}%{{{now}}}"
        for t, now in enumerate(frames)
        if t in (0, len(frames) - 1) or not frames[t - 1] == now == frames[t + 1]
    ]
    return f"{''.join(keyframes)}100%{{{frames[-1]}}}"
