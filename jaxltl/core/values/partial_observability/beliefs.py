"""Explored beliefs of a POMDP as a Markov decision process, with sound rounding.

A node is a measure c of the undecided states of one observation, and its value that of c exactly as it
is stored. A row of a node and an action leads to nodes c_j with weights w_j so that the true successor
measure m is at least ``w_j c_j``; the rest of its mass is counted with a bound of its value. Since values
are monotone and homogeneous in measures and convex (a maximum) or concave (a minimum), the values of
these rows are bounds of those of the beliefs; see :mod:`.bounds` for rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers, SparseMatrix
from jaxltl.core.sparse.rows import concatenated_ranges, offsets_from_counts
from jaxltl.core.values.partial_observability.problem import BeliefProblem

_TRUNCATED = 1e-9  # share of a belief that is counted as seen
_MERGED = 2.0**39  # reciprocal of the differences within which beliefs are one node
Exact = dict[int, Fraction]  # weights of states
_DEEPEST = 500  # steps from a belief that is known exactly to one that is computed
_UNIT = 1e-13  # deviation of a mass from one that is not divided out, so that cycles stay exact


class GrowingArray:
    """An array that grows at its end, with room to spare."""

    def __init__(self, dtype: type = np.int64) -> None:
        self._room: np.ndarray = np.zeros(1024, dtype)
        self.size = 0

    def add(self, part: np.ndarray) -> None:
        """Appends a part."""
        end = self.size + part.size
        if end > self._room.size:
            room = np.zeros(max(end, 2 * self._room.size), self._room.dtype)
            room[: self.size] = self.array()
            self._room = room
        self._room[self.size : end] = part
        self.size = end

    def array(self) -> np.ndarray:
        """The array, a view that later parts leave as it is."""
        return self._room[: self.size]


@dataclass(frozen=True)
class Measures:
    """Measures of the states of one observation each, in rows, without empty ones."""

    start: Integers  # int[M + 1]
    state: Integers  # int[E], ascending in a row
    weight: Floats  # float64[E], positive

    @property
    def size(self) -> int:
        """M."""
        return self.start.size - 1

    def take(self, index: Integers) -> Measures:
        """Some of the measures."""
        count = self.start[index + 1] - self.start[index]
        entry = concatenated_ranges(self.start[index], count)
        return Measures(offsets_from_counts(count), self.state[entry], self.weight[entry])

    def total(self) -> Floats:
        """The mass of each."""
        return np.add.reduceat(self.weight, self.start[:-1]) if self.size else np.zeros(0)

    def matrix(self, num_states: int) -> SparseMatrix:
        """``float64[M, N]``."""
        from scipy.sparse import csr_array

        return csr_array((self.weight, self.state, self.start), shape=(self.size, num_states))


@dataclass(frozen=True)
class NextMeasures:
    """Measures that follow some measures under an action, grouped by observation."""

    source: Integers  # int[G], ascending, the number of the measure before
    mass: Floats  # float64[G]
    measures: Measures  # G of them, of mass one up to rounding
    lost: Floats  # float64[M], bound of the value of what was truncated


def successors(
    problem: BeliefProblem, before: Measures, action: int, *, truncated: float = _TRUNCATED
) -> NextMeasures:
    """The measures after an action, without states of a small share, whose value is bounded."""
    matrix = before.matrix(problem.num_states) @ problem.transition[action]
    matrix.sort_indices()
    row = np.repeat(np.arange(before.size), np.diff(matrix.indptr))
    state, weight = matrix.indices, matrix.data
    start = _starts(row, problem.observation[state])
    lost = np.zeros(before.size)
    if start.size:
        mass = np.add.reduceat(weight, start)
        count = np.diff(np.append(start, row.size))
        small = weight < truncated * mass.repeat(count)
        if small.any():
            value = weight[small] * problem.corner[state[small]]
            lost += np.bincount(row[small], value, minlength=before.size)
            row, state, weight = row[~small], state[~small], weight[~small]
            start = _starts(row, problem.observation[state])
    count = np.diff(np.append(start, row.size))
    mass = np.add.reduceat(weight, start) if start.size else np.zeros(0)
    mass = np.where(np.abs(mass - 1) <= _UNIT, 1.0, mass)
    measures = Measures(np.append(start, row.size), state, weight / mass.repeat(count))
    return NextMeasures(row[start], mass, measures, lost)


def _starts(row: Integers, seen: Integers) -> Integers:
    first = np.ones(row.size, bool)
    first[1:] = (row[1:] != row[:-1]) | (seen[1:] != seen[:-1])
    starts: Integers = np.flatnonzero(first)
    return starts


class BeliefGraph:
    """Nodes of beliefs and rows of their actions; grows by :meth:`expand`."""

    def __init__(self, problem: BeliefProblem) -> None:
        self.problem = problem
        rng = np.random.default_rng(0)
        self._projection = rng.uniform(0.5, 1.5, (2, problem.num_states))
        self._sign = rng.integers(1, 2**62, problem.num_states)
        self._known: dict[int, int] = {}
        self._start, self._state, self._weight = (GrowingArray(t) for t in (int, int, float))
        self._size = self._entries = 0
        self._start.add(np.zeros(1, np.int64))
        # rows: node, action, gain, mass that is lost to bounds of corners; entries: node, weight
        kinds = {"node": int, "action": int, "gain": float, "lost": float, "count": int}
        self._rows = {name: GrowingArray(t) for name, t in kinds.items()}
        self._to, self._by = GrowingArray(int), GrowingArray(float)
        # of each node the node and the action by which it was found first, -1 of initial ones
        self.parent, self.via = GrowingArray(int), GrowingArray(int)
        self.exact = ExactBeliefs(self)
        self.expanded = np.zeros(0, bool)
        self.root = self._first()

    @property
    def size(self) -> int:
        """The number of nodes."""
        return self._size

    def measures(self) -> Measures:
        """The nodes."""
        return Measures(self._start.array(), self._state.array(), self._weight.array())

    def observation(self) -> Integers:
        """``int[nodes]``."""
        seen: Integers = self.problem.observation[self._state.array()[self._start.array()[:-1]]]
        return seen

    def rows(self) -> dict[str, np.ndarray]:
        """The rows in the order of their nodes: node, action, gain, lost, start, to, by."""
        parts = {name: x.array() for name, x in self._rows.items()}
        start = offsets_from_counts(parts.pop("count"))
        order = np.argsort(parts["node"], kind="stable")
        count = np.diff(start)[order]
        entry = concatenated_ranges(start[:-1][order], count)
        table = {name: x[order] for name, x in parts.items()}
        to, by = self._to.array(), self._by.array()
        return table | {"start": offsets_from_counts(count), "to": to[entry], "by": by[entry]}

    @property
    def num_rows(self) -> tuple[int, int]:
        """The numbers of rows and of their entries."""
        return self._rows["node"].size, self._to.size

    def rows_from(self, first: tuple[int, int]) -> dict[str, np.ndarray]:
        """The rows and entries from some numbers on, as they were added, with the `count` of entries."""
        parts = {name: x.array()[first[0] :] for name, x in self._rows.items()}
        return parts | {"to": self._to.array()[first[1] :], "by": self._by.array()[first[1] :]}

    def _first(self) -> tuple[Integers, Floats, float]:
        """Nodes and weights of the initial measure, and the bound of the rest."""
        problem = self.problem
        state = np.flatnonzero(problem.initial > 0)
        if not state.size:
            return np.zeros(0, np.int64), np.zeros(0), 0.0
        weight = problem.initial[state]
        start = _starts(np.zeros(state.size, np.int64), problem.observation[state])
        mass = np.add.reduceat(weight, start)
        count = np.diff(np.append(start, state.size))
        whole = Measures(np.append(start, state.size), state, weight / mass.repeat(count))
        none = np.full(mass.size, -1)
        node, share, lost = self._insert(whole, none, -1)
        return node, mass * share, float(mass @ lost)

    def corners(self, states: Integers) -> Integers:
        """The nodes of the beliefs that know the state, of some states; new ones where they are missing.

        Their masses are one up to twice `_UNIT`, far below the rounding of bounds.
        """
        whole = Measures(np.arange(states.size + 1), states, np.ones(states.size))
        node, share, _ = self._insert(whole, np.full(states.size, -1), -1)
        if not (np.abs(share - 1) <= 2 * _UNIT).all():
            raise ArithmeticError("two beliefs have one hash; explore the model in another order.")
        return node

    def expand(self, nodes: Integers) -> None:
        """Adds the rows of nodes that have none."""
        problem = self.problem
        some = self.measures().take(nodes)
        seen = problem.observation[some.state[some.start[:-1]]]
        for action in range(len(problem.transition)):
            chosen = np.flatnonzero(problem.available[seen, action])
            if not chosen.size:
                continue
            before = some.take(chosen)
            after = successors(problem, before, action)
            node, share, lost = self._insert(after.measures, nodes[chosen][after.source], action)
            gain = before.matrix(problem.num_states) @ problem.gain[action]
            rest = after.lost + np.bincount(after.source, after.mass * lost, minlength=chosen.size)
            self._rows["node"].add(nodes[chosen])
            self._rows["action"].add(np.full(chosen.size, action))
            self._rows["gain"].add(gain)
            self._rows["lost"].add(rest)
            self._rows["count"].add(np.bincount(after.source, minlength=chosen.size))
            self._to.add(node)
            self._by.add(after.mass * share)
        self.expanded[nodes] = True

    def _insert(
        self, measures: Measures, parent: Integers, via: int
    ) -> tuple[Integers, Floats, Floats]:
        """The node of each measure, its weight, and a bound of the value of the rest."""
        key = self._keys(measures)
        unique, first, inverse = np.unique(key, return_index=True, return_inverse=True)
        known = self._known
        node = np.array([known.get(k, -1) for k in unique.tolist()], np.int64)
        new = np.flatnonzero(node < 0)
        new = new[np.argsort(first[new], kind="stable")]
        node[new] = self._size + np.arange(new.size)
        known.update(zip(unique[new].tolist(), node[new].tolist(), strict=True))
        added = measures.take(first[new])
        self._start.add(self._entries + added.start[1:])
        self._state.add(added.state)
        self._weight.add(added.weight)
        self.parent.add(parent[first[new]])
        self.via.add(np.full(new.size, via))
        self._size += new.size
        self._entries += added.state.size
        self.expanded = np.concatenate([self.expanded, np.zeros(new.size, bool)])
        node = node[inverse.ravel()]
        return node, *self._shares(measures, node)

    def _keys(self, measures: Measures) -> Integers:
        start, projection = measures.start[:-1], self._projection[:, measures.state]
        places = [
            np.rint(np.add.reduceat(measures.weight * x, start) * _MERGED) for x in projection
        ]
        sign = np.add.reduceat(self._sign[measures.state], start)
        with np.errstate(over="ignore"):
            key = sign + places[0].astype(np.int64) * 1_000_003
            return key * 998_244_353 + places[1].astype(np.int64)

    def _shares(self, measures: Measures, node: Integers) -> tuple[Floats, Floats]:
        """Largest weights w with ``w c <= m`` for the nodes c, and bounds of the value of ``m - w c``."""
        stored = self.measures().take(node)
        same = np.diff(stored.start) == np.diff(measures.start)
        if same.all() and (stored.state == measures.state).all():
            ratio, start = measures.weight / stored.weight, measures.start[:-1]
            share = np.minimum.reduceat(ratio, start)
            count = np.diff(measures.start)
            rest = np.maximum(measures.weight - share.repeat(count) * stored.weight, 0)
            return share, np.add.reduceat(rest * self.problem.corner[measures.state], start)
        # Two measures with one key and other states: the value is bounded state by state.
        size = self.problem.num_states
        dense, other = measures.matrix(size), stored.matrix(size)
        share = np.ones(node.size)
        whole = dense @ self.problem.corner
        difference = abs(dense - other).sum(1)
        agrees: Booleans = np.asarray(difference).ravel() == 0
        return np.where(agrees, share, 0.0), np.where(agrees, 0.0, whole)


class ExactBeliefs:
    """Beliefs of nodes in rational arithmetic: what exact successors keep of the states of a node.

    A probability is the shortest decimal of its double if those of its row sum to one, else the double
    divided by the sum of the row.
    """

    def __init__(self, graph: BeliefGraph) -> None:
        self.graph = graph
        self._belief: dict[int, Exact] = {}
        self._checked: dict[tuple[int, int], bool] = {}

    def belief(self, node: int) -> Exact:
        """The belief of a node, by states, not normalised."""
        graph, path = self.graph, [node]
        parent, via = graph.parent.array(), graph.via.array()
        while path[-1] not in self._belief and parent[path[-1]] >= 0:
            path.append(int(parent[path[-1]]))
        measures, problem = graph.measures(), graph.problem
        for place in range(len(path) - 1, -1, -1):
            at = path[place]
            if at in self._belief:
                continue
            first, last = measures.start[at : at + 2]
            states = measures.state[first:last].tolist()
            if parent[at] < 0:
                known = len(states) == 1
                self._belief[at] = {
                    s: Fraction(1 if known else float(problem.initial[s])) for s in states
                }
            else:
                after = self.after(int(parent[at]), int(via[at]))
                total = sum(after[s] for s in states)
                self._belief[at] = {s: after[s] / total for s in states}
        return self._belief[node]

    def after(self, node: int, action: int) -> Exact:
        """The measure after an action; what leaves the undecided states has the number -1."""
        problem = self.graph.problem
        host = problem.pomdp.fully_observable.host
        row = problem.pomdp.row_of_action[problem.state, action]
        result: Exact = {}
        for s, w in self.belief(node).items():
            first, last = host.entry_start[row[s] : row[s] + 2]
            numbers = host.probability[first:last].tolist()
            weights = [Fraction(repr(x)) for x in numbers]
            if sum(weights) != 1:
                weights = [Fraction(x) for x in numbers]
                total = sum(weights)
                weights = [x / total for x in weights]
            for t, p in zip(
                problem.number[host.successor[first:last]].tolist(), weights, strict=True
            ):
                result[t] = result.get(t, Fraction(0)) + w * p
        return result

    def is_exact(self, node: int, action: int, to: list[int], deviation: float) -> bool:
        """True if the beliefs of the nodes `to` are all that follows, and stored within a deviation."""
        key = node, action
        if key not in self._checked and self._is_deep((node, *to)):
            self._checked[key] = False
        if key not in self._checked:
            self._checked[key] = self._follows(node, action, to) and all(
                self._is_near(j, deviation) for j in (node, *to)
            )
        return self._checked[key]

    def _is_deep(self, nodes: tuple[int, ...]) -> bool:
        """True if exact beliefs would take too many steps from the initial one."""
        parent = self.graph.parent.array()
        for node in nodes:
            steps = 0
            while node >= 0 and node not in self._belief:
                node, steps = int(parent[node]), steps + 1
                if steps > _DEEPEST:
                    return True
        return False

    def _follows(self, node: int, action: int, to: list[int]) -> bool:
        after = self.after(node, action)
        covered = 0
        for j in to:
            belief = self.belief(j)
            if len({after.get(t, Fraction(0)) / w for t, w in belief.items()}) != 1:
                return False
            covered += len(belief)
        return covered == len(after)

    def _is_near(self, node: int, deviation: float) -> bool:
        """True if the stored measure is the exact belief up to a factor and a relative deviation."""
        measures, belief = self.graph.measures(), self.belief(node)
        first, last = measures.start[node : node + 2]
        total, limit = sum(belief.values()), Fraction(deviation)
        pairs = zip(
            measures.state[first:last].tolist(), measures.weight[first:last].tolist(), strict=True
        )
        return all(abs(Fraction(w) * total / belief[s] - 1) <= limit for s, w in pairs)
