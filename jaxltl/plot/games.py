"""Games of two robots: values, regions and moves."""

from __future__ import annotations


from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.games.synthesis import Synthesis
from jaxltl.plot.board import (
    DIRECTIONS,
    LOSES,
    ROBOT,
    Board,
    as_mask,
    board_of,
    cell_size,
    draw_moves,
    draw_robot,
    fill_cells,
    frame_cells,
    keep_out_of_layout,
    number_cells,
    require_directions,
    rows_of_maps,
    shade_cells,
)
from jaxltl.plot.style import (
    ACCENT,
    FAINT,
    INK,
    MUTED,
    PAPER,
    SERIES,
    blank,
    head,
    note,
    plain_axes,
    scale_bar,
    value_limits,
    write,
)

_MAX_PANELS = 6  # of a strategy's memory
_CELLS = "The cells of a map are those of the system's robot."


def game_values(
    values: ArrayLike,
    board: int | str,
    *,
    policy: ArrayLike | None = None,
    environment: Sequence[int] | None = None,
    actions: Sequence[str] = tuple(DIRECTIONS),
    label: str = "",
    limits: tuple[float, float] | None = None,
    wall: str = "#",
) -> Figure:
    """The values on the system's turns: one map of the system's cell per cell of the environment.

    Args:
      values: ``float[2 * C * C]``, of the states of :func:`jaxltl.envs.robots.robots` or
        :func:`jaxltl.envs.robots.grid_game`; NaN leaves a cell blank.
      board: the size of the former, or the text map of the latter.
      policy: ``int[S]``, the system's moves, as arrows (negative for none), or ``bool[S, A]``.
      actions: the name of each action, of up, down, left, right and stay.
      environment: numbers of the environment's places to show; default all, laid out as they lie.
      label, limits: of the colour scale; default limits are those of the data.
      wall: the kind of cell that is not a place.

    Raises:
      ValueError: values or policy do not fit the board, or an action has no direction.

    Example:
      >>> len(game_values(np.linspace(0, 1, 32), 2, label="value").axes)  # four maps and a scale
      5
    """
    world = board_of(board, wall)
    table = _of_turns(np.asarray(values, float), world, "values")
    allowed = None
    if policy is not None:
        require_directions(actions)
        allowed = _of_turns(as_mask(policy, len(actions)), world, "policy")
    limits = value_limits(table, limits)
    figure, maps, size = _small_multiples(world, environment, bar=0.75)
    image: AxesImage | None = None
    for place, axes in maps.items():
        image = _shade(axes, world, table[place], limits)
        draw_robot(axes, world, place)
        if allowed is not None:
            colors = np.where(table[place] < sum(limits) / 2, PAPER, INK)
            draw_moves(axes, world, allowed[place], actions, colors.tolist())
        elif size >= 0.27:
            _figures(axes, world, table[place], place, sum(limits) / 2)
        keep_out_of_layout(axes)
    scale_bar(figure, image, list(maps.values()), label, aspect=28)
    note(figure, [(ROBOT, "the environment's robot", "o")], _CELLS)
    return figure


def game_region(
    region: ArrayLike,
    board: int | str | Board,
    *,
    environment: Sequence[int] | None = None,
    wall: str = "#",
) -> Figure:
    """The winning region on the system's turns: one map per cell of the environment.

    Args:
      region: ``bool[2 * C * C]``.
      board, environment, wall: as for :func:`game_values`; or a :class:`~jaxltl.plot.board.Board`.

    Raises:
      ValueError: the region does not fit the board.

    Example:
      >>> len(game_region(np.ones(32, bool), 2, environment=[0, 3]).axes)
      2
    """
    world = board_of(board, wall)
    table = _of_turns(np.asarray(region, bool), world, "region")
    figure, maps, _ = _small_multiples(world, environment)
    for place, axes in maps.items():
        _paint(axes, world, table[place])
        draw_robot(axes, world, place)
        keep_out_of_layout(axes)
    note(figure, _REGION_MARKS, _CELLS)
    return figure


_REGION_MARKS = [
    ("#cfe6d6", "the system wins", "s"),
    (LOSES, "the environment wins", "s"),
    (ROBOT, "the environment's robot", "o"),
]


def game_moves(
    allowed: ArrayLike,
    board: int | str,
    environment: int,
    *,
    region: ArrayLike | None = None,
    available: ArrayLike | None = None,
    system: int | None = None,
    actions: Sequence[str] = tuple(DIRECTIONS),
    titles: Sequence[str] | str = "",
    wall: str = "#",
) -> Figure:
    """The allowed moves of the system in each cell (a triangle, or a dot for staying).

    Args:
      allowed: ``bool[2 * C * C, A]`` over the states of :func:`game_values`, or with M panels
        first, such as one for each memory state of a strategy.
      board, actions, wall: as for :func:`game_values`.
      environment, system: numbers of the robots' places; a ring marks the system's.
      region: ``bool[2 * C * C]``, or with M panels first: the winning region.
      available: ``bool[2 * C * C, A]``: actions that are not allowed get a hollow mark.
      titles: one per panel.

    Raises:
      ValueError: an array does not fit the board, or an action has no direction.

    Example:
      >>> len(game_moves(np.ones((32, 5), bool), 2, environment=3, system=0).axes)
      1
    """
    world = board_of(board, wall)
    _require_place(world, environment)
    require_directions(actions)
    panels = np.asarray(allowed, bool)
    panels = panels[None] if panels.ndim == 2 else panels
    regions = None if region is None else np.asarray(region, bool)
    if regions is not None and regions.ndim == 1:
        regions = np.broadcast_to(regions, (len(panels), *regions.shape))
    titles = [titles] * len(panels) if isinstance(titles, str) else list(titles)
    rows, columns = world.cells.shape
    max_columns = 3 if columns * cell_size((rows, columns)) > 1.5 else 4
    figure, every = rows_of_maps((rows, columns), len(panels), min(len(panels), max_columns))
    for m, axes in enumerate(every):
        mask = _of_turns(panels[m], world, "allowed")[environment]
        wins = mask.any(-1)
        if regions is not None:
            wins = _of_turns(regions[m], world, "region")[environment]
        _paint(axes, world, wins)
        number_cells(axes, rows, columns)
        if available is not None:
            can = _of_turns(np.asarray(available, bool), world, "available")[environment]
            draw_moves(axes, world, can & ~mask & wins[:, None], actions, ["none"] * len(wins))
        draw_moves(axes, world, mask, actions)
        draw_robot(axes, world, environment)
        if system is not None:
            row, column = world.places[system]
            axes.add_patch(
                Circle((column + 0.5, row + 0.5), 0.44, fill=False, lw=1.6, ec=ACCENT, zorder=6)
            )
        head(axes, titles[m])
        keep_out_of_layout(axes)
    marks = [*_REGION_MARKS, (INK, "allowed", "^")]
    note(figure, marks + ([(PAPER, "not allowed", "^")] if available is not None else []))
    return figure


def strategy_moves(
    synthesis: Synthesis,
    board: int | str,
    environment: int | None = None,
    *,
    actions: Sequence[str] = tuple(DIRECTIONS),
    goals: Sequence[str] = (),
    wall: str = "#",
) -> Figure:
    """The moves that the permissive strategy of a synthesis allows on a map, by its memory.

    Args:
      synthesis: of :func:`~jaxltl.core.games.synthesis.synthesize` for a game of two robots on the map.
      board, actions, wall: as for :func:`game_values`.
      environment: number of the environment's place; default: where most moves are forbidden.
      goals: names of the guarantees, for titles.

    Returns:
      A panel for each of the automaton and memory states with most cells, at most 6.

    Raises:
      ValueError: the system has no strategy, or the game does not fit the board.

    Example:
      >>> from jaxltl.core.games.objective import safety
      >>> from jaxltl.core.games.synthesis import synthesize
      >>> from jaxltl.envs.robots import grid_game
      >>> game = grid_game("...\\n...")
      >>> len(strategy_moves(synthesize(game, safety(game, "!collision")), "...\\n...").axes)
      1
    """
    nodes, strategy, restricted = synthesis.nodes, synthesis.strategy, synthesis.restricted
    if strategy is None or restricted is None:
        raise ValueError("synthesis has no strategy: the system wins from no initial state.")
    game, count = synthesis.game, len(board_of(board, wall).places)
    memory, mine = np.asarray(restricted.memory), np.asarray(restricted.model.system)
    state = nodes.world_state[synthesis.base]
    automaton = nodes.automaton_state[synthesis.base]
    can, place = np.asarray(game.available), state // (2 * count)
    if environment is None:
        forbids = can[state].sum(-1) - np.asarray(restricted.model.available).sum(-1)
        environment = int(np.argmax(np.bincount(place[mine], forbids[mine], minlength=count)))
    here = mine & (place == environment)
    pairs, size = np.unique(
        np.stack([automaton[here], memory[here]], 1), axis=0, return_counts=True
    )
    panels = np.sort(np.argsort(-size, kind="stable")[:_MAX_PANELS])
    mask = np.asarray(strategy.allowed).reshape(
        nodes.game.num_states, -1, strategy.allowed.shape[-1]
    )
    region = np.asarray(strategy.region).reshape(nodes.game.num_states, -1)
    allowed = np.zeros((len(panels), game.num_states, game.num_actions), bool)
    wins = np.zeros((len(panels), game.num_states), bool)
    titles = []
    for panel, (q, m) in enumerate(pairs[panels]):
        node = np.flatnonzero((nodes.automaton_state == q) & np.asarray(nodes.game.system))
        allowed[panel, nodes.world_state[node]] = mask[node, m, : game.num_actions]
        wins[panel, nodes.world_state[node]] = region[node, m]
        parts = [f"automaton in {q}"] if len(set(pairs[:, 0])) > 1 else []
        if len(set(pairs[:, 1])) > 1:
            parts.append(f"towards {goals[m]}" if m < len(goals) else f"memory {m}")
        titles.append(", ".join(parts))
    return game_moves(
        allowed,
        board,
        environment,
        region=wins,
        available=can,
        actions=actions,
        titles=titles,
        wall=wall,
    )


def _require_place(world: Board, number: int) -> int:
    if not 0 <= number < len(world.places):
        raise ValueError(
            f"environment {number} is no place of the board, whose places are 0 to "
            f"{len(world.places) - 1}."
        )
    return int(number)


def _of_turns(array: np.ndarray, world: Board, name: str) -> np.ndarray:
    """An array over states as ``[environment, system, ...]``, where the system moves."""
    count = len(world.places)
    if array.ndim < 1 or len(array) != 2 * count**2:
        raise ValueError(
            f"{name} has shape {array.shape}; the board has {count} places, so that the game has "
            f"2 * {count}**2 = {2 * count**2} states."
        )
    return np.asarray(array.reshape(count, count, 2, *array.shape[1:])[:, :, 1])


def _small_multiples(
    world: Board, environment: Sequence[int] | None, bar: float = 0.0
) -> tuple[Figure, dict[int, Axes], float]:
    """A figure with axes by the environment's place, and the size of a cell in inches."""
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
    figure = blank(max(width, 3.4), down * (rows * size + gap) + 0.5)
    every = figure.subplots(down, across, squeeze=False).ravel()
    maps = {place: every[spot] for place, spot in zip(chosen, spots, strict=True)}
    for axes in every:
        if all(axes is not drawn for drawn in maps.values()):
            axes.axis("off")
    if environment is not None:
        for place, axes in maps.items():
            row, column = world.places[place] + 1
            axes.set_title(f"row {row}, column {column}", fontsize=8, color=MUTED, pad=3)
    return figure, maps, size


def _shade(
    axes: Axes, world: Board, values: NDArray[np.float64], limits: tuple[float, float]
) -> AxesImage:
    colors: NDArray[np.float64] = np.full(world.cells.shape, np.nan)
    colors[tuple(world.places.T)] = values
    image = shade_cells(axes, colors, limits)
    frame_cells(axes, world)
    return image


def _paint(axes: Axes, world: Board, wins: NDArray[np.bool_]) -> None:
    fill_cells(axes, world, [_REGION_MARKS[0][0] if good else LOSES for good in wins])


def _figures(
    axes: Axes, world: Board, values: NDArray[np.float64], robot: int, middle: float
) -> None:
    for place, (row, column) in enumerate(world.places):
        if place != robot and np.isfinite(values[place]):
            color, text = PAPER if values[place] < middle else INK, f"{values[place]:.3g}"
            write(axes, (column + 0.5, row + 0.5), text, 6.5, color, zorder=4)


def compare(
    values: Mapping[str, ArrayLike], *, groups: Sequence[str] | None = None, label: str = "value"
) -> Figure:
    """The values of the same states under several strategies, one column per state.

    Args:
      values: ``float[S]`` by the name of the strategy, first on top. States are sorted by the
        first, then by the second, and so on.
      groups: the name of each state's group; groups are ordered by their first states.
      label: of the values.

    Raises:
      ValueError: there is nothing to show, or lengths differ.

    Example:
      >>> len(compare({"optimal": [1.0, 0.5], "safe": [0.75, 0.5]}, groups=["near", "far"]).axes)
      1
    """
    series = {name: np.asarray(value, float) for name, value in values.items()}
    sizes = {len(value) for value in series.values()}
    if len(sizes) != 1 or 0 in sizes:
        lengths = ", ".join(f"{name}: {len(value)}" for name, value in series.items())
        raise ValueError(f"compare needs values of the same states; it has {lengths or 'none'}.")
    count = sizes.pop()
    names = [""] * count if groups is None else list(groups)
    if len(names) != count:
        raise ValueError(f"groups has {len(names)} names; there are {count} states.")
    kinds = list(dict.fromkeys(names))
    group = np.array([kinds.index(name) for name in names])
    order = np.lexsort((*reversed(series.values()), group))
    place = np.arange(count) + 1.5 * group[order]
    figure = blank(float(np.clip(0.085 * count + 1.2, 4, 10)), 3.2, padded=True)
    axes = figure.subplots()
    styles = [("_", 8), ("o", 4.5), ("x", 4), ("D", 3.5), ("v", 4), ("s", 3.5)]
    for i, (name, value) in reversed(list(enumerate(series.items()))):
        marker, size = styles[i % len(styles)]
        axes.plot(
            place,
            value[order],
            ls="",
            marker=marker,
            ms=size,
            label=name,
            color=SERIES[i % len(SERIES)],
            mew=1.4 if marker in "_x" else 0,
        )
    for i, name in enumerate(kinds):
        here = place[group[order] == i]
        style = {"transform": axes.get_xaxis_transform(), "va": "bottom"}
        write(axes, (here.mean(), 1.02), name, 8.5, MUTED, **style)
        if i:
            axes.axvline(here[0] - 1.25, color=FAINT, lw=1)
    axes.set_ylabel(label, fontsize=9, color=INK)
    axes.set(xticks=[], ylim=(min(0, axes.get_ylim()[0]), None))
    plain_axes(axes)
    handles, texts = axes.get_legend_handles_labels()
    figure.legend(
        handles[::-1],
        texts[::-1],
        loc="outside lower left",
        ncols=len(series),
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
        handletextpad=0.2,
    )
    return figure
