"""Least expected steps until a goal, and rows that attain them (Bertsekas and Tsitsiklis 1991)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import concatenated_ranges, mask_of, offsets_from_counts
from jaxltl.core.sparse.solvers.reachability import total_reward

_TOLERANCE = 1e-8  # width of the expected times, relative
_TIE = 1e-10  # relative difference up to which expected times are equal


class Fastest(NamedTuple):
    """Rows ``int[S]`` with the least expected number of steps to a goal, and this number."""

    row: Integers
    time: Floats


def fastest_rows(mdp: HostMDP, rows: Booleans, goal: Booleans, row: Integers) -> Integers:
    """The first rows ``int[S]`` that reach a goal in the least expected number of steps."""
    fastest = fastest_policy(mdp, rows, goal, row)
    return row if fastest is None else fastest.row


def fastest_policy(mdp: HostMDP, rows: Booleans, goal: Booleans, row: Integers) -> Fastest | None:
    """:func:`fastest_rows` with their time; None without a certificate of it."""
    if goal.all():
        return None
    cost = np.where(rows | goal[mdp.state], 1.0, np.inf)
    time = total_reward(mdp, cost, goal, maximize=False, tolerance=_TOLERANCE)
    if not np.isfinite(time.upper).all():
        return None
    width = time.upper - time.lower
    if not (width <= _TOLERANCE * time.upper).all():
        return None
    ahead = np.where(rows, 1 + mdp.expectation(time.value), np.inf)
    slack = np.maximum(_TIE * time.value, width)
    best = mdp.over_choices(np.minimum, ahead) + slack
    first = mdp.first_choice(ahead <= best[mdp.state])[1]
    # A policy still ends if every step costs less than a whole one more.
    chosen = np.where(slack < 0.1, first, time.row)
    return Fastest(np.where(goal, row, chosen), time.value)


def expected_steps(mdp: HostMDP, row: Integers, goal: Booleans) -> Floats | None:
    """Expected steps to a goal, ``float64[S]`` or infinity; None without six certified digits."""
    rows = mask_of(row, mdp.num_rows)
    cost = np.where(rows | goal[mdp.state], 1.0, np.inf)
    time = total_reward(mdp, cost, goal, maximize=False, tolerance=_TOLERANCE)
    finite = np.isfinite(time.value)
    narrow = time.upper[finite] - time.lower[finite] <= 1e-6 * time.upper[finite]
    return time.value if narrow.all() else None


def with_exits(mdp: HostMDP, leaving: Booleans) -> HostMDP:
    """The model in which some entries ``bool[T]`` lead to a further, absorbing state S."""
    size = mdp.num_states
    target = np.where(leaving, size, mdp.successor)
    weight, width = mdp.probability, np.diff(mdp.entry_start)
    # Entries stay ascending and distinct within their rows.
    several = np.bincount(mdp.row[leaving], minlength=mdp.num_rows) > 0
    touched = concatenated_ranges(mdp.entry_start[:-1][several], width[several])
    order = np.arange(target.size)
    order[touched] = touched[np.lexsort((target[touched], mdp.row[touched]))]
    target, weight = target[order], weight[order]
    same = np.zeros(target.size, bool)
    same[1:] = (target[1:] == size) & (target[:-1] == size) & (mdp.row[1:] == mdp.row[:-1])
    merged = np.add.reduceat(weight, np.flatnonzero(~same))
    width = np.bincount(mdp.row[~same], minlength=mdp.num_rows)
    return HostMDP(
        offsets_from_counts(np.append(np.diff(mdp.row_start), 1)),
        offsets_from_counts(np.append(width, 1)),
        np.append(target[~same], size).astype(np.int32),
        np.append(merged, 1.0),
    )
