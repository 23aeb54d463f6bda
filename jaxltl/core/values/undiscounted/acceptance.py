"""Acceptance of products as reachability: targets, accepting components, and the compiled engine."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.graphs.end_components import (
    Accepting,
    accepting_bottom_components,
    accepting_end_components,
)
from jaxltl.core.graphs.graph import is_table
from jaxltl.core.models.action_numbers import row_actions
from jaxltl.core.models.game import Game
from jaxltl.core.models.mesh.sharded import is_sharded
from jaxltl.core.models.ops.array_namespace import is_traced, jax_array, namespace, to_jax
from jaxltl.core.models.ops.operators import is_deterministic, require_policy
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers.shortest_path import fastest_rows, with_exits
from jaxltl.core.types import Solution
from jaxltl.core.values.door.question import Accuracy, Question, Reach
from jaxltl.core.values.engine.host_solution import complement_event
from jaxltl.core.values.engine.row_form import on_rows, row_of_action, rows_of
from jaxltl.core.values.engine.state_quantities import reduction_for
from jaxltl.core.values.undiscounted import compiled_engines, reaching
from jaxltl.core.values.undiscounted.fastest import QUICK_LIMIT


def accept_padded(
    model: Model,
    question: Question,
    accuracy: Accuracy,
    *,
    method: str = "auto",
    max_steps: jax.Array | int | None = None,
    start: tuple[jax.Array, jax.Array] | None = None,
) -> Solution:
    """Probability of acceptance in products of padded models, as that of reaching a target."""
    product = as_product(model)
    if question.policy is not None:
        return _of_policy(product, question.policy, accuracy, method)
    run = _over_mesh if is_sharded(product) else _optimal
    return run(product, accuracy.tolerance, max_steps, start, objective=question.objective)


def _of_policy(model: Product, policy: Array, accuracy: Accuracy, method: str) -> Solution:
    task = model.automaton
    if task.has_final_states:
        target = model.final if task.is_cosafe else _not_final(model)
    else:
        require_policy(model, policy)
        support = policy
        if is_deterministic(policy):
            support = _one_hot(policy, model.num_actions)
        target = accepting_bottom_components(model, lax.stop_gradient(support))
    reach = _reached(model, Question(Reach(target), policy=policy), accuracy, method=method)
    return complement_event(reach) if task.is_safety else reach


def _reached(
    model: Product,
    question: Question,
    accuracy: Accuracy,
    *,
    method: str = "auto",
    limits: tuple[Array | None, Array | None] = (None, None),
) -> Solution:
    """The probability of reaching a target, on the host where nothing needs a compiled engine."""
    iterated = method == "iterative" or any(x is not None for x in limits)
    compiled = is_sharded(model) or not is_table(model) or iterated
    if compiled or is_traced((model, question, accuracy)):
        max_steps, start = limits
        return compiled_engines.reach(
            model, question, accuracy, method=method, max_steps=max_steps, start=start
        )
    return reaching.reach(model, question, accuracy)


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
    question = Question(Reach(problem.target), problem.objective)
    solution = _reached(problem.model, question, Accuracy(tolerance), limits=(max_steps, start))
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
    sparse = rows_of(model)
    visits = until_visit(problem, sparse.host)
    inside = on_rows(sparse, accepting.inside)
    outer = ~np.asarray(accepting.region).ravel()
    row = row_of_action(sparse, accepting.action)
    rows = fastest_rows(
        visits, np.append(inside, True), np.append(outer, True), np.append(row, sparse.num_rows)
    )
    return row_actions(sparse)[rows[:-1]].reshape(model.state_shape)


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


def require_product(model: Model) -> Model:
    """The product, or the game on one; ValueError for other models."""
    as_product(model.mdp if isinstance(model, Game) else model)
    return model


def as_product(model: object) -> Product:
    """The product itself; ValueError for a model of another kind."""
    if not isinstance(model, Product):
        raise ValueError(
            f"{type(model).__name__} is no product of a world and a task; give "
            "product(world, formula), or the task to optimal_satisfaction."
        )
    return model
