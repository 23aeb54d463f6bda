"""Stochastic shortest path problems: their data, and backward induction on acyclic states."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import SupportsFloat

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.linear.topological_order import Edges, Levels
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import (
    SCIPY_SIZE,
    concatenated_ranges,
    first_hits,
    mask_of,
    offsets_from_counts,
    positions,
    row_entries,
)

TINY = 1e-290  # products that underflow: relative errors do not count them


class RelativeTolerance(float):
    """A width of bounds relative to the value, where a plain number would be absolute.

    Scaled by a number it is relative too; with an array it is a TypeError unless converted.
    """

    __array_ufunc__ = None  # so that products from the left are not plain numbers either

    def __mul__(self, factor: float) -> RelativeTolerance:
        if not isinstance(factor, int | float):
            return NotImplemented
        return RelativeTolerance(float(self) * factor)

    __rmul__ = __mul__

    def __truediv__(self, divisor: float) -> RelativeTolerance:
        return self * (1 / divisor)


def as_width(tolerance: SupportsFloat) -> float:
    """A tolerance as a float, or as :class:`RelativeTolerance`."""
    return tolerance if isinstance(tolerance, RelativeTolerance) else float(tolerance)


@dataclass(frozen=True)
class ShortestPathProblem:
    """``x = opt_r (c_r + P_r x)`` on interior states, which every policy that counts leaves.

    Self-loops are eliminated by normalising the other successors of a row.
    """

    mdp: HostMDP  # the model; its rows may be unsorted and repeat successors
    interior: Booleans  # bool[S], the states to solve for
    terminal_value: Floats  # float64[S], at least 0: the value of the other states
    cost: Floats  # float64[R], at least 0
    allowed: Booleans | None = None  # bool[R], the rows that may be taken; None for all
    # int[S], rows by which the interior is left almost surely; needed only where some policies
    # never leave it
    proper_policy: Integers | None = None
    depth: int = 0  # the number of roundings behind each number


@dataclass(frozen=True)
class Enclosure:
    """Certified bounds of an optimum, or of the value of a chain."""

    # float64[S]; 0 and infinity where nothing could be certified (value, lower, upper)
    value: Floats
    lower: Floats
    upper: Floats
    row: Integers  # int[S], a policy that attains the bound on the safe side, `lower` of a maximum
    rounds: int  # linear systems solved, or sweeps
    residual: float  # of the optimality equation, relative where the value exceeds one
    method: str  # the algorithm, in words


@dataclass(frozen=True)
class InteriorRows:
    """Rows of the interior states, the nodes, without self-loops: ``known_r + P_r x``."""

    row_start: Integers  # int[N + 1]
    entry_start: Integers  # int[R + 1]
    target: Integers  # int32[T], nodes
    weight: Floats  # float64[T]
    known: Floats  # float64[R], cost, and known values by the probability of reaching them
    leaving: Floats  # float64[R], the probability of leaving the interior
    row: Integers  # int[R], int[N], rows and states of the model
    node: Integers
    widest: int  # the largest number of successors of a row in the model, over which sums go

    @property
    def num_nodes(self) -> int:
        return self.node.size

    def edges(self) -> Edges:
        """The graph of the nodes."""
        return Edges(self.entry_start[self.row_start], self.target)

    def backup(self, value: Floats) -> Floats:
        """``known_r + P_r x`` of each row."""
        if self.target.size > SCIPY_SIZE:
            from scipy import sparse

            arrays = self.weight, self.target, self.entry_start
            matrix = sparse.csr_array(arrays, shape=(self.row.size, value.size))
            images: Floats = self.known + matrix @ value
            return images
        of = np.repeat(np.arange(self.row.size), np.diff(self.entry_start))
        return self.known + np.bincount(of, self.weight * value[self.target], self.row.size)

    def residual(self, value: Floats, sign: int) -> float:
        """The residual of the optimality equation, relative where the value exceeds one."""
        if not value.size or not np.isfinite(value).all():
            return np.inf if value.size else 0.0
        best = _reduction(sign).reduceat(self.backup(value), self.row_start[:-1])
        return float((np.abs(best - value) / np.maximum(value, 1)).max())


def interior_rows(problem: ShortestPathProblem) -> InteriorRows:
    """The rows of a problem's interior."""
    mdp, interior = problem.mdp, problem.interior
    kept = interior[mdp.state]
    if problem.allowed is not None:
        kept &= problem.allowed
    row = np.flatnonzero(kept)
    width = np.diff(mdp.entry_start)[row]
    widest = int(width.max(initial=1))
    if row.size == mdp.num_rows:
        target, weight, of = mdp.successor, mdp.probability, mdp.row
    else:
        entry = concatenated_ranges(mdp.entry_start[row], width)
        target, weight = mdp.successor[entry], mdp.probability[entry]
        of = np.repeat(np.arange(row.size, dtype=np.int32), width)
    state = mdp.state[row]
    inner = interior[target]
    known: Floats = problem.cost[row]
    leaving: Floats = np.zeros(row.size)
    if not inner.all():
        out = np.flatnonzero(~inner)
        leaving = np.bincount(of[out], weight[out], row.size).astype(np.float64)
        terms = weight[out] * problem.terminal_value[target[out]]
        known = known + np.bincount(of[out], terms, row.size)
    loops = inner & (target == state[of])
    if loops.any():
        rest = np.bincount(of[~loops], weight[~loops], row.size)
        looping = mask_of(of[loops], row.size)
        scale = np.where(looping & (rest > 0), rest, 1)
        known, leaving, weight = known / scale, leaving / scale, weight / scale[of]
        inner &= ~loops
        if (stuck := looping & (rest == 0)).any():  # rows that are nothing but a self-loop
            inner &= ~stuck[of]
            keep = ~stuck
            number = np.cumsum(keep) - 1
            row, state, known, leaving = row[keep], state[keep], known[keep], leaving[keep]
            target, weight, of, inner = (x[keep[of]] for x in (target, weight, number[of], inner))
    if not inner.all():
        target, weight, of = target[inner], weight[inner], of[inner]
    node = np.flatnonzero(interior)
    number = positions(node, interior.size)
    return InteriorRows(
        row_start=offsets_from_counts(np.bincount(number[state], minlength=node.size)),
        entry_start=offsets_from_counts(np.bincount(of, minlength=row.size)),
        target=number[target],
        weight=weight,
        known=known,
        leaving=leaving,
        row=row,
        node=node,
        widest=widest,
    )


def solve_levels(
    rows: InteriorRows, levels: Levels, bounds: Floats, policy: Integers, sign: int
) -> None:
    """Backward induction over levels, in place; the caller accounts for its rounding."""
    if not levels.node.size:
        return
    row, count = row_entries(rows.row_start, levels.node)
    entry, width = row_entries(rows.entry_start, row)
    targets, weights, images = rows.target[entry], rows.weight[entry], rows.known[row]
    # Rows without entries have no sum: the numbers of the others, and where their entries begin.
    some = np.flatnonzero(width)
    first = offsets_from_counts(width)[some]
    begin = offsets_from_counts(count)
    single = row.size == levels.node.size
    same = bool((bounds[0] == bounds[1]).all())
    sides = [bounds[2]] if same else [bounds[2], bounds[1], bounds[0]]
    operation = _reduction(sign)
    row_at = begin[levels.start]
    some_at = np.searchsorted(some, row_at)
    entry_at = np.append(first, entry.size)[some_at].tolist()
    for (a, b), (r0, r1), (s0, s1), (e0, e1) in zip(
        *(pairwise(x) for x in (levels.start, row_at.tolist(), some_at.tolist(), entry_at)),
        strict=True,
    ):
        if a == b:
            continue
        known, node = images[r0:r1], levels.node[a:b]
        for side in sides:
            image = known
            if s0 < s1:
                sums = np.add.reduceat(weights[e0:e1] * side[targets[e0:e1]], first[s0:s1] - e0)
                image = known + sums if s1 - s0 == r1 - r0 else known.copy()
                if s1 - s0 < r1 - r0:
                    image[some[s0:s1] - r0] += sums
            side[node] = image if single else operation.reduceat(image, begin[a:b] - r0)
        images[r0:r1] = image
    if not single:
        owner = np.arange(count.size, dtype=np.int32).repeat(count)
        start = begin[:-1]
        hits = first_hits(images == sides[-1][levels.node][owner], owner, start)
        policy[levels.node] = rows.row_start[levels.node] + hits - start
    if same:
        bounds[:2, levels.node] = bounds[2, levels.node]


def _reduction(sign: int) -> np.ufunc:
    return np.maximum if sign > 0 else np.minimum
