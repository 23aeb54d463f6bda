"""Pareto front of satisfaction probability and expected steps of a co-safe task, on the host.

A weighted sum ``min mu E[steps] + P(lost)`` is a stochastic shortest path. Solved for the slope
between two vertices, it gives another vertex, or certifies that no policy is beyond the line
between them (Forejt, Kwiatkowska and Parker 2012).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaxltl.core.models.ops.array_namespace import is_traced
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Array
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.solvers import reachability as optimal
from jaxltl.core.values.engine.host_solution import induced_chain
from jaxltl.core.values.engine.validated import validated
from jaxltl.core.values.undiscounted.policy_gradient import transient_factors
from jaxltl.core.values.undiscounted.reachability import on_actions
from jaxltl.core.values.undiscounted.satisfaction_steps import (
    StepAnalysis,
    Quickest,
    quickest_policy,
)

_NEAR = 1e-6  # distance in probability up to which a vertex is on a line
_CLOSE = 1e-3  # the same, in a front of few points
_MARGIN = 1e-9  # by which a mixture exceeds requirements, for the rounding of its certificate
_SOLVED = 1e-10  # relative width to which weighted sums are solved
_MOST_SUMS = 60  # weighted sums of a search for one point


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
    front = _Front.of(model, quickest)
    vertices = list(front.ends)
    lines = [front.ends]
    while lines and len(vertices) < max_points:
        first, last = lines.pop(0)
        if first.probability[0] - last.probability[0] <= _CLOSE:
            continue
        between = front.between(first, last, _CLOSE)[0]
        if between is not None:
            vertices.append(between)
            lines += [(first, between), (between, last)]
    vertices.sort(key=lambda one: (-one.probability[0], one.steps[0]))
    least, front_vertices = np.inf, list[Vertex]()
    for one in vertices:
        if one.steps[0] < least * (1 - _NEAR):
            least, front_vertices = one.steps[0], [*front_vertices, one]
    return front_vertices


class Meeting(NamedTuple):
    """Policy with a required satisfaction probability and expected steps, if there is one."""

    policy: np.ndarray | None  # float[S, Q, A]
    # certified upper bound of the probability of all policies with so few steps
    upper: float


def meeting(model: Product, probability: float, steps: float, quickest: Quickest) -> Meeting:
    """A policy with at least a probability and at most a number of steps, of a co-safe task."""
    front = _Front.of(model, quickest)
    one_hot = np.eye(model.num_actions)
    first, last = front.ends
    highest = min(1.0, first.probability[2])
    if first.steps[2] <= steps:
        return Meeting(
            one_hot[first.policy] if first.probability[1] >= probability else None, highest
        )
    if steps < quickest.steps.upper and last.steps[1] > steps:
        return Meeting(None, 0.0)
    for _ in range(_MOST_SUMS):
        if last.steps[2] <= steps and last.probability[1] >= probability:
            return Meeting(one_hot[last.policy], highest)
        gain = first.probability[1] - last.probability[1]
        share = (probability + _MARGIN - last.probability[1]) / gain
        time = (1 - share) * last.steps[2] + share * first.steps[2]
        if share <= 1 and time <= steps * (1 - _MARGIN):
            return Meeting(front.mixed(first, last, share), highest)
        between, slope, bound = front.between(first, last)
        highest = min(highest, 1 + slope * steps - bound)
        if between is None or highest < probability:
            break
        first, last = (first, between) if between.steps[2] <= steps else (between, last)
    return Meeting(None, highest)


@dataclass(frozen=True)
class _Front:
    clock: StepAnalysis
    ends: tuple[Vertex, Vertex]  # the quickest optimal policy, and the earliest decision

    @staticmethod
    def of(model: Product, quickest: Quickest | None) -> _Front:
        if is_traced(model):
            raise ValueError("fronts are found on the host; call it outside jit and vmap.")
        if not model.automaton.is_cosafe:
            raise ValueError(
                f"the front of probability and steps is for co-safe tasks, and this one is "
                f"{model.automaton.acceptance}; quickest_policy has the steps of any task."
            )
        quickest = quickest_policy(model) if quickest is None else quickest
        clock = StepAnalysis(model)
        front = _Front(clock, ())  # type: ignore[arg-type]
        ends = front.vertex(quickest.policy), front.vertex(front.cheapest(1.0, _NEAR)[0])
        return _Front(clock, ends)

    def vertex(self, policy: np.ndarray) -> Vertex:
        return Vertex(policy, self.clock.probability(policy), self.clock.steps(policy)[:3])

    def cheapest(self, slope: float, worth: float = 1.0) -> tuple[np.ndarray, float]:
        """A policy of least ``slope E[steps] + worth P(lost)``, and a lower bound of all."""
        clock, host = self.clock, self.clock.sparse.host
        lost = clock.lost.astype(float)
        cost = np.where(clock.undecided[host.state], slope + worth * host.expectation(lost), 0)
        total = optimal.total_reward(
            host, cost, ~clock.undecided, maximize=False, tolerance=_SOLVED
        )
        action = np.asarray(clock.sparse.action)[total.row].reshape(clock.model.state_shape)
        # States that are lost already count too; rounding of one sum of products for each row.
        start = np.asarray(clock.model.initial, float).ravel()
        bound = clock.mean(total)[1] * (1 - 1e-12) + worth * float(start @ lost) - 1e-12
        return action.astype(np.int32), bound

    def between(
        self, first: Vertex, last: Vertex, distance: float = _NEAR
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
        chain = induced_chain(clock.model, clock.sparse, policy)
        start = np.asarray(clock.model.initial, float).ravel()[inner]
        visits[inner] = transient_factors(chain.mdp, inner).solve(start, "T")
        rows = np.maximum(visits, 0)[clock.sparse.host.state] * chain.weight
        result: np.ndarray = on_actions(clock.sparse, rows, clock.model)
        return result
