"""Exploration of beliefs between a certified bound of all controllers and the value of one."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from jaxltl.core.array_types import Floats, Integers
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy
from jaxltl.core.values.partial_observability.beliefs import BeliefGraph
from jaxltl.core.values.partial_observability.bounds import BeliefRows, NodeValues
from jaxltl.core.values.partial_observability.certified_controllers import (
    Evaluated,
    Library,
    MemorySteps,
    row_edges,
    steps_of_rows,
)
from jaxltl.core.values.partial_observability.interpolation import (
    Interpolation,
    improve_bounds,
    near_visits,
    visits,
)
from jaxltl.core.values.partial_observability.problem import BeliefProblem
from jaxltl.core.values.partial_observability.rollouts import (
    action_guides,
    deviations,
    heaviest,
    roll_out,
)

Report = Callable[[int, float, float], None]  # of the number of beliefs and the bounds so far
_ROUND = 300  # beliefs that a round expands at least
_SHARE = 0.3  # of the expanded beliefs that a round expands at most
_IMPROVED = 0.5  # share of the time so far, beyond which the improvement of controllers waits
_SMALL = 1000  # beliefs of an exploration without rollouts
_SHARE_INTERPOLATED = 0.1  # the same where decompositions of leaves are useful
_GROWTH = 2  # of the time of an improvement over the one before
_ROLLED = 1e-2  # relative gain of a rollout that is worth the next one
_ROLLOUTS = 0.25  # share of the beliefs that rollouts expand, most
_REPEATS = 30  # evaluations of a controller that continues in its own steps
_IMPROVING = 4  # pairs of these for each transition between beliefs, on average at most
# Depth of the beliefs that a round expands below its first ones; the great one, in rounds 1, 2, 4, 8 ...,
# finds controllers, the small one narrows the bound of all controllers.
_DEPTH, _DEEP = 12, 300
_MOVING = 1e-3  # share of mass that is left in cycles, at which the certified engine solves them
_TIE = 1e-2  # width, relative to the gap, within which actions are as good as the best one
_NARROW = 1e-3  # width of a leaf, relative to that of the initial belief, that needs no expansion
_LONGEST = 8  # rounds
_COVERED = 1e-3  # weight of a leaf that one expanded belief covers
_USEFUL = (
    1e-3  # share of the gap that new decompositions of leaves save, else they wait for some rounds
)


@dataclass(frozen=True)
class BeliefBounds:
    """Bounds of the optimal value from the initial belief, and the controller that attains one of them."""

    outer: float  # of all controllers: the upper bound of a maximum
    inner: float  # of the controller: the lower bound of a maximum
    policy: FiniteMemoryPolicy
    num_beliefs: int  # expanded
    rounds: int
    is_complete: bool  # False if a limit ended the exploration
    exploration: Exploration | None = field(default=None, repr=False)  # the last one

    def joined(self, other: BeliefBounds, maximize: bool) -> BeliefBounds:
        """The bounds of another exploration, or of this one where they are narrower."""
        narrower, better = (min, max) if maximize else (max, min)
        best = other if better(self.inner, other.inner) == other.inner else self
        return replace(
            other,
            outer=narrower(self.outer, other.outer),
            inner=best.inner,
            policy=best.policy,
        )


@dataclass
class Exploration:
    """State of an exploration."""

    problem: BeliefProblem
    library: Library
    graph: BeliefGraph
    outer: Floats  # float64[nodes], bounds of all controllers
    inner: Floats  # float64[nodes], bounds of the library
    memory: Integers  # int[nodes], the memory state of the library that attains it
    best_outer: float
    best_inner: float
    best: tuple[Integers, Integers]  # the best controller: start memory and reached memory states
    end: float  # the time after which controllers are improved no more
    interpolation: Interpolation
    seconds: float = 0.0  # spent on the improvement of controllers
    latest: float = 0.0  # seconds of the latest improvement
    wait: tuple[int, int] = (
        0,
        1,
    )  # rounds until leaves are decomposed again, and after the next failure

    def extend(self) -> None:
        """Bounds of the nodes that are new."""
        graph, problem = self.graph, self.problem
        new = np.arange(self.outer.size, graph.size)
        some = graph.measures().take(new)
        seen = graph.observation()[new]
        worst = -np.inf if problem.maximize else np.inf
        matrix = some.matrix(problem.num_states)
        best = np.full(new.size, worst)
        for action, bound in enumerate(problem.action_bound):
            value = matrix @ np.where(np.isfinite(bound), bound, 0.0)
            value = np.where(problem.available[seen, action], value, worst)
            best = np.maximum(best, value) if problem.maximize else np.minimum(best, value)
        corner = matrix @ problem.corner
        best = np.minimum(best, corner) if problem.maximize else np.maximum(best, corner)
        sign = 1 if problem.maximize else -1
        self.outer = np.concatenate([self.outer, best * (1 + sign * 1e-12)])
        inner, memory = self.library.best_at(some)
        self.inner = np.concatenate([self.inner, inner])
        self.memory = np.concatenate([self.memory, memory])

    @property
    def gap(self) -> float:
        """The width of the bounds, of rewards relative to the value."""
        width = abs(self.best_outer - self.best_inner)
        share = self.problem.is_reward and np.isfinite(width)
        return width / max(abs(self.best_inner), 1e-300) if share and width else width

    def refresh(self) -> None:
        """Bounds of all leaves from the library, after it has changed."""
        leaves = np.flatnonzero(~self.graph.expanded)
        some = self.graph.measures().take(leaves)
        self.inner[leaves], self.memory[leaves] = self.library.best_at(some)

    def tighten(self, rows: BeliefRows, tolerance: float, room: int) -> tuple[BeliefRows, Floats]:
        """Improves the bounds of all controllers; the rows, and the visits of a policy that attains them."""
        rows, mass = self._sweep(rows, tolerance)
        pause, longest = self.wait
        leaves = np.flatnonzero((mass > 1e-9 * mass.sum()) & ~self.graph.expanded)
        if pause or not leaves.size or not np.isfinite(self.gap):
            self.wait = max(pause - 1, 0), longest
            return rows, mass
        if not self.interpolation.expand_states(leaves, room):
            self.wait = longest, min(2 * longest, _LONGEST)
            return rows, mass
        self.extend()
        rows = BeliefRows(self.graph, self.graph.rows())
        mass = np.append(mass, np.zeros(self.graph.size - mass.size))
        before = self.outer[leaves]
        self.interpolation.refine(leaves[np.argsort(-mass[leaves], kind="stable")], self.outer)
        rows, after = self._sweep(rows, tolerance)
        saved = float(mass[leaves] @ np.abs(before - self.outer[leaves]))
        useful = self.interpolation.is_useful = saved > _USEFUL * self.gap
        self.wait = (0, 1) if useful else (longest, min(2 * longest, _LONGEST))
        return rows, after

    def _sweep(self, rows: BeliefRows, tolerance: float) -> tuple[BeliefRows, Floats]:
        """Value iteration, then the certified engine if its policy stays in cycles."""
        decomposed, problem = self.interpolation.leaves(), self.problem
        bound = improve_bounds(rows, decomposed, self.outer, tolerance)
        mass, moving = visits(rows, decomposed, bound.row)
        # A maximal reward is finite only where all policies leave: there value iteration is enough.
        if moving > _MOVING and not (problem.is_reward and problem.maximize):
            solved = rows.solve(self.outer, safe=True, tolerance=min(1e-4, tolerance / 8))
            better = np.minimum if problem.maximize else np.maximum
            self.outer = better(self.outer, solved.value)
            mass, _ = visits(rows, decomposed, solved.row)
        return rows, mass

    def begin_by_rollouts(self, room: int) -> None:
        """Expands beliefs along guides while the policy of the rows gets better by that."""
        sign = 1 if self.problem.maximize else -1
        guides, before = action_guides(self.problem), -np.inf
        node, weight, _ = self.graph.root
        mass: Floats = np.bincount(node, weight, minlength=self.graph.size).astype(np.float64)
        while room > 0:
            for guide in guides:
                leaves = np.append(mass, np.zeros(self.graph.size - mass.size))
                leaves[self.graph.expanded] = 0
                room -= roll_out(self.graph, leaves, guide, room)
            self.extend()
            rows = BeliefRows(self.graph, self.graph.rows())
            policy = rows.solve(self.inner, safe=False, tolerance=1e-5)
            value = sign * rows.at_root(policy.value)
            if not value > before + _ROLLED * abs(value) or time.monotonic() > self.end:
                break
            mass, before = deviations(rows, policy.row), value
        self.improve(rows)

    def keep(self, evaluated: Evaluated, start: Integers) -> bool:
        """Keeps a controller if it is the best one."""
        sign = 1 if self.problem.maximize else -1
        if not sign * evaluated.initial > sign * self.best_inner:
            return False
        self.best_inner = evaluated.initial
        self.best = start, np.unique(evaluated.chain.memory)
        return True

    def improve(self, rows: BeliefRows) -> bool:
        """Evaluates controllers of the explored beliefs, and counts the time; True if one is better."""
        begin = time.monotonic()
        better = self._improve(rows)
        self.latest = time.monotonic() - begin
        self.seconds += self.latest
        return better

    def _improve(self, rows: BeliefRows) -> bool:
        """Evaluates controllers of the explored beliefs; True if one is better.

        At its leaves a controller continues in the library; then, while that improves it, in its own steps.
        """
        problem, library = self.problem, self.library
        policy = rows.solve(self.inner, safe=False, tolerance=1e-5)
        sign = 1 if problem.maximize else -1
        least = 2e-3 * self.gap if np.isfinite(self.gap) else 0.0
        if not sign * (rows.at_root(policy.value) - self.best_inner) > least:
            return False
        work = _IMPROVING * rows.table["to"].size + 10 * _IMPROVING
        initial = np.flatnonzero(problem.initial > 0)
        memory, best = self.memory, None
        for _ in range(_REPEATS):
            steps, start, leaves = self._controller(rows, policy, memory)
            evaluated = library.evaluate(library.machine(start, steps), initial)
            change = np.inf if best is None else sign * (evaluated.initial - best[1].initial)
            if not change > least:
                break
            best = steps, evaluated, start
            work -= evaluated.bound.size
            late = work < 0 or time.monotonic() > self.end
            if late or not problem.maximize or not leaves.size:
                break
            some = rows.graph.measures().take(leaves)
            value, chosen = library.alternatives(some, evaluated, library.steps.size)
            better = value > self.inner[leaves]
            memory = self.memory.copy()
            memory[leaves[better]] = chosen[better]
        assert best is not None
        if not sign * best[1].initial > sign * self.best_inner:
            return False
        self.best_inner = best[1].initial
        start = library.freeze(*best)
        self.best = start, np.arange(library.num_blocks, library.num_blocks + library.steps.size)
        self.refresh()
        return True

    def _controller(
        self, rows: BeliefRows, policy: NodeValues, memory: Integers
    ) -> tuple[MemorySteps, Integers, Integers]:
        """MemorySteps of a policy of rows, the memory states of initial observations, and the leaves it reaches."""
        graph, table, library = rows.graph, rows.table, self.library
        count = self.problem.pomdp.num_observations
        reached = np.zeros(graph.size, bool)
        level = graph.root[0]
        reached[level] = True
        while level.size:
            inner = level[policy.row[level] >= 0]
            entry, _ = row_edges(table["start"], policy.row[inner])
            after = np.unique(table["to"][entry])
            level = after[~reached[after]]
            reached[level] = True
        nodes = np.flatnonzero(reached & (policy.row >= 0))
        memory = memory.copy()
        memory[nodes] = library.num_blocks + library.steps.size + np.arange(nodes.size)
        row = policy.row[nodes]
        entry, place = row_edges(table["start"], row)
        seen, to = graph.observation(), table["to"][entry]
        edges = place, seen[to], memory[to]
        steps = steps_of_rows(seen[nodes], table["action"][row], edges, count)
        start = np.full(count, library.fallback, np.int64)
        start[seen[graph.root[0]]] = memory[graph.root[0]]
        return steps, start, np.flatnonzero(reached & (policy.row < 0))


def explore(
    problem: BeliefProblem,
    controllers: Sequence[FiniteMemoryPolicy],
    *,
    tolerance: float,
    max_beliefs: int,
    max_seconds: float = np.inf,
    report: Report | None = None,
    goal: float | None = None,
) -> BeliefBounds:
    """Expands beliefs that matter most until the bounds are within the tolerance, or a limit is met.

    With a `goal` until the bound of all controllers is as good, without a search for controllers.
    """
    begin = time.monotonic()
    library = Library(problem, list(controllers))
    graph = BeliefGraph(problem)
    none, ends = np.zeros(0, np.int64), (np.inf, -np.inf)
    outer, inner = ends if problem.maximize else ends[::-1]
    state = Exploration(
        problem,
        library,
        graph,
        np.zeros(0),
        np.zeros(0),
        none,
        outer,
        inner,
        (none, none),
        begin + max_seconds,
        Interpolation(graph),
    )
    initial = np.flatnonzero(problem.initial > 0)
    for start in library.start:
        state.keep(library.evaluate(library.machine(start), initial), start)
    state.extend()
    if max_beliefs > _SMALL:
        state.begin_by_rollouts(int(_ROLLOUTS * max_beliefs))
    rounds, complete, checked = 0, False, 0
    try:
        while True:
            rows = BeliefRows(graph, graph.rows())
            room = max_beliefs - int(graph.expanded.sum())
            rows, mass = state.tighten(rows, tolerance, room)
            at_root = rows.at_root(state.outer)
            narrower = min if problem.maximize else max
            state.best_outer = narrower(state.best_outer, at_root)
            expanded = int(graph.expanded.sum())
            leaves = rows.reaches_leaves()
            now = time.monotonic()
            # An improvement, the last one too, takes longer than the one before.
            late = now + _GROWTH * state.latest > state.end
            early = not late and state.seconds <= _IMPROVED * (now - begin)
            if goal is None and ((early and expanded >= 1.25 * checked + 20) or not leaves):
                checked = expanded
                state.improve(rows)
            rounds += 1
            if report is not None:
                low, high = sorted((state.best_inner, state.best_outer))
                report(expanded, low, high)
            sign = 1 if problem.maximize else -1
            reached = goal is not None and sign * state.best_outer <= sign * goal
            if state.gap <= tolerance or not leaves or reached:
                complete = reached or state.gap <= tolerance
                break
            room = max_beliefs - expanded
            late = room <= 0 or time.monotonic() + _GROWTH * state.latest > state.end
            depth = _DEEP if rounds & (rounds - 1) == 0 else _DEPTH
            if late or not _grow(state, mass, room, depth):
                if goal is None:
                    state.improve(rows)
                complete = state.gap <= tolerance
                break
    except KeyboardInterrupt:
        pass
    return BeliefBounds(
        state.best_outer,
        state.best_inner,
        library.policy(*state.best),
        int(graph.expanded.sum()),
        rounds,
        complete,
        state,
    )


def _scores(state: Exploration, mass: Floats) -> Floats:
    """Visits of leaves that are not narrow, weighted by the share that no belief of a decomposition covers."""
    share = 1 - state.interpolation.covered() + _COVERED
    with np.errstate(invalid="ignore"):
        width = abs(state.best_outer - state.best_inner)
        narrow = np.abs(state.outer - state.inner) <= _NARROW * width
        wide = ~(narrow & np.isfinite(width))
    return np.where(state.graph.expanded | ~wide, 0, share * mass)


def _grow(state: Exploration, mass: Floats, room: int, deepest: int) -> bool:
    """Expands leaves of the greatest gaps, weighted by visits, and some beliefs below them."""
    graph = state.graph
    share = _SHARE
    if state.interpolation.is_useful:
        # Children have no decompositions yet: their bounds are too loose to choose the best action below.
        share, deepest = _SHARE_INTERPOLATED, 0
    amount = min(room, max(_ROUND, int(share * graph.expanded.sum())))
    score = _scores(state, mass)
    if not (score > 0).any():
        # The policy reaches no leaf: it stays in end components of inexact beliefs. The oldest leaves follow.
        score = np.where(graph.expanded, 0, 1 / (1 + np.arange(graph.size)))
        deepest = 0
    done = 0
    for depth in range(deepest + 1):
        chosen = heaviest(score, max(amount - done, 1))
        size, before = graph.size, graph.num_rows
        graph.expand(chosen)
        state.extend()
        done += chosen.size
        if done >= amount or depth == deepest:
            break
        # The children of the best action by the bounds of leaves.
        mass = np.append(mass, np.zeros(graph.size - size))
        score, mass = _below(state, chosen, mass, before)
        if not (score > 0).any():
            break
    if done < amount:
        # The policy has few leaves: those of other actions that are nearly as good follow.
        rows = BeliefRows(graph, graph.rows())
        mass = near_visits(rows, state.outer, _TIE * abs(state.best_outer - state.best_inner))
        graph.expand(heaviest(np.where(graph.expanded, 0, mass), amount - done))
        state.extend()
    return True


def _below(
    state: Exploration, parents: Integers, mass: Floats, before: tuple[int, int]
) -> tuple[Floats, Floats]:
    """Scores of the unexpanded successors of some nodes under their best actions."""
    graph, problem = state.graph, state.problem
    part = graph.rows_from(before)
    node, gain, lost, count, to, by = (
        part[name] for name in ("node", "gain", "lost", "count", "to", "by")
    )
    row = np.arange(node.size).repeat(count)
    value = gain + lost + np.bincount(row, by * state.outer[to], minlength=node.size)
    order = np.lexsort((-value if problem.maximize else value, node))
    best = np.zeros(node.size, bool)
    best[order[np.append(True, node[order][1:] != node[order][:-1])]] = True
    arriving = np.bincount(to[best[row]], (by * mass[node[row]])[best[row]], minlength=graph.size)
    return _scores(state, arriving.astype(np.float64)), mass + arriving
