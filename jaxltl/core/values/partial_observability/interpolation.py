"""Bounds of beliefs by decompositions into other beliefs, and value iteration with them.

The optimal value V of measures is monotone and homogeneous, and convex for a maximum (concave for a
minimum). If a belief c is ``sum_j w_j c_j + r`` with a measure r of states, then for a maximum
``V(c) <= sum_j w_j V(c_j) + sum_s r_s V(e_s)`` with the beliefs e_s that know the state; decompositions with
one c_j are the sawtooth bound (Hauskrecht 2000), those into a grid that of Lovejoy (1991). Here the c_j are
expanded beliefs, chosen greedily by their saving, and the e_s are nodes themselves, so that their bounds
improve on the fast informed bound.

Bounds x of all nodes decrease for a maximum: if x bounds V, so does ``min(x, B x)`` for the optimality
operator B, and so do decompositions. No argument about end components is needed, although the bounds may
stay above the least fixed point there; see :mod:`.bounds` for these. Each sum of nonnegative terms is rounded
outwards by the relative ``slack`` of the rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Floats, Integers, SparseMatrix
from jaxltl.core.sparse.rows import concatenated_ranges, offsets_from_counts
from jaxltl.core.values.partial_observability.beliefs import BeliefGraph, GrowingArray
from jaxltl.core.values.partial_observability.bounds import BeliefRows, NodeValues

_SHORTLIST = 24  # beliefs that a decomposition chooses among, after the first
_TERMS = 8  # beliefs of a decomposition
_CANDIDATES = (
    3000  # expanded beliefs of an observation that are tried, those of the largest savings
)
_WORK = 1e9  # products of a refinement of decompositions, some two seconds
_SAVING = 1e-6  # least relative saving of a term
_SWEEPS = 60  # of value iteration in a round
_STEPS = 300  # of visits
_STILL = 1e-2  # change of a sweep, relative to the tolerance, at which value iteration ends


class Interpolated(NamedTuple):
    """Leaves with decompositions, and their weights of nodes."""

    leaf: Integers  # int[L]
    matrix: SparseMatrix  # float64[L, nodes]


class Interpolation:
    """Decompositions of unexpanded beliefs into expanded ones and states."""

    def __init__(self, graph: BeliefGraph) -> None:
        self.graph = graph
        self.is_useful = False  # whether the last refinement saved a share of the gap
        self._corner = np.full(graph.problem.num_states, -1)
        count = graph.problem.pomdp.num_observations
        self._first = np.searchsorted(graph.problem.observation, np.arange(count + 1))
        self._count, self._to, self._by = GrowingArray(), GrowingArray(), GrowingArray(float)
        self._start = GrowingArray()  # of each decomposition in `_to`
        self._record = np.zeros(0, np.int64)  # int[nodes], the decomposition; -1 without one

    def _extend(self) -> None:
        new = np.full(self.graph.size - self._record.size, -1)
        self._record = np.concatenate([self._record, new])

    def covered(self) -> Floats:
        """The largest weight of a node in the decomposition of each node, 0 without one."""
        self._extend()
        some = np.flatnonzero(self._record >= 0)
        share = np.zeros(self.graph.size)
        if some.size:
            largest = np.maximum.reduceat(self._by.array(), self._start.array())
            share[some] = largest[self._record[some]]
        return share

    def leaves(self, expanded: bool = False) -> Interpolated:
        """The unexpanded nodes with a decomposition, or those that were expanded since."""
        from scipy.sparse import csr_array

        self._extend()
        leaf = np.flatnonzero((self._record >= 0) & (self.graph.expanded == expanded))
        record = self._record[leaf]
        count = self._count.array()[record]
        entry = concatenated_ranges(self._start.array()[record], count)
        to, by, start = self._to.array()[entry], self._by.array()[entry], offsets_from_counts(count)
        return Interpolated(leaf, csr_array((by, to, start), shape=(leaf.size, self.graph.size)))

    def expand_states(self, leaves: Integers, room: int) -> bool:
        """Expands the states of the observations of leaves; False if there is no room for them."""
        graph = self.graph
        seen = np.unique(graph.observation()[leaves])
        states = concatenated_ranges(self._first[seen], self._first[seen + 1] - self._first[seen])
        new = states[self._corner[states] < 0]
        if new.size > room:
            return False
        if new.size:
            self._corner[new] = graph.corners(new)
            graph.expand(np.sort(self._corner[new][~graph.expanded[self._corner[new]]]))
        return True

    def refine(self, leaves: Integers, value: Floats) -> None:
        """New decompositions of leaves, of as many of the first ones as `_WORK` allows."""
        graph = self.graph
        self._extend()
        seen, length = graph.observation(), np.diff(graph.measures().start)
        done = np.flatnonzero(graph.expanded & (length > 1))
        members = {o: done[seen[done] == o] for o in np.unique(seen[leaves]).tolist()}
        size = np.diff(self._first)
        work = np.array(
            [size[o] * (1 + min(members[o].size, _CANDIDATES)) for o in seen[leaves].tolist()]
        )
        leaves = leaves[: max(1, int(np.searchsorted(np.cumsum(work), _WORK)))]
        for o, candidates in members.items():
            some = leaves[seen[leaves] == o]
            if some.size:
                self._decompose(o, some, candidates, value)

    def _decompose(self, o: int, leaves: Integers, candidates: Integers, value: Floats) -> None:
        """Decompositions of leaves of one observation."""
        first, last = self._first[o : o + 2]
        at_state = value[self._corner[first:last]]
        sign = 1 if self.graph.problem.maximize else -1
        rest, basis = self._dense(leaves, first, last), self._dense(candidates, first, last)
        saving = sign * (basis @ at_state - value[candidates])
        useful = np.flatnonzero(saving > _SAVING * np.abs(value[candidates]))
        useful = useful[np.argsort(-saving[useful], kind="stable")][:_CANDIDATES]
        candidates, basis, saving = candidates[useful], basis[useful], saving[useful]
        terms = [] if not useful.size else _pursue(rest, basis, saving)
        number = [place for place, _, _ in terms]
        to = [candidates[j] for _, j, _ in terms]
        by = [w for _, _, w in terms]
        row, state = np.nonzero(rest > 0)
        number.append(row)
        to.append(self._corner[first + state])
        by.append(rest[row, state])
        place = np.concatenate(number)
        order = np.argsort(place, kind="stable")
        count = np.bincount(place, minlength=leaves.size)
        begin = self._count.size
        self._start.add(self._to.size + offsets_from_counts(count)[:-1])
        self._count.add(count)
        self._to.add(np.concatenate(to)[order])
        self._by.add(np.concatenate(by)[order])
        self._record[leaves] = begin + np.arange(leaves.size)

    def _dense(self, nodes: Integers, first: int, last: int) -> Floats:
        some = self.graph.measures().take(nodes)
        table = np.zeros((nodes.size, last - first))
        table[np.arange(nodes.size).repeat(np.diff(some.start)), some.state - first] = some.weight
        return table


def _pursue(rest: Floats, basis: Floats, saving: Floats) -> list[tuple[Integers, Integers, Floats]]:
    """Terms (places, numbers in the basis, weights) of greedy decompositions; leaves what remains in `rest`.

    A weight is the largest one with ``w c <= rest``. As these only decrease, the shortlist of the first
    step is kept. Sums of terms and rest are the beliefs up to relative rounding of each state.
    """
    with np.errstate(divide="ignore"):
        inverse = np.where(basis > 0, 1 / basis, np.inf)
    short = min(_SHORTLIST, saving.size)
    top = np.empty((len(rest), short), np.int64)
    rough, reciprocal = rest.astype(np.float32), inverse.astype(np.float32)
    step = max(1, int(2e6 // saving.size))
    with np.errstate(invalid="ignore"):  # 0 times infinity, outside the support of a belief
        for begin in range(0, len(rest), step):
            part = rough[begin : begin + step]
            weight = np.full((len(part), saving.size), np.inf, np.float32)
            for i in range(rest.shape[1]):
                np.fmin(weight, part[:, i : i + 1] * reciprocal[:, i], out=weight)
            worth = -weight * saving.astype(np.float32)
            top[begin : begin + step] = np.argpartition(worth, short - 1, axis=1)[:, :short]
        terms = []
        active = np.arange(len(rest))
        for _ in range(_TERMS):
            ratio = rest[active, None] * inverse[top[active]]
            weight = np.fmin.reduce(ratio, axis=2)
            worth = weight * saving[top[active]]
            pick = worth.argmax(1)
            each = np.arange(active.size)
            kept = worth[each, pick] > _SAVING * saving.max()
            active, pick, each = active[kept], pick[kept], each[kept]
            if not active.size:
                break
            chosen, by = top[active, pick], weight[each, pick]
            rest[active] = np.maximum(rest[active] - by[:, None] * basis[chosen], 0)
            terms.append((active, chosen, by))
    return terms


def improve_bounds(
    rows: BeliefRows, decomposed: Interpolated, bound: Floats, tolerance: float
) -> NodeValues:
    """Improves bounds of all controllers at all nodes in place, by sweeps; the bounds and greedy rows."""
    table, maximize = rows.table, rows.problem.maximize
    node, matrix = table["node"], rows.matrix
    first = np.flatnonzero(np.append(True, node[1:] != node[:-1])) if node.size else node
    inner = node[first]
    better, optimum = (np.minimum, np.maximum) if maximize else (np.maximum, np.minimum)
    outwards = 1 + (rows.slack if maximize else -rows.slack)
    gain = table["gain"] + table["lost"]
    value = gain
    for _ in range(_SWEEPS if node.size else 0):
        at_leaves = (decomposed.matrix @ bound) * outwards
        bound[decomposed.leaf] = better(bound[decomposed.leaf], at_leaves)
        value = gain + matrix @ bound
        new = better(bound[inner], optimum.reduceat(value, first) * outwards)
        change = np.abs(new - bound[inner]).max()
        bound[inner] = new
        if change <= _STILL * tolerance:
            break
    row = np.full(bound.size, -1)
    # the first of the best rows
    best = optimum.reduceat(value, first) if node.size else value
    count = np.diff(np.append(first, node.size))
    is_best = np.flatnonzero(value == best.repeat(count))
    row[node[is_best[::-1]]] = is_best[::-1]
    return NodeValues(bound, row)


def visits(rows: BeliefRows, decomposed: Interpolated, policy: Integers) -> tuple[Floats, float]:
    """Expected visits of each node under rows ``int[nodes]`` from the initial measure, from below.

    Leaves continue in the nodes of their decompositions. Also the mass that still moves after the last sweep.
    """
    from scipy.sparse import csr_array

    size = rows.graph.size
    inner = np.flatnonzero(policy >= 0)
    moved, split = rows.matrix[policy[inner]].tocoo(), decomposed.matrix.tocoo()
    source = np.concatenate([inner[moved.coords[0]], decomposed.leaf[split.coords[0]]])
    after = np.concatenate([moved.coords[1], split.coords[1]])
    matrix = csr_array(
        (np.concatenate([moved.data, split.data]), (after, source)), shape=(size, size)
    )
    moves = policy >= 0
    moves[decomposed.leaf] = True
    total, mass = _flow(rows, matrix)
    return total, float(mass[moves].sum())


def policy_visits(rows: BeliefRows, policy: Integers) -> Floats:
    """The same without decompositions: every leaf is an end."""
    inner = np.flatnonzero(policy >= 0)
    return _visits_of_choices(rows, inner, policy[inner], np.ones(inner.size))


def near_visits(rows: BeliefRows, bound: Floats, width: float) -> Floats:
    """The same where all actions within a width of the best one are equally likely."""
    table, maximize = rows.table, rows.problem.maximize
    node = table["node"]
    first = np.flatnonzero(np.append(True, node[1:] != node[:-1]))
    count = np.diff(np.append(first, node.size))
    value = table["gain"] + table["lost"] + rows.matrix @ bound
    best = (np.maximum if maximize else np.minimum).reduceat(value, first).repeat(count)
    with np.errstate(invalid="ignore"):
        is_near = ~(np.abs(value - best) > width)  # also where both are infinite
    share = is_near / np.add.reduceat(is_near.astype(np.float64), first).repeat(count)
    return _visits_of_choices(rows, node, np.arange(node.size), share)


def _visits_of_choices(rows: BeliefRows, node: Integers, row: Integers, share: Floats) -> Floats:
    """Expected visits if a node takes a row with the probability `share`."""
    from scipy.sparse import csr_array

    shape = rows.graph.size, rows.table["node"].size
    total, _ = _flow(
        rows, csr_array((csr_array((share, (node, row)), shape=shape) @ rows.matrix).T)
    )
    return total


def _flow(rows: BeliefRows, matrix: SparseMatrix) -> tuple[Floats, Floats]:
    """Expected visits from the initial measure, from below, and the measure after the last sweep."""
    node, weight, _ = rows.graph.root
    mass: Floats = np.bincount(node, weight, minlength=rows.graph.size).astype(np.float64)
    total = mass.copy()
    for _ in range(_STEPS):
        mass = matrix @ mass
        total += mass
        if mass.sum() < 1e-6:
            break
    return total, mass
