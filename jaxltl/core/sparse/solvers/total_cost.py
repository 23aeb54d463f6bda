"""Stochastic shortest path problems on sparse rows, and their solution in topological order."""

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
    offsets_from_counts,
    row_entries,
)

TINY = 1e-290  # products that underflow: relative errors do not count them


class Relative(float):
    """A width of bounds relative to the value, where a plain number would be absolute."""


def as_width(tolerance: SupportsFloat) -> float:
    """A tolerance as a float, or as :class:`Relative`."""
    return tolerance if isinstance(tolerance, Relative) else float(tolerance)


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
    """Rows of the interior states without self-loops, and a last node of value 1 for known values."""

    row_start: Integers  # int[N + 1]
    entry_start: Integers  # int[R + 1]
    target: Integers  # int32[T], nodes; N for the last one, weighed by cost and known value
    weight: Floats  # float64[T]
    row: Integers  # int[R], int[N], rows and states of the model
    node: Integers
    leaving: Floats  # float64[R], the probability of leaving the interior
    widest: int  # the largest number of successors of a row in the model, over which sums go

    @property
    def num_nodes(self) -> int:
        return self.node.size

    def take(self, node: Integers) -> InteriorRows:
        """The rows of some nodes, in their order; targets keep their numbers."""
        row, count = row_entries(self.row_start, node)
        entry, width = row_entries(self.entry_start, row)
        return InteriorRows(
            row_start=offsets_from_counts(count),
            entry_start=offsets_from_counts(width),
            target=self.target[entry],
            weight=self.weight[entry],
            row=self.row[row],
            node=self.node[node],
            leaving=self.leaving[row],
            widest=self.widest,
        )

    def edges(self) -> Edges:
        """The graph of the nodes, without the last one."""
        kept = self.target != self.num_nodes
        place = np.zeros(kept.size + 1, np.int32)
        np.cumsum(kept, out=place[1:])
        return Edges(place[self.entry_start[self.row_start]], self.target[kept])

    def backup(self, value: Floats) -> Floats:
        """``c_r + P_r x`` of each row, from ``float64[N + 1]``."""
        if self.target.size > SCIPY_SIZE:
            from scipy import sparse

            arrays = self.weight, self.target, self.entry_start
            matrix = sparse.csr_array(arrays, shape=(self.row.size, value.size))
            found: Floats = matrix @ value
            return found
        return np.add.reduceat(self.weight * value[self.target], self.entry_start[:-1])

    def residual(self, value: Floats, sign: int) -> float:
        """The residual of the optimality equation, relative where the value exceeds one."""
        if not value.size or not np.isfinite(value).all():
            return np.inf if value.size else 0.0
        image = self.backup(np.append(value, 1))
        best = _reduction(sign).reduceat(image, self.row_start[:-1])
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
        known = known + np.bincount(
            of[out], weight[out] * problem.terminal_value[target[out]], row.size
        )
    loops = inner & (target == state[of])
    if loops.any():
        rest = np.bincount(of[~loops], weight[~loops], row.size)
        looping = np.zeros(row.size, bool)
        looping[of[loops]] = True
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
    return _with_known_values(problem, (row, state, known, leaving), (target, weight, of), widest)


def _with_known_values(
    problem: ShortestPathProblem,
    rows: tuple[Integers, Integers, Floats, Floats],
    entries: tuple[Integers, Floats, Integers],
    widest: int,
) -> InteriorRows:
    """Puts the known part of each row, if it is positive or the row is empty, before its entries."""
    (row, state, known, leaving), (target, weight, of) = rows, entries
    node = np.flatnonzero(problem.interior)
    number: Integers = np.zeros(problem.interior.size, np.int32)
    number[node] = np.arange(node.size)
    count = np.bincount(of, minlength=row.size)
    some = (known != 0) | (count == 0)
    start = offsets_from_counts(count + some)
    first = start[:-1][some]
    targets, weights = np.empty(start[-1], np.int32), np.empty(start[-1])
    inside = np.ones(start[-1], bool)
    inside[first] = False
    targets[first], weights[first] = node.size, known[some]
    targets[inside], weights[inside] = number[target], weight
    return InteriorRows(
        row_start=offsets_from_counts(np.bincount(number[state], minlength=node.size)),
        entry_start=start,
        target=targets,
        weight=weights,
        row=row,
        node=node,
        leaving=leaving,
        widest=widest,
    )


def solve_levels(
    rows: InteriorRows, levels: Levels, bounds: Floats, policy: Integers, sign: int
) -> None:
    """Backward induction over levels, in place; the caller accounts for its rounding."""
    if not levels.node.size:
        return
    part = rows.take(levels.node)
    single = part.row.size == part.node.size
    same = bool((bounds[0] == bounds[1]).all())
    sides = [bounds[2]] if same else [bounds[2], bounds[1], bounds[0]]
    operation = _reduction(sign)
    images: Floats = np.empty(part.row.size)
    row_at = part.row_start[levels.start]
    entry_at = part.entry_start[row_at].tolist()
    for (a, b), (r0, r1), (e0, e1) in zip(
        pairwise(levels.start), pairwise(row_at.tolist()), pairwise(entry_at), strict=True
    ):
        if a == b:
            continue
        target, weight, node = part.target[e0:e1], part.weight[e0:e1], levels.node[a:b]
        starts, image = part.entry_start[r0:r1] - e0, images[r0:r1]
        begin = None if single else part.row_start[a:b] - r0
        for side in sides:
            np.add.reduceat(weight * side[target], starts, out=image)
            side[node] = image if begin is None else operation.reduceat(image, begin)
    if not single:
        start = part.row_start[:-1]
        owner = np.arange(start.size, dtype=np.int32).repeat(np.diff(part.row_start))
        first = first_hits(images == sides[-1][levels.node][owner], owner, start)
        policy[levels.node] = rows.row_start[levels.node] + first - start
    if same:
        bounds[:2, levels.node] = bounds[2, levels.node]


def _reduction(sign: int) -> np.ufunc:
    return np.maximum if sign > 0 else np.minimum
