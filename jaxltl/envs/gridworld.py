"""Gridworlds from text maps."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from jaxltl.core import validation
from jaxltl.core.logic.labels import satisfying
from jaxltl.core.models.mdp import MDP, make_mdp
from jaxltl.core.models.protocols import Array
from jaxltl.envs.text_map import parse_map

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
