"""Expected steps to satisfaction: of policies, of fastest optimal policies, and Pareto fronts.

Stochastic shortest paths (Bertsekas and Tsitsiklis 1991) to a decision, and long-run rates of
acceptance (Puterman 1994, chapters 8 and 9). docs/optimal-actions.md has the proofs.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.graphs.attractor import max_sets
from jaxltl.core.graphs.graph import graph_of
from jaxltl.core.models.ops.array_namespace import is_traced
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Array
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.contraction import with_stops
from jaxltl.core.sparse.graph.qualitative import end_components
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers import reachability as optimal
from jaxltl.core.sparse.solvers.average_reward import average
from jaxltl.core.sparse.solvers.shortest_path import with_exits
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure, RelativeTolerance
from jaxltl.core.types import Solution, Status
from jaxltl.core.values.engine.host_solution import PolicyChain, induced_chain, status_between
from jaxltl.core.values.engine.state_quantities import safe_ends
from jaxltl.core.values.engine.validated import validated
from jaxltl.core.values.undiscounted.fastest import possibly_optimal_rows, tied_rows
from jaxltl.core.values.undiscounted.optimal_actions import OptimalActions, optimal_actions
from jaxltl.core.values.undiscounted.policy_gradient import transient_factors
from jaxltl.core.values.engine.row_form import on_actions, on_rows, rows_of
from jaxltl.core.values.undiscounted.acceptance import Reaching, as_product, as_reachability
from jaxltl.core.values.undiscounted.satisfaction import satisfaction_probability


_EPS = float(np.finfo(np.float64).eps)
_PART_WIDTH = 1e-9  # relative width to which each part is solved
_TOLERANCE = 1e-6  # relative width of a converged enclosure
_MAX_SWEEPS = 1_000_000  # of the rates of acceptance
_PROBABILITY_WIDTH = 1e-10  # width of probabilities; the default width may need exact fractions
_OPTIMUM_WIDTH = 1e-11  # relative width of the maximal probability, for its ties
_LOSS = 1e-9  # of the satisfaction probability, relative, that counts as a rounding error


@brief
class Steps(NamedTuple):
    """Expected number of steps to satisfaction, the mean over the initial states.

    Of a co-safe task, the expected number of steps until the formula is decided: satisfied, or
    lost, which means that no policy can satisfy it any more. Of a task without end (Buchi and
    parity), the sum of two terms: the expected number of steps outside of accepting end components
    before it is lost, and the expected number of steps between two rounds of acceptance in the
    long run, given that the task is satisfied. A round ends where an even priority is read that is
    less than all odd priorities of the bottom component. Of a safety task 0.

    Attributes:
      value: the number; infinite if the task stays undecided with positive probability.
      lower, upper: certified bounds.
      status: CONVERGED if the bounds agree in six digits, or are infinite; else PRECISION.

    Example:
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[0.5, 0.5]], [[0.0, 1.0]]], label=[[0], [1]], propositions=["a"],
      ...                    initial=[1, 0])
      >>> round(satisfaction_steps(product(world, "F a"), np.ones((2, 2, 1))).value, 6)
      2.0
    """

    value: float
    lower: float
    upper: float
    status: Status


@brief
class Quickest(NamedTuple):
    """The quickest optimal policy.

    Attributes:
      policy: ``int32[S, Q]``, an optimal policy.
      steps: its :class:`Steps`.
      least: lower bound of the steps of every optimal policy.
      status: CONVERGED if the bounds meet, so that the policy is the quickest up to six digits;
        PRECISION if a quicker optimal policy is not excluded, which may be so for tasks without
        end. A policy counts as optimal if it loses at most a share of 1e-9 of the probability.

    Example:
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[0.5, 0.5]], [[0.0, 1.0]]], label=[[0], [1]], propositions=["a"],
      ...                    initial=[1, 0])
      >>> round(quickest_policy(product(world, "F a")).least, 6)
      2.0
    """

    policy: np.ndarray
    steps: Steps
    least: float
    status: Status = Status.PRECISION


@validated()
def satisfaction_steps(model: Product, policy: Array) -> Steps:
    """Expected number of steps of a policy until its task is decided, with certified bounds.

    Args:
      model: a concrete product.
      policy: ``float[S, Q, A]`` or ``int32[S, Q]``.

    Returns:
      :class:`Steps`, which has the definition. Concrete arrays only; not differentiable.

    Raises:
      ValueError: something is traced, or the policy is invalid.

    Example:
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[0.75, 0.25]], [[0.0, 1.0]]], label=[[0], [1]], propositions=["a"],
      ...                    initial=[1, 0])
      >>> steps = satisfaction_steps(product(world, "F a"), np.ones((2, 2, 1)))
      >>> round(steps.value, 6), steps.lower <= 4 <= steps.upper
      (4.0, True)
    """
    if is_traced((model, policy)):
        raise ValueError("satisfaction_steps works on the host; call it outside jit and vmap.")
    return StepAnalysis(as_product(model)).steps(policy)


@validated()
def quickest_policy(model: Product, actions: OptimalActions | None = None) -> Quickest:
    """The optimal policy with the least expected number of steps to satisfaction.

    Args:
      model: a concrete product.
      actions: of :func:`optimal_actions`; default: they are computed.

    Returns:
      :class:`Quickest`; the policy satisfies the task with the maximal probability. Concrete arrays
      only; not differentiable.

    Raises:
      ValueError: something is traced.

    Example:
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[0.75, 0.25], [0.5, 0.5]], [[0.0, 1.0]] * 2], label=[[0], [1]],
      ...                    propositions=["a"], initial=[1, 0])
      >>> found = quickest_policy(product(world, "F a"))
      >>> found.policy[0, 0].item(), round(found.steps.value, 6), round(found.least, 6)
      (1, 2.0, 2.0)
    """
    if is_traced((model, actions)):
        raise ValueError("quickest_policy works on the host; call it outside jit and vmap.")
    model = as_product(model)
    return StepAnalysis(model).quickest(optimal_actions(model) if actions is None else actions)


@dataclass(frozen=True)
class StepAnalysis:
    """The expected number of steps to satisfaction of a product's policies."""

    model: Product

    @cached_property
    def problem(self) -> Reaching:
        return as_reachability(self.model, "max")

    @cached_property
    def sparse(self) -> SparseMDP:
        return rows_of(self.model)

    @cached_property
    def lost(self) -> Booleans:
        """``bool[N]``: no policy satisfies the task."""
        graph = graph_of(self.problem.model)
        return np.asarray(max_sets(graph, np.asarray(self.problem.target)).zero).ravel()

    @cached_property
    def undecided(self) -> Booleans:
        """``bool[N]``: the states in which steps count."""
        result: Booleans = ~(self.lost | np.asarray(self.problem.target).ravel())
        return result

    def steps(self, policy: Array) -> Steps:
        """:func:`satisfaction_steps` of a policy."""
        if self.problem.opposite:
            return Steps(0.0, 0.0, 0.0, Status.CONVERGED)
        chain = induced_chain(self.model, policy)
        total = optimal.reward_forever(
            chain.mdp,
            self.undecided.astype(float),
            maximize=False,
            tolerance=_PART_WIDTH,
            depth=chain.depth,
        )
        value, low, high = self.mean(total)
        if self.problem.accepting is not None:
            part = self._between_rounds(chain)
            value, low, high = value + part[0], low + part[1], high + part[2]
            low, high = low * (1 - _EPS), high * (1 + _EPS)
        bounds = np.array([low]), np.array([high])
        return Steps(value, low, high, status_between(*bounds, _TOLERANCE, relative=True))

    def quickest(self, actions: OptimalActions) -> Quickest:
        """:func:`quickest_policy` inside a mask of optimal actions."""
        best = np.asarray(actions.best.policy).astype(np.int32)
        if self.problem.opposite:
            return Quickest(best, self.steps(best), 0.0, Status.CONVERGED)
        host, target = self.sparse.host, np.asarray(self.problem.target).ravel()
        optimum = optimal.reachability(
            host, target, maximize=True, tolerance=RelativeTolerance(_OPTIMUM_WIDTH)
        )
        highest = self.mean(optimum, 1.0)[2]
        wide = possibly_optimal_rows(host, "max", optimum)
        first, least = self._soonest(wide)
        rounds, inner = 0.0, first
        if self.problem.accepting is not None:
            rounds, inner = self._fewest_between_rounds(on_rows(self.sparse, actions.allowed))
            least = (least + rounds) * (1 - _EPS)
        masks = wide, wide & tied_rows(host, "max", optimum), on_rows(self.sparse, actions.allowed)
        quickest: Quickest | None = None
        for rows in (None, *masks):
            policy = best
            if rows is not None:
                if quickest is not None and quickest.status == Status.CONVERGED:
                    break
                row = first if rows is wide else self._soonest(rows)[0]
                row = np.where(target, inner, row) if self.problem.accepting is not None else row
                policy = np.asarray(self.sparse.action)[row].reshape(best.shape).astype(np.int32)
            loses = highest - self._share_reached(policy) > _LOSS * highest
            if loses and rows is not None:
                continue
            steps = self.steps(policy)
            if quickest is None or steps.upper < quickest.steps.upper:
                meets = steps.upper <= least * (1 + _TOLERANCE) and not loses
                status = Status.CONVERGED if meets else Status.PRECISION
                quickest = Quickest(policy, steps, least, status)
        assert quickest is not None
        return quickest

    def _soonest(self, rows: Booleans) -> tuple[Integers, float]:
        """Rows with the least expected time in undecided states, and a lower bound of its mean."""
        host = self.sparse.host
        cost = np.where(rows, self.undecided[host.state], np.inf)
        total = optimal.reward_forever(host, cost, maximize=False, tolerance=_PART_WIDTH)
        return total.row, self.mean(total)[1]

    def _share_reached(self, policy: Array) -> float:
        """Lower bound of the probability of the target, to a width relative to it."""
        chain = induced_chain(self.model, policy)
        own = optimal.reachability(
            chain.mdp,
            np.asarray(self.problem.target).ravel(),
            maximize=True,
            tolerance=RelativeTolerance(_PROBABILITY_WIDTH),
            depth=chain.depth,
        )
        return self.mean(own, 1.0)[1]

    def probability(self, policy: Array) -> tuple[float, float, float]:
        """Satisfaction probability from the initial distribution: value, lower and upper bound."""
        solution = satisfaction_probability(self.model, policy, tolerance=_PROBABILITY_WIDTH)
        return self.mean(solution, 1.0)

    def mean(
        self, enclosure: Enclosure | Solution, highest: float = np.inf
    ) -> tuple[float, float, float]:
        """Value, lower and upper bound of the mean over the initial distribution."""
        share = np.asarray(self.model.initial, np.float64).ravel()
        low, high = safe_ends(self.model, enclosure, highest=highest)
        start = np.flatnonzero(share)
        middle = share[start] @ np.asarray(enclosure.value).ravel()[start] / share.sum()
        return float(np.clip(middle, low, high)), low, high

    # --- rounds of acceptance ---------------------------------------------------------------------

    def _priorities(self, mdp: HostMDP) -> Integers:
        """The priority that each transition reads, ``int[T]``."""
        count = self.model.num_memory
        source = mdp.state[mdp.row]
        read = mdp.successor if self.model.label_on == "entry" else source
        letter = np.asarray(self.model.letter)[read // count]
        priority: Integers = np.asarray(self.model.automaton.priority)[source % count, letter]
        return priority

    def _between_rounds(self, chain: PolicyChain) -> tuple[float, float, float]:
        """Steps between two rounds of a policy: value, lower and upper bound."""
        mdp, size = chain.mdp, chain.mdp.num_states
        components = end_components(mdp)
        member, leader = components.inside, components.component
        read = self._priorities(mdp)
        among, part, is_odd = member[mdp.row], leader[mdp.row], read % 2 == 1
        odd, even = np.full((2, size), np.iinfo(np.int64).max)
        np.minimum.at(odd, part[among & is_odd], read[among & is_odd])
        np.minimum.at(even, part[among & ~is_odd], read[among & ~is_odd])
        accepted = member & (even < odd)[leader]
        hits = np.where(~is_odd & (read < odd[part]), mdp.probability, 0)
        gain = _gain(mdp, np.add.reduceat(hits, mdp.entry_start[:-1]))
        # Relative errors of a chain's probabilities change its stationary distribution by at most
        # twice the number of states times as much (O'Cinneide 1993).
        slack = 1 + 2 * (size + 2) * (chain.depth + 2) * _EPS
        ended, goal = with_exits(mdp, among), np.arange(size + 1) == size

        def at_end(worth: Floats) -> tuple[float, float, float]:
            """The mean worth of the accepting component that is reached, 0 for others."""
            cost = np.append(np.where(accepted, worth, 0), 0)
            total = optimal.total_reward(
                ended, cost, goal, maximize=False, tolerance=_PART_WIDTH, depth=chain.depth
            )
            return self.mean(total)

        share = at_end(np.ones(size))
        if not share[0] > 0:
            return np.inf, np.inf if share[2] == 0 else 0.0, np.inf
        with np.errstate(divide="ignore"):
            value, low, high = (
                at_end(1 / np.maximum(rate, 0))[i]
                for i, rate in enumerate((gain.value, gain.upper * slack, gain.lower / slack))
            )
        upper = high / share[1] * (1 + 2 * _EPS) if share[1] > 0 else np.inf
        return value / share[0], low / share[2] * (1 - 2 * _EPS), upper

    def _fewest_between_rounds(self, rows: Booleans) -> tuple[float, Integers]:
        """Lower bound of the steps between rounds over policies of some rows, and a quick one."""
        # The mean of 1 / rate is at least 1 / (mean rate), by Jensen's inequality, and the mean
        # rate over all runs is at most the largest long-run average of even priorities.
        host, accepting = self.sparse.host, self.problem.accepting
        assert accepting is not None
        region = np.asarray(accepting.region).ravel()
        read, start = self._priorities(host), host.entry_start[:-1]
        hits = np.where((read % 2 == 0) & region[host.state][host.row], host.probability, 0)
        rate = self.mean(_gain(*_among(host, rows, np.add.reduceat(hits, start))[:2]), 1.0)
        reached = optimal.reachability(host, region, maximize=True, tolerance=_PART_WIDTH)
        share = self.mean(reached, highest=1.0)[1]
        # Inside an accepting end component the least priority alone is sure to be accepted.
        inner = ~region[host.state] | on_rows(self.sparse, accepting.inside)
        least = np.asarray(accepting.least).ravel()[host.state][host.row]
        hits = np.where((read == least) & region[host.state][host.row], host.probability, 0)
        small, reward, row = _among(host, inner, np.add.reduceat(hits, start))
        taken: Integers = row[_gain(small, reward).row]
        return share / rate[2] * (1 - 2 * _EPS) if rate[2] > 0 else np.inf, taken


def _gain(mdp: HostMDP, reward: Floats) -> Enclosure:
    return average(mdp, reward, reward, tolerance=_PART_WIDTH, max_steps=_MAX_SWEEPS)


def _among(mdp: HostMDP, rows: Booleans, reward: Floats) -> tuple[HostMDP, Floats, Integers]:
    """The model with some rows alone, their rewards, and their numbers."""
    row, none = np.flatnonzero(rows), np.zeros(0, np.int64)
    every = np.arange(mdp.num_states)
    small, order = with_stops(mdp, row, every, (none, none), mdp.num_states)
    return small, reward[row][order], row[order]


_LINE_TOLERANCE = 1e-6  # distance in probability up to which a vertex is on a line
_COARSE_LINE_TOLERANCE = 1e-3  # the same, in a front of few points
_MARGIN = 1e-9  # by which a mixture exceeds requirements, for the rounding of its certificate
_SUM_WIDTH = 1e-10  # relative width to which weighted sums are solved
_MAX_SUMS = 60  # weighted sums of a search for one point


@brief
class Vertex(NamedTuple):
    """A vertex of a front: a policy with its satisfaction probability and expected steps.

    Attributes:
      policy: ``int32[S, Q]``.
      probability, steps: value, lower and upper bound, of the mean over the initial states.

    Example:
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[0.5, 0.5]], [[0.0, 1.0]]], label=[[0], [1]], propositions=["a"],
      ...                    initial=[1, 0])
      >>> round(steps_front(product(world, "F a"))[0].steps[0], 6)
      2.0
    """

    policy: np.ndarray
    probability: tuple[float, float, float]
    steps: tuple[float, float, float]


@validated()
def steps_front(
    model: Product, quickest: Quickest | None = None, *, max_points: int = 8
) -> list[Vertex]:
    """Pareto front of satisfaction probability and expected steps until a co-safe task is decided.

    Args:
      model: a concrete product of a co-safe task.
      quickest: of :func:`quickest_policy`; default: it is computed.
      max_points: maximal number of vertices.

    Returns:
      Vertices in the order of decreasing probability and steps, from the quickest optimal policy to
      the earliest decision. Probabilities and steps between neighbours are attained by randomised
      policies. Concrete arrays only; not differentiable.

    Raises:
      ValueError: something is traced, or the task is not co-safe.

    Example:
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[0.75, 0.25, 0], [0, 0.5, 0.5]], [[0, 1.0, 0]] * 2, [[0, 0, 1.0]] * 2],
      ...                    label=[[0], [1], [0]], propositions=["a"], initial=[1, 0, 0])
      >>> front = steps_front(product(world, "F a"))
      >>> [(round(v.probability[0], 6), round(v.steps[0], 6)) for v in front]
      [(1.0, 4.0), (0.5, 1.0)]
    """
    front = _StepsFrontSearch.of(as_product(model), quickest)
    vertices = list(front.ends)
    lines = [front.ends]
    while lines and len(vertices) < max_points:
        first, last = lines.pop(0)
        if first.probability[0] - last.probability[0] <= _COARSE_LINE_TOLERANCE:
            continue
        between = front.between(first, last, _COARSE_LINE_TOLERANCE)[0]
        if between is not None:
            vertices.append(between)
            lines += [(first, between), (between, last)]
    vertices.sort(key=lambda one: (-one.probability[0], one.steps[0]))
    least, front_vertices = np.inf, list[Vertex]()
    for one in vertices:
        if one.steps[0] < least * (1 - _LINE_TOLERANCE):
            least, front_vertices = one.steps[0], [*front_vertices, one]
    return front_vertices


class ConstrainedPolicy(NamedTuple):
    """Policy with a required satisfaction probability and expected steps, if there is one."""

    policy: np.ndarray | None  # float[S, Q, A]
    # certified upper bound of the probability of all policies with so few steps
    upper: float


def constrained_policy(
    model: Product, probability: float, steps: float, quickest: Quickest
) -> ConstrainedPolicy:
    """A policy with at least a probability and at most a number of steps, of a co-safe task."""
    front = _StepsFrontSearch.of(model, quickest)
    one_hot = np.eye(model.num_actions)
    first, last = front.ends
    highest = min(1.0, first.probability[2])
    if first.steps[2] <= steps:
        return ConstrainedPolicy(
            one_hot[first.policy] if first.probability[1] >= probability else None, highest
        )
    if steps < quickest.steps.upper and last.steps[1] > steps:
        return ConstrainedPolicy(None, 0.0)
    for _ in range(_MAX_SUMS):
        if last.steps[2] <= steps and last.probability[1] >= probability:
            return ConstrainedPolicy(one_hot[last.policy], highest)
        gain = first.probability[1] - last.probability[1]
        share = (probability + _MARGIN - last.probability[1]) / gain
        time = (1 - share) * last.steps[2] + share * first.steps[2]
        if share <= 1 and time <= steps * (1 - _MARGIN):
            return ConstrainedPolicy(front.mixed(first, last, share), highest)
        between, slope, bound = front.between(first, last)
        highest = min(highest, 1 + slope * steps - bound)
        if between is None or highest < probability:
            break
        first, last = (first, between) if between.steps[2] <= steps else (between, last)
    return ConstrainedPolicy(None, highest)


@dataclass(frozen=True)
class _StepsFrontSearch:
    """Search of the front by weighted sums ``min mu E[steps] + P(lost)``, shortest paths.

    Solved for the slope between two vertices, a sum gives another vertex, or certifies that no
    policy is beyond the line between them (Forejt, Kwiatkowska and Parker 2012).
    """

    clock: StepAnalysis
    ends: tuple[Vertex, Vertex]  # the quickest optimal policy, and the earliest decision

    @staticmethod
    def of(model: Product, quickest: Quickest | None) -> _StepsFrontSearch:
        if is_traced(model):
            raise ValueError("fronts are found on the host; call it outside jit and vmap.")
        if not model.automaton.is_cosafe:
            raise ValueError(
                f"the front of probability and steps is for co-safe tasks, and this one is "
                f"{model.automaton.acceptance}; quickest_policy has the steps of any task."
            )
        quickest = quickest_policy(model) if quickest is None else quickest
        clock = StepAnalysis(model)
        front = _StepsFrontSearch(clock, ())  # type: ignore[arg-type]
        ends = front.vertex(quickest.policy), front.vertex(front.cheapest(1.0, _LINE_TOLERANCE)[0])
        return _StepsFrontSearch(clock, ends)

    def vertex(self, policy: np.ndarray) -> Vertex:
        return Vertex(policy, self.clock.probability(policy), self.clock.steps(policy)[:3])

    def cheapest(self, slope: float, worth: float = 1.0) -> tuple[np.ndarray, float]:
        """A policy of least ``slope E[steps] + worth P(lost)``, and a lower bound of all."""
        clock, host = self.clock, self.clock.sparse.host
        lost = clock.lost.astype(float)
        cost = np.where(clock.undecided[host.state], slope + worth * host.expectation(lost), 0)
        total = optimal.total_reward(
            host, cost, ~clock.undecided, maximize=False, tolerance=_SUM_WIDTH
        )
        action = np.asarray(clock.sparse.action)[total.row].reshape(clock.model.state_shape)
        # States that are lost already count too; rounding of one sum of products for each row.
        start = np.asarray(clock.model.initial, float).ravel()
        bound = clock.mean(total)[1] * (1 - 1e-12) + worth * float(start @ lost) - 1e-12
        return action.astype(np.int32), bound

    def between(
        self, first: Vertex, last: Vertex, distance: float = _LINE_TOLERANCE
    ) -> tuple[Vertex | None, float, float]:
        """A vertex beyond the line between two, the line's slope, and the weighted sum's bound."""
        slope = (first.probability[0] - last.probability[0]) / (first.steps[0] - last.steps[0])
        policy, bound = self.cheapest(slope)
        vertex = self.vertex(policy)
        line = slope * last.steps[0] - last.probability[0]
        beyond = line - (slope * vertex.steps[0] - vertex.probability[0])
        return vertex if beyond > distance else None, slope, bound

    def mixed(self, first: Vertex, last: Vertex, share: float) -> np.ndarray:
        """Policy with the mean occupancy of two, and so the mean probability and steps."""
        weights = [self.occupancy(one.policy) for one in (first, last)]
        total = share * weights[0] + (1 - share) * weights[1]
        some = total.sum(-1, keepdims=True)
        unused = np.eye(total.shape[-1])[first.policy]
        return np.where(some > 0, total / np.where(some > 0, some, 1), unused)

    def occupancy(self, policy: Array) -> np.ndarray:
        """Expected visits of undecided states with each action, ``float[S, Q, A]``."""
        clock = self.clock
        inner, visits = clock.undecided, np.zeros(clock.undecided.size)
        chain = induced_chain(clock.model, policy)
        start = np.asarray(clock.model.initial, float).ravel()[inner]
        visits[inner] = transient_factors(chain.mdp, inner).solve(start, "T")
        rows = np.maximum(visits, 0)[clock.sparse.host.state] * chain.weight
        result: np.ndarray = on_actions(clock.sparse, rows, clock.model)
        return result
