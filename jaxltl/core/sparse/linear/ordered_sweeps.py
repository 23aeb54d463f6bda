"""Gauss-Seidel value iteration by distance from the exits, and bounds certified by flow balance.

This is the fallback where elimination fills, Krylov methods stagnate, or some policies stay for so
long that an extra cost per step decides nothing (a battery that is charged again and again). States
are swept in the order of their distance from those that leave, so that a sweep carries values
through a whole episode.

A row ``sum_j w_j (x_i - x_j) + l_i x_i = c_i`` has the inflow ``U = c + sum_{x_j > x_i} w_j (x_j -
x_i)`` and the outflow D, the other terms. Both are sums of nonnegative terms, accurate to a few
roundings of themselves. Values that rise until no row of a maximum has ``U - D > e (U + D)`` satisfy
``x >= c' + P' x`` for all rows of a problem with weights and costs that differ by a share e. They
are at least its optimum, which differs from the optimum by the share of
:func:`~jaxltl.core.sparse.linear.extended_precision.perturbation_bound`, however long policies may
stay (O'Cinneide 1993). The bound that a policy attains is the mirror image, on its rows. The values
from which this starts need not be trusted: optimistic value iteration (Hartmanns and Kaminski 2020).
"""

from __future__ import annotations

from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Floats, Integers, SparseMatrix
from jaxltl.core.sparse.linear.extended_precision import MAX_SHARE, perturbation_bound
from jaxltl.core.sparse.rows import concatenated_ranges, first_hits, positions

_EPS = float(np.finfo(np.float64).eps)
_MIN_BLOCK = 256  # states of a block, so that the overhead of NumPy's calls is small
_BLOCK_OVERHEAD = 6000  # transitions that take as long as that overhead
_MAX_WORK, _MAX_SWEEPS = 1e10, 5000  # transitions read by a sequence of sweeps, and sweeps
_RECENT, _TRIAL = 4, 120  # sweeps by which the rate is judged, and after which that may end them
_UNDERFLOW = 1e-290  # products that underflow, in up to 10^30 expected steps
_CLOSE = 1e-14  # relative accuracy that values should have before they are settled
_TIME_ACCURACY = 0.1  # relative error of expected times that decide between equal choices
_SETTLED, _SETTLE_WORK = 60, 2e7  # sweeps, or transitions, after which values should be settled


class CostRows(NamedTuple):
    """Rows ``c_r + P_r x`` of an optimality equation, with their probabilities of leaving."""

    matrix: SparseMatrix  # SciPy's float64[R, M], without self-loops
    cost: Floats  # float64[R], at least 0
    leaving: Floats  # float64[R]
    owner: Integers  # int[R], the unknown of each row

    def only(self, row: Integers) -> CostRows:
        """Some of the rows."""
        return CostRows(self.matrix[row], self.cost[row], self.leaving[row], self.owner[row])


def short_policy(sweeps: OrderedSweeps, rows: CostRows, value: Floats) -> Integers:
    """Rows ``int[M]`` that are optimal up to rounding and leave in the least expected time.

    Where values differ by rounding only, the optimal rows alone might stay nearly for ever.
    """
    optimal = sweeps.optimal_rows(value)
    if optimal.size == value.size:
        return optimal[np.argsort(rows.owner[optimal])]
    some = rows.only(optimal)._replace(cost=np.ones(optimal.size))
    times = OrderedSweeps(some, -1, sweeps.unit, relative=True)
    return optimal[times.greedy(times.converge(np.zeros(value.size), _TIME_ACCURACY)[0])]


def start_from_above(rows: CostRows, unit: float, accuracy: float) -> Floats | None:
    """Values ``float64[M]`` of a policy that leaves soon, if sweeps find them.

    Sweeps of a minimum from zero may end at values that only policies seem to have that wait nearly
    for ever; from these values they do not.
    """
    timed = OrderedSweeps(rows._replace(cost=np.ones(rows.cost.size)), -1, unit, relative=True)
    times, error = timed.converge(np.zeros(rows.matrix.shape[1]), _TIME_ACCURACY)
    if not error <= _TIME_ACCURACY:
        return None
    chain = OrderedSweeps(rows.only(timed.greedy(times)), 1, unit, relative=False)
    value, error = chain.converge(np.zeros(times.size), accuracy)
    return value if error <= accuracy else None


class OrderedSweeps:
    """Sweeps over the states of an equation in the order of their distance from the exits.

    Arguments and results are in the equation's order.
    """

    def __init__(self, rows: CostRows, sign: int, unit: float, relative: bool) -> None:
        from scipy import sparse

        self.sign, self.unit, self.relative = sign, unit, relative
        matrix = rows.matrix
        self.order, layers, self.stuck = _by_distance(rows)
        place = positions(self.order, self.order.size)
        owner = place[rows.owner]
        self.row = np.argsort(owner, kind="stable")
        self.owner = owner[self.row]
        count = np.bincount(owner, minlength=self.order.size)
        self.row_start = np.concatenate([[0], count.cumsum()])
        width = np.diff(matrix.indptr)[self.row]
        entry = concatenated_ranges(matrix.indptr[self.row], width)
        self.entry_start = np.concatenate([[0], width.cumsum()])
        self.target, self.weight = place[matrix.indices[entry]], matrix.data[entry]
        self.cost, self.leaving = rows.cost[self.row], rows.leaving[self.row]
        shape = (self.row.size, self.order.size)
        arrays = self.weight, self.target, self.entry_start
        self.matrix: SparseMatrix = sparse.csr_array(arrays, shape=shape)
        self.start = _merged(layers)
        self.blocks: list[SparseMatrix] = []
        for a, b in pairwise(self.row_start[self.start].tolist()):
            first = self.entry_start[a : b + 1]
            span = slice(int(first[0]), int(first[-1]))
            arrays = self.weight[span], self.target[span], first - first[0]
            self.blocks.append(sparse.csr_array(arrays, shape=(b - a, self.order.size)))
        self.sweep_work = self.weight.size + _BLOCK_OVERHEAD * len(self.blocks)
        self.num_sweeps = 0

    @cached_property
    def back(self) -> SparseMatrix:
        """Rows that lead to each state, by columns."""
        return self.matrix.tocsc()

    def sweep(self, value: Floats) -> None:
        """Replaces all values by the optimum over their rows, in place, block after block."""
        better = np.maximum if self.sign > 0 else np.minimum
        rows = self.row_start[self.start].tolist()
        for k, (a, b) in enumerate(pairwise(self.start.tolist())):
            image = self.blocks[k] @ value
            image += self.cost[rows[k] : rows[k + 1]]
            begin = self.row_start[a:b] - rows[k]
            value[a:b] = image if b - a == image.size else better.reduceat(image, begin)
        self.num_sweeps += 1

    def converge(self, start: Floats, accuracy: float) -> tuple[Floats, float]:
        """Values after sweeps from some others, and their estimated error.

        Errors are relative to each value, or to the largest one.
        """
        value, error = start[self.order], np.inf
        changes, steps = [0.0], [0.0]  # largest changes, relative and absolute
        max_sweeps = min(_MAX_SWEEPS, max(int(_MAX_WORK / self.sweep_work), 2 * _TRIAL))
        for k in range(1, max_sweeps + 1):
            old = value.copy()
            self.sweep(value)
            np.abs(np.subtract(value, old, out=old), out=old)
            steps.append(float(old.max(initial=0)))
            old /= np.maximum(value if self.relative else value.max(initial=0), 1e-290)
            changes.append(float(old.max(initial=0)))
            if not np.isfinite(changes[-1]):
                return start, np.inf
            if changes[-1] <= 4 * _EPS:
                return self._restored(value), changes[-1]
            if k <= _RECENT:
                continue
            rate = (changes[-1] / changes[-1 - _RECENT]) ** (1 / _RECENT)
            error = changes[-1] / (1 - rate) if rate < 1 else np.inf
            if error <= accuracy:
                break
            if k >= _TRIAL:
                rate = (steps[-1] / steps[-1 - _TRIAL // 2]) ** (2 / _TRIAL)
                if rate >= 1 or rate ** (2 * (max_sweeps - k)) * error > accuracy:
                    break
        return self._restored(value), error

    def bound(self, value: Floats, direction: int, margins: tuple[float, ...]) -> Floats | None:
        """Upper bound (`direction` 1) or lower one (-1) of all rows near some values, or None.

        It differs by one of the margins, relative or absolute, if the values are close to the optimum.
        """
        share = perturbation_bound(3 * self.unit, value.size)
        if share > MAX_SHARE or self.stuck or not np.isfinite(value).all():
            return None
        for accuracy in (None, _CLOSE):
            # Values settle fast only if they are as near to the optimum as rounding allows.
            value = value if accuracy is None else self.converge(value, accuracy)[0]
            start = value[self.order]
            for margin in filter(np.isfinite, margins):
                moved = (
                    start * (1 + direction * margin)
                    if self.relative
                    else start + direction * margin
                )
                moved = np.maximum(moved, 0)
                if self._settle(moved, direction):
                    moved = moved * (1 + direction * share) + direction * _UNDERFLOW
                    return self._restored(np.maximum(moved, 0))
        return None

    def monotone_bound(self, direction: int, num_sweeps: int) -> Floats:
        """Upper bound (`direction` 1) or lower one by sweeps from trivial ones."""
        value = np.zeros(self.order.size)
        if direction > 0:
            if self.stuck or ((self.leaving == 0) & (self.cost > 0)).any():
                return np.full(value.size, np.inf)
            some = self.leaving > 0
            value += (self.cost[some] / self.leaving[some]).max(initial=0) * (1 + 4 * self.unit)
        for _ in range(num_sweeps):
            self.sweep(value)
        # All terms are nonnegative, so that relative errors add up over the sums behind a value.
        share = self.unit * (num_sweeps + 2) * len(self.blocks)
        value = value * (1 + direction * 1.01 * share) + direction * _UNDERFLOW
        return self._restored(np.maximum(value, 0))

    def tightened(self, bound: Floats | None, direction: int, num_sweeps: int) -> Floats:
        """The tighter one of a bound and the one by some sweeps."""
        swept = self.monotone_bound(direction, num_sweeps)
        if bound is None:
            return swept
        tighter: Floats = (np.minimum if direction > 0 else np.maximum)(bound, swept)
        return tighter

    def greedy(self, value: Floats) -> Integers:
        """The first optimal row of each state, as a row of the equation, ``int[M]``."""
        value = value[self.order]
        _, loss = self._losses(value)
        policy = np.empty(value.size, np.int64)
        policy[self.order] = self.row[first_hits(loss == 0, self.owner, self.row_start[:-1])]
        return policy

    def _losses(self, value: Floats) -> tuple[Floats, Floats]:
        """The optimum of each state over its rows, and the loss of each row."""
        image = self.matrix @ value + self.cost
        better = np.maximum if self.sign > 0 else np.minimum
        best = better.reduceat(image, self.row_start[:-1])
        return best, self.sign * (best[self.owner] - image)

    def optimal_rows(self, value: Floats) -> Integers:
        """The rows of the equation that are optimal up to rounding."""
        best, loss = self._losses(value[self.order])
        return np.sort(self.row[loss <= self.unit * np.abs(best)[self.owner]])

    def _restored(self, value: Floats) -> Floats:
        """Values in the order of the equation."""
        restored = np.empty_like(value)
        restored[self.order] = value
        return restored

    def _rows_to(self, states: Integers) -> Integers:
        """The rows that lead to some states, in ascending order."""
        start = self.back.indptr[states]
        entry = concatenated_ranges(start, self.back.indptr[states + 1] - start)
        rows: Integers = np.unique(self.back.indices[entry])
        return rows

    def _settle(self, value: Floats, direction: int) -> bool:
        """Moves values in one direction until all rows balance, in place; False if that is slow."""
        dirty = np.ones(value.size, bool)
        work, rounds = 0.0, 0
        while dirty.any():
            rounds += 1
            for a, b in pairwise(self.start.tolist()):
                state = a + np.flatnonzero(dirty[a:b])
                if not state.size:
                    continue
                dirty[state] = False
                moved, entries = self._move(value, state, direction, rounds)
                work += 8 * entries + 4 * _BLOCK_OVERHEAD
                if moved.size:
                    dirty[self.owner[self._rows_to(moved)]] = True
                    dirty[moved] = True
            if (
                work > max(_SETTLED * 8 * self.sweep_work, _SETTLE_WORK)
                or not np.isfinite(value).all()
            ):
                return False
        return True

    def _move(
        self, value: Floats, state: Integers, direction: int, rounds: int
    ) -> tuple[Integers, int]:
        """Moves values of states with a row out of balance: these states, and the entries read."""
        count = self.row_start[state + 1] - self.row_start[state]
        row = concatenated_ranges(self.row_start[state], count)
        width = self.entry_start[row + 1] - self.entry_start[row]
        entry = concatenated_ranges(self.entry_start[row], width)
        of = np.repeat(np.arange(row.size), width)
        own, after = np.repeat(value[state], count), value[self.target[entry]]
        flow = self.weight[entry] * (after - own[of])
        cost, leaving = self.cost[row], self.leaving[row]
        end = leaving * own
        gap = direction * (np.bincount(of, flow, row.size) + (cost - end))
        scale = np.bincount(of, np.abs(flow), row.size) + (cost + end)
        ahead = gap > self.unit * scale
        if not ahead.any():
            return state[:0], entry.size
        optimum = np.maximum if direction > 0 else np.minimum
        # No value passes all those that its row leads to, so that they do not chase each other.
        limit = np.full(row.size, -direction * np.inf)
        some = np.flatnonzero(width)
        limit[some] = optimum.reduceat(after, (width.cumsum() - width)[some])
        with np.errstate(all="ignore"):
            outside = np.where(leaving > 0, cost / leaving * (1 + 4 * direction * _EPS), np.inf)
        ends = (cost > 0) | (leaving > 0)
        limit[ends] = optimum(limit[ends], outside[ends])
        # More than the rounding, increasingly, so that the values settle.
        moved = np.nextafter(own + direction * (gap + rounds * _EPS * own), direction * np.inf)
        moved = np.minimum(moved, limit) if direction > 0 else np.maximum(moved, limit)
        new = value[state]
        optimum.at(new, np.repeat(np.arange(state.size), count)[ahead], moved[ahead])
        new = np.maximum(new, 0)
        changed = new != value[state]
        value[state] = new
        return state[changed], entry.size


def _by_distance(rows: CostRows) -> tuple[Integers, Integers, bool]:
    """The states by distance from those that leave, the starts of layers, and if some never leave."""
    from scipy import sparse
    from scipy.sparse import csgraph

    matrix, size = rows.matrix, rows.matrix.shape[1]
    source = np.repeat(rows.owner, np.diff(matrix.indptr))
    exits = np.unique(rows.owner[rows.leaving > 0])
    begin = np.concatenate([matrix.indices, np.full(exits.size, size)])
    end = np.concatenate([source, exits])
    ones = np.ones(begin.size, np.int8)
    graph = sparse.coo_array((ones, (begin, end)), shape=(size + 1, size + 1)).tocsr()
    graph.data[:] = 1
    order, before = csgraph.breadth_first_order(graph, size)
    place = positions(order, size + 1)
    parent = place[before[order[1:]]]  # ascending
    starts = [1]
    while starts[-1] < order.size:
        # A layer ends before the first state whose predecessor is in it.
        starts.append(1 + int(np.searchsorted(parent, starts[-1])))
    stuck = np.flatnonzero(place[:-1] < 0)
    layers = np.array([*starts, size + 1] if stuck.size else starts) - 1
    return np.concatenate([order[1:], stuck]).astype(np.int64), layers, stuck.size > 0


def _merged(starts: Integers) -> Integers:
    """Starts of blocks of whole layers that are not too small."""
    kept, end = [0], int(starts[-1])
    for s in starts.tolist():
        if s - kept[-1] >= _MIN_BLOCK and end - s >= _MIN_BLOCK:
            kept.append(s)
    return np.array([*kept, end])
