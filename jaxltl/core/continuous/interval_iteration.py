"""Lower bounds of satisfaction probabilities on a grid, by value iteration from below."""

from __future__ import annotations

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.continuous.grid import covered
from jaxltl.core.continuous.task_product import TaskProduct
from jaxltl.core.continuous.transition_bounds import TransitionBounds
from jaxltl.core.continuous.winning_cells import Successors

_TOLERANCE = 1e-7  # largest change of the last sweep
_EVALUATION_SWEEPS = 200  # of a policy between two sweeps over all actions


def iterate(
    task: TaskProduct,
    bounds: TransitionBounds,
    rows: Successors,
    start: tuple[Floats, Integers],
    max_sweeps: int,
    maximize: bool = True,
) -> tuple[Floats, Integers]:
    """Values `V <- max(V, opt_a min_P P V)` and actions that attain them, both ``[Q, C]``.

    Each iterate is a lower bound if the first one is; it is 1 in winning states.
    """
    value, action = start[0].copy(), start[1].copy()
    change = np.inf
    for _ in range(max_sweeps):
        if change <= _TOLERANCE:
            break
        change = 0.0
        for q in reversed(np.flatnonzero(task.decided < 0)):
            expected = _expected(task, bounds, value, q, rows.shape).reshape(-1, rows.num_actions)
            best = expected.argmax(1) if maximize else expected.argmin(1)
            new = np.take_along_axis(expected, best[:, None], 1)[:, 0]
            better = new > value[q, rows.cells]
            action[q, rows.cells[better]] = best[better]
            change = max(change, _raise(value, q, rows.cells, new))
        if maximize and rows.num_actions > 1:
            _evaluate(task, bounds, rows, value, action, max(change / 10, _TOLERANCE))
    return value, action


def _expected(
    task: TaskProduct, bounds: TransitionBounds, value: Floats, memory: int, shape: tuple[int, ...]
) -> Floats:
    """Least expected values ``[R]`` of the rows from a memory state."""
    return bounds.least(task.entered(value, memory).reshape(shape), float(task.outside[memory]))


def _raise(value: Floats, memory: int, cells: Integers, new: Floats) -> float:
    """Raises values to new ones; returns the largest change."""
    before = value[memory, cells]
    value[memory, cells] = np.maximum(before, new)
    return float((new - before).max(initial=0))


def _evaluate(
    task: TaskProduct,
    bounds: TransitionBounds,
    rows: Successors,
    value: Floats,
    action: Integers,
    tolerance: float,
) -> None:
    """Sweeps with the chosen actions alone, which cost a fraction of those over all actions."""
    undecided = np.flatnonzero(task.decided < 0)
    first = np.arange(len(rows.cells)) * rows.num_actions
    parts = {q: bounds.part(first + action[q, rows.cells]) for q in undecided}
    for _ in range(_EVALUATION_SWEEPS):
        change = 0.0
        for q in reversed(undecided):
            expected = _expected(task, parts[q], value, q, rows.shape)
            change = max(change, _raise(value, q, rows.cells, expected))
        if change <= tolerance:
            return


def reachable(
    task: TaskProduct, rows: Successors, initial: Booleans, finished: Booleans
) -> Booleans:
    """Product states ``bool[Q, C]`` that may be reached from initial cells ``bool[C]``, through states
    that are not finished.
    """
    row_of_cell = np.full(initial.shape, -1)
    row_of_cell[rows.cells] = np.arange(len(rows.cells))
    reached = (task.start[task.label_class].T) & initial
    todo = reached & ~finished & (task.decided < 0)[:, None]
    while todo.any():
        new = np.zeros_like(reached)
        for q in np.flatnonzero(todo.any(1)):
            at = row_of_cell[np.flatnonzero(todo[q])]
            at = at[at >= 0]
            index = (at[:, None] * rows.num_actions + np.arange(rows.num_actions)).reshape(-1)
            met = covered(rows.start[index], rows.stop[index], rows.shape).reshape(-1)
            new |= task.moves[q][task.label_class].T & met
        todo = new & ~reached & ~finished & (task.decided < 0)[:, None]
        reached |= new
    return reached
