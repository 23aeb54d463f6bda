"""Certified block Gauss-Seidel value iteration for large models that mix well.

Where few steps lead anywhere, elimination fills and sweeps converge soon. Sweeps go through blocks
of states, each of which reads what those before it found; the slowest mode is extrapolated away
(Aitken 1926); single precision comes first, as half the memory moves. None of this is trusted: as
in :mod:`jaxltl.core.sparse.solvers.policy_iteration`, every step costs a small extra d, so that the
value found is one bound by one backup, and its policy attains the other one,
``v - sign d m t``, where m is a margin and t the expected time of the policy, truncated where it
stays for longer with probability at most 1/4.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Booleans, Floats, Integers, SparseMatrix
from jaxltl.core.sparse.rows import first_hits

T = TypeVar("T")
Values = NDArray[np.floating[Any]]  # in either precision

_EPS32 = float(np.finfo(np.float32).eps)
_LARGEST = 1e30  # numbers that single precision holds, with room for sums
_BLOCKS = 64  # blocks of a model, with
_MIN_BLOCK, _MAX_BLOCK = 2**14, 2**18  # at least and at most that many transitions
_COLUMNS = 16  # choices up to which an optimum over them is taken one by one
_TRIAL = 12  # sweeps after which convergence is judged,
_RECENT = 6  # by the last ones
_SHORTEST, _LONGEST = 3, 6  # sweeps between two extrapolations
_STEADY = 0.1  # relative change of the slowest mode's rate at which it is extrapolated
_SINGLE = 1e-6  # change, relative to the largest value, at which single precision ends
_ROUGH = 0.01  # and at which a first policy is read off
_STAYS = 0.25  # the largest probability to stay for longer than the truncated time
_STEPS = 300  # steps of the truncated time at most
_FINAL_CHANGE = 0.25  # of the extra cost: the change at which sweeps end
_MARGIN = 1.05  # of the proof
_PROOFS = 4  # attempts
_THREADS = 2**20  # transitions from which two blocks are swept at once


@dataclass(frozen=True)
class RowBlocks:
    """Rows in blocks of states, in both precisions."""

    row_start: Integers  # int[N + 1], the first row of each node, and R
    matrix: SparseMatrix  # SciPy's float64[R, M]
    node: list[int]  # the first node of each block, and N
    single: list[SparseMatrix]  # the rows of each block
    double: list[SparseMatrix]  # the same in double precision
    width: int  # the number of rows of every node; 0 where they differ


def row_blocks(
    row_start: Integers, entry_start: Integers, column: Integers, weight: Values, num_columns: int
) -> RowBlocks:
    """Splits rows with nonnegative weights ``float[T]`` into blocks."""
    from scipy import sparse

    size, entries = row_start.size - 1, int(entry_start[-1])
    entries_per_block = min(max(entries // _BLOCKS, _MIN_BLOCK), _MAX_BLOCK)
    first = entry_start[row_start]  # of each node
    node = np.unique(np.searchsorted(first, np.arange(0, entries, entries_per_block))).tolist()
    node = sorted({0, *node, size})
    single: list[SparseMatrix] = []
    double: list[SparseMatrix] = []
    for a, b in pairwise(node):
        start = entry_start[row_start[a] : row_start[b] + 1]
        part, index = slice(int(start[0]), int(start[-1])), start - start[0]
        shape = (index.size - 1, num_columns)
        for blocks, dtype in ((single, np.float32), (double, np.float64)):
            data = weight[part].astype(dtype, copy=False)
            blocks.append(sparse.csr_array((data, column[part], index), shape=shape))
    count = np.diff(row_start)
    same = size > 0 and bool((count == count[0]).all()) and count[0] <= _COLUMNS
    arrays = weight.astype(np.float64, copy=False), column, entry_start
    matrix = sparse.csr_array(arrays, shape=(entry_start.size - 1, num_columns))
    return RowBlocks(row_start, matrix, node, single, double, int(count[0]) if same else 0)


@dataclass(frozen=True)
class BlockProblem:
    """``x = opt_r (c_r + P_r y)`` on some nodes, where y is x or known."""

    blocks: RowBlocks  # the rows P; they sum to one at most, up to rounding
    interior: Booleans  # bool[N], nodes to solve for, which every policy that counts leaves
    live: Booleans  # bool[M], M >= N, columns that read the interior node of their number
    attained: Floats  # float64[M], >= 0, bound of the other columns, as of SweptBounds
    outer: Floats  # float64[M], >= 0, likewise
    cost: Floats | None = None  # float64[R], at least 0, or None for zero
    allowed: Booleans | None = None  # bool[R], the rows that may be taken; None for all


@dataclass(frozen=True)
class SweepSettings:
    """Settings of sweeps."""

    sign: int  # 1 to maximise, -1 to minimise
    tolerance: float  # the width of the bounds beyond that of the known values
    relative: bool  # True if the tolerance is a share of the value
    unit: float  # the relative rounding of one backup
    max_sweeps: int = 200


@dataclass(frozen=True)
class SweptBounds:
    """Bounds of the interior nodes."""

    attained: Floats  # float64[N], the bound that the rows attain
    outer: Floats  # float64[N], the other bound
    row: Integers  # int64[N]
    sweeps: int  # the number of sweeps
    time: float  # the longest truncated time of the policy


def solve_by_sweeps(
    problem: BlockProblem,
    settings: SweepSettings,
    start: Floats | None = None,
    time: float | None = None,
) -> SweptBounds | None:
    """Certified optimum by sweeps; None where they would take long, or prove too little."""
    cost = 0 if problem.cost is None else problem.cost.max()
    if max(problem.outer.max(initial=0), cost) > _LARGEST:
        return None
    with ThreadPoolExecutor(1) as pool:
        parallel = problem.blocks.matrix.nnz >= _THREADS
        search = _SweepSearch(problem, settings, pool if parallel else None)
        return _solve(search, start, None if settings.relative else time)


def _solve(search: _SweepSearch, start: Floats | None, time: float | None) -> SweptBounds | None:
    problem = search.problem
    value: Values = problem.outer.astype(np.float32)
    live = np.flatnonzero(problem.live)
    value[live] = 0 if start is None else start[live]
    if time is None:
        if not search.sweep(value, 0.0, _ROUGH):
            return None
        timed = search.truncated_time(search.chain(search.greedy(value)[1])[0])
        if timed is None:
            return None
        extra = search.extra_cost(value, timed[0])
    else:
        extra = search.extra_cost(value, np.full(1, time))
    if not search.sweep(value, extra, 0.0):
        return None
    value = np.where(problem.live, value, problem.outer)
    for _ in range(_PROOFS):
        proven = search.prove(value, extra) if search.sweep(value, extra, 0.0) else None
        if proven is None:
            return None
        width = search.excess(proven)
        if width <= 1:
            return proven
        extra *= 0.8 / width
    return None


@dataclass(frozen=True)
class _SweepBlock:
    """Nodes a to b: where the rows of each begin, their costs, and the rows that are not allowed."""

    a: int
    b: int
    begin: Integers
    cost: Floats | None
    barred: Booleans | None


@dataclass
class _SweepSearch:
    """Counted sweeps; two blocks at a time read the same values and then are written."""

    problem: BlockProblem
    settings: SweepSettings
    pool: Executor | None = None
    sweeps: int = 0
    parts: list[_SweepBlock] = field(default_factory=list)

    def __post_init__(self) -> None:
        problem, row_start = self.problem, self.problem.blocks.row_start
        for a, b in pairwise(problem.blocks.node):
            rows = slice(int(row_start[a]), int(row_start[b]))
            cost = None if problem.cost is None else problem.cost[rows]
            barred = None if problem.allowed is None else ~problem.allowed[rows]
            self.parts.append(_SweepBlock(a, b, row_start[a:b] - rows.start, cost, barred))

    @property
    def sign(self) -> int:
        return self.settings.sign

    def in_pairs(self, one: Callable[[int], T]) -> Iterator[list[tuple[int, T]]]:
        """Results for all blocks, for one of either half at a time."""
        half = (len(self.parts) + 1) // 2
        for i in range(half):
            if (j := i + half) == len(self.parts):
                yield [(i, one(i))]
            elif self.pool is None:
                yield [(i, one(i)), (j, one(j))]
            else:
                other = self.pool.submit(one, j)
                yield [(i, one(i)), (j, other.result())]

    def images(self, i: int, value: Values) -> Values:
        """``c + P y`` of a block's rows; the worst for rows that are not allowed."""
        part, blocks = self.parts[i], self.problem.blocks
        image: Values = (blocks.single if value.dtype == np.float32 else blocks.double)[i] @ value
        if part.cost is not None:
            image += part.cost
        if part.barred is not None:
            image[part.barred] = -self.sign * np.inf
        return image

    def best(self, i: int, image: Values) -> Values:
        """The optimum over the rows of each node of a block."""
        better, width = (np.maximum if self.sign > 0 else np.minimum), self.problem.blocks.width
        if not width:
            return better.reduceat(image, self.parts[i].begin)
        table = image.reshape(-1, width)
        optimum = table[:, 0].copy()
        for k in range(1, width):
            better(optimum, table[:, k], out=optimum)
        return optimum

    def sweep(self, value: Values, extra: float, rough: float) -> bool:
        """Sweeps in place until little changes; False where that would take too long."""
        kind = value.dtype.type
        shift = kind(self.sign * extra)
        before: Values | None = None
        rate, since, changes = 0.0, 0, []

        def one(i: int) -> Values:
            return self.best(i, self.images(i, value))

        while True:
            old = value.copy()
            for blocks in self.in_pairs(one):
                for i, optimum in blocks:
                    a, b = self.parts[i].a, self.parts[i].b
                    if extra:
                        optimum += shift
                    np.copyto(value[a:b], optimum, where=self.problem.live[a:b])
            change: Values = np.subtract(value, old, out=old)
            self.sweeps += 1
            largest = float(np.abs(change).max(initial=0))
            if not np.isfinite(largest):
                return False
            rough_or_single = max(rough, _SINGLE if kind is np.float32 else 0.0)
            goal = max(_FINAL_CHANGE * extra, rough_or_single * float(value.max(initial=0)))
            if largest <= goal:
                return True
            changes.append(largest)
            if self.is_hopeless(changes, goal):
                return False
            since += 1
            if before is not None:
                size = float(before @ before)
                new = float(change @ before) / size if size > 0 else 0.0
                steady = abs(new - rate) <= _STEADY * (1 - new)
                rate = new
                if 0 < new < 1 and (since >= _LONGEST or (since >= _SHORTEST and steady)):
                    value += change * kind(new / (1 - new))
                    since, before = 0, None
                    continue
            before = change

    def is_hopeless(self, changes: list[float], goal: float) -> bool:
        """True if there would be too many sweeps at the rate of the last ones."""
        max_sweeps = self.settings.max_sweeps
        if self.sweeps >= max_sweeps:
            return True
        if len(changes) < _TRIAL:
            return False
        rate = (changes[-1] / changes[-1 - _RECENT]) ** (1 / _RECENT)
        if rate >= 1:
            return len(changes) > 2 * _TRIAL
        return bool(self.sweeps + np.log(goal / changes[-1]) / np.log(rate) > 2 * max_sweeps)

    def greedy(self, value: Values) -> tuple[Values, Integers]:
        """The backup of a value that stays as it is, and the first row that attains it."""
        best = np.empty(self.problem.interior.size, value.dtype)
        row = np.empty(best.size, np.int64)

        def one(i: int) -> tuple[Values, Integers]:
            image = self.images(i, value)
            optimum = self.best(i, image)
            return optimum, _first(image, optimum, self.parts[i].begin, self.problem.blocks.width)

        for blocks in self.in_pairs(one):
            for i, (optimum, first) in blocks:
                a, b = self.parts[i].a, self.parts[i].b
                best[a:b], row[a:b] = optimum, self.problem.blocks.row_start[a] + first
        return np.where(self.problem.interior, best, 0), row

    def chain(self, row: Integers) -> tuple[SparseMatrix, Floats | None]:
        """The rows of a policy, and their costs."""
        cost = None if self.problem.cost is None else self.problem.cost[row]
        return self.problem.blocks.matrix[row], cost

    def truncated_time(self, chain: SparseMatrix) -> tuple[Values, float] | None:
        """Lower bound of a chain's expected time, and min ``t - P t``; None if it stays too long."""
        from scipy import sparse

        live = self.problem.live[: self.problem.interior.size]
        rows = sparse.csr_array(
            (chain.data.astype(np.float32), chain.indices, chain.indptr), shape=chain.shape
        )
        stays: Values = np.zeros(self.problem.live.size, np.float32)
        stays[: live.size] = live
        time: Values = np.zeros(self.problem.live.size, np.float32)
        for _ in range(_STEPS):
            time += stays
            stays[: live.size] = (rows @ stays) * live
            if stays.max(initial=0) <= _STAYS:
                ahead = time[: live.size] - rows @ time
                least = float(ahead[live].min(initial=1.0)) - 64 * _EPS32 * float(time.max())
                return (time, least) if least > 0.5 else None
        return None

    def extra_cost(self, value: Values, time: Values) -> float:
        """The extra cost of a step: what the tolerance allows, and more than rounding."""
        some = self.problem.live & (value > 0)
        size = float(value.max(initial=0))
        share = 1 / max(float(time.max(initial=1)), 1)
        if self.settings.relative:
            share = float((value[some] / time[some]).min(initial=np.inf))
            share = share if np.isfinite(share) else 1.0
        needed = (
            _MARGIN * (1 + _FINAL_CHANGE) / (1 - _STAYS) + 1
        )  # times the extra, between the bounds
        rounding = 32 * self.settings.unit * max(size, 1e-300)
        return max(0.9 * self.settings.tolerance * share / needed, rounding)

    def prove(self, value: Values, extra: float) -> SweptBounds | None:
        """The attained bound, the bound that is not exceeded, and the policy."""
        problem, sign, unit = self.problem, self.sign, self.settings.unit
        nodes = problem.interior.size
        live = problem.live[:nodes]
        best, row = self.greedy(value)
        slack = unit * (best + 2 * max(-float(value.min(initial=0)), 0.0))
        self.sweeps += 1
        if not (sign * best + slack <= sign * value[:nodes])[live].all():
            return None
        outer = np.where(live, value[:nodes], best + sign * slack)
        chain, cost = self.chain(row)
        timed = self.truncated_time(chain)
        if timed is None:
            return None
        time, least = timed
        known = self._known_width()
        loss = (
            _MARGIN
            * (extra * (1 + 2 * _FINAL_CHANGE) + 4 * unit * float(value.max(initial=0)))
            / least
        )
        attained = np.where(problem.live, value - sign * (loss * time + known), problem.attained)
        image = chain @ attained
        if cost is not None:
            image += cost
        slack = unit * (image + 2 * max(-float(attained.min(initial=0)), 0.0))
        if not (sign * attained[:nodes] <= sign * image - slack)[live].all():
            return None
        attained = np.where(live, attained[:nodes], image - sign * slack)
        return SweptBounds(attained, outer, row, self.sweeps, float(time.max(initial=0)))

    def excess(self, bounds: SweptBounds) -> float:
        """The width of bounds beyond that of the known values, in tolerances."""
        width = np.abs(bounds.outer - bounds.attained)[self.problem.interior] - self._known_width()
        if self.settings.relative:
            size = np.abs(bounds.attained if self.sign > 0 else bounds.outer)[self.problem.interior]
            width = width / np.maximum(size, 1e-300)
        return float(width.max(initial=0)) / self.settings.tolerance

    def _known_width(self) -> float:
        problem = self.problem
        return float(np.abs(problem.outer - problem.attained)[~problem.live].max(initial=0))


def _first(image: Values, best: Values, begin: Integers, width: int) -> Integers:
    """The first row of each node that attains its optimum, counted from the block's first row."""
    if width:
        table, rank = image.reshape(-1, width), np.zeros(best.size, np.int64)
        for k in range(width - 1, -1, -1):
            np.copyto(rank, k, where=table[:, k] == best)
        return begin + rank
    owner = np.repeat(np.arange(begin.size), np.diff(begin, append=image.size))
    return first_hits(image == best[owner], owner, np.array(begin, np.int64))
