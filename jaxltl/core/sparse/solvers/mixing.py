"""Optimal sums by the method that a model asks for: sweeps where it mixes, or elimination."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxltl.core.array_types import Booleans, Floats
from jaxltl.core.sparse.linear.gauss_seidel import (
    SweptBounds,
    BlockProblem,
    row_blocks,
    solve_by_sweeps,
)
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import group_starts, concatenated_ranges
from jaxltl.core.sparse.solvers import policy_iteration as transient
from jaxltl.core.sparse.solvers.policy_iteration import Enclosure, ShortestPathProblem

_EPS = float(np.finfo(np.float64).eps)
_TINY = 1e-290
_LARGE = 20_000  # open states from which sweeps are tried
_MET = 4096  # states that are met
_STEPS = 10  # within so many steps from one, where a model may mix
_SOME = 400  # open states from which they are where half of them are met
_FEW = 5  # within so many


def optimum(
    problem: ShortestPathProblem, *, maximize: bool, tolerance: float, relative: bool
) -> Enclosure:
    """:func:`jaxltl.core.sparse.solvers.policy_iteration.optimum`, by sweeps where a model mixes well."""
    size = int(np.count_nonzero(problem.open))
    met, steps = (_MET, _STEPS) if size >= _LARGE else (min(_MET, size // 2), _FEW)
    if size >= _SOME and _spreads(problem.mdp, problem.open, met, steps):
        found = by_sweeps(problem, maximize=maximize, tolerance=tolerance, relative=relative)
        if found is not None:
            return found
    return transient.optimum(problem, maximize=maximize, tolerance=tolerance, relative=relative)


def by_sweeps(
    problem: ShortestPathProblem, *, maximize: bool, tolerance: float, relative: bool
) -> Enclosure | None:
    """The same by sweeps; None where these take too long."""
    mdp, sign = problem.mdp, 1 if maximize else -1
    weight, rows = _without_loops(problem)
    widest = int(np.diff(mdp.entry_start).max())
    unit = (4 * widest + problem.depth + 16) * _EPS
    cost: Any = problem.cost if rows is None else np.where(rows, problem.cost, 0)
    if not cost.any():
        cost = None
    sums = BlockProblem(
        row_blocks(mdp.row_start, mdp.entry_start, mdp.successor, weight, mdp.num_states),
        problem.open,
        problem.open,
        problem.known,
        problem.known,
        cost,
        rows,
    )
    found = solve_by_sweeps(sums, sign=sign, tolerance=tolerance, relative=relative, unit=unit)
    return None if found is None else _enclosed(problem, found, sign)


def _enclosed(problem: ShortestPathProblem, found: SweptBounds, sign: int) -> Enclosure:
    low, high = (found.near, found.far) if sign > 0 else (found.far, found.near)

    def everywhere(x: Floats) -> Floats:
        return np.where(problem.open, x, problem.known)

    # Products too small for a float to hold are lost; relative errors do not count them.
    low, high = everywhere(np.maximum(low - _TINY, 0)), everywhere(high + _TINY)
    value = low + (high - low) / 2
    row = np.where(problem.open, found.row, problem.mdp.row_start[:-1])
    # The operator carries the bounds towards each other, so the value by half of what is between.
    left = (high - value) / np.maximum(value, 1)
    return Enclosure(
        value,
        low,
        high,
        row,
        found.sweeps,
        float(left[problem.open].max(initial=0)),
        "sweeps in place",
    )


def _without_loops(problem: ShortestPathProblem) -> tuple[Floats, Booleans | None]:
    """Weights by which rows sum to one where they loop, and the rows that lead elsewhere."""
    mdp = problem.mdp
    loop = np.flatnonzero(mdp.successor == mdp.state[mdp.row])
    if not loop.size:
        return mdp.probability, problem.rows
    weight = mdp.probability.copy()
    weight[loop] = 0
    of = mdp.row[loop]
    first = loop[group_starts(of)]  # a row may repeat its successors
    row = mdp.row[first]
    width = np.diff(mdp.entry_start)[row]
    entry = concatenated_ranges(mdp.entry_start[row], width)
    rest = np.add.reduceat(weight[entry], width.cumsum() - width)
    weight[first] = np.maximum(1 - rest, 0)
    rows = np.ones(mdp.num_rows, bool) if problem.rows is None else problem.rows.copy()
    rows[row[rest == 0]] = False
    return weight, rows


def _spreads(mdp: HostMDP, open_: Booleans, met: int = _MET, steps: int = _STEPS) -> bool:
    """Whether few steps from a state lead to many, as they do where elimination fills."""
    node, first = np.flatnonzero(open_), mdp.entry_start[mdp.row_start]

    def follow(states: Any) -> Any:
        after = mdp.successor[concatenated_ranges(first[states], first[states + 1] - first[states])]
        return after[open_[after]]

    return expands_fast(follow, node[node.size // 2 : node.size // 2 + 1], open_.size, met, steps)


def expands_fast(
    follow: Callable[[Any], Any],
    start: Any,
    num_states: int,
    met: int | None = None,
    steps: int = _STEPS,
) -> bool:
    """Whether few steps from a state lead to many others.

    Args:
      follow: the states to which some states ``int[M]`` lead, maybe repeatedly.
      start: ``int[1]``.
      num_states: S.
      met: to how many; default 4096.
      steps: within how many.
    """
    left = (_MET if met is None else met) - 1
    seen: Any = np.zeros(num_states, bool)
    seen[start] = True
    for _ in range(steps):
        if left <= 0:
            return True
        after = follow(start)
        start = np.unique(after[~seen[after]])
        seen[start] = True
        left -= start.size
    return left <= 0
