"""Lower bounds of satisfaction probabilities on a grid, by value iteration from below."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.continuous.grid import covered
from jaxltl.core.continuous.task_product import TaskProduct
from jaxltl.core.continuous.transition_bounds import TransitionBounds
from jaxltl.core.continuous.winning_cells import Successors
from jaxltl.core.pretty_print import brief


@brief
@dataclass(frozen=True)
class IterationResult:
    """Lower bounds of values and the policy that attains them.

    Attributes:
      value: ``float[Q, C]``.
      action: ``int[Q, C]``.
      change: the largest change of the last sweep.
      num_sweeps: number of sweeps.
    """

    value: Floats
    action: Integers
    change: float
    num_sweeps: int


@dataclass(frozen=True)
class IterationLimits:
    """When the iteration stops: the largest change of a sweep, or a number of sweeps."""

    tolerance: float = 1e-7
    max_sweeps: int = 1000


def iterate(
    task: TaskProduct,
    bounds: TransitionBounds,
    rows: Successors,
    start: IterationResult,
    limits: IterationLimits,
    maximize: bool = True,
) -> IterationResult:
    """Values `V <- max(V, opt_a min_P P V)`: each iterate is a lower bound if the first one is.

    Args:
      task: the product.
      bounds: interval transition probabilities of the rows.
      rows: cells and actions.
      start: lower bounds, 1 in winning states; with the actions that attain them.
      limits: when to stop.
      maximize: True if the controller maximises, False if it minimises.
    """
    value, action = start.value.copy(), start.action.copy()
    open_memory = np.flatnonzero(task.decided < 0)
    cells, shape = rows.cells, rows.shape
    change, sweep = np.inf, 0
    while sweep < limits.max_sweeps and change > limits.tolerance:
        sweep, change = sweep + 1, 0.0
        for q in reversed(open_memory):
            entered = task.entered(value, q).reshape(shape)
            found = bounds.least(entered, float(task.outside[q])).reshape(-1, rows.num_actions)
            best = found.argmax(1) if maximize else found.argmin(1)
            new = np.take_along_axis(found, best[:, None], 1)[:, 0]
            before = value[q, cells]
            better = new > before
            gain = (new - before)[better]
            action[q, cells[better]] = best[better]
            value[q, cells[better]] = new[better]
            change = max(change, float(gain.max(initial=0)))
    return IterationResult(value, action, change, sweep)


def reachable(
    task: TaskProduct, rows: Successors, initial: Booleans, finished: Booleans
) -> Booleans:
    """Product states ``bool[Q, C]`` that may be reached from cells, through unfinished states.

    Args:
      task: the product.
      rows: successors.
      initial: ``bool[C]``, the initial cells.
      finished: ``bool[Q, C]``, states that are not followed.
    """
    row_of_cell = np.full(initial.shape, -1)
    row_of_cell[rows.cells] = np.arange(len(rows.cells))
    found = (task.start[task.label_class].T) & initial
    todo = found & ~finished & (task.decided < 0)[:, None]
    while todo.any():
        new = np.zeros_like(found)
        for q in np.flatnonzero(todo.any(1)):
            at = row_of_cell[np.flatnonzero(todo[q])]
            at = at[at >= 0]
            index = (at[:, None] * rows.num_actions + np.arange(rows.num_actions)).reshape(-1)
            met = covered(rows.start[index], rows.stop[index], rows.shape).reshape(-1)
            new |= task.moves[q][task.label_class].T & met
        todo = new & ~found & ~finished & (task.decided < 0)[:, None]
        found |= new
    return found
