"""Optimal sums of systems that take very long to end, by refinement beyond double precision.

Of equations ``sum_j w_j (x_i - x_j) + l_i x_i = c_i``, in which no weights are subtracted, and a
solution in two floats, of which differences are right in all their digits, what comes in,
``U = c + sum_{x_j > x_i} w_j (x_j - x_i)``, and what goes out, ``D``, then are sums of positive
terms. Where a policy's rows have ``|U - D| <= e (U + D)``, and no row has more than that on the
better side, the numbers are the exact optimum of weights that differ by a share e at most, and the
matrix-tree theorem bounds what that means. Such numbers are found by iterative refinement
(Wilkinson 1963), and by policy iteration on these differences.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Floats, Integers
from jaxltl.core.sparse.graph.qualitative import forward_search
from jaxltl.core.sparse.linear.matrix_tree import System, share_of_values
from jaxltl.core.sparse.linear.topological_order import Edges

_ROUNDS = 30  # policies
_STEPS = 12  # of refinement, of one policy
_LEVELS = 0.0, 1e-10, 1e-5, 1.0, 16.0  # of the last step: values that differ by less may be one
_NOISE = 8  # times what a policy's own rows miss: gains below that are none
_LOOSE = 1e-9  # what they may miss where gains are believed
_MOST = 1e-3  # share up to which its powers are what is written for them

Solver = Callable[[Floats], Floats]


class Refined(NamedTuple):
    """Values ``float64[M]``, the share by which they may err, and the rows that attain them."""

    value: Floats
    share: float
    chosen: Integers
    rounds: int


def refined(
    system: System,
    unit: float,
    chosen: Integers,
    solver_of: Callable[[Integers], Solver | None],
    sign: int,
    tolerance: float,
) -> Refined | None:
    """The optimum of a system that every policy that counts leaves.

    Args:
      system: the equations.
      unit: the share by which their numbers, and the sums of a row, may err.
      chosen: ``int[M]``, a policy that surely ends.
      solver_of: what solves ``(I - P) x = b`` for a policy's rows P, roughly; None where it fails.
      sign: 1 for the largest, -1 for the smallest.
      tolerance: the share of error that is asked for.

    Returns:
      It, or None if it was not found.
    """
    rows = _Rows(system)
    for round_ in range(1, _ROUNDS + 1):
        solve = solver_of(chosen)
        pair = None if solve is None else _solution(rows, chosen, solve)
        if pair is None:
            return None
        best, better = None, None
        for level in _LEVELS:
            high, low = _levelled(pair, level)
            gap, scale = rows.balance(high, low)
            left = float(_share(gap[chosen], scale[chosen]))
            # What a row has more on the better side than rounding explains.
            ahead = sign * gap - max(2 * unit, _NOISE * left) * scale
            ahead[chosen] = 0
            if (ahead > 0).any():
                better = (ahead, sign * gap) if left <= _LOOSE or better is None else better
                continue
            found = _proven(system, unit, high, chosen, gap, scale, sign, round_)
            if found is not None and (best is None or found.share < best.share):
                best = found
                if found.share <= tolerance / 4:
                    break
        if best is not None or better is None:
            return best
        chosen = _switched(system.owner, chosen, *better)
    return None


def _switched(owner: Integers, chosen: Integers, ahead: Floats, gain: Floats) -> Integers:
    """The policy with the row that gains most, where one is ahead."""
    order = np.lexsort((-np.where(ahead > 0, gain, 0), owner))
    first = order[np.searchsorted(owner[order], np.arange(chosen.size))]
    return np.where(ahead[first] > 0, first, chosen)


def _share(gap: Floats, scale: Floats) -> float:
    """The largest gap as a share of its scale."""
    some = scale > 0
    return float((np.abs(gap[some]) / scale[some]).max(initial=0.0))


def _proven(
    system: System,
    unit: float,
    value: Floats,
    chosen: Integers,
    gap: Floats,
    scale: Floats,
    sign: int,
    rounds: int,
) -> Refined | None:
    """What the differences prove of a policy that surely ends."""
    over = np.maximum(sign * gap, 0)
    over[chosen] = np.abs(gap[chosen])
    share = share_of_values(_share(over, scale) + 2 * unit, chosen.size)
    own = system.matrix[chosen]
    back = Edges(own.indptr, own.indices).reverse()
    leaves = forward_search(back.start, back.target, system.leaving[chosen] > 0)
    if not share <= _MOST or not (value >= 0).all() or not leaves.all():
        return None
    return Refined(value, share, chosen, rounds)


class _Rows:
    """The entries of the rows, and how what comes in differs from what goes out."""

    def __init__(self, system: System):
        matrix = system.matrix
        self.known, self.leaving, self.owner = system.known, system.leaving, system.owner
        self.row = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
        self.of, self.target, self.weight = self.owner[self.row], matrix.indices, matrix.data

    def balance(self, high: Floats, low: Floats) -> tuple[Floats, Floats]:
        """``U - D`` and ``U + D`` of each row, from a value in two floats.

        Their rounding is a share of ``U + D`` that the unit covers: differences
        are right to two roundings, and a row has as many sums as terms.
        """
        apart = difference(high[self.target], low[self.target], high[self.of], low[self.of])
        flow = self.weight * apart
        count = self.known.size
        end = self.leaving * high[self.owner]
        gap = np.bincount(self.row, flow, count) + (self.known - end)
        return gap, np.bincount(self.row, np.abs(flow), count) + (self.known + end)


def difference(high: Floats, low: Floats, other: Floats, other_low: Floats) -> Floats:
    """``(high + low) - (other + other_low)``, to two roundings (Knuth's sums without error)."""
    large, rest = two_sum(high, -other)
    small, more = two_sum(low, -other_low)
    large, lost = two_sum(large, small)
    return large + (lost + (rest + more))


def two_sum(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


class _Pair(NamedTuple):
    """Values ``high + low``, and the last step that refinement took."""

    high: Floats
    low: Floats
    step: float


def _solution(rows: _Rows, chosen: Integers, solve: Solver) -> _Pair | None:
    """A policy's value in two floats."""
    with np.errstate(all="ignore"):
        high = solve(rows.known[chosen])
        found = _Pair(high, np.zeros_like(high), float(np.abs(high).max(initial=0)))
        for _ in range(_STEPS):
            more = solve(rows.balance(found.high, found.low)[0][chosen])
            step = float(np.abs(more).max(initial=0))
            if not step < found.step / 2:  # NaN is none either
                break
            high, lost = two_sum(found.high, more)
            found = _Pair(*two_sum(high, found.low + lost), step)
    return found if np.isfinite(found.high).all() else None


def _levelled(pair: _Pair, level: float) -> tuple[Floats, Floats]:
    """The values, of which those are made one that differ by rounding, for that is all of them."""
    high, low = pair.high, pair.low
    if not level:
        return high, low
    order = np.argsort(high, kind="stable")
    first, second = order[:-1], order[1:]
    apart = np.abs(difference(high[second], low[second], high[first], low[first]))
    apart = apart > level * pair.step
    begin = np.concatenate([[0], np.flatnonzero(apart) + 1])
    one = order[np.repeat(begin, np.diff(begin, append=order.size))]
    same = np.empty_like(order)
    same[order] = one
    return high[same], low[same]
