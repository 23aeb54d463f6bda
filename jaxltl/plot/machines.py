"""Finite-state controllers of partially observable models as pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.policies.finite_memory import action_text
from jaxltl.envs.text_map import parse_map, plain_kind
from jaxltl.plot import layout
from jaxltl.plot.automata import draw_graph, draw_start, draw_state
from jaxltl.plot.board import ROBOT, WALL, rule_cells, short_name
from jaxltl.plot.live_graph import live_graph
from jaxltl.plot.maps import kind_colors
from jaxltl.plot.style import FAINT, INK, MUTED, PAPER, write

# source, target, observation, and the probabilities of actions, of mealy_machine
Transition = tuple[int, int, int, Sequence[float] | NDArray[np.float64]]
_ROWS = 5  # of a label


class _MachineGraph(NamedTuple):
    layout: layout.GraphLayout
    initial: int
    num_memory: int  # memory states; one more node stands for the start where it is none of them


def controller(transitions: Sequence[Transition], *, actions: Sequence[str] = ()) -> Figure:
    """The Mealy machine of a finite-state controller: states are memory, edges observations and actions.

    An edge has a line for each action that follows, with the numbers of the observations that are
    entered: ``→ 3 5`` moves right in the observations 3 and 5. Probabilities are rounded.

    Args:
      transitions: of :func:`~jaxltl.core.values.partial_observability.reduction.mealy_machine`.
      actions: A names; default: numbers.

    Example:
      >>> len(controller([(-1, 0, 2, [1.0, 0.0]), (0, 0, 3, [0.5, 0.5])], actions=["up", "stay"]).axes)
      1
    """
    machine = _machine(transitions, actions)
    graph = machine.layout
    figure, axes = draw_graph(graph, [], lambda key: INK, lambda key: INK)
    draw_start(axes, graph.position[machine.initial])
    for q, center in enumerate(graph.position):
        draw_state(
            axes, center, str(q) if q < machine.num_memory else "▸", doomed=q >= machine.num_memory
        )
    return figure


def live_controller(transitions: Sequence[Transition], name: str, actions: Sequence[str]) -> str:
    """The same as SVG in which each memory state is a button.

    Args:
      transitions, actions: as for :func:`controller`.
      name: prefix of the ids.

    Example:
      >>> live_controller([(-1, 0, 2, [1.0]), (0, 0, 3, [1.0])], "task", ["up"]).count("data-memory")
      1
    """
    machine = _machine(transitions, actions)
    titles = [f"memory {q}" for q in range(machine.num_memory)]
    titles += ["before the first observation"] * (len(machine.layout.position) - machine.num_memory)
    return live_graph(
        machine.layout,
        name,
        machine.initial,
        [("state" if q < machine.num_memory else "state doomed", x) for q, x in enumerate(titles)],
        lambda key: "edge",
        f"A controller of {machine.num_memory} memory states; a table follows",
    )


def _machine(transitions: Sequence[Transition], actions: Sequence[str]) -> _MachineGraph:
    """The layout of a controller; its start is the memory state 0 if that acts alike."""
    count = max([x[1] for x in transitions], default=0) + 1
    first = {(x[2], x[1]) for x in transitions if x[0] < 0}
    of_zero = {x[2]: x[1] for x in transitions if x[0] == 0}
    start = 0 if all(of_zero.get(o, target) == target for o, target in first) else count
    lines: dict[layout.Key, dict[str, list[int]]] = {}
    for source, target, observation, action in transitions:
        key = (start if source < 0 else source, target, 0)
        group = lines.setdefault(key, {}).setdefault(action_text(action, actions), [])
        if observation not in group:
            group.append(observation)
    size = max(count, start + 1)
    texts = {key: _rows(groups) for key, groups in lines.items()}
    width = max([sum(k[0] == q for k in texts) for q in range(size)] + [1])
    delta = np.repeat(np.arange(size)[:, None], width, 1)
    for q in range(size):
        targets = [k[1] for k in texts if k[0] == q]
        delta[q, : len(targets)] = targets
    graph = layout.arrange(delta, start, np.zeros(size, bool), texts)
    return _MachineGraph(graph, start, count)


def _rows(groups: dict[str, list[int]]) -> layout.Rows:
    rows = [
        ("", f"{action} {' '.join(map(str, sorted(numbers)))}")
        for action, numbers in sorted(groups.items(), key=lambda x: -len(x[1]))
    ]
    return tuple(rows if len(rows) <= _ROWS else [*rows[: _ROWS - 1], ("", "…")])


def windows(
    cells: str | NDArray[np.str_],
    observation: ArrayLike,
    side: int = 3,
    *,
    numbers: Sequence[int] | None = None,
    hidden: Sequence[str] = (),
    wall: str = "#",
) -> Figure:
    """The windows through which a robot sees a map, with the numbers of their observations.

    Args:
      cells, side, hidden, wall: of :func:`~jaxltl.envs.gridworld.partial_gridworld`.
      observation: ``int[S]``, of each cell.
      numbers: observations that are drawn; default all but that of walls.

    Example:
      >>> len(windows("a . b", [0, 1, 2], side=1).axes)
      3
    """
    kinds = parse_map(cells) if isinstance(cells, str) else np.asarray(cells)
    seen = np.asarray(observation)
    looks = np.where(np.isin(kinds, list(hidden)), plain_kind(kinds), kinds)
    half, colors = side // 2, kind_colors(looks, wall)
    wide = np.pad(
        looks.astype(f"<U{max(len(wall), looks.itemsize // 4)}"), half, constant_values=wall
    )
    if numbers is None:
        numbers = np.unique(seen[(kinds != wall).ravel()]).tolist()
    across = min(8, len(numbers))
    down = -(-len(numbers) // max(across, 1))
    figure = Figure(figsize=(0.95 * across + 0.2, 1.15 * down + 0.1), facecolor=PAPER)
    panels = np.ravel(figure.subplots(down, across, squeeze=False))
    for axes, number in zip(panels, numbers, strict=False):
        row, column = divmod(int(np.flatnonzero(seen == number)[0]), kinds.shape[1])
        for (r, c), kind in np.ndenumerate(wide[row : row + side, column : column + side]):
            color = WALL if kind == wall else colors.get(str(kind), PAPER)
            axes.add_patch(Rectangle((c, r), 1, 1, facecolor=color, lw=0))
            if kind in colors:
                write(axes, (c + 0.5, r + 0.5), short_name(str(kind)), 7, INK, zorder=5)
        rule_cells(axes, side, side, FAINT)
        axes.add_patch(Rectangle((half, half), 1, 1, fill=False, ec=ROBOT, lw=1.6, zorder=6))
        axes.set(xlim=(0, side), ylim=(side, 0), aspect="equal", xticks=[], yticks=[])
        axes.set_title(str(number), fontsize=8, color=MUTED, pad=2)
    for axes in panels[len(numbers) :]:
        axes.remove()
    return figure
