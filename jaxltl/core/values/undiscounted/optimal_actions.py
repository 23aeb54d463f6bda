"""The actions that lose nothing of the best probability of a task.

Where the best probability is 0 or 1, and in end components, that is decided on the graph; in
between by certified bounds, and what these leave open is certified afterwards by the policy that
takes all of the actions alike. docs/optimal-actions.md has the proofs.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import numpy as np
from flax import struct
from numpy.typing import NDArray

from jaxltl.core.graphs.end_components import components_within
from jaxltl.core.graphs.graph import graph_of
from jaxltl.core.graphs.reaching import max_sets, min_sets
from jaxltl.core.models.mesh.sharded import refuse_sharded
from jaxltl.core.models.ops.array_namespace import is_traced, to_jax
from jaxltl.core.models.product import Product
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.graph.qualitative import backward_reachable
from jaxltl.core.types import Solution, Status
from jaxltl.core.values import facts
from jaxltl.core.values.engine.certificates import rounding_unit
from jaxltl.core.values.engine.host_solution import solution_from_enclosure
from jaxltl.core.values.undiscounted.complement import opposite_event
from jaxltl.core.values.undiscounted.reachability import (
    QUICK_LIMIT,
    Question,
    conserving_rows,
    on_actions,
    rows_of_model,
)
from jaxltl.core.values.undiscounted.satisfaction import (
    Reaching,
    as_reachability,
    optimal_satisfaction,
    satisfaction_probability,
)
from jaxltl.core.values.engine.validated import validated

Booleans = NDArray[np.bool_]


@brief(facts=facts.optimal_actions)
@struct.dataclass
class OptimalActions:
    """A mask of actions inside which a task is done as well as it can be.

    Attributes:
      allowed: ``bool[S, Q, A]``, the mask; it allows an action in every state.
      policy: ``float[S, Q, A]``, all allowed actions alike.
      best: the best probability, of
        :func:`~jaxltl.core.values.undiscounted.satisfaction.optimal_satisfaction`.
      attained: the probability that `policy` attains.
      loss: ``float[]``, a certified bound on what `policy` loses in any state.
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
    """The actions that preserve the best probability of a product's task, as a mask.

    With V the best probability, the conserving actions: ``(P V)(s, a) = V(s)``. **Every policy
    that gives positive probability to exactly the actions of the mask attains V from every
    state.** V of its run is a martingale, and its run ends in a set of states that it goes on
    visiting and that no action of the mask leaves. There V is constant, and if it is not 0, the
    set holds an accepting end component, since best policies do not leave it either. So the mask
    has to leave out, of the conserving actions, only those by which a run might return to the
    accepting end component that it is in, having met a lesser, odd priority: of the actions that
    stay for ever in an end component of conserving actions around it, it keeps those of the
    accepting component alone. For co-safe and safety tasks, and the most of a Buchi task, there
    are none, and the mask holds every action of every best policy; so it does outside of
    accepting end components for any task.

    Args:
      model: the product, concrete.
      solution: of :func:`~jaxltl.core.values.undiscounted.satisfaction.optimal_satisfaction` for the same
        objective; default, it is computed.
      objective: ``"max"``, or ``"min"`` for the least probability.
      tolerance: what the policy may lose at most; default the square root of the dtype's precision.

    Returns:
      :class:`OptimalActions`. An action is kept if by the bounds, and the rounding of the model's
      numbers, it can be conserving; so none is missing, and some may be kept that lose less than
      that. `loss` bounds what the uniform policy loses by them. If it is above the tolerance,
      other actions are kept where the probability is between 0 and 1: those that are proven not
      to lead away from a lower bound, which then every policy that takes all of them attains; or,
      where that cannot be proven, the best policy's action.

    Raises:
      ValueError: the model is traced, or the objective is unknown.

    Concrete arrays only, on the host; not differentiable.

    Example:
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[0, 1.0, 0], [0, 0.5, 0.5]], [[0, 1.0, 0]] * 2, [[0, 0, 1.0]] * 2],
      ...                    label=[[0], [1], [0]], propositions=["goal"])
      >>> optimal_actions(product(world, "F goal")).allowed[0].tolist()
      [[True, False], [True, True]]
    """
    refuse_sharded(model)
    if is_traced((model, solution, tolerance)):
        raise ValueError(
            "optimal_actions(model) reads values, so it works on the host only: "
            "call it outside jit and vmap, and pass the mask in."
        )
    goal = float(np.sqrt(np.finfo(model.dtype).eps) if tolerance is None else tolerance)
    problem = as_reachability(model, objective)
    if solution is None:
        solution = optimal_satisfaction(model, objective=objective, tolerance=goal / 8)
    found = _certified(
        model, solution, _conserving(problem, solution, objective), problem, objective, goal
    )
    if int(found.status) == Status.CONVERGED:
        return found
    # What is left of it attains bounds whatever the shares of its actions.
    sure = _attaining(problem)
    if sure is not None:
        keeps, bounds = sure
        bounds = opposite_event(bounds) if problem.opposite else bounds
        narrower = _bounded(problem, keeps, bounds, objective, goal)
        if int(narrower.status) == Status.CONVERGED:
            return narrower
    graph = graph_of(problem.model)
    chosen = np.asarray(solution.policy)[..., None] == np.arange(graph.num_actions)
    return _bounded(problem, chosen, solution, objective, goal)


def _conserving(problem: Reaching, solution: Solution, objective: str) -> Booleans:
    """The actions that may be conserving, and all that are: ``bool[S, Q, A]``."""
    decided, keeps, open_ = _on_graph(problem)
    graph = graph_of(problem.model)
    if problem.objective == "max":
        # Inside an end component the best probability is everywhere the same.
        keeps = keeps | components_within(graph, open_).inside
    return graph.available & (
        keeps | (~decided[..., None] & _by_bounds(problem.model, solution, objective))
    )


def _on_graph(problem: Reaching) -> tuple[Booleans, Booleans, Booleans]:
    """Where the probability is 0 or 1, the actions that lose nothing there, and the rest."""
    graph = graph_of(problem.model)
    largest = problem.objective == "max"
    sets = (max_sets if largest else min_sets)(graph, np.asarray(problem.target))
    good, bad = (sets.one, sets.zero) if largest else (sets.zero, sets.one)
    keeps = bad[..., None] | (good[..., None] & graph.forall(good))
    return good | bad, keeps, ~(good | bad)


def _by_bounds(model: Product, solution: Solution, objective: str) -> Booleans:
    """The actions whose bound on the safe side reaches that of their state."""
    near, far = np.asarray(solution.lower, float), np.asarray(solution.upper, float)
    sign = 1
    if objective == "min":
        near, far, sign = far, near, -1
    sparse = rows_of_model(model)
    ahead = on_actions(sparse, sparse.host.expectation(far.ravel()), model)
    # A model's probabilities are rounded, and so may be what it is a model of.
    slack = rounding_unit(model) * np.maximum(ahead, near[..., None])
    return sign * ahead + slack >= sign * near[..., None]


def _attaining(problem: Reaching) -> tuple[Booleans, Solution] | None:
    """Actions by which every policy that takes them all attains a bound, and that bound.

    None if such a policy may stay undecided for ever.
    """
    if problem.model.num_states > QUICK_LIMIT:
        return None
    sparse = rows_of_model(problem.model)
    host = sparse.host
    found = Question.of(problem.target, None, problem.objective).solve(host, 1e-11)
    keeps = conserving_rows(host, problem.objective, found)
    decided = found.lower == found.upper
    if not backward_reachable(host, decided, keeps).all():
        return None
    bounds = solution_from_enclosure(problem.model, sparse, found, np.inf, relative=False)
    return on_actions(sparse, keeps, problem.model), bounds


def _bounded(
    problem: Reaching, keeps: Booleans, bounds: Solution, objective: str, goal: float
) -> OptimalActions:
    """The mask of what the graph decides, and elsewhere of actions that attain the bounds."""
    decided, sure, _ = _on_graph(problem)
    graph = graph_of(problem.model)
    allowed, policy = _staying(
        problem, graph.available & (sure | (~decided[..., None] & keeps)), problem.model.dtype
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
    """The mask of conserving actions, and what its uniform policy attains."""
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


def _staying(problem: Reaching, keeps: Booleans, dtype: Any) -> tuple[jax.Array, jax.Array]:
    """Leaves out the actions by which a run may return to its accepting end component.

    Returns:
      The mask and its uniform policy.
    """
    accepting: Any = problem.accepting
    if accepting is not None:
        graph = graph_of(problem.model)
        region, inside = np.asarray(accepting.region), np.asarray(accepting.inside)
        around = components_within(graph, np.ones_like(region), keeps).inside
        keeps = keeps & ~(region[..., None] & around & ~inside)
    policy = (keeps / keeps.sum(-1, keepdims=True)).astype(dtype)
    return to_jax(keeps), to_jax(policy)
