"""Optimal sums of large models that mix well, by sweeps in place (Gauss and Seidel), proven.

Where states lead anywhere within few steps, elimination fills, and sweeps converge soon. They go
through blocks of states, each of which reads what those before it found; what is left of the
slowest mode is extrapolated away (Aitken 1926). Single precision comes first, as half the memory
moves. None of this is trusted: every step costs a little more than it does, so that the value that
is found is a bound by one application of the operator, and its policy attains a bound that the time
proves for which it stays at least.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Booleans, Floats, Integers

Values = NDArray[np.floating[Any]]  # in either precision

_EPS32 = float(np.finfo(np.float32).eps)
_LARGEST = 1e30  # numbers that single precision holds, with room for sums
_BLOCKS = 64  # into how many blocks a model is cut, where these have
_LEAST, _MOST = 2**14, 2**18  # so many transitions at least, and at most
_COLUMNS = 16  # choices up to which an optimum over them is taken one by one
_TRIAL = 12  # sweeps after which it is judged how many it will take,
_RECENT = 6  # by the last ones
_SHORTEST, _LONGEST = 3, 6  # sweeps from one extrapolation to the next
_STEADY = 0.1  # how much the rate of the slowest mode may change then, as a share of what it lacks
_SINGLE = 1e-6  # as a share of the largest value: what single precision still finds
_ROUGH = 0.01  # and what is left when a policy tells how long it stays
_STAYS = 0.25  # the largest probability to stay for longer than the time that is counted
_STEPS = 300  # steps that are counted at most
_LEFT = 0.25  # of the extra cost: what sweeps leave
_MARGIN = 1.05  # by which a proof has more than it needs
_PROOFS = 4  # that are tried
_THREADS = 2**20  # transitions from which two blocks are swept at once


class RowBlocks(NamedTuple):
    """Rows in blocks of states, in both precisions.

    Attributes:
      row_start: ``int[N + 1]``, the first row of each node, and R.
      matrix: ``float64[R, M]``, SciPy's.
      node: where blocks of nodes begin, and N.
      single, double: the rows of each block.
      width: rows of every node; 0 where they differ.
    """

    row_start: Integers
    matrix: Any
    node: list[int]
    single: list[Any]
    double: list[Any]
    width: int


class BlockProblem(NamedTuple):
    """``x = opt_r (cost_r + P_r y)`` on some nodes, where y is x or what is known.

    Attributes:
      cut: the rows P; they sum to one at most, up to rounding.
      open: ``bool[N]``, the nodes to solve for. Every policy that counts leaves them.
      live: ``bool[M]``, the columns that read the open node of their number; M is N at least.
      near, far: ``float64[M]``, at least 0: bounds of what the others read, `near` is attained.
      cost: ``float64[R]``, at least 0, or None for nothing.
      rows: ``bool[R]``, the rows that may be taken; default all.
    """

    cut: RowBlocks
    open: Booleans
    live: Booleans
    near: Floats
    far: Floats
    cost: Floats | None = None
    rows: Booleans | None = None


class SweptBounds(NamedTuple):
    """What was found and proven; of nodes that are not open it says nothing.

    Attributes:
      near: ``float64[N]``, the bound that the rows attain: of a maximum the lower one.
      far: ``float64[N]``, the one on the other side.
      row: ``int64[N]``.
      sweeps: how many there were.
      time: the longest time for which its policy was counted to stay.
    """

    near: Floats
    far: Floats
    row: Integers
    sweeps: int
    time: float


def row_blocks(
    row_start: Integers, entry_start: Integers, column: Integers, weight: Floats, columns: int
) -> RowBlocks:
    """Rows, cut into blocks.

    Args:
      row_start: ``int[N + 1]``.
      entry_start: ``int[R + 1]``.
      column: ``int32[T]``.
      weight: ``float[T]``, not negative.
      columns: M.
    """
    from scipy import sparse

    size, entries = row_start.size - 1, int(entry_start[-1])
    most = min(max(entries // _BLOCKS, _LEAST), _MOST)
    first = entry_start[row_start]  # of each node
    node = np.unique(np.searchsorted(first, np.arange(0, entries, most))).tolist()
    node = sorted({0, *node, size})
    single: list[Any] = []
    double: list[Any] = []
    for a, b in pairwise(node):
        start = entry_start[row_start[a] : row_start[b] + 1]
        part, index = slice(int(start[0]), int(start[-1])), start - start[0]
        shape = (index.size - 1, columns)
        for found, dtype in ((single, np.float32), (double, np.float64)):
            data = weight[part].astype(dtype, copy=False)
            found.append(sparse.csr_array((data, column[part], index), shape=shape))
    count = np.diff(row_start)
    same = size > 0 and bool((count == count[0]).all()) and count[0] <= _COLUMNS
    matrix = sparse.csr_array(
        (weight.astype(np.float64, copy=False), column, entry_start),
        shape=(entry_start.size - 1, columns),
    )
    return RowBlocks(row_start, matrix, node, single, double, int(count[0]) if same else 0)


def solve_by_sweeps(
    sums: BlockProblem,
    *,
    sign: int,
    tolerance: float,
    relative: bool,
    unit: float,
    start: Floats | None = None,
    time: float | None = None,
    most: int = 150,
) -> SweptBounds | None:
    """The optimal sums by sweeps.

    Args:
      sums: what is asked.
      sign: 1 for the largest, -1 for the smallest, which needs that what stays for ever costs
        infinitely much.
      tolerance: how far apart the bounds may be, more than those of what is known are.
      relative: whether that is a share of the value.
      unit: the relative rounding of one application of a row.
      start: ``float[N]``, a first guess.
      time: and one of how long a policy stays, unless the tolerance is relative.
      most: sweeps at most.

    Returns:
      The bounds; None where sweeps would take longer, or too little could be proven.
    """
    if max(sums.far.max(initial=0), 0 if sums.cost is None else sums.cost.max()) > _LARGEST:
        return None
    with ThreadPoolExecutor(1) as pool:
        many = sums.cut.matrix.nnz >= _THREADS
        search = _Search(sums, sign, unit, most, pool if many else None)
        return _relaxed(search, tolerance, relative, start, time)


def _relaxed(
    search: _Search, tolerance: float, relative: bool, start: Floats | None, time: float | None
) -> SweptBounds | None:
    sums = search.sums
    value: Any = sums.far.astype(np.float32)
    live = np.flatnonzero(sums.live)
    value[live] = 0 if start is None else start[live]
    if time is None or relative:
        if not search.sweep(value, 0.0, _ROUGH):
            return None
        found = search.staying(search.chain(search.look(value)[1])[0])
        if found is None:
            return None
        extra = search.extra(value, found[0], tolerance, relative)
    else:
        extra = search.extra(value, np.full(1, time), tolerance, relative)
    if not search.sweep(value, extra, 0.0):
        return None
    value = np.where(sums.live, value, sums.far)
    for _ in range(_PROOFS):
        proven = search.prove(value, extra) if search.sweep(value, extra, 0.0) else None
        if proven is None:
            return None
        width = search.excess(proven, tolerance, relative)
        if width <= 1:
            return proven
        extra *= 0.8 / width
    return None


@dataclass
class _Search:
    """Sweeps, which are counted. Two blocks at a time read the same and then are written."""

    sums: BlockProblem
    sign: int
    unit: float
    most: int
    pool: Executor | None = None
    sweeps: int = 0
    left: float = 0.0  # what the last one changed
    parts: list[Any] = field(default_factory=list)

    def __post_init__(self) -> None:
        sums, node = self.sums, self.sums.cut.node
        for a, b in pairwise(node):
            first, last = int(sums.cut.row_start[a]), int(sums.cut.row_start[b])
            begin = sums.cut.row_start[a:b] - first
            cost = None if sums.cost is None else sums.cost[first:last]
            barred = None if sums.rows is None else ~sums.rows[first:last]
            self.parts.append((a, b, begin, cost, barred))

    def in_pairs(self, one: Callable[[int], Any]) -> Iterator[list[tuple[int, Any]]]:
        """What is found of each block, of one in either half at a time."""
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
        """What the rows of a block lead to; of those that may not be taken the worst."""
        *_, cost, barred = self.parts[i]
        blocks = self.sums.cut.single if value.dtype == np.float32 else self.sums.cut.double
        image = blocks[i] @ value
        if cost is not None:
            image += cost
        if barred is not None:
            image[barred] = -self.sign * np.inf
        return image

    def best(self, i: int, image: Values) -> Values:
        """The optimum over the rows of each node of a block."""
        better, width = (np.maximum if self.sign > 0 else np.minimum), self.sums.cut.width
        if not width:
            return better.reduceat(image, self.parts[i][2])
        table = image.reshape(-1, width)
        found = table[:, 0].copy()
        for k in range(1, width):
            better(found, table[:, k], out=found)
        return found

    def sweep(self, value: Values, extra: float, rough: float) -> bool:
        """Sweeps until little changes; False where that takes too long."""
        kind = value.dtype.type
        shift = kind(self.sign * extra)
        before: Any = None
        rate, since, worst = 0.0, 0, []

        def one(i: int) -> Values:
            return self.best(i, self.images(i, value))

        while True:
            old = value.copy()
            for blocks in self.in_pairs(one):
                for i, found in blocks:
                    a, b, *_ = self.parts[i]
                    if extra:
                        found += shift
                    np.copyto(value[a:b], found, where=self.sums.live[a:b])
            change: Any = np.subtract(value, old, out=old)
            self.sweeps += 1
            self.left = float(np.abs(change).max(initial=0))
            if not np.isfinite(self.left):
                return False
            goal = max(_LEFT * extra, rough * float(value.max(initial=0)))
            if kind is np.float32:
                goal = max(goal, _SINGLE * float(value.max(initial=0)))
            if self.left <= goal:
                return True
            worst.append(self.left)
            if self.hopeless(worst, goal):
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

    def hopeless(self, worst: list[float], goal: float) -> bool:
        """Whether at the rate of the last sweeps there would be too many."""
        if self.sweeps >= self.most:
            return True
        if len(worst) < _TRIAL:
            return False
        rate = (worst[-1] / worst[-1 - _RECENT]) ** (1 / _RECENT)
        if rate >= 1:
            return len(worst) > 2 * _TRIAL
        return bool(self.sweeps + np.log(goal / worst[-1]) / np.log(rate) > 2 * self.most)

    def look(self, value: Values) -> tuple[Values, Integers]:
        """The optimum of each node, from values that stay as they are, and the first such row."""
        best = np.empty(self.sums.open.size, value.dtype)
        row = np.empty(best.size, np.int64)

        def one(i: int) -> tuple[Values, Integers]:
            image = self.images(i, value)
            found = self.best(i, image)
            return found, _first(image, found, self.parts[i][2], self.sums.cut.width)

        for blocks in self.in_pairs(one):
            for i, (found, first) in blocks:
                a, b, *_ = self.parts[i]
                best[a:b], row[a:b] = found, self.sums.cut.row_start[a] + first
        return np.where(self.sums.open, best, 0), row

    def chain(self, row: Integers) -> tuple[Any, Floats | None]:
        """The rows of a policy, and their costs."""
        cost = None if self.sums.cost is None else self.sums.cost[row]
        return self.sums.cut.matrix[row], cost

    def staying(self, chain: Any) -> tuple[Values, float] | None:
        """A time that a policy stays at least, and by how much less it is after a step.

        Args:
          chain: ``float64[N, M]``, of the policy.

        Returns:
          ``float32[M]``, zero where nobody reads it, and the share; None where it stays too long.
        """
        from scipy import sparse

        live = self.sums.live[: self.sums.open.size]
        rows = sparse.csr_array(
            (chain.data.astype(np.float32), chain.indices, chain.indptr), shape=chain.shape
        )
        stays: Any = np.zeros(self.sums.live.size, np.float32)
        stays[: live.size] = live
        time: Any = np.zeros(self.sums.live.size, np.float32)
        for _ in range(_STEPS):
            time += stays
            stays[: live.size] = (rows @ stays) * live
            if stays.max(initial=0) <= _STAYS:
                ahead = time[: live.size] - rows @ time
                least = float(ahead[live].min(initial=1.0)) - 64 * _EPS32 * float(time.max())
                return (time, least) if least > 0.5 else None
        return None

    def extra(self, value: Values, time: Values, tolerance: float, relative: bool) -> float:
        """What every step shall cost besides."""
        some = self.sums.live & (value > 0)
        size = float(value.max(initial=0))
        share = 1 / max(float(time.max(initial=1)), 1)
        if relative:
            share = float((value[some] / time[some]).min(initial=np.inf))
            share = share if np.isfinite(share) else 1.0
        needed = _MARGIN * (1 + _LEFT) / (1 - _STAYS) + 1  # times of it, of which bounds differ
        return max(0.9 * tolerance * share / needed, 32 * self.unit * max(size, 1e-300))

    def prove(self, value: Values, extra: float) -> SweptBounds | None:
        """The bound that a policy attains, the one beyond which nothing is, and the policy."""
        sums, sign, unit = self.sums, self.sign, self.unit
        nodes = sums.open.size
        live = sums.live[:nodes]
        best, row = self.look(value)
        slack = unit * (best + 2 * max(-float(value.min(initial=0)), 0.0))
        self.sweeps += 1
        if not (sign * best + slack <= sign * value[:nodes])[live].all():
            return None
        far = np.where(live, value[:nodes], best + sign * slack)
        chain, cost = self.chain(row)
        found = self.staying(chain)
        if found is None:
            return None
        time, least = found
        known = np.abs(sums.far - sums.near)[~sums.live].max(initial=0)
        loss = _MARGIN * (extra * (1 + 2 * _LEFT) + 4 * unit * float(value.max(initial=0))) / least
        near = np.where(sums.live, value - sign * (loss * time + known), sums.near)
        image = chain @ near
        if cost is not None:
            image += cost
        slack = unit * (image + 2 * max(-float(near.min(initial=0)), 0.0))
        if not (sign * near[:nodes] <= sign * image - slack)[live].all():
            return None
        near = np.where(live, near[:nodes], image - sign * slack)
        return SweptBounds(near, far, row, self.sweeps, float(time.max(initial=0)))

    def excess(self, found: SweptBounds, tolerance: float, relative: bool) -> float:
        """How many times the tolerance bounds are apart, more than those of what is known are."""
        known = np.abs(self.sums.far - self.sums.near)[~self.sums.live].max(initial=0)
        width = np.abs(found.far - found.near)[self.sums.open] - known
        if relative:
            size = np.abs(found.near if self.sign > 0 else found.far)[self.sums.open]
            width = width / np.maximum(size, 1e-300)
        return float(width.max(initial=0)) / tolerance


def _first(image: Values, best: Values, begin: Integers, width: int) -> Integers:
    """The first of the rows of each node that attains its best, counted from the block's first."""
    if width:
        table, rank = image.reshape(-1, width), np.zeros(best.size, np.int64)
        for k in range(width - 1, -1, -1):
            np.copyto(rank, k, where=table[:, k] == best)
        return begin + rank
    count = np.diff(begin, append=image.size)
    hit = np.flatnonzero(image == np.repeat(best, count))
    owner = np.searchsorted(begin, hit, "right") - 1
    found = np.array(begin, np.int64)
    found[owner[::-1]] = hit[::-1]  # the first one is written last
    return found
