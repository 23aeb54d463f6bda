"""Certified optimality gaps: optimal less achieved satisfaction probability, by tabulation."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxltl.core.models.ops.array_namespace import jit
from jaxltl.core import validation
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.environments.environment import Environment, as_partial
from jaxltl.core.environments.monitor import Verdict, lasso_verdicts, verdicts
from jaxltl.core.environments.tabulate import TabulatedEnvironment
from jaxltl.core.environments.episodes import Agent, without_time_limit
from jaxltl.core.environments.task_environment import TaskObservation, memory_seen, without_task
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.models.ops.operators import is_deterministic
from jaxltl.core.models.product import Product, product
from jaxltl.core.models.protocols import Array, PyTree
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.bounded.row_game import RowGame
from jaxltl.core.sparse.bounded.step_bounded import until
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.product import sparse_product
from jaxltl.core.types import Solution
from jaxltl.core.values.undiscounted.satisfaction import (
    optimal_satisfaction,
    satisfaction_probability,
)
from jaxltl.core.values.undiscounted.sparse_satisfaction import (
    at_states,
)
from jaxltl.core.values.engine.state_quantities import PROBABILITY, safe_mean, solution_from_error

_BATCH = 4096  # pairs of a world and a memory that are shown to an agent at once
_SUM = 1e-4  # by how much a network's distribution may miss one; it is scaled


@brief
class OptimalityGap(NamedTuple):
    """Result of :func:`optimality_gap`, for each of the N initial states.

    Attributes:
      start: ``int32[N]``, their states in the table.
      weight: ``float64[N]``, their initial probabilities.
      value, optimum: of the agent, and optimal: :class:`~jaxltl.core.types.Solution` of ``[N]``.
      lower, upper: ``float64[N]``, bounds on the gap, optimum minus value.
      mean, mean_value, mean_optimum: bounds on the means over the initial states.
      evidence: of the equality of table and environment; see
        :class:`~jaxltl.core.environments.tabulate.TabulatedEnvironment`.

    Example:
      >>> from jaxltl import make_environment, tabulate
      >>> from jaxltl.core.environments import Timestep
      >>> corridor = make_environment(
      ...     lambda key: jnp.int32(2),
      ...     lambda at, action, key: Timestep(jnp.clip(at + 2 * action - 1, 0, 4), 0.0, False),
      ...     lambda place: place[None], actions=2,
      ...     labels=lambda place: jnp.array([place == 4]), propositions=["goal"])
      >>> found = optimality_gap(tabulate(corridor), "F goal", np.full((5, 2, 2), 0.5), num_steps=4)
      >>> found.start.tolist(), found.weight.tolist(), found.mean_optimum  # listed from the start
      ([0], [1.0], (1.0, 1.0))
      >>> bool(found.lower[0] <= 0.625 <= found.upper[0])
      True
    """

    start: np.ndarray
    weight: np.ndarray
    value: Solution
    optimum: Solution
    lower: np.ndarray
    upper: np.ndarray
    mean: tuple[float, float]
    mean_value: tuple[float, float]
    mean_optimum: tuple[float, float]
    evidence: str


def tabulate_policy(
    policy: Callable[..., jax.Array] | Agent,
    environment: Environment,
    table: TabulatedEnvironment,
    num_memory: int,
) -> np.ndarray:
    """Action probabilities of an agent in each tabulated state and automaton state.

    Args:
      policy: function of ``(observation, memory)`` to an action or the probabilities ``float[A]``;
        `memory` is ``int32[]``, the automaton state. A ``Partial`` is compiled once. Or an
        :class:`~jaxltl.core.environments.episodes.Agent` without memory, such as
        ``ppo.policy(state, problem, hparams)`` of a network without memory.
      environment, table: the tabulated environment and its table. For an agent of
        :func:`~jaxltl.core.environments.task_environment.task_environment`, that one, whose
        observations contain the automaton state.
      num_memory: Q.

    Returns:
      ``int32[S, Q]`` or ``float[S, Q, A]``, for :func:`optimality_gap`; not differentiable.

    Raises:
      ValueError: an invalid table, number of memory states, or policy.

    Example:
      >>> from jaxltl import make_environment, tabulate
      >>> from jaxltl.core.environments import Timestep
      >>> corridor = make_environment(
      ...     lambda key: jnp.int32(2),
      ...     lambda at, action, key: Timestep(jnp.clip(at + 2 * action - 1, 0, 4), 0.0, False),
      ...     lambda place: place[None], actions=2,
      ...     labels=lambda place: jnp.array([place == 4]), propositions=["goal"])
      >>> def to_the_right(observation, memory):
      ...     return jnp.where(memory == 0, 1, 0)
      >>> tabulate_policy(to_the_right, corridor, tabulate(corridor), 2).tolist()
      [[1, 0], [1, 0], [1, 0], [1, 0], [1, 0]]
    """
    validation.instance("table", table, TabulatedEnvironment, "one of tabulate")
    num_memory = validation.integer("num_memory", num_memory, least=1, limit=2**24)
    count = table.model.num_states
    size = max(1, min(count, _BATCH // num_memory))
    if isinstance(policy, Agent):
        _require_tabular(policy)
    else:
        policy = as_partial(policy, "policy")
    inner, tables = without_task(without_time_limit(environment)[0])
    inner, _ = without_time_limit(inner)
    memory = jnp.arange(num_memory, dtype=jnp.int32)
    parts = []
    for begin in range(0, count, size):
        place = np.minimum(np.arange(begin, begin + size), count - 1)
        some = jax.tree.map(lambda x, i=place: jnp.asarray(x)[i], table.world)
        with _observed_as_trained(policy, tables):
            parts.append(np.asarray(_acts(policy, (inner, tables), memory, some))[: count - begin])
    return np.concatenate(parts)


@contextlib.contextmanager
def _observed_as_trained(policy: PyTree, tables: PyTree) -> Iterator[None]:
    """Names the remedy if an agent of a task is given the observations without the task."""
    try:
        yield
    except (ValueError, TypeError, AttributeError) as error:
        if tables is not None or not isinstance(policy, Agent):
            raise
        raise ValueError(
            "the agent does not take the observations of environment, which has no task; if the agent "
            f"was trained in task_environment(...), give that environment. ({error})"
        ) from error


@jit()
def _acts(policy: PyTree, observed: PyTree, memory: jax.Array, worlds: PyTree) -> jax.Array:
    environment, tables = observed

    def one(world: PyTree, memory: jax.Array) -> jax.Array:
        observation = environment.observe(world)
        if tables is not None:
            observation = TaskObservation(observation, memory_seen(tables, memory))
        allowed = None if environment.allowed is None else environment.allowed(world)
        if not isinstance(policy, Agent):
            return cast(jax.Array, policy(observation, memory))
        if policy.probabilities is not None:
            return policy.probabilities(policy.act, policy.memory, observation, allowed)
        return cast(jax.Array, policy.act(policy.memory, observation, allowed, None)[0])

    return jax.vmap(lambda world: jax.vmap(partial(one, world))(memory))(worlds)


def _require_tabular(agent: Agent) -> None:
    """Raises ValueError for an agent whose actions depend on more than the observation."""
    if jax.tree.leaves(agent.memory):
        raise ValueError(
            "policy is an Agent with a memory of its own, which is no function of the state; give an "
            "agent without memory, or evaluate(key, agent, environment)."
        )


def optimality_gap(
    table: TabulatedEnvironment,
    formula: Automaton | Formula | str,
    policy: ArrayLike,
    *,
    num_steps: int | None = None,
) -> OptimalityGap:
    """Optimality gap: the optimal satisfaction probability minus an agent's, with bounds.

    Both are step-bounded reachability probabilities in the product of the table and the task (Baier
    and Katoen 2008, section 10.1.1): that some prefix of at most n steps has only satisfying
    continuations. The optimum is over all policies, also time-dependent ones. Without a limit of
    steps both are satisfaction probabilities. The last label of a terminated episode repeats
    forever.

    Args:
      table: from :func:`~jaxltl.core.environments.tabulate.tabulate`.
      formula: a formula, its text, or an automaton; memory states are those of its automaton.
      policy: actions ``int[S, Q]`` or their probabilities ``float[S, Q, A]``, such as
        :func:`tabulate_policy` returns. Rows that miss a sum of one by rounding are scaled.
      num_steps: n; default the table's.

    Returns:
      :class:`OptimalityGap`. Concrete arrays only; not differentiable.

    Raises:
      ValueError: a wrong shape, a reachable row of the policy that is not a distribution over
        available actions, or a table with truncated episodes without `num_steps`.

    Example:
      >>> from jaxltl import make_environment, tabulate
      >>> from jaxltl.core.environments import Timestep
      >>> corridor = make_environment(
      ...     lambda key: jnp.int32(2),
      ...     lambda at, action, key: Timestep(jnp.clip(at + 2 * action - 1, 0, 4), 0.0, False),
      ...     lambda place: place[None], actions=2,
      ...     labels=lambda place: jnp.array([place == 4]), propositions=["goal"])
      >>> lazy = np.full((5, 2, 2), 0.5)
      >>> found = optimality_gap(tabulate(corridor), "F goal", lazy, num_steps=4)
      >>> found.optimum.value.tolist(), found.value.value.tolist(), round(found.mean[1], 9)
      ([1.0], [0.375], 0.625)
    """
    validation.instance("table", table, TabulatedEnvironment, "one of tabulate")
    if not isinstance(formula, Automaton):
        formula = to_automaton(formula)
    steps = table.num_steps if num_steps is None else validation.integer("num_steps", num_steps)
    model = product(table.model, formula)
    table_of_policy = _rows_of(policy)
    shape, num_actions = model.state_shape, int(np.max(np.asarray(table.model.action))) + 1
    if (
        table_of_policy.shape[:2] != shape
        or table_of_policy.ndim != 2 + (not is_deterministic(table_of_policy))
        or (table_of_policy.ndim == 3 and table_of_policy.shape[2] < num_actions)
    ):
        raise ValueError(
            f"policy is {table_of_policy.dtype}{list(table_of_policy.shape)}; expected actions "
            f"int{list(shape)}, or probabilities float{[*shape, num_actions]}."
        )
    start = np.unique(np.asarray(table.start))
    weight = np.asarray(table.model.initial)[start]
    if steps is None:
        value, optimum = _unbounded(table, model, table_of_policy, start)
    else:
        value, optimum = _bounded(table, model, formula, table_of_policy, start, steps)
    own, best = (tuple(np.asarray(x) for x in (y.lower, y.upper)) for y in (value, optimum))
    sure = np.isin(own, (0, 1)).all(axis=0) & np.isin(best, (0, 1)).all(axis=0)
    below, above = best[0] - own[1], best[1] - own[0]
    # No policy is better than the best.
    lower = np.maximum(np.where(sure, below, np.nextafter(below, -np.inf)), 0)
    upper = np.maximum(np.where(sure, above, np.nextafter(above, np.inf)), 0)
    return OptimalityGap(
        start.astype(np.int32),
        weight,
        value,
        optimum,
        lower,
        upper,
        _mean(weight, lower, upper),
        _mean(weight, *own),
        _mean(weight, *best),
        table.evidence,
    )


def _rows_of(policy: ArrayLike) -> np.ndarray:
    try:
        array = np.asarray(policy)
    except ValueError:  # ragged
        array = np.asarray(None)
    if array.dtype.kind not in "iuf":
        raise ValueError(
            f"policy is {validation.shorten(policy)}; give actions, or their probabilities."
        )
    return array


def _bounded(
    table: TabulatedEnvironment,
    model: Product,
    automaton: Automaton,
    policy: np.ndarray,
    start: np.ndarray,
    steps: int,
) -> tuple[Solution, Solution]:
    """Step-bounded probabilities of the agent and the optimum, from each initial state."""
    base, decisions, letter = table.model.host, verdicts(automaton), np.asarray(model.letter)
    reachable = sparse_product(
        base,
        np.asarray(automaton.delta),
        letter,
        (start, np.asarray(model.initial_memory)[start]),
        still=decisions != Verdict.UNDECIDED,
    )
    ended = np.asarray(table.terminated)[reachable.base_state]
    at_end = lasso_verdicts(automaton)[reachable.memory, letter[reachable.base_state]]
    target = np.where(ended, at_end, decisions[reachable.memory]) == Verdict.SATISFIED
    going = ~np.asarray(table.truncated)[reachable.base_state]
    every = np.ones(target.size, bool)
    game = RowGame(reachable.host, every)
    best = until(game, target, going, steps)
    single = np.diff(base.row_start)[reachable.base_state] == 1
    fixed = reachable.still | (single & (ended | ~going))
    weight = _weights(
        policy,
        np.asarray(table.model.action)[reachable.base_row],
        reachable.base_state,
        reachable.memory,
        reachable.host,
        fixed,
    )
    own = until(game.under(weight, every)[0], target, going, steps)
    at = reachable.start
    return (
        solution_from_error(own.value[at], own.error[at], None, own.num_steps, span=PROBABILITY),
        solution_from_error(
            best.value[at],
            best.error[at],
            reachable.base_row[best.row[at]],
            best.num_steps,
            span=PROBABILITY,
        ),
    )


def _unbounded(
    table: TabulatedEnvironment, model: Product, policy: np.ndarray, start: np.ndarray
) -> tuple[Solution, Solution]:
    """Probabilities of the agent and the optimum without a step bound."""
    if np.asarray(table.truncated).any():
        raise ValueError(
            "optimality_gap: the environment cuts episodes off, and what would come is not in the "
            "table; give num_steps, or tabulate it without its limit."
        )
    base = table.model
    num_memory = model.num_memory
    state, memory = (
        np.repeat(base.host.state, num_memory),
        np.tile(np.arange(num_memory), base.num_rows),
    )
    ended = np.asarray(table.terminated)
    action = np.repeat(np.asarray(base.action), num_memory)
    mass = _mass(policy, action, state, memory)
    mass = np.where(ended[state], 1.0, mass).reshape(base.num_rows, num_memory)
    total = np.add.reduceat(mass, base.host.row_start[:-1], axis=0)
    _require(
        total,
        np.minimum.reduceat(mass, base.host.row_start[:-1], axis=0),
        lambda at: (int(at[0]), int(at[1])),
    )
    own = satisfaction_probability(model, mass / total[base.host.state])
    best = optimal_satisfaction(model)
    at: Array = start, np.asarray(model.initial_memory)[start]
    return at_states(own, at), at_states(best, at)


def _mass(
    policy: np.ndarray, action: np.ndarray, state: np.ndarray, memory: np.ndarray
) -> np.ndarray:
    """Weights of rows under the agent."""
    if is_deterministic(policy):
        weight: np.ndarray = policy[state, memory] == action
    else:
        weight = policy[state, memory, action]
    return weight.astype(np.float64)


def _weights(
    policy: np.ndarray,
    action: np.ndarray,
    base: np.ndarray,
    memory: np.ndarray,
    mdp: HostMDP,
    fixed: np.ndarray,
) -> np.ndarray:
    """``float64[R']``, the agent's distribution over the rows of each pair."""
    weight = _mass(policy, action, base[mdp.state], memory[mdp.state])
    weight = np.where(fixed[mdp.state], 1.0, weight)
    total = mdp.over_choices(np.add, weight)
    _require(
        total,
        mdp.over_choices(np.minimum, weight),
        lambda at: (int(base[at[0]]), int(memory[at[0]])),
    )
    result: np.ndarray = weight / total[mdp.state]
    return result


def _require(total: np.ndarray, least: np.ndarray, place: Callable[..., tuple[int, int]]) -> None:
    for at in np.argwhere(~((np.abs(total - 1) <= _SUM) & (least >= 0)))[:1]:
        state, memory = place(at)
        raise ValueError(
            f"policy: in state {state} with memory {memory} the actions that are allowed have the "
            f"probability {total[tuple(at)]:.9g} in sum; it must be a distribution over them."
        )


def _mean(weight: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> tuple[float, float]:
    """Bounds on a mean of numbers between zero and one, rounding included."""
    return safe_mean(weight, lower, up=False), safe_mean(weight, upper, up=True, highest=1)
