"""Plots of models and solutions: grid maps, small transition graphs, and sorted values.

Models are recognised by their fields, since importing their types would load JAX.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from jaxltl.plot import layout as drawing
from jaxltl.plot.automata import draw_graph, draw_start, draw_state
from jaxltl.plot.board import STEPS, Board
from jaxltl.plot.maps import grid
from jaxltl.plot.style import ACCENT, INK, MUTED, blank, plain_axes

if TYPE_CHECKING:
    from jaxltl.core.models.protocols import PyTree
    from jaxltl.core.types import Solution

MAX_CELLS, MAX_STATES, MAX_ARROWS = 900, 16, 40  # up to which something is drawn
_MAX_PANELS = 9
_WALL = "#"


def model(model: PyTree) -> Figure:
    """The grid map of a model with moves between adjacent cells, else its graph.

    A map needs four actions, each with its likeliest successor one cell up, down, left or right, or
    the cell itself, and states numbered in rows from the top left. Cells without moves in or out are
    walls. Games of two robots (:func:`~jaxltl.envs.grid_game`) have the map of both.

    Args:
      model: an MDP, a DenseMDP, a SparseMDP, or a Game or a Product of one of them.

    Returns:
      The figure. In a graph an arrow has the choice and its probability, unless that is 1; states
      of a game in which the environment moves are square.

    Raises:
      ValueError: there is no map, and there are too many states for a graph.

    Example:
      >>> from jaxltl import gridworld
      >>> len(model(gridworld("a . #")).axes)
      1
    """
    world = model.mdp if hasattr(model, "automaton") else model
    system = getattr(world, "system", None)
    if system is not None and (board := board_of_robots(world)) is not None:
        return grid(board.cells, wall=board.wall)
    inner = world if system is None else world.mdp
    if hasattr(inner, "automaton"):
        raise ValueError("model: a game on a product is not drawn; give the game of its world.")
    if (cells := map_of(inner)) is not None:
        return grid(cells, wall=_WALL)
    return _graph(inner, None if system is None else np.asarray(system))


def solution(
    solution: Solution, model: PyTree = None, *, memories: Sequence[str] | None = None
) -> Figure:
    """The values and policy of a solution on the map or graph of a model, or values alone.

    Args:
      solution: of one lane; without a model also of several.
      model: the solved model. Without it the values are drawn in ascending order, with
        their certified bounds.
      memories: of a product, the memory states to show, a panel each; default: those of different
        values, at most nine.

    Raises:
      ValueError: the model has no map and is too large for a graph, or the solution
        belongs to another model.

    Example:
      >>> import jaxltl as jl
      >>> coin = jl.make_sparse(
      ...     None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1], label={"heads": [1]})
      >>> answer = jl.reachability_probability(coin, coin.states_with_label("heads"))
      >>> len(solution(answer).axes), len(solution(answer, coin).axes)
      (1, 1)
    """
    if model is None:
        return _strip(solution)
    is_product = hasattr(model, "automaton")
    world = model.mdp if is_product else model
    values, policy = np.asarray(solution.value), np.asarray(solution.policy)
    if values.shape != tuple(model.state_shape):
        raise ValueError(
            f"solution: its value has shape {values.shape}, the model's states "
            f"{tuple(model.state_shape)}; give the model that was solved, and one lane."
        )
    cells = map_of(world)
    if cells is None:
        if is_product:
            raise ValueError("solution: the product's world has no map; read the values.")
        return _graph(world, None, values, policy if policy.dtype.kind in "iu" else None)
    inside = (cells != _WALL).ravel()
    # One panel for each memory state.
    panels = values.reshape(len(values), -1)
    chosen, titles = [0], [""]
    if is_product:
        several = [q for q in range(panels.shape[1]) if np.ptp(panels[inside, q]) > 0] or [0]
        chosen = several[:_MAX_PANELS] if memories is None else [int(q) for q in memories]
        if not chosen or not all(0 <= q < panels.shape[1] for q in chosen):
            raise ValueError(f"memories={memories}; give some of 0 to {panels.shape[1] - 1}.")
        names = model.automaton.state_names or ("",) * panels.shape[1]
        titles = [
            textwrap.shorten(f"memory {q}: {names[q]}".rstrip(": "), 34, placeholder=" …")
            for q in chosen
        ]
    chances = np.eye(len(STEPS))[policy] if policy.dtype.kind in "iu" else policy.astype(float)
    arrows = None
    if chances.shape[values.ndim :] == (len(STEPS),):
        by_memory = chances.reshape(*panels.shape, len(STEPS))
        arrows = np.stack([np.where(inside[:, None], by_memory[:, q], np.nan) for q in chosen])
    return grid(
        cells,
        np.stack([np.where(inside, panels[:, q], np.nan) for q in chosen]),
        arrows,
        titles=titles,
        limits=_limits(values),
        wall=_WALL,
    )


def _limits(values: np.ndarray) -> tuple[float, float] | None:
    """The limits [0, 1] for probabilities, else None."""
    return (0.0, 1.0) if values.size and values.min() >= 0 and values.max() <= 1 else None


def _strip(solution: Solution) -> Figure:
    """Values of all states in ascending order, one line per lane."""
    value, low, high = (
        np.asarray(x, float) for x in (solution.value, solution.lower, solution.upper)
    )
    lanes = int(np.prod(np.shape(solution.status)))
    figure = blank(4.6, 1.7)
    axes = figure.subplots()
    plain_axes(axes)
    for mine, least, upper in zip(
        *(x.reshape(lanes, -1)[:8] for x in (value, low, high)), strict=True
    ):
        order = np.argsort(mine, kind="stable")
        chosen = order[np.linspace(0, order.size - 1, min(order.size, 1000)).astype(int)]
        edges = np.linspace(0, order.size, len(chosen) + 1)
        below, above, middle = (
            np.where(np.isfinite(x[chosen]), x[chosen], np.nan) for x in (least, upper, mine)
        )
        axes.stairs(above, edges, baseline=below, fill=True, color=ACCENT, alpha=0.25)
        axes.stairs(middle, edges, baseline=None, color=ACCENT, lw=1.4)
    axes.set_xlabel("states, from the least value to the greatest", fontsize=8, color=MUTED)
    axes.set_ylabel("value", fontsize=8, color=MUTED)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.margins(x=0.01)
    return figure


# --- maps -----------------------------------------------------------------------------------------


def map_of(world: PyTree) -> NDArray[np.str_] | None:
    """The cells of a map on which a model's moves lie, ``str[rows, columns]``, or None."""
    if hasattr(world, "row_start") or not (hasattr(world, "successor") or _is_dense(world)):
        return None
    if world.available.ndim != 2 or not (
        world.num_actions == len(STEPS) and 1 < world.num_states <= MAX_CELLS
    ):
        return None
    state = np.arange(world.num_states)
    target = _likeliest(world)
    step = np.where(np.asarray(world.available), target - state[:, None], 0)
    up, down, left, right = step.T
    heights = {*np.abs(np.stack([up, down])).ravel().tolist()} - {0}
    columns = heights.pop() if heights else len(state)
    fits = (
        not heights
        and len(state) % columns == 0
        and step.any()
        and (up <= 0).all()
        and (down >= 0).all()
        and np.isin(left, (-1, 0)).all()
        and np.isin(right, (0, 1)).all()
        and not (left[state % columns == 0]).any()
        and not (right[state % columns == columns - 1]).any()
    )
    if not fits:
        return None
    stuck = ~step.any(axis=1)
    entered = np.zeros(len(state), bool)
    entered[(state[:, None] + step)[step != 0]] = True
    wall = stuck & ~entered & ~(np.asarray(world.initial) > 0)
    label = np.asarray(world.label)
    names = np.array(
        [
            _WALL if here else ",".join(np.array(world.propositions)[row]) or "."
            for here, row in zip(wall, label, strict=True)
        ]
    )
    return None if _WALL in world.propositions else names.reshape(-1, columns)


def _is_dense(world: PyTree) -> bool:
    return hasattr(world, "transition")


def _likeliest(world: PyTree) -> NDArray[np.int64]:
    """``int[S, A]``, the most likely successor."""
    if _is_dense(world):
        return np.argmax(np.asarray(world.transition), axis=-1)
    first = np.argmax(np.asarray(world.probability), axis=-1)[..., None]
    successor = np.take_along_axis(np.asarray(world.successor), first, axis=-1)[..., 0]
    return np.asarray(successor, np.int64)


def board_of_robots(game: PyTree) -> Board | None:
    """The board of a game of two robots in turns, read off the system's moves, or None."""
    world, count = game.mdp, round((game.num_states / 2) ** 0.5)
    known = (
        hasattr(world, "probability")
        and world.available.shape[1:] == (5,)
        and (world.propositions[:3] == ("collision", "diagonal", "system_turn"))
    )
    if not known or 2 * count**2 != world.num_states or count > MAX_CELLS:
        return None
    own = 2 * np.arange(count) + 1  # the environment in its first place, the system to move
    target = np.where(np.asarray(world.available)[own], _likeliest(world)[own] // 2, -1)
    steps = [(down, right) for right, down in STEPS.values()]
    place: dict[int, tuple[int, int]] = {0: (0, 0)}
    queue = [0]
    while queue:
        here = queue.pop()
        for (down, right), there in zip(steps, target[here, :4].tolist(), strict=True):
            spot = (place[here][0] + down, place[here][1] + right)
            if there < 0 or there == here:
                continue
            if there not in place:
                place[there] = spot
                queue.append(there)
            elif place[there] != spot:
                return None
    if len(place) != count or len({*place.values()}) != count:
        return None
    places = np.array([place[i] for i in range(count)])
    places -= places.min(axis=0)
    cells = np.full(places.max(axis=0) + 1, _WALL, dtype="<U64")
    marks = [
        (i, p.removeprefix("system_"))
        for i, p in enumerate(world.propositions[3:], 3)
        if p.startswith("system_")
    ]
    label = np.asarray(world.label)[own]
    for i, spot in enumerate(places):
        cells[tuple(spot)] = ",".join(name for k, name in marks if label[i, k]) or "."
    return Board(cells, places, _WALL)


# --- graphs ---------------------------------------------------------------------------------------


class _Arrow(NamedTuple):
    source: int
    target: int
    number: int  # of the choice, as policies name it
    choice: str
    probability: float


def _arrows_of(world: PyTree) -> Iterator[_Arrow]:
    """All transitions of a model, choice by choice."""
    # Import here: other pictures do not need JAX.
    from jaxltl.core.models import to_sparse

    model = to_sparse(world)
    host, is_sparse = model.host, model is world
    number = np.arange(model.num_rows) if is_sparse else np.asarray(model.action)
    names = [str(k) for k in (model.rank if is_sparse else number).tolist()]
    if model.action is not None and model.action_names:
        names = [model.action_names[a] for a in np.asarray(model.action).tolist()]
    else:  # a single choice of a state has no name
        several = np.diff(host.row_start)[host.state] > 1
        names = [name if one else "" for name, one in zip(names, several, strict=True)]
    for r, target, chance in zip(host.row, host.successor, host.probability, strict=True):
        yield _Arrow(int(host.state[r]), int(target), int(number[r]), names[r], float(chance))


def _graph(
    world: PyTree,
    system: NDArray[np.bool_] | None = None,
    values: np.ndarray | None = None,
    policy: NDArray[np.int64] | None = None,
) -> Figure:
    count = world.num_states
    if count > MAX_STATES:
        raise ValueError(
            f"model: it has {count} states and its moves lie on no map; graphs have up to "
            f"{MAX_STATES} states."
        )
    arrows = list(_arrows_of(world))
    rows: dict[drawing.Key, drawing.Rows] = {}
    for x in arrows:
        chance = "" if x.probability == 1 else f"{x.probability:.3g}".removeprefix("0")
        text = ": ".join(part for part in (x.choice, chance) if part)
        text = text or ("⊤" if x.source == x.target else "1")  # layout omits "⊤"
        key = (x.source, x.target, 0)
        rows[key] = (*rows.get(key, ()), ("", text))
    if len(rows) > MAX_ARROWS:
        raise ValueError(f"model: it has {len(rows)} arrows; graphs have up to {MAX_ARROWS}.")
    delta = np.repeat(np.arange(count)[:, None], max(1, len(arrows)), axis=1)
    for i, x in enumerate(arrows):
        delta[x.source, i] = x.target
    starts = np.flatnonzero(np.asarray(world.initial) > 0)
    first = int(starts[0]) if starts.size else 0
    graph = drawing.arrange(delta, first, np.zeros(count, bool), rows)
    taken = {
        (x.source, x.target) for x in arrows if policy is not None and policy[x.source] == x.number
    }
    figure, axes = draw_graph(
        graph,
        _notes(world, values),
        lambda key: ACCENT if key[:2] in taken else INK,
        lambda key: INK,
    )
    if len(starts) == 1:
        draw_start(axes, graph.position[first])
    for s, center in enumerate(graph.position):
        draw_state(axes, center, str(s), square=system is not None and not system[s])
    return figure


def _notes(world: PyTree, values: np.ndarray | None) -> list[str]:
    """Labels and values by state, as text."""
    label = np.asarray(world.label)
    lines = []
    for s in range(world.num_states):
        held = ", ".join(np.array(world.propositions)[label[s]]) if label.size else ""
        value = "" if values is None else f"{values[s]:.6g}"
        if held or value:
            lines.append(
                textwrap.shorten(
                    f"{s}: {'; '.join(x for x in (value, held) if x)}", 60, placeholder=" …"
                )
            )
    return lines
