"""Optimality equations beyond double precision: iterative refinement, GTH elimination, fractions.

Written as ``sum_j w_j (x_i - x_j) + l_i x_i = c_i``, without self-loops, an equation subtracts no
weights, and each policy's solution is a quotient of sums of products of the weights w, l and costs
c (matrix-tree theorem). Weights that err by a share e of themselves therefore change it by a share
of at most about ``2 n e`` for n unknowns, however long an episode may take (O'Cinneide 1993,
Entrywise perturbation theory and error analysis for Markov chains).

With values in two floats, differences are accurate in all their digits, and so are the inflow
``U = c + sum_{x_j > x_i} w_j (x_j - x_i)`` and the outflow ``D`` of a row, sums of positive terms.
If ``|U - D| <= e (U + D)`` for a policy's rows, and no row has more than that on the better side,
the values are the exact optimum for weights that differ by e, and the bound above applies.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Floats, Integers, SparseMatrix
from jaxltl.core.sparse.graph.components import forward_search
from jaxltl.core.sparse.linear.optimality_equation import OptimalityEquation
from jaxltl.core.sparse.linear.topological_order import Edges

_POLICIES = 30  # policies at most
_STEPS = 16  # refinements of one policy
_TIES = 0.0, 1e-10, 1e-5, 1.0, 16.0  # of the last step: values that differ by less may be equal
_NOISE = 8  # times the residual of a policy's own rows: smaller gains are rounding
_TRUSTED = 1e-9  # residual up to which gains are believed
MAX_SHARE = 1e-3  # up to which second-order terms are covered by `perturbation_bound`

_MAX_BAND, _MAX_WORK = 2**27, 4e9  # entries of a band, and its multiplications
MAX_FRACTIONS = 1000  # unknowns of a system in fractions
_OPERATIONS = 150_000  # on fractions, in one elimination
_BITS = 1024  # of a number, beyond which an operation counts as several
_FRACTION_POLICIES = 50

Solver = Callable[[Floats], Floats | None]


def perturbation_bound(share: float, num_unknowns: int) -> float:
    """Relative error of a solution if weights and costs err by a share: ``2.1 (n + 2)`` times it.

    The theorem's bound is ``((1 + e) / (1 - e))^n - 1`` for the weights and e for the costs; the
    factor covers its higher powers while the result is at most 1e-3.
    """
    return share * (2.1 * (num_unknowns + 2))


# --- two floats ---------------------------------------------------------------------------------


def two_sum(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """A sum and its rounding error (Knuth)."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


def two_float_difference(high: Floats, low: Floats, other: Floats, other_low: Floats) -> Floats:
    """``(high + low) - (other + other_low)`` to two roundings."""
    large, rest = two_sum(high, -other)
    small, more = two_sum(low, -other_low)
    large, lost = two_sum(large, small)
    return large + (lost + (rest + more))


class TwoFloats(NamedTuple):
    """Values ``high + low``, ``float64[M]`` each, and the size of their last refinement."""

    high: Floats
    low: Floats
    step: float = 0.0


def refine(
    solve: Solver, right: Floats, residual: Callable[[TwoFloats], Floats]
) -> TwoFloats | None:
    """Solution of a linear system in two floats, by iterative refinement (Wilkinson 1963)."""
    with np.errstate(all="ignore"):
        high = solve(right)
        if high is None:
            return None
        value = TwoFloats(high, np.zeros_like(high), float(np.abs(high).max(initial=0)))
        for _ in range(_STEPS):
            more = solve(residual(value))
            step = np.inf if more is None else float(np.abs(more).max(initial=0))
            if more is None or not step < value.step / 2:  # also if NaN
                break
            high, lost = two_sum(value.high, more)
            value = TwoFloats(*two_sum(high, value.low + lost), step)
    return value if np.isfinite(value.high).all() else None


@dataclass(frozen=True)
class RefinedOptimum:
    """Values ``float64[M]``, their relative error, and the policy, found after some policies."""

    value: Floats
    share: float
    policy: Integers
    num_policies: int


def refined_optimum(
    equation: OptimalityEquation,
    unit: float,
    policy: Integers,
    solver_of: Callable[[Integers], Solver | None],
    tolerance: float,
) -> RefinedOptimum | None:
    """Optimum by policy iteration on two-float values; None if it is not found."""
    rows = _RowFlows(equation)

    def residual_of_policy(x: TwoFloats) -> Floats:
        return rows.balance(x.high, x.low)[0][policy]

    for round_ in range(1, _POLICIES + 1):
        solve = solver_of(policy)
        if solve is None:
            return None
        pair = refine(solve, rows.cost[policy], residual_of_policy)
        if pair is None:
            return None
        best: RefinedOptimum | None = None
        better: tuple[Floats, Floats] | None = None
        for level in _TIES:
            high, low = _with_ties(pair, level)
            gap, scale = rows.balance(high, low)
            residual = _largest_share(gap[policy], scale[policy])
            # The excess on the better side beyond what rounding explains.
            ahead = equation.sign * gap - max(2 * unit, _NOISE * residual) * scale
            ahead[policy] = 0
            if (ahead > 0).any():
                if residual <= _TRUSTED or better is None:
                    better = ahead, equation.sign * gap
                continue
            over = np.maximum(equation.sign * gap, 0)
            over[policy] = np.abs(gap[policy])
            share = perturbation_bound(_largest_share(over, scale) + 2 * unit, policy.size)
            if share <= MAX_SHARE and (high >= 0).all() and _leaves(equation, policy):
                if best is None or share < best.share:
                    best = RefinedOptimum(high, share, policy, round_)
                if best.share <= tolerance / 4:
                    break
        if best is not None or better is None:
            return best
        policy = _improved(equation.owner, policy, *better)
    return None


def _improved(owner: Integers, policy: Integers, ahead: Floats, gain: Floats) -> Integers:
    """The policy with the row of largest gain, where one is ahead."""
    order = np.lexsort((-np.where(ahead > 0, gain, 0), owner))
    first = order[np.searchsorted(owner[order], np.arange(policy.size))]
    return np.where(ahead[first] > 0, first, policy)


def _largest_share(gap: Floats, scale: Floats) -> float:
    some = scale > 0
    return float((np.abs(gap[some]) / scale[some]).max(initial=0.0))


def _leaves(equation: OptimalityEquation, policy: Integers) -> bool:
    """True if a policy leaves from everywhere."""
    own = equation.matrix[policy]
    back = Edges(own.indptr, own.indices).reverse()
    return bool(forward_search(back.start, back.target, equation.leaving[policy] > 0).all())


class _RowFlows:
    """Inflow and outflow of each row."""

    def __init__(self, equation: OptimalityEquation) -> None:
        matrix = equation.matrix
        self.cost, self.leaving, self.owner = equation.cost, equation.leaving, equation.owner
        self.row = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
        self.source, self.target = self.owner[self.row], matrix.indices
        self.weight = matrix.data

    def balance(self, high: Floats, low: Floats) -> tuple[Floats, Floats]:
        """``U - D`` and ``U + D``; their rounding is a share of ``U + D`` that the unit covers."""
        source, target, count = self.source, self.target, self.cost.size
        flow = self.weight * two_float_difference(
            high[target], low[target], high[source], low[source]
        )
        end = self.leaving * high[self.owner]
        gap = np.bincount(self.row, flow, count) + (self.cost - end)
        return gap, np.bincount(self.row, np.abs(flow), count) + (self.cost + end)


def _with_ties(pair: TwoFloats, level: float) -> tuple[Floats, Floats]:
    """The values, made equal where they differ by less than a level of the last refinement."""
    high, low = pair.high, pair.low
    if not level:
        return high, low
    order = np.argsort(high, kind="stable")
    first, second = order[:-1], order[1:]
    apart = np.abs(two_float_difference(high[second], low[second], high[first], low[first]))
    begin = np.concatenate([[0], np.flatnonzero(apart > level * pair.step) + 1])
    same = np.empty_like(order)
    same[order] = order[np.repeat(begin, np.diff(begin, append=order.size))]
    return high[same], low[same]


# --- elimination without subtractions -----------------------------------------------------------


def gth_solver(matrix: SparseMatrix, leaving: Floats) -> Solver | None:
    """Solver of ``(D - W) x = b`` for ``D = sum_j W_ij + l_i`` in a band; None if that is too large.

    Each pivot is the sum of the weights that remain (Grassmann, Taksar and Heyman 1985), so that its
    relative error does not grow with the length of episodes. None also if some state is never left.
    """
    from scipy.sparse import csgraph

    size = leaving.size
    both = (matrix + matrix.T).tocsr()
    order = csgraph.reverse_cuthill_mckee(both, symmetric_mode=True)
    place = np.empty(size, np.int64)
    place[order] = np.arange(size)
    row = place[np.repeat(np.arange(size), np.diff(matrix.indptr))]
    column = place[matrix.indices]
    width = max(int(np.abs(row - column).max(initial=0)), 1)
    if size * (2 * width + 1) > _MAX_BAND or size * float(width) ** 2 > _MAX_WORK:
        return None
    # Row i of the band holds the columns from i - width to i + width.
    flat = np.zeros(size * (2 * width + 1))
    flat[width + 2 * width * row + column] = matrix.data
    step = flat.itemsize
    band = np.lib.stride_tricks.as_strided(
        flat[width:], (size, size), (2 * width * step, step), writeable=True
    )
    total, out = np.empty(size), leaving[order].astype(np.float64)
    first = np.maximum(np.arange(size) - width, 0).tolist()
    for k in reversed(range(size)):
        earlier = slice(first[k], k)
        total[k] = band[k, earlier].sum() + out[k]
        if not total[k] > 0:
            return None
        share = band[earlier, k]
        share /= total[k]
        band[earlier, earlier] += share[:, None] * band[k, earlier]
        out[earlier] += share * out[k]

    def solve(b: Floats) -> Floats:
        x = b[order]
        for k in reversed(range(size)):
            x[first[k] : k] += band[first[k] : k, k] * x[k]
        for k in range(size):
            x[k] = (x[k] + band[k, first[k] : k] @ x[first[k] : k]) / total[k]
        result: Floats = x[place]
        return result

    return solve


# --- fractions ----------------------------------------------------------------------------------


def exact_optimum(
    equation: OptimalityEquation, policy: Integers, order: Integers
) -> tuple[Floats, Integers] | None:
    """Optimum in fractions by policy iteration, rounded to floats; None if it takes too long."""
    rows = [_fraction_row(equation, r) for r in range(equation.owner.size)]
    owner, policy = equation.owner.tolist(), np.array(policy)
    for _ in range(_FRACTION_POLICIES):
        value = _eliminated([rows[r] for r in policy.tolist()], order.tolist())
        if value is None:
            return None
        gain: dict[int, tuple[Fraction, int]] = {}
        for r, (row, i) in enumerate(zip(rows, owner, strict=True)):
            if row.total:
                ahead = row.cost + sum(w * value[j] for j, w in row.weights.items())
                more = equation.sign * (ahead / row.total - value[i])
                if more > 0 and (i not in gain or more > gain[i][0]):
                    gain[i] = more, r
        if not gain:
            return np.array([float(x) for x in value]), policy
        for node, (_, r) in gain.items():
            policy[node] = r
    return None


@dataclass(frozen=True)
class _FractionRow:
    total: Fraction
    cost: Fraction
    weights: dict[int, Fraction]


def _fraction_row(equation: OptimalityEquation, row: int) -> _FractionRow:
    matrix = equation.matrix
    span = slice(matrix.indptr[row], matrix.indptr[row + 1])
    pairs = zip(matrix.indices[span].tolist(), matrix.data[span].tolist(), strict=True)
    weights = {j: Fraction(w) for j, w in pairs}
    total = Fraction(float(equation.leaving[row])) + sum(weights.values())
    return _FractionRow(total, Fraction(float(equation.cost[row])), weights)


def _eliminated(rows: list[_FractionRow], order: list[int]) -> list[Fraction] | None:
    """Solution by elimination of one unknown after the other."""
    size, done = len(rows), 0
    weights = [dict(row.weights) for row in rows]
    total, cost = [row.total for row in rows], [row.cost for row in rows]
    into: list[set[int]] = [set() for _ in range(size)]
    for i, row in enumerate(weights):
        for j in row:
            into[j].add(i)
    for k in reversed(order):
        pivot = weights[k]
        for j in pivot:
            into[j].discard(k)
        if not total[k]:
            return None  # never left
        for i in into[k]:
            share = weights[i].pop(k) / total[k]
            cost[i] += share * cost[k]
            for j, w in pivot.items():
                if j == i:
                    total[i] -= share * w
                else:
                    weights[i][j] = weights[i].get(j, Fraction(0)) + share * w
                    into[j].add(i)
            done += (len(pivot) + 1) * (1 + share.denominator.bit_length() // _BITS)
            if done > _OPERATIONS:
                return None
    value = [Fraction(0)] * size
    for k in order:
        value[k] = (cost[k] + sum(w * value[j] for j, w in weights[k].items())) / total[k]
    return value
