"""Sparse LU solver of policy evaluation systems ``(I - P) x = b``, and Krylov steps where it fills.

Unknowns are ordered by strongly connected component, and within each by reverse Cuthill-McKee
(1969), so that only components and the blocks between them fill. Where the blocks between fill too
much, large components are eliminated one after the other. Where a component itself fills too much
(graphs that mix well), a Krylov method converges. The fill is bounded or counted in advance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.sparse.rows import positions
from jaxltl.core.array_types import Floats, Integers, SparseMatrix
from jaxltl.core.sparse.linear.krylov import bicgstab, iterate

# Limits of elimination; measured on the models of benchmarks.real_models and on random graphs.
_SMALL = 3000  # states of a component up to which it may fill
_LARGE = 3000  # states of a component from which minimum degree is tried,
_SEVERAL = 1.5  # if its rows have more entries in the mean (sparser ones are nearly trees)
_NARROW = 40  # and its mean bandwidth is larger
_MIN_STATES_PER_BANDWIDTH = 8  # times its mean bandwidth that a larger component must have states
_MAX_FILL = 2**28  # entries of factors, 12 bytes each
_MAX_FILL_TOGETHER = 10**7  # of these, between components that are eliminated together
_MIN_STATES_ALONE = 500  # states from which a component is eliminated alone otherwise
_MAX_FORCED_STATES = (
    8000  # states up to which a component is eliminated, however it fills, if sweeps fail
)
_WORK = 1e11  # multiplications of a band from which a Krylov method comes first,
_MANY = 2  # if rows have more entries in the mean
_SAMPLED = 64  # rows in which the fill is counted
_PANEL = 2  # columns that SuperLU eliminates at once: each needs room for a full one
_FILL = 4  # growth of the fill after which the order is computed anew
_KRYLOV_RESTARTS = 8  # restarts of the Krylov method,
_KRYLOV_STEPS = 500  # steps of each
_SWEEPS = 20_000  # and sweeps after it
_ROUNDED = 4 * float(np.finfo(np.float64).eps)  # smallest residual relative to the solution
_RELATIVE_RESIDUAL = 1e-14  # residual relative to the right side
_DIRECT = 2000  # unknowns up to which each system of a sequence is eliminated
_MAX_OLD_STEPS = 10  # steps after which old factors are given up
_MAX_STEPS = 200  # of BiCGSTAB without factors


class _EliminationBlock(NamedTuple):
    """Some components, on which no earlier block depends."""

    order: Integers  # int[B], states in elimination order; ascending for a Krylov method
    inner: SparseMatrix  # float64[B, B], the policy's matrix on these
    outer: SparseMatrix | None  # float64[B, M], on earlier blocks; None without any
    factor: Any  # of SuperLU; None for a Krylov method
    fill: int  # entries of the first factors in this order
    min_degree: bool = False  # states of least degree first, wherever that may help


class Factors(NamedTuple):
    """The system of a policy, ready to be solved."""

    rows: SparseMatrix  # SciPy's float64[R, M], all rows
    label: Integers  # int[M], components in topological order
    blocks: tuple[_EliminationBlock, ...]  # in the order of solution

    @property
    def method(self) -> str:
        """The algorithm, in words."""
        swept = {x.factor is None for x in self.blocks}
        how = {True: "sweeps", False: "elimination"}
        return "policy iteration by " + " and ".join(how[x] for x in sorted(swept))

    @property
    def fill(self) -> int:
        """The number of entries of the first factors."""
        return sum(x.fill for x in self.blocks)

    def solve(self, b: Floats) -> Floats:
        """The solution; NaN where none was found."""
        x = np.zeros(b.size)
        for block in self.blocks:
            right = b[block.order]
            if block.outer is not None:
                right = right + block.outer @ x
            if not np.isfinite(right).all():
                return np.full(b.size, np.nan)
            x[block.order] = (
                _iterative_solution(block.inner, right)
                if block.factor is None
                else block.factor.solve(right, trans="T")
            )
        return x

    def refactorize(self, chosen: Integers) -> Factors | None:
        """The factors of another policy, in the same order unless that fills more."""
        blocks = []
        for block in self.blocks:
            swept = block.factor is None
            new = _block(
                self.rows, self.label, block.order, chosen, swept=swept, min_degree=block.min_degree
            )
            if new is None:
                return None
            if not swept and (new.factor is None or new.fill > _FILL * block.fill):
                return factorize(self.rows, self.label, chosen)
            blocks.append(new._replace(fill=block.fill))
        return self._replace(blocks=tuple(blocks))

    def without_krylov(self, chosen: Integers) -> Factors | None:
        """The factors without Krylov methods, for policies on which these fail; None if too large."""
        if not any(x.factor is None for x in self.blocks):
            return None
        blocks, matrix = [], self.rows[chosen]
        for block in self.blocks:
            nodes, swept = block.order, block.factor is None
            if (
                swept
                and nodes.size > _MAX_FORCED_STATES
                and elimination_order(matrix[nodes][:, nodes], self.label[nodes]) is None
            ):
                return None
            new = _block(self.rows, self.label, nodes, chosen, min_degree=swept or block.min_degree)
            if new is None or new.factor is None:
                return None
            blocks.append(new)
        return self._replace(blocks=tuple(blocks))


def factorize(rows: SparseMatrix, label: Integers, chosen: Integers) -> Factors | None:
    """Factors of a policy's system; None if it is singular."""
    matrix, size = rows[chosen], np.bincount(label)
    if min(_between(matrix, label, size)) <= _MAX_FILL_TOGETHER:
        order = elimination_order(matrix, label, _WORK)
        one = None if order is None else _block(rows, label, order, chosen)
        if order is not None and one is None:
            return None
        if one is not None and one.factor is not None:
            return Factors(rows, label, (one,))
    blocks = []
    for nodes in _parts(label, size):
        order = elimination_order(matrix[nodes][:, nodes], label[nodes], _WORK)
        kept = nodes if order is None else nodes[order]
        block = _block(rows, label, kept, chosen, swept=order is None)
        if block is None:
            return None
        blocks.append(block)
    return Factors(rows, label, tuple(blocks))


def _parts(label: Integers, size: Integers) -> list[Integers]:
    """The states of each large component, and of what lies between two of them."""
    large = size > _MIN_STATES_ALONE
    begins = large.copy()
    begins[1:] |= large[:-1]
    begins[:1] = False
    part = begins.cumsum()[label]
    return np.split(np.argsort(part, kind="stable"), np.bincount(part).cumsum()[:-1])


def _between(matrix: SparseMatrix, label: Integers, size: Integers) -> tuple[int, int]:
    """Bounds of the fill between components: with earlier ones first, and with later ones first."""
    source = np.repeat(label, np.diff(matrix.indptr))
    target = label[matrix.indices]
    between = source != target
    return int(size[target[between]].sum()), int(size[source[between]].sum())


def elimination_order(
    matrix: SparseMatrix, label: Integers, work: float = np.inf
) -> Integers | None:
    """Order by component, and within each by reverse Cuthill-McKee; None where that would not help."""
    from scipy.sparse import csgraph

    size = np.bincount(label)
    if size.max(initial=0) <= 1:
        return np.argsort(label, kind="stable")
    source = np.repeat(np.arange(label.size), np.diff(matrix.indptr))
    into, out_of = _between(matrix, label, size)
    within = matrix.copy()
    within.data[label[source] != label[matrix.indices]] = 0
    within.eliminate_zeros()
    both = (within + within.T).tocsr()
    order = csgraph.reverse_cuthill_mckee(both, symmetric_mode=True)
    order = order[np.argsort(label[order], kind="stable")]
    large = size[label] > _SMALL
    if large.any():
        place = np.empty(label.size, np.int64)
        place[order] = np.arange(label.size)
        source = np.repeat(np.arange(label.size), np.diff(both.indptr))
        furthest = np.zeros(label.size, np.int64)
        np.maximum.at(furthest, source, place[source] - place[both.indices])
        mean = np.bincount(label, furthest) / np.maximum(size, 1)
        fills = (size * mean**2 > work) & (within.nnz > _MANY * label.size)
        if ((size > _SMALL) & ((mean * _MIN_STATES_PER_BANDWIDTH > size) | fills)).any():
            return None
    # An edge between components fills the one that is eliminated first.
    result: Integers | None = order[::-1] if out_of < into else order
    return result


def _block(
    rows: SparseMatrix,
    label: Integers,
    order: Integers,
    chosen: Integers,
    *,
    swept: bool = False,
    min_degree: bool = False,
) -> _EliminationBlock | None:
    """Some states of a policy, factored unless that fills too much; None if singular."""
    from scipy.sparse import linalg

    whole = order.size == label.size
    place = positions(order, label.size)
    inner, outer = rows[chosen[order]], None
    if whole:
        inner.indices = place[inner.indices]
        inner.has_sorted_indices = False
    else:
        outer = inner.copy()
        outer.data[place[outer.indices] >= 0] = 0
        outer.eliminate_zeros()
        inner = inner[:, order]
    if swept or _too_much(inner, label[order]):
        return _EliminationBlock(order, inner, outer, None, 0)
    # In one large component minimum degree fills less (Liu 1985).
    largest = np.bincount(label[order]).max(initial=0)
    wide = (
        largest > max(order.size / 2, _LARGE)
        and inner.nnz > _SEVERAL * order.size
        and _bandwidth(inner) > _NARROW
    )
    try:
        factor = linalg.splu(
            _transposed_system(inner),
            permc_spec="MMD_AT_PLUS_A" if min_degree or wide else "NATURAL",
            diag_pivot_thresh=0,
            relax=1,
            panel_size=_PANEL,
            options={"SymmetricMode": True},
        )
    except (RuntimeError, MemoryError):
        return None
    return _EliminationBlock(order, inner, outer, factor, int(factor.nnz), min_degree)


def _bandwidth(matrix: SparseMatrix) -> float:
    """The mean distance of the first entries of rows and columns from the diagonal."""
    size = matrix.shape[0]
    source = np.repeat(np.arange(size), np.diff(matrix.indptr))
    first, top = _first_entries(source, matrix.indices, size)
    return float((2 * np.arange(size) - first - top).mean()) / 2


def _first_entries(source: Integers, target: Integers, size: int) -> tuple[Integers, Integers]:
    """The first entry of each row, and of each column; at most the diagonal."""
    first, top = np.arange(size), np.arange(size)
    np.minimum.at(first, source, target.astype(first.dtype))  # of one type, which is far faster
    np.minimum.at(top, target, source.astype(top.dtype))
    return first, top


def _too_much(matrix: SparseMatrix, label: Integers) -> bool:
    """True if elimination in the order of the states fills more than the limit.

    Factors fill nothing before the first entry of a row and of a column (George and Liu 1981). In
    components where that bound is too large, rows are counted along the elimination tree.
    """
    size = label.size
    if size * (size + 1) <= _MAX_FILL:
        return False
    source = np.repeat(np.arange(size), np.diff(matrix.indptr))
    target = matrix.indices
    between = label[source] != label[target]
    last = np.zeros(int(label.max(initial=0)) + 1, np.int64)
    last[label] = np.arange(1, size + 1)
    first = np.minimum(source[between], target[between])
    allowed = _MAX_FILL - size - int((last[label[first]] - first).sum())
    source, target = source[~between], target[~between]
    leftmost, top = _first_entries(source, target, size)
    if int((2 * np.arange(size) - leftmost - top).sum()) <= allowed:
        return False
    return allowed <= 0 or 2 * _counted(source, target, size) > allowed


def _counted(source: Integers, target: Integers, size: int) -> float:
    """Estimated number of entries of one factor of a symmetric pattern, from a sample of its rows.

    Row i is filled where the elimination tree leads from its entries towards i (Liu 1990).
    """
    from scipy import sparse

    low, high = np.minimum(source, target), np.maximum(source, target)
    kept = low < high
    pattern = sparse.coo_array(
        (np.ones(np.count_nonzero(kept), bool), (high[kept], low[kept])), shape=(size, size)
    ).tocsr()
    starts, entries = pattern.indptr.tolist(), pattern.indices.tolist()
    parent, beyond = [-1] * size, [-1] * size
    for i in range(size):
        for k in entries[starts[i] : starts[i + 1]]:
            while k != -1 and k < i:
                after, beyond[k] = beyond[k], i
                if after == -1:
                    parent[k] = i
                k = after
    sampled = np.linspace(0, size - 1, min(_SAMPLED, size)).astype(int).tolist()
    total = 0
    for i in sampled:
        seen = {i}
        for k in entries[starts[i] : starts[i + 1]]:
            while k not in seen:
                seen.add(k)
                k = parent[k]
        total += len(seen) - 1
    return total * size / len(sampled)


def _transposed_system(matrix: SparseMatrix) -> SparseMatrix:
    """``(I - P)^T`` in compressed columns, from P in compressed rows."""
    from scipy import sparse

    size, start = matrix.shape[0], matrix.indptr + np.arange(matrix.indptr.size)
    diagonal = start[:-1]
    other = np.ones(matrix.nnz + size, bool)
    other[diagonal] = False
    data, indices = np.ones(other.size), np.empty(other.size, matrix.indices.dtype)
    data[other] = -matrix.data
    indices[diagonal], indices[other] = np.arange(size), matrix.indices
    return sparse.csc_array((data, indices, start), shape=matrix.shape)


def _iterative_solution(matrix: SparseMatrix, b: Floats) -> Floats:
    """Solution by BiCGSTAB (van der Vorst 1992), then by sweeps while the residual shrinks."""
    size = np.abs(b).max(initial=0)
    x, residual = np.zeros(b.size), np.array(b)

    def enough() -> bool:
        # Where x is far larger than b, its own rounding remains.
        least = max(_RELATIVE_RESIDUAL * size, _ROUNDED * float(np.abs(x).max(initial=0)))
        return bool(np.abs(residual).max(initial=0) <= least)

    for _ in range(_KRYLOV_RESTARTS):  # restarts where it stagnates or breaks down
        with np.errstate(all="ignore"):
            more = iterate(
                matrix, residual, np.zeros(b.size), _RELATIVE_RESIDUAL * size, _KRYLOV_STEPS
            )
        after = residual - (more - matrix @ more)
        if not np.isfinite(more).all() or not np.abs(after).max() < np.abs(residual).max():
            break
        x, residual = x + more, after
        if enough():
            return x
    for _ in range(_SWEEPS):
        if enough():
            return x
        x = x + residual
        residual = matrix @ residual
    return np.full(b.size, np.nan)


# --- sequences of systems ------------------------------------------------------------------------


@dataclass
class SystemSequence:
    """Solver of systems of one size, each different from the last one in a few rows.

    Where few steps lead to many states, BiCGSTAB from the last solution converges fast. Elsewhere
    the factors of an earlier system precondition it, until they are too old and are computed anew.
    """

    label: Callable[[], Integers]  # SCCs int[M] in topological order
    mixes: bool  # True if few steps lead to many unknowns
    factors: Factors | None = None  # of the earlier system `matrix`
    matrix: SparseMatrix | None = None

    def solve(
        self, matrix: SparseMatrix, b: Floats, start: Floats, residual: float
    ) -> Floats | None:
        """The solution up to a residual, or up to rounding if that is more; None if singular."""
        if self.mixes:
            solution = bicgstab(matrix, b, start, residual, steps=_MAX_STEPS)
            if solution is not None:
                return solution
            self.mixes = False
        if self.factors is not None and self.matrix is not matrix and b.size > _DIRECT:
            old = self.factors.solve
            solution = bicgstab(matrix, b, start, residual, steps=_MAX_OLD_STEPS, precondition=old)
            if solution is not None:
                return solution
        return self.solve_directly(matrix, b)

    def solve_directly(self, matrix: SparseMatrix, b: Floats) -> Floats | None:
        """The solution by factors of this system; None if it is singular."""
        if self.matrix is not matrix and not self._factor(matrix):
            return None
        assert self.factors is not None
        x = self.factors.solve(b)
        return x if np.isfinite(x).all() else None

    def _factor(self, matrix: SparseMatrix) -> bool:
        rows = np.arange(matrix.shape[0])
        if self.factors is None:
            self.factors = factorize(matrix, self.label(), rows)
        else:
            self.factors = self.factors._replace(rows=matrix).refactorize(rows)
        self.matrix = matrix
        return self.factors is not None
