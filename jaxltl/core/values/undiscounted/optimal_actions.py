"""Action masks inside which every policy of full support attains the optimal probability.

Qualitative analysis decides which actions are optimal where the probability is 0 or 1, and in end
components; certified bounds decide elsewhere, and the uniform policy over the mask certifies the
rest. docs/optimal-actions.md has the proofs.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
from jaxltl.core import struct, validation
from numpy.typing import DTypeLike, NDArray

from jaxltl.core.graphs.end_components import components_within
from jaxltl.core.graphs.graph import graph_of
from jaxltl.core.graphs.attractor import max_sets, min_sets
from jaxltl.core.models.mesh.sharded import refuse_sharded
from jaxltl.core.models.ops.array_namespace import is_traced, to_jax
from jaxltl.core.models.product import Product
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.graph.qualitative import backward_reachable
from jaxltl.core.types import Solution, Status
from jaxltl.core.values.engine.certificates import rounding_unit
from jaxltl.core.values.engine.host_solution import complement_event, solution_from_enclosure
from jaxltl.core.values.undiscounted.fastest import (
    QUICK_LIMIT,
    attained_by_ties,
    conserving_rows,
)
from jaxltl.core.values.engine.row_form import on_actions, row_form, rows_of
from jaxltl.core.values.undiscounted.acceptance import Reaching, as_product, as_reachability
from jaxltl.core.values.undiscounted.reaching import enclose
from jaxltl.core.values.undiscounted.satisfaction import (
    optimal_satisfaction,
    satisfaction_probability,
)
from jaxltl.core.values.engine.validated import validated

Booleans = NDArray[np.bool_]


@brief
@struct.dataclass
class OptimalActions:
    """A mask of optimal actions of a product.

    Attributes:
      allowed: ``bool[S, Q, A]``, the mask, with an action in every state.
      policy: ``float[S, Q, A]``, uniform over the allowed actions.
      best: the optimal probability, of
        :func:`~jaxltl.core.values.undiscounted.satisfaction.optimal_satisfaction`.
      attained: the probability of `policy`.
      loss: ``float[]``, a certified bound on the loss of `policy` in any state.
      status: CONVERGED if the loss is within the tolerance, else PRECISION.

    Example:
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[0, 1.0, 0], [0, 0.5, 0.5]], [[0, 1.0, 0]] * 2, [[0, 0, 1.0]] * 2],
      ...                    label=[[0], [1], [0]], propositions=["goal"])
      >>> found = optimal_actions(product(world, "F goal"))
      >>> found.policy[0, 0].tolist(), found.best.value[0, 0].item(), found.loss.item() < 1e-3
      ([1.0, 0.0], 1.0, True)
    """

    allowed: jax.Array
    policy: jax.Array
    best: Solution
    attained: Solution
    loss: jax.Array
    status: jax.Array


@validated()
def optimal_actions(
    model: Product,
    solution: Solution | None = None,
    *,
    objective: str = "max",
    tolerance: float | None = None,
) -> OptimalActions:
    """The actions that conserve the optimal satisfaction probability of a product, as a mask.

    With V the optimal probability, the conserving actions satisfy ``(P V)(s, a) = V(s)``. **Every
    policy that gives positive probability to exactly the actions of the mask attains V from every
    state.** The mask excludes only those conserving actions by which a trajectory could leave an
    accepting end component, meet a smaller odd priority and return: none for co-safe and safety
    tasks, and for maxima of Buchi tasks. Proofs: docs/optimal-actions.md.

    Args:
      model: the product, concrete.
      solution: of :func:`~jaxltl.core.values.undiscounted.satisfaction.optimal_satisfaction` for
        the same objective; default: it is computed.
      objective: ``"max"`` or ``"min"``.
      tolerance: maximal loss of the policy; default the square root of the dtype's precision.

    Returns:
      :class:`OptimalActions`. The mask contains every action that can be conserving within the
      bounds. If the loss of its uniform policy is above the tolerance, it contains, where the
      probability is between 0 and 1, the actions that are proven to conserve a lower bound, or else
      the action of the optimal policy. Concrete arrays only; not differentiable.

    Raises:
      ValueError: the model is traced, or the objective is unknown.

    Example:
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[0, 1.0, 0], [0, 0.5, 0.5]], [[0, 1.0, 0]] * 2, [[0, 0, 1.0]] * 2],
      ...                    label=[[0], [1], [0]], propositions=["goal"])
      >>> optimal_actions(product(world, "F goal")).allowed[0].tolist()
      [[True, False], [True, True]]
    """
    refuse_sharded(model)
    if solution is not None:
        validation.instance("solution", solution, Solution, "that of optimal_satisfaction")
    if is_traced((model, solution, tolerance)):
        raise ValueError(
            "optimal_actions(model) reads values, so it works on the host only: "
            "call it outside jit and vmap, and pass the mask in."
        )
    model = as_product(model)
    goal = float(np.sqrt(np.finfo(model.dtype).eps) if tolerance is None else tolerance)
    problem = as_reachability(model, objective)
    if solution is None:
        solution = optimal_satisfaction(model, objective=objective, tolerance=goal / 8)
    actions = _certified(
        model, solution, _conserving(problem, solution, objective), problem, objective, goal
    )
    if int(actions.status) == Status.CONVERGED:
        return actions
    attaining = _attaining(problem)
    if attaining is not None:
        keeps, bounds = attaining
        bounds = complement_event(bounds) if problem.opposite else bounds
        narrower = _bounded(problem, keeps, bounds, objective, goal)
        if int(narrower.status) == Status.CONVERGED:
            return narrower
    chosen = np.asarray(solution.policy)[..., None] == np.arange(problem.model.num_actions)
    return _bounded(problem, chosen, solution, objective, goal)


def _conserving(problem: Reaching, solution: Solution, objective: str) -> Booleans:
    """A superset of the conserving actions: ``bool[S, Q, A]``."""
    decided, keeps, undecided = _on_graph(problem)
    graph = graph_of(problem.model)
    if problem.objective == "max":
        # The optimal probability is constant in an end component.
        keeps = keeps | components_within(graph, undecided).inside
    result: Booleans = graph.available & (
        keeps | (~decided[..., None] & _by_bounds(problem.model, solution, objective))
    )
    return result


def _on_graph(problem: Reaching) -> tuple[Booleans, Booleans, Booleans]:
    """The prob0 and prob1 states, the optimal actions in them, and the other states."""
    graph = graph_of(problem.model)
    largest = problem.objective == "max"
    sets = (max_sets if largest else min_sets)(graph, np.asarray(problem.target))
    good, bad = (sets.one, sets.zero) if largest else (sets.zero, sets.one)
    keeps = bad[..., None] | (good[..., None] & graph.forall(good))
    return good | bad, keeps, ~(good | bad)


def _by_bounds(model: Product, solution: Solution, objective: str) -> Booleans:
    """Actions with an optimistic bound not worse than the pessimistic bound of the state."""
    pessimistic, optimistic = np.asarray(solution.lower, float), np.asarray(solution.upper, float)
    sign = 1
    if objective == "min":
        pessimistic, optimistic, sign = optimistic, pessimistic, -1
    sparse = rows_of(model)
    ahead = on_actions(sparse, sparse.host.expectation(optimistic.ravel()), model)
    # The model's probabilities may be rounded ones.
    slack = rounding_unit(model) * np.maximum(ahead, pessimistic[..., None])
    result: Booleans = sign * ahead + slack >= sign * pessimistic[..., None]
    return result


def _attaining(problem: Reaching) -> tuple[Booleans, Solution] | None:
    """Actions by which every policy that takes them all attains a bound, and that bound."""
    # None if such a policy may stay undecided for ever.
    if problem.model.num_states > QUICK_LIMIT:
        return None
    sparse = rows_of(problem.model)
    host = sparse.host
    enclosure = enclose(host, problem.target, problem.objective, 1e-12)
    keeps = conserving_rows(host, problem.objective, enclosure)
    decided = enclosure.lower == enclosure.upper
    slower = attained_by_ties(host, problem.objective, enclosure)
    if slower is not None:
        more = conserving_rows(host, problem.objective, slower)
        if more.sum() >= keeps.sum() and backward_reachable(host, decided, more).all():
            keeps, enclosure = more, slower
    if not backward_reachable(host, decided, keeps).all():
        return None
    bounds = solution_from_enclosure(row_form(problem.model), enclosure, np.inf, relative=False)
    return on_actions(sparse, keeps, problem.model), bounds


def _bounded(
    problem: Reaching, keeps: Booleans, bounds: Solution, objective: str, goal: float
) -> OptimalActions:
    """The mask of qualitatively optimal actions, and elsewhere of actions attaining the bounds."""
    decided, optimal, _ = _on_graph(problem)
    graph = graph_of(problem.model)
    allowed, policy = _staying(
        problem, graph.available & (optimal | (~decided[..., None] & keeps)), problem.model.dtype
    )
    return _judged(allowed, policy, bounds, replace(bounds, policy=policy), objective, goal)


def _certified(
    model: Product,
    solution: Solution,
    keeps: Booleans,
    problem: Reaching,
    objective: str,
    goal: float,
) -> OptimalActions:
    """The mask of conserving actions, and the probability of its uniform policy."""
    allowed, policy = _staying(problem, keeps, model.dtype)
    attained = satisfaction_probability(model, policy, tolerance=goal / 8)
    return _judged(allowed, policy, solution, attained, objective, goal)


def _judged(
    allowed: jax.Array,
    policy: jax.Array,
    solution: Solution,
    attained: Solution,
    objective: str,
    goal: float,
) -> OptimalActions:
    above, below = (solution, attained) if objective == "max" else (attained, solution)
    loss = np.max(np.asarray(above.upper, float) - np.asarray(below.lower, float))
    status = Status.CONVERGED if loss <= goal else Status.PRECISION
    # Rounded up to the model's precision.
    loss = np.nextafter(loss.astype(policy.dtype), np.asarray(2, policy.dtype))
    return OptimalActions(allowed, policy, solution, attained, *to_jax((loss, np.int32(status))))


def _staying(problem: Reaching, keeps: Booleans, dtype: DTypeLike) -> tuple[jax.Array, jax.Array]:
    """The mask without actions that return to an accepting end component, and its uniform policy."""
    accepting = problem.accepting
    if accepting is not None:
        graph = graph_of(problem.model)
        region, inside = np.asarray(accepting.region), np.asarray(accepting.inside)
        around = components_within(graph, np.ones_like(region), keeps).inside
        keeps = keeps & ~(region[..., None] & around & ~inside)
    policy = (keeps / keeps.sum(-1, keepdims=True)).astype(dtype)
    return to_jax(keeps), to_jax(policy)
