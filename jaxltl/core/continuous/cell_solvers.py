"""Cells from which a task is satisfied surely or with probability 1, by nested fixed points.

With bounded noise, a cell's successors lie in a box of cells; all of them must be in the set (noise as
an adversary). With random noise, some cells have positive probability for every state of the cell:
they are met almost surely if they can be met again and again. Parity conditions with priorities
0..d are solved by `nu X_0 mu X_1 nu X_2 ...` over predecessors (Emerson and Jutla 1991); at odd
priorities the predecessor takes the next set with positive probability while staying in the outer
one, which is the fixed point of games with strongly fair edges (Banerjee, Majumdar, Mallik, Schmuck
and Soudjani 2023, Theorem 3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.continuous.grid import count_in, covered, cumulative, volume
from jaxltl.core.continuous.task_product import TaskProduct
from jaxltl.core.continuous.transition_bounds import TransitionBounds
from jaxltl.core.pretty_print import brief


@brief
@dataclass(frozen=True)
class Successors:
    """Boxes of cells that rows may and must meet; rows are pairs of cells and actions."""

    cells: Integers  # int[M], the cells of the rows
    num_actions: int  # A
    start: Integers  # int[M A, n], the cells that are possible
    stop: Integers
    outside: Booleans  # bool[M A], True if the domain may be left
    # int[M A, n] twice, boxes of cells of positive probability, and bool[M A], True if leaving
    # the domain has one; None: noise is an adversary
    certain: tuple[Integers, Integers, Booleans] | None
    shape: tuple[int, ...]  # of the grid


def winning_cells(
    task: TaskProduct, rows: Successors, known: Booleans, maximize: bool = True
) -> tuple[Booleans, Integers]:
    """Product states ``bool[Q, C]`` from which the parity condition holds, against every successor in
    the boxes, and actions ``int[Q, C]`` of a winning strategy, 0 elsewhere.

    Cells without rows are winning if ``known bool[Q, C]``. Without `maximize`, the controller is an
    adversary too.
    """
    solver = _Solver(task, rows, known | (task.decided == 1)[:, None], maximize)
    top = int(task.priority.max())
    states = solver.solve(0, max(top, 1), [])
    return states, solver.action


class _Solver:
    """State of the nested fixed point: the sets, and the actions by which states entered them."""

    def __init__(
        self, task: TaskProduct, rows: Successors, known: Booleans, maximize: bool
    ) -> None:
        self.task, self.rows, self.known, self.maximize = task, rows, known, maximize
        self.action = np.zeros(known.shape, np.int32)
        self.undecided: list[int] = np.flatnonzero(task.decided < 0).tolist()

    def solve(self, priority: int, top: int, outer: list[Booleans]) -> Booleans:
        """The fixed point of the variables from `priority` on, for values of the outer ones."""
        greatest = priority % 2 == 0
        current = self.known | np.ones_like(self.known) if greatest else self.known.copy()
        current[self.task.decided == 0] = False
        while True:
            sets, before = [*outer, current], self.action.copy()
            new = self.solve(priority + 1, top, sets) if priority < top else self.step(sets)
            if not greatest:  # states that entered earlier keep the actions by which they did
                self.action = np.where(current, before, self.action)
            if (new == current).all():
                return new
            current = new

    def step(self, sets: list[Booleans]) -> Booleans:
        """One application of the predecessors of all priorities."""
        won_states = self.known.copy()
        for q in self.undecided:
            priority = int(self.task.priority[q])
            inner = sets[priority]
            good = self.all_inside(inner, q)
            if priority % 2 and self.rows.certain is not None:
                good |= self.all_inside(sets[priority - 1], q) & self.some_inside(inner, q)
            grid = good.reshape(-1, self.rows.num_actions)
            won = grid.any(1) if self.maximize else grid.all(1)
            cells = self.rows.cells
            new = won & ~won_states[q, cells]
            self.action[q, cells[new]] = grid[new].argmax(1)
            won_states[q, cells[new]] = True
        return won_states

    def all_inside(self, states: Booleans, q: int) -> Booleans:
        """Rows with all successors in a set."""
        return contained(self.task, self.rows, states, q)

    def some_inside(self, states: Booleans, q: int) -> Booleans:
        """Rows with positive probability of a set."""
        assert self.rows.certain is not None
        table = cumulative(self.task.entered(states, q).reshape(self.rows.shape))
        start, stop, leaves = self.rows.certain
        return (count_in(table, start, stop) > 0) | (leaves & bool(self.task.outside[q]))


def contained(task: TaskProduct, rows: Successors, states: Booleans, memory: int) -> Booleans:
    """Rows ``bool[R]`` with all possible successors, entered from a memory state, in a set."""
    table = cumulative(task.entered(states, memory).reshape(rows.shape))
    cells = volume(rows.start, rows.stop)
    inside = count_in(table, rows.start, rows.stop) == cells
    if not task.outside[memory]:
        inside &= ~rows.outside
    result: Booleans = inside & ((cells > 0) | rows.outside)
    return result


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
