"""Gridworlds from text maps, fully or partially observable."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from jaxltl.core import validation
from jaxltl.core.logic.labels import satisfying
from jaxltl.core.models.mdp import MDP, make_mdp
from jaxltl.core.models.pomdp import POMDP, make_pomdp, observation_numbers
from jaxltl.core.models.protocols import Array
from jaxltl.envs.text_map import parse_map, plain_kind

ACTIONS = ("up", "down", "left", "right")
_MOVES = ((-1, 0), (1, 0), (0, -1), (0, 1))
_SIDEWAYS = ((2, 3), (2, 3), (0, 1), (0, 1))


def gridworld(
    text: str,
    *,
    slip: float = 0.0,
    absorbing: Collection[str] = (),
    legend: Mapping[str, Collection[str]] | None = None,
    wall: str = "#",
    initial: str | Array | None = None,
) -> MDP:
    """Gridworld MDP with labels and the actions up, down, left, right.

    State ``row * columns + column``, both from 0 at the top left. A move off the map or into a wall is
    a self-loop. With probability `slip` a move goes to one of the two sides instead, half each.

    Args:
      text, slip: the map, see :func:`parse_map`, and the probability in [0, 1] of moving sideways.
      absorbing: propositions of absorbing cells.
      legend: the propositions of each kind of cell; default: none for ``.``, else that of its name.
      wall: the kind of cell that is a wall.
      initial: a propositional formula over the labels (``"!r & !y"``), for a uniform distribution on
        its cells, or a distribution ``float[S]``; default: uniform over all cells.

    Returns:
      :class:`MDP` with ``rows * columns`` states and four actions.

    Raises:
      ValueError: a malformed map, a cell that is missing in the legend, a probability outside [0, 1],
        an unknown proposition, or no initial cell.

    >>> world = gridworld("b . y", absorbing=["y"])
    >>> world.successor[:, 3, 0].tolist()  # right
    [1, 2, 2]
    """
    cells = parse_map(text)
    rows, columns = cells.shape
    slip = validation.fraction("slip", slip)
    label, propositions = _labels(cells, legend, wall)
    is_wall = (cells == wall).ravel()
    stays = is_wall | _holds_one_of(absorbing, label, propositions, "absorbing")

    state = np.arange(rows * columns)
    row, column = np.divmod(state, columns)
    moved = np.empty((state.size, len(ACTIONS)), np.int32)
    for a, (down, right) in enumerate(_MOVES):
        r, c = row + down, column + right
        target = np.where((r >= 0) & (r < rows) & (c >= 0) & (c < columns), r * columns + c, state)
        moved[:, a] = np.where(is_wall[target] | stays, state, target)
    if slip == 0:
        successor = moved[:, :, None]
        probability = np.ones(successor.shape)
    else:
        successor = np.stack([moved, *(moved[:, list(x)] for x in zip(*_SIDEWAYS, strict=True))], 2)
        probability = np.broadcast_to([1 - slip, slip / 2, slip / 2], successor.shape)
    if initial is None or isinstance(initial, str):
        initial = _initial(initial, label, propositions, ~is_wall)
    return make_mdp(successor, probability, initial=initial, label=label, propositions=propositions)


def partial_gridworld(
    text: str,
    observations: int | Collection[str] = 3,
    *,
    hidden: Collection[str] = (),
    slip: float = 0.0,
    absorbing: Collection[str] = (),
    legend: Mapping[str, Collection[str]] | None = None,
    wall: str = "#",
    initial: str | Array | None = None,
) -> POMDP:
    """Partially observable gridworld: a robot that sees a window around its cell, or senses a few facts.

    Equal windows are one observation, so that only memory distinguishes look-alike places. The
    border of the map looks like a wall.

    Args:
      text: the map, see :func:`parse_map`.
      observations: the odd side of a square window in cells, 3 for the eight neighbours; or what is
        sensed: ``"wall"`` (in each of the four directions) and propositions of the robot's own cell.
      hidden: kinds of cells that look like plain floor in a window.
      slip, absorbing, legend, wall, initial: as in :func:`gridworld`.

    Returns:
      :class:`~jaxltl.core.models.pomdp.POMDP` whose ``fully_observable`` is the gridworld. Its
      `observables` are the kinds in the window (``"up 1, left 1"``, numbered in alphabetical order), or
      what is sensed, 0 or 1 (``"wall up"``, ``"a"``).

    Raises:
      ValueError: a window that is no odd number, an unknown proposition or kind, or an argument that
        :func:`gridworld` refuses.

    >>> world = partial_gridworld("a . . . . b", 3)
    >>> world.observation.tolist()  # the two cells in the middle look alike
    [0, 4, 1, 1, 2, 3]
    >>> partial_gridworld("a . . b", ["wall"]).observables["wall left"].tolist()
    [0, 0, 1]
    """
    world = gridworld(
        text, slip=slip, absorbing=absorbing, legend=legend, wall=wall, initial=initial
    )
    cells = parse_map(text)
    names = [hidden] if isinstance(hidden, str) else list(hidden)
    for kind in names:
        if kind not in cells:
            raise ValueError(
                f"hidden: {kind!r} is not a kind of cell of the map; it has "
                f"{', '.join(np.unique(cells))}."
            )
    if isinstance(observations, int | np.integer):
        side = validation.integer("observations", observations, least=1)
        if side % 2 == 0:
            raise ValueError(
                f"observations is {side}; the side of a window is odd, such as {side + 1}, so that the "
                "robot is in its middle."
            )
        looks = np.where(np.isin(cells, names), plain_kind(cells), cells)
        columns = _windows(looks, side // 2, wall)
    else:
        if names:
            raise ValueError(
                "hidden is for windows; leave it out, and name in observations what is sensed."
            )
        listed = [observations] if isinstance(observations, str) else list(observations)
        columns = _sensed(cells, np.asarray(world.label), world.propositions, listed, wall)
    is_wall = (cells == wall).ravel()
    first = np.flatnonzero(is_wall)[:1]
    # Walls are never entered, and have one observation.
    for values in columns.values():
        values[is_wall] = values[first]
    number, observables = observation_numbers(columns)
    return make_pomdp(world, number, observables=observables)


def _windows(looks: np.ndarray, radius: int, wall: str) -> dict[str, np.ndarray]:
    """The kind in each cell of the window, numbered, by its place relative to the robot."""
    rows, columns = looks.shape
    wide = looks.astype(f"<U{max(len(wall), looks.itemsize // 4)}")  # room for the name of walls
    _, number = np.unique(np.pad(wide, radius, constant_values=wall), return_inverse=True)
    number = number.reshape(rows + 2 * radius, columns + 2 * radius)
    seen = {}
    for down in range(-radius, radius + 1):
        for right in range(-radius, radius + 1):
            there = number[radius + down :, radius + right :][:rows, :columns]
            seen[_place_name(down, right)] = there.ravel().copy()
    return seen


def _place_name(down: int, right: int) -> str:
    parts = [f"{'down' if down > 0 else 'up'} {abs(down)}"] if down else []
    parts += [f"{'right' if right > 0 else 'left'} {abs(right)}"] if right else []
    return ", ".join(parts) or "here"


def _sensed(
    cells: np.ndarray,
    label: np.ndarray,
    propositions: tuple[str, ...],
    observations: list[str],
    wall: str,
) -> dict[str, np.ndarray]:
    """Walls in the four directions, and propositions of the robot's cell, as 0 or 1."""
    seen = {}
    for name in observations:
        if name == "wall":
            blocked = np.pad(cells == wall, 1, constant_values=True)
            for action, (down, right) in zip(ACTIONS, _MOVES, strict=True):
                there = blocked[1 + down :, 1 + right :][: cells.shape[0], : cells.shape[1]]
                seen[f"wall {action}"] = there.ravel().astype(int)
        elif name in propositions:
            seen[name] = label[:, propositions.index(name)].astype(int)
        else:
            known = ", ".join(("wall", *propositions))
            raise ValueError(
                f"observations: {name!r} is neither 'wall' nor a proposition of the map; it has {known}."
            )
    if not seen:
        raise ValueError(
            "observations is empty; give the side of a window, such as 3, or a list such as ['wall']."
        )
    return seen


def _labels(
    cells: np.ndarray, legend: Mapping[str, Collection[str]] | None, wall: str
) -> tuple[np.ndarray, tuple[str, ...]]:
    kinds = np.unique(cells)
    if legend is None:
        legend = {kind: () if kind == "." else (str(kind),) for kind in kinds}
    for kind in kinds:
        if kind != wall and kind not in legend:
            r, c = np.argwhere(cells == kind)[0]
            raise ValueError(
                f"cell {str(kind)!r} (row {r + 1}, column {c + 1}) is not in the legend; it "
                f"has {', '.join(map(repr, legend))}. Add it, with [] if nothing holds there."
            )
        if isinstance(legend.get(str(kind), ()), str):
            raise ValueError(f"legend[{str(kind)!r}] is a string; give a list of propositions.")
    here = [str(kind) for kind in kinds if kind != wall]
    propositions = tuple(sorted({p for kind in legend for p in legend[kind] if kind != wall}))
    label = np.zeros((cells.size, len(propositions)), bool)
    for kind in here:
        for p in legend[kind]:
            label[(cells == kind).ravel(), propositions.index(p)] = True
    return label, propositions


def _holds_one_of(
    names: Collection[str], label: np.ndarray, propositions: tuple[str, ...], argument: str
) -> np.ndarray:
    names = (names,) if isinstance(names, str) else names
    for name in names:
        if name not in propositions:
            raise ValueError(
                f"{argument}: {name!r} is not a proposition of the map; "
                f"it has {', '.join(propositions) or '(none)'}."
            )
    return np.asarray(label[:, [propositions.index(n) for n in names]].any(axis=1))


def _initial(
    formula: str | None, label: np.ndarray, propositions: tuple[str, ...], place: np.ndarray
) -> np.ndarray:
    holds = (
        place if formula is None else place & satisfying(label, propositions, formula, "initial")
    )
    if not place.any():
        raise ValueError(
            "all cells of the map are walls; give at least one other cell, such as '.'."
        )
    if not holds.any():
        raise ValueError(f"initial={formula!r} holds in no cell of the map.")
    return holds / holds.sum()
