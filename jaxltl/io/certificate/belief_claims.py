"""Claims of bounds of all policies of a POMDP by stored beliefs; docs/certificates.md derives them.

Values of rows are the fast informed bound (Hauskrecht 2000). Explored beliefs are rounded to integers, and
the exact measures after them are covered by stored beliefs, up to a rest with the informed bound. Value
iteration from above keeps the inequalities of the checker, since each step is rounded outwards. Values y are
those of the checker: ``x`` of upper bounds, ``-x`` of lower ones, ``1 - x`` of lower ones of formulas. They
decrease.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple, cast

import numpy as np

from jaxltl import checker
from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.models.pomdp import POMDP
from jaxltl.core.values.partial_observability.bounds import BeliefRows
from jaxltl.core.values.partial_observability.controller_gradient import SoftmaxAscent
from jaxltl.core.values.partial_observability.exploration import Exploration, explore
from jaxltl.core.values.partial_observability.problem import EPS, reach_problem, reward_problem
from jaxltl.io.certificate.inductive_bounds import Certified, as_text, store

_INFORMED_SWEEPS = 300  # of the fast informed bound, most
_SWEEPS = 2000  # of value iteration over beliefs, most
_RISING = 1000  # sweeps after which values that still rise become the informed bound
_REACHED = 1e-9  # relative distance to the goal of the exploration at which it ends
_LOOSE = 1e-8  # relative difference of a belief's bound and what follows from its successors
_STILL = 1e-10  # relative change of a sweep at which iterations end
_SCALE = 2**48  # denominator of rounded beliefs
_WIDEST, _DEEPEST = 40, 100  # states and steps of a belief up to which it is exact
LARGEST_COVER = 64  # terms, the checker's limit

Improvement = Callable[
    [Certified, checker.CertificateFile, dict[str, object]], dict[str, object]
]  # of a claim
Measure = dict[int, int]  # integer masses of nodes of the checker


@dataclass(frozen=True)
class BeliefSearch:
    """The exploration from which beliefs are stored."""

    pomdp: POMDP
    goal: float  # the bound at which it ends
    tolerance: float  # of value iteration
    max_beliefs: int

    def improve(
        self, problem: Certified, file: checker.CertificateFile, claim: dict[str, object]
    ) -> dict[str, object]:
        """The claim with stored beliefs, or the one of policies that see states if it is as good."""
        plain = checker.ClaimChecker(file, claim)
        is_covered = plain.file.kind != "total" and plain.width == math.prod(problem.shape[1:])
        if plain.infinite or plain.is_signed or not is_covered:
            return claim
        nodes = _CheckedNodes(problem, plain, np.asarray(self.pomdp.observation))
        explored = self._explore(nodes)
        if explored is None:
            return claim
        side = str(claim["side"])
        names = {x: f"{side}_{x}" for x in ("rows", "vectors", "covers", "values")}
        rows = names.pop("rows")
        shape = (len(file.model.rows), *problem.shape[1:])
        store(file, rows, nodes.stored(nodes.informed_rows()), shape)
        improved: dict[str, object] = {"side": side, "bound": "0", "values": rows, "beliefs": names}
        stored = _StoredBeliefs(nodes, file, improved, explored)
        bounds = np.array([stored.solve()])
        improved["bound"] = as_text(Fraction(nodes.stored(bounds)[0]), side)
        old, new = (Fraction(str(x["bound"])) for x in (claim, improved))
        is_better = new < old if side == "upper" else new > old
        if is_better:
            with contextlib.suppress(checker.Refusal):
                checker.ClaimChecker(file, improved).check()
                _remove(file, str(claim["values"]), str(claim.get("policy", "")))
                return improved
        _remove(file, rows, *names.values())
        return claim

    def _explore(self, nodes: _CheckedNodes) -> Exploration | None:
        """Explores beliefs of the undecided nodes of a claim's graph; None if the initial ones are decided."""
        problem, maximize = nodes.problem, nodes.claim.is_upper
        host, pomdp = problem.host, POMDP(problem.sparse, nodes.seen)
        if "reward" in problem.path:
            reward = np.add.reduceat(host.probability * problem.gain, host.entry_start[:-1])
            question = reward_problem(pomdp, reward, problem.target, maximize=maximize)
        else:
            target = nodes.end != 0
            lost = nodes.is_end & ~target
            question = reach_problem(pomdp, target & nodes.is_end, ~lost, maximize=maximize)
        if not (question.initial > 0).any():
            return None
        known = SoftmaxAscent.random(question, 1, 0.0, 0).policies()
        goal, limit = self.goal, self.max_beliefs
        goal = 1 - goal if nodes.claim.is_negated else goal
        goal += (1 if maximize else -1) * _REACHED * max(1.0, abs(goal))
        bounds = explore(question, known, tolerance=self.tolerance, max_beliefs=limit, goal=goal)
        return bounds.exploration


class _CheckedNodes:
    """The states of a problem as nodes of the checker, and where the question ends."""

    def __init__(
        self, problem: Certified, claim: checker.ClaimChecker, observation: Integers
    ) -> None:
        self.problem, self.claim = problem, claim
        graph, self.ends, self.initial = claim.explored(True)
        node = problem.node.tolist()
        self.seen = observation[problem.node // claim.width]
        self.end: Floats = np.array([self.ends.get(v, 0) / claim.one for v in node])
        self.is_end: Booleans = np.array([v in self.ends for v in node])
        self.is_undecided: Booleans = np.array([v in graph for v in node]) & ~self.is_end
        size = int(np.bincount(self.seen, minlength=1).max(initial=1))
        self.slack = 4 * (size + 40) * EPS

    def outwards(self, y: Floats) -> Floats:
        """Values after rounding that covers that of a sum of terms of one sign."""
        return y + self.slack * np.abs(y)

    def stored(self, y: Floats | list[Fraction]) -> Floats | list[Fraction]:
        """Values x of the file."""
        if self.claim.is_negated:
            return [1 - Fraction(x) for x in y]
        if isinstance(y, np.ndarray):
            return y if self.claim.is_upper else -y
        return y if self.claim.is_upper else [-x for x in y]

    def informed_rows(self) -> Floats | list[Fraction]:
        """The fast informed bound of each row and automaton state, from the claim's values on."""
        problem, claim, host = self.problem, self.claim, self.problem.host
        y = [Fraction(claim.y[v], claim.one) for v in problem.node.tolist()]
        first: Floats = np.array([float(x) for x in y])
        _, p = problem.means(np.zeros(host.num_states))
        sign = 1 if claim.is_upper else -1
        gain = sign * problem.gain + np.where(self.is_end, self.end, 0.0)[host.successor]
        base = np.add.reduceat(p * gain, host.entry_start[:-1])
        entry = np.flatnonzero(~self.is_end[host.successor])
        entry = entry[np.lexsort((self.seen[host.successor[entry]], host.row[entry]))]
        row, successor, p = host.row[entry], host.successor[entry], p[entry]
        key = row * np.int64(self.seen.max() + 1) + self.seen[successor]
        start = np.flatnonzero(np.append(True, key[1:] != key[:-1])) if entry.size else entry
        count = np.diff(host.row_start)
        value = self.outwards(first)[host.state]
        for _ in range(_INFORMED_SWEEPS if entry.size else 0):
            best = np.full(start.size, -np.inf)
            for k in range(int(count.max())):
                there = k < count[successor]
                term = np.where(there, value[host.row_start[successor] + k * there] * p, -np.inf)
                best = np.maximum(best, np.add.reduceat(term, start))
            total: Floats = base + np.bincount(row[start], best, host.num_rows).astype(np.float64)
            new = np.minimum(value, self.outwards(total))
            new = np.where(self.is_end[host.state], value, new)
            change = np.abs(new - value).max()
            value = new
            if change <= _STILL * max(1.0, float(np.abs(value).max())):
                break
        # Where nothing was gained, the exact value is that of the claim.
        is_better = value < first[host.state] - self.slack * np.abs(first[host.state])
        states = host.state.tolist()
        exact = [
            Fraction(v) if b else y[s]
            for v, b, s in zip(value.tolist(), is_better, states, strict=True)
        ]
        at = self.row_nodes()
        result = [Fraction(0)] * (len(claim.model.rows) * claim.width)
        for place, x in zip(at.tolist(), exact, strict=True):
            result[place] = x
        rounded = np.array([float(x) for x in result])
        is_double = all(Fraction(v) == x for v, x in zip(rounded.tolist(), result, strict=True))
        return rounded if is_double else result

    def row_nodes(self) -> Integers:
        """The place of each row among the checker's values of rows."""
        host, claim = self.problem.host, self.claim
        state, q = np.divmod(self.problem.node[host.state], claim.width)
        rank = np.arange(host.num_rows) - host.row_start[host.state]
        return (np.array(claim.model.row_start, np.int64)[state] + rank) * claim.width + q


class _BeliefCover(NamedTuple):
    """A measure after a belief and an action, of one observation."""

    terms: list[int]  # stored beliefs
    weights: list[float]
    rest: float  # the informed bound of what they leave
    informed: float  # that of the measure
    is_whole: bool  # whether they leave nothing


class _BeliefRow(NamedTuple):
    """A belief and an action, or an initial measure: a constant, and the measures after it."""

    belief: int  # -1 of an initial measure
    constant: float  # of what is earned, and of what ends
    is_closed: bool  # whether all of it is stored beliefs
    covers: list[_BeliefCover]


class _StoredBeliefs:
    """Stored beliefs, the covers of what follows them, and values that satisfy the inequalities."""

    def __init__(
        self,
        nodes: _CheckedNodes,
        file: checker.CertificateFile,
        claim: dict[str, object],
        explored: Exploration,
    ) -> None:
        self.nodes, self.file, self.explored = nodes, file, explored
        self.names = cast(dict[str, str], claim["beliefs"])
        graph = explored.graph
        # Nodes of the exploration, but for states that are reachable through the target alone.
        some, number = graph.measures(), graph.problem.state
        is_known = nodes.is_undecided[number[some.state]]
        is_known = (
            np.logical_and.reduceat(is_known, some.start[:-1]) if some.size else graph.expanded
        )
        self.node = np.flatnonzero(graph.expanded & is_known)
        self.place = np.full(graph.size, -1)
        self.place[self.node] = np.arange(self.node.size)
        self._store([], [], np.zeros(0))
        self.check = checker.ClaimChecker(file, claim)
        self.check.graph, self.check.ends, _ = self.check.explored(True)  # over its denominator
        some = some.take(self.node)
        checked = nodes.problem.node[number[some.state]].tolist()
        ranges = zip(some.start[:-1].tolist(), some.start[1:].tolist(), strict=True)
        self.beliefs: list[Measure] = [
            dict(zip(checked[a:b], _integers(some.weight[a:b], self._exact(v)), strict=True))
            for v, (a, b) in zip(self.node.tolist(), ranges, strict=True)
        ]
        self.check.beliefs = self.beliefs
        self.rows = [*self._rows()]
        self.values: Floats = np.zeros(self.node.size)

    def _exact(self, node: int) -> list[Fraction]:
        """The exact belief of a node, in the order of its states; empty if it is far or large."""
        graph = self.explored.graph
        first, last = graph.measures().start[node : node + 2]
        parent, depth, at = graph.parent.array(), 0, node
        while at >= 0 and depth <= _DEEPEST:
            at, depth = int(parent[at]), depth + 1
        if last - first > _WIDEST or depth > _DEEPEST:
            return []
        belief = graph.exact.belief(node)
        return [belief[s] for s in graph.measures().state[first:last].tolist()]

    def _store(self, beliefs: list[Measure], covers: list[list[list[int]]], values: Floats) -> None:
        """Stores arrays in the file: lists of numbers after their lengths."""
        vectors = [x for b in beliefs for x in (len(b), *(n for e in b.items() for n in e))]
        terms = [x for row in covers for cover in row for x in (len(cover), *cover)]
        for name, numbers, bits in (("vectors", vectors, 64), ("covers", terms, 32)):
            content = np.array(numbers, f"<u{bits // 8}").tobytes()
            self.file.contents[f"certificate/{self.names[name]}.bin"] = content
            entry = {"dtype": f"uint{bits}", "shape": [len(numbers)]}
            self.file.members[self.names[name]] = entry
        store(self.file, self.names["values"], self.nodes.stored(values), (values.size,))

    def _terms(self) -> dict[int, list[int]]:
        """The stored beliefs of which each node of the exploration is made, by decreasing use."""
        terms = {v: [j] for j, v in enumerate(self.node.tolist())}
        outer, rows = (
            self.explored.outer,
            BeliefRows(self.explored.graph, self.explored.graph.rows()),
        )
        table, sign = rows.table, 1 if self.nodes.claim.is_upper else -1
        backup = np.full(outer.size, -np.inf)
        np.maximum.at(
            backup, table["node"], sign * (table["gain"] + table["lost"] + rows.matrix @ outer)
        )
        # The bound of an expanded belief may be that of its decomposition, before it was expanded.
        is_loose = backup > sign * outer + _LOOSE * np.abs(outer)
        for expanded in (False, True):
            leaf, matrix = self.explored.interpolation.leaves(expanded)
            for i, node in enumerate(leaf.tolist()):
                to = self.place[matrix.indices[matrix.indptr[i] : matrix.indptr[i + 1]]]
                if not expanded or is_loose[node]:
                    terms[node] = to[to >= 0].tolist()[:LARGEST_COVER]
        return terms

    def _rows(self) -> Iterator[_BeliefRow]:
        """The initial measures, then all beliefs with all actions, in the checker's order."""
        graph, problem, check = self.explored.graph, self.explored.graph.problem, self.check
        seen, table, terms = graph.observation(), graph.rows(), self._terms()

        def row(belief: int, gain: int, mass: Measure, scale: int, after: list[int]) -> _BeliefRow:
            ended, parts = check.parts(mass)
            by_observation = {int(seen[j]): terms.get(j, []) for j in after}
            observation = (self.file.observation[next(iter(x)) // check.width] for x in parts)
            pairs = zip(parts, observation, strict=True)
            covers = [self._cover(part, scale, by_observation.get(o, [])) for part, o in pairs]
            is_closed = len(mass) == sum(map(len, parts)) and all(c.is_whole for c in covers)
            constant = (gain + ended) / (scale * check.one)
            return _BeliefRow(belief, constant, is_closed and not gain, covers)

        weights, roots = self.file.weights, graph.root[0].tolist()
        starts = [{v: 1} for v in self.nodes.initial]
        if weights:
            chosen = [weights[v // check.width] for v in self.nodes.initial]
            numbers = checker.to_integers(chosen)[0][0]
            starts = [{v: n for v, n in zip(self.nodes.initial, numbers, strict=True) if n}]
        for start in starts:
            yield row(-1, 0, start, sum(start.values()), roots)
        nodes, actions = table["node"].tolist(), table["action"].tolist()
        ends = zip(table["start"][:-1].tolist(), table["start"][1:].tolist(), strict=True)
        following = {
            (v, a): table["to"][begin:end].tolist()
            for v, a, (begin, end) in zip(nodes, actions, ends, strict=True)
        }
        first = graph.measures().start[self.node]
        state = problem.state[graph.measures().state[first]]
        model = problem.pomdp.fully_observable
        for j, (node, belief) in enumerate(zip(self.node.tolist(), self.beliefs, strict=True)):
            begin, end = model.host.row_start[state[j] : state[j] + 2].tolist()
            for k, action in enumerate(model.action_number[begin:end].tolist()):
                gain, mass, common = check.moved(belief, k)
                scale = common * sum(belief.values())
                yield row(j, gain, mass, scale, following.get((node, action), []))

    def _cover(self, mass: Measure, scale: int, terms: list[int]) -> _BeliefCover:
        """The cover of a measure divided by a scale, by some of the stored beliefs."""
        check, kept, weights = self.check, [], []
        informed, factor = check.informed(mass) / (scale * check.one), scale
        for j in terms:
            n, d, rest = check.taken_out(mass, j)
            if n:
                mass, factor = rest, factor * d
                kept.append(j)
                weights.append(n * sum(self.beliefs[j].values()) / factor)
        least = check.informed(mass) / (factor * check.one) if mass else 0.0
        return _BeliefCover(kept, weights, least, informed, not mass)

    def solve(self) -> float:
        """Values by value iteration, without beliefs that are not needed; the initial bound.

        They begin at those of the exploration, raised to satisfy all inequalities. Where they would rise
        on and on, in cycles that rounding breaks, they are the informed bound.
        """
        from scipy.sparse import coo_array

        nodes, size = self.nodes, self.node.size
        covers = [cover for row in self.rows for cover in row.covers]
        row_of = np.arange(len(self.rows)).repeat([len(row.covers) for row in self.rows])
        rest, informed = np.array([(c.rest, c.informed) for c in covers]).reshape(-1, 2).T
        group = np.arange(len(covers)).repeat([len(c.terms) for c in covers])
        to = np.array([j for c in covers for j in c.terms], np.int64)
        by = np.array([w for c in covers for w in c.weights])
        matrix = coo_array((by, (group, to)), shape=(len(covers), size)).tocsr()
        constant = np.array([row.constant for row in self.rows])
        owner = np.array([row.belief for row in self.rows])
        first = np.searchsorted(owner, np.arange(size))
        # Rows of stored beliefs alone have a mean of their values, whatever is rounded.
        is_closed = np.array([row.is_closed for row in self.rows])
        closed = np.flatnonzero(is_closed[row_of[group]])

        def summed(bound: Floats) -> Floats:
            return np.bincount(row_of, bound, constant.size).astype(np.float64)

        def backup(y: Floats) -> tuple[Floats, Floats]:
            covered = np.minimum(informed, nodes.outwards(matrix @ y + rest))
            total = nodes.outwards(constant + summed(covered))
            largest = np.full(constant.size, -np.inf)
            np.maximum.at(largest, row_of[group[closed]], y[to[closed]])
            return np.where(is_closed, np.minimum(total, largest), total), covered

        def best(y: Floats) -> Floats:
            return np.maximum.reduceat(backup(y)[0], first) if size else y

        scale = [sum(b.values()) * self.check.one for b in self.beliefs]
        top = nodes.outwards(
            np.array([self.check.informed(b) / x for b, x in zip(self.beliefs, scale, strict=True)])
        )
        sign = 1 if nodes.claim.is_upper else -1
        y = np.minimum(top, nodes.outwards(sign * self.explored.outer[self.node]))
        for sweep in range(2 * _SWEEPS):
            new = np.minimum(top, np.maximum(y, best(y)))
            rises = new > y
            y = np.where(rises & (sweep > _RISING), top, new)
            if not rises.any():
                break
        for _ in range(_SWEEPS):
            new = np.minimum(y, best(y))
            change = np.abs(new - y).max(initial=0)
            y = new
            if change <= _STILL * max(1.0, float(np.abs(y).max(initial=0))):
                break
        value, covered = backup(y)
        loose = nodes.outwards(constant + summed(informed))
        is_loose = (loose <= y[owner]) & (owner >= 0) if size else owner >= 0
        self._keep(y, is_loose[row_of] | ((covered >= informed) & ~is_closed[row_of]))
        return float(value[owner < 0].max())

    def _keep(self, y: Floats, is_informed: Booleans) -> None:
        """Keeps the beliefs that are reachable by covers, of which some are the informed bound."""
        used = iter(is_informed.tolist())
        chosen = [[[] if next(used) else cover.terms for cover in row.covers] for row in self.rows]
        of_belief: list[list[int]] = [[] for _ in self.beliefs]
        number: dict[int, int] = {}
        for r, row in enumerate(self.rows):
            if row.belief >= 0:
                of_belief[row.belief].append(r)
            else:
                number |= {j: 0 for cover in chosen[r] for j in cover}
        pending = [*number]
        for j in pending:
            after = {i for r in of_belief[j] for cover in chosen[r] for i in cover} - number.keys()
            number |= dict.fromkeys(after, 0)
            pending += after
        kept = sorted(number)
        number = {j: i for i, j in enumerate(kept)}
        rows = [r for r, row in enumerate(self.rows) if row.belief < 0 or row.belief in number]
        renamed = [[[number[j] for j in cover] for cover in chosen[r]] for r in rows]
        self._store([self.beliefs[j] for j in kept], renamed, y[kept])


def _remove(file: checker.CertificateFile, *names: str) -> None:
    for name in names:
        file.members.pop(name, None)
        file.contents.pop(f"certificate/{name}.bin", None)


def _integers(weight: Floats, exact: Sequence[Fraction] = ()) -> list[int]:
    """Positive integers in the proportions of a belief: exact if they are small, else rounded."""
    if exact:
        common = math.lcm(*[x.denominator for x in exact])
        numbers = [int(x * common) for x in exact]
        divisor = math.gcd(*numbers)
        if max(numbers) // divisor < 2**63:
            return [n // divisor for n in numbers]
    largest = weight.max()
    return [max(1, round(x / largest * _SCALE)) for x in weight.tolist()]
