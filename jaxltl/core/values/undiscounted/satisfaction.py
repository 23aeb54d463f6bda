"""Satisfaction probabilities of LTL formulas in MDPs, games and interval models."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, Unpack, overload

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
from jax import lax

from jaxltl.core.values.engine.state_quantities import reduction_for
from jaxltl.core import validation
from jaxltl.core.values.engine.validated import SolverOptions, validated
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.graphs.end_components import (
    Accepting,
    accepting_bottom_components,
    accepting_end_components,
)
from jaxltl.core.automata.translate import FormulaLike
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.mdp import MDP, DenseMDP
from jaxltl.core.models.mesh.sharded import is_sharded
from jaxltl.core.models.refusals import refuse_game, refuse_traced
from jaxltl.core.models.ops.array_namespace import jax_array, is_traced, namespace, to_jax
from jaxltl.core.models.ops.operators import is_deterministic, require_policy
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers.shortest_path import fastest_rows, with_exits
from jaxltl.core.types import Solution
from jaxltl.core.values.engine.host_solution import complement_event, is_sparse
from jaxltl.core.values.interval.robust import refuse_nature
from jaxltl.core.values.interval.satisfaction import (
    robust_product_satisfaction,
    robust_satisfaction,
)
from jaxltl.core.values.undiscounted.reachability import (
    QUICK_LIMIT,
    on_rows,
    reachability_probability,
    refuse_iteration,
    relative_width,
    row_of_action,
    rows_of_model,
)
from jaxltl.core.values.undiscounted.sparse_satisfaction import (
    Satisfaction,
    product_satisfaction,
    sparse_satisfaction,
)


@validated(method=("auto", "direct", "iterative"))
def satisfaction_probability(
    model: Product,
    policy: jax.Array,
    *,
    nature: str | None = None,
    method: str = "auto",
    tolerance: jax.Array | float | None = None,
) -> Solution:
    """Satisfaction probability of a policy, from every product state.

    For a co-safe task, the probability of reaching a final state (2.5); for a safety task, of never
    leaving the final states; for Buchi and parity, of reaching a bottom strongly connected
    component with an even least priority.

    Args:
      model: the product.
      policy: ``float[S, Q, A]`` or ``int32[S, Q]``; for a sparse world ``float[R, Q]``, or its rows
        ``int32[S, Q]``.
      nature: for products of interval models only, ``"adversarial"`` (default), against the policy,
        or ``"cooperative"``.
      method, tolerance: as in :func:`reachability_probability`.

    Returns:
      :class:`Solution`; `value` is ``float[S, Q]``. The probability from the initial distribution
      is ``jnp.sum(model.initial * solution.value)``. Differentiable in the policy and in the
      world's transition probabilities, one-sided where one is 0; not for products of sparse and
      of interval models, which are solved on the host.

    Raises:
      ValueError: the model is not a product, the policy has the wrong shape or a row that is not a
        distribution over available actions (INVALID_POLICY under ``jit``), `nature` is given for a
        model without intervals, or the method is unknown.

    Example:
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[0, 1.0, 0], [0, 0.5, 0.5]], [[0, 1.0, 0]] * 2, [[0, 0, 1.0]] * 2],
      ...                    label=[[0], [1], [0]], propositions=["goal"], initial=[1, 0, 0])
      >>> model = product(world, "F goal")
      >>> found = satisfaction_probability(model, np.full((3, 2, 2), 0.5))
      >>> round(float(np.sum(model.initial * found.value)), 6)
      0.75
    """
    model = as_product(model)
    if isinstance(model.mdp, IntervalMDP):
        return robust_product_satisfaction(model, policy=policy, nature=nature, tolerance=tolerance)
    refuse_nature(nature)
    if is_sparse(model):
        arguments = [("model", model), ("policy", policy), ("tolerance", tolerance)]
        refuse_traced("satisfaction_probability", arguments)
        return product_satisfaction(model, policy=policy, tolerance=tolerance)
    task = model.automaton
    if task.has_final_states:
        target = model.final if task.is_cosafe else _not_final(model)
    else:
        require_policy(model, policy)
        support = policy
        if is_deterministic(policy):
            support = _one_hot(policy, model.num_actions)
        target = accepting_bottom_components(model, lax.stop_gradient(support))
    reach = reachability_probability(
        model, target, policy=policy, method=method, tolerance=tolerance
    )
    return complement_event(reach) if task.is_safety else reach


@overload
def optimal_satisfaction(
    model: Product,
    formula: None = None,
    *,
    objective: str = "max",
    nature: str | None = None,
    tolerance: jax.Array | float | None = None,
    **options: Unpack[SolverOptions],
) -> Solution: ...


@overload
def optimal_satisfaction(
    model: Model | IntervalMDP | Game,
    formula: FormulaLike,
    *,
    objective: str = "max",
    nature: str | None = None,
    states: ArrayLike | None = None,
    label_on: str | None = None,
    tolerance: float | None = None,
    relative: bool = False,
) -> Satisfaction: ...


@validated(games=True)
def optimal_satisfaction(
    model: Product | Model | IntervalMDP | Game,
    formula: FormulaLike | None = None,
    *,
    objective: str = "max",
    nature: str | None = None,
    states: ArrayLike | None = None,
    label_on: str | None = None,
    tolerance: jax.Array | float | None = None,
    **options: Unpack[SolverOptions],
) -> Solution | Satisfaction:
    """Maximal or minimal satisfaction probability of a product, or of a model and a formula.

    For Buchi and parity tasks, the probability of reaching an accepting end component, in which the
    policy is accepted almost surely (Baier and Katoen 2008, section 10.6.4); for other tasks as in
    :func:`satisfaction_probability`.

    Of all optimal policies of a concrete padded model with up to 10^5 states, the result is the
    **fastest**: it has the least expected number of steps, from every state, until the set or an
    accepting end component is reached (a set to be avoided: almost surely) or cannot be reached;
    inside the component, until its least priority is read next. This is a stochastic shortest path
    (Bertsekas and Tsitsiklis 1991) over the conserving actions; ties go to the first action.

    A model with a `formula` is solved on the host, on the reachable part of its product; an interval
    model with adversarial nature is a stochastic parity game.

    Args:
      model: a product; or with `formula` a concrete model, an interval model or a game on one of them.
      formula: a formula, its text, or an automaton over the letters that occur in the model.
      objective: ``"max"`` or ``"min"``.
      nature: for interval models, ``"adversarial"`` (default) or ``"cooperative"``.
      states: with `formula`, ``int[I]``, the requested states; default the initial ones.
      label_on: with `formula`, ``"entry"`` (default) or ``"exit"``, when the policy's memory reads a
        state's label; the probability is the same. Interval models read on exit.
      tolerance: as for :func:`reachability_probability`.
      max_steps, start, relative: as for :func:`reachability_probability`; the first two of a product.

    Returns:
      Of a product, a :class:`Solution`; `value` is ``float[S, Q]``, `policy` ``int32[S, Q]``, rows
      for a sparse world. With a formula, a :class:`Satisfaction`, a finite-memory policy of rows.
      Differentiable in a product's transition probabilities, with the optimal
      policy held fixed; not for sparse and interval models, which are solved on the host.

    Raises:
      ValueError: neither a product nor a formula, an unknown label, state or objective, an option that
        is not for this model, or a product of a sparse world with restricted actions.

    Example:
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[0, 0.5, 0.5], [0, 0.75, 0.25]], [[0, 1, 0]] * 2, [[0, 0, 1]] * 2],
      ...                    label=[[0], [1], [0]], propositions=["goal"], initial=[1, 0, 0])
      >>> best = optimal_satisfaction(product(world, "F goal"))
      >>> best.value[0, 0].item(), best.policy[0, 0].item()
      (0.75, 1)
    """
    max_steps, start, relative = validation.options(
        "optimal_satisfaction", options, max_steps=None, start=None, relative=False
    )
    if relative:
        tolerance = relative_width(model, tolerance)
    if formula is not None:
        refuse_traced("optimal_satisfaction", [("model", model), ("tolerance", tolerance)])
        refuse_iteration(max_steps, start)
        if isinstance(model, Game) and isinstance(model.mdp, MDP | DenseMDP):
            model = replace(model, mdp=to_sparse(model.mdp))
        if isinstance(model, IntervalMDP | Game):
            if label_on is not None:  # interval models read labels on exit
                validation.choice("label_on", label_on, ("exit",))
            return robust_satisfaction(
                model,
                formula,
                objective=objective,
                nature=nature,
                states=states,
                tolerance=tolerance,
            )
        refuse_nature(nature)
        return sparse_satisfaction(
            to_sparse(model),
            formula,
            objective=objective,
            states=states,
            label_on="entry" if label_on is None else label_on,
            tolerance=tolerance,
        )
    refuse_game("optimal_satisfaction", [("model", model)])
    if states is not None or label_on is not None:
        raise ValueError("states and label_on are for a model and a formula, not for a product.")
    model = as_product(model)
    by_rows = objective in ("max", "min") and is_sparse(model)
    if by_rows or isinstance(model.mdp, IntervalMDP):
        refuse_iteration(max_steps, start)
    if isinstance(model.mdp, IntervalMDP):
        return robust_product_satisfaction(
            model, objective=objective, nature=nature, tolerance=tolerance
        )
    refuse_nature(nature)
    if by_rows:
        refuse_traced("optimal_satisfaction", [("model", model), ("tolerance", tolerance)])
        return product_satisfaction(model, objective=objective, tolerance=tolerance)
    run = _over_mesh if is_sharded(model) else _optimal
    return run(model, tolerance, max_steps, start, objective=objective)


def _optimal(
    model: Product,
    tolerance: jax.Array | float | None,
    max_steps: jax.Array | int | None,
    start: tuple[jax.Array, jax.Array] | None,
    *,
    objective: str,
) -> Solution:
    problem, bounds = as_reachability(model, objective), start
    if start is not None and problem.opposite:  # rounded outwards
        eps = np.finfo(model.dtype).eps
        start = 1 - start[1] - eps, 1 - start[0] + eps
    solution = reachability_probability(
        problem.model,
        problem.target,
        objective=problem.objective,
        tolerance=tolerance,
        max_steps=max_steps,
        start=start,
    )
    if problem.accepting is not None:
        xp, region, action, chosen = namespace(
            problem.accepting.region, _visiting(problem, solution), solution.policy
        )
        solution = replace(
            solution, policy=to_jax(xp.where(region, action, chosen).astype(xp.int32))
        )
    if not problem.opposite:
        return solution
    solution = complement_event(solution)
    return solution if bounds is None else _within(solution, bounds)


def _within(solution: Solution, bounds: tuple[jax.Array, jax.Array]) -> Solution:
    """A solution with bounds no wider than given ones, despite rounding outwards."""
    lower = jnp.maximum(solution.lower, bounds[0])
    upper = jnp.minimum(solution.upper, bounds[1])
    inside = jnp.clip(solution.value, lower, upper)
    # The value with its derivative, which clipping halves at a bound.
    value = solution.value + lax.stop_gradient(inside - solution.value)
    return replace(solution, value=value, lower=lower, upper=upper)


# One program for a model over a mesh, instead of one for each operation.
_over_mesh = jax.jit(_optimal, static_argnames=("objective",))


@brief
class Reaching(NamedTuple):
    """An optimal satisfaction problem as an optimal reachability problem."""

    model: Product  # the product, or that of the task's negation
    target: Array  # ``bool[S, Q]``
    objective: str  # ``"max"`` or ``"min"``
    opposite: bool  # whether the satisfaction probability is one minus that of the target
    # for Buchi and parity, the accepting end components of the target
    accepting: Accepting | None = None


def as_reachability(model: Product, objective: str) -> Reaching:
    """Reachability problem with the optimal satisfaction probability as its optimum."""
    reduction_for(objective)
    task = model.automaton
    if task.is_cosafe:
        return Reaching(model, model.final, objective, False)
    if task.is_safety:
        return Reaching(model, _not_final(model), "min" if objective == "max" else "max", True)
    if objective == "min":
        model = replace(model, automaton=_shifted(model.automaton))
    accepting = accepting_end_components(model)
    return Reaching(model, accepting.region, "max", objective == "min", accepting)


def _visiting(problem: Reaching, solution: Solution) -> Array:
    """A policy that reads the least priority of accepting end components infinitely often."""
    model, accepting = problem.model, problem.accepting
    assert accepting is not None
    if is_traced((model, solution)) or model.num_states > QUICK_LIMIT:
        return accepting.action
    sparse = rows_of_model(model)
    visits = until_visit(problem, sparse.host)
    inside = on_rows(sparse, accepting.inside)
    outer = ~np.asarray(accepting.region).ravel()
    row = row_of_action(sparse, accepting.action)
    rows = fastest_rows(
        visits, np.append(inside, True), np.append(outer, True), np.append(row, sparse.num_rows)
    )
    return np.asarray(sparse.action)[rows[:-1]].reshape(model.state_shape)


def until_visit(problem: Reaching, mdp: HostMDP) -> HostMDP:
    """The product's rows, in which accepting visits lead to a further, absorbing state."""
    # An accepting visit reads the least priority of the accepting end component.
    model, accepting = problem.model, problem.accepting
    assert accepting is not None
    automaton, letter = jax.tree.map(np.asarray, (model.automaton, model.letter))
    least = np.asarray(accepting.least)
    if model.label_on == "entry":
        marked = automaton.priority == least[..., None]  # [S, Q, L]
        read = np.repeat(letter, model.num_memory)
    else:
        marked = least == automaton.priority[:, letter].T
        read = np.zeros(model.num_states, np.int32)
    marked = marked.reshape(model.num_states, -1)
    return with_exits(mdp, marked[mdp.state[mdp.row], read[mdp.successor]])


def _shifted(automaton: Automaton) -> Automaton:
    """The automaton of the negation; unlike `complement`, for traced tables too."""
    xp, priority = namespace(automaton.priority)
    priority = to_jax((priority + 1).astype(xp.int32))
    return replace(automaton, priority=priority, acceptance="parity", state_names=())


def _not_final(model: Product) -> jax.Array:
    _, final = namespace(model.final)
    return jax_array(~final)


def _one_hot(policy: Array, num_actions: int) -> Array:
    xp, table = namespace(policy)
    return table[..., None] == xp.arange(num_actions)


def as_product(model: object) -> Product:
    if not isinstance(model, Product):
        raise ValueError(
            f"{type(model).__name__} is no product of a world and a task; give "
            "product(world, formula), or the task to optimal_satisfaction."
        )
    return model
