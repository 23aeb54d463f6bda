"""Policies of learners as functions of the state."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import jaxpr_as_fun

from jaxltl.core import validation
from jaxltl.core.array_types import Floats, PyTree
from jaxltl.core.continuous.dynamics import Dynamics
from jaxltl.core.environments.environment import Environment
from jaxltl.core.environments.episodes import Agent
from jaxltl.core.environments.monitor import Verdict
from jaxltl.core.environments.task_environment import (
    TaskObservation,
    TaskTables,
    task_environment,
    task_tables,
)
from jaxltl.core.logic.ltl import Formula

StatePolicy = Callable[[jax.Array], jax.Array]
# A function, an Agent, or a flax module with its parameters.
Policy = StatePolicy | Agent | tuple[object, PyTree]


def state_policy(policy: Policy, environment: Dynamics | Environment) -> StatePolicy:
    """A learned policy as a function ``float[n] -> float[m]`` of the state of dynamics.

    Args:
      policy: one of

        - a function ``float[n] -> float[m]``, which is returned;
        - ``(module, parameters)`` of flax, applied to the state;
        - a deterministic :class:`~jaxltl.core.environments.episodes.Agent`: ``ppo.greedy(...)`` or
          ``trust_region.greedy(...)`` of ``(state, problem, hparams)``, the mean of the Gaussian;
          ``network_agent(network, environment)(cce.policy(...))``; the latter's parameters alone
          are no policy.
      environment: the dynamics or the task environment in which the policy was learned. In the latter
        the policy observes the automaton state too; it is held at its value while the formula is
        undecided.

    Returns:
      The function; differentiable where the policy is.

    Raises:
      ValueError: an agent with memory or with random actions; a task with several undecided automaton
        states that the policy can distinguish, so that it is no function of the state.

    Example:
      >>> from jaxltl.core.continuous import make_dynamics
      >>> from jaxltl.core.environments import make_agent
      >>> world = make_dynamics(
      ...     lambda x, u, w: x + u, domain=([0.0], [1.0]), labels={}, actions=([-1.0], [1.0]))
      >>> agent = make_agent(lambda seen, key: -seen / 2)
      >>> float(state_policy(agent, world)(jnp.array([0.5]))[0])
      -0.25
    """
    if isinstance(policy, tuple) and len(policy) == 2 and hasattr(policy[0], "apply"):
        apply, parameters = policy[0].apply, policy[1]
        variables = (
            parameters
            if isinstance(parameters, dict) and "params" in parameters
            else {"params": parameters}
        )
        return lambda state: apply(variables, state)
    if not isinstance(policy, Agent):
        return validation.function("policy", policy)
    if jax.tree.leaves(policy.memory):
        raise ValueError("policy is an agent with memory; give a policy of the state alone.")
    tabled = None if isinstance(environment, Dynamics) else _tables(environment)
    row = None if tabled is None else _undecided_row(tabled)

    def act(state: jax.Array) -> jax.Array:
        seen = state if row is None else TaskObservation(state, jnp.asarray(row, state.dtype))
        action: jax.Array = policy.act((), seen, None, None)[0]
        return action

    n = environment.num_states if isinstance(environment, Dynamics) else _size(environment)
    try:
        jax.eval_shape(act, jax.ShapeDtypeStruct((n,), jnp.result_type(float)))
    except (TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"policy is an agent that cannot act on a state float[{n}] without a random key "
            f"({' '.join(str(error).split())[:120]}); give a deterministic one, such as "
            "ppo.greedy(state, problem, hparams), and state_policy(agent, environment) of the "
            "environment in which it was learned."
        ) from error
    return _folded(act)


def _folded(act: StatePolicy) -> StatePolicy:
    """The same function with the parts evaluated that depend on no state, such as scales.

    Their enclosures would be wide where a comparison of constants is within rounding of equality.
    """

    def folded(state: jax.Array) -> jax.Array:
        program = jax.make_jaxpr(act)(jax.ShapeDtypeStruct(state.shape, state.dtype))
        with jax.ensure_compile_time_eval():
            action: jax.Array = jaxpr_as_fun(program)(state)[0]
        return action

    return folded


def _tables(environment: Environment) -> TaskTables | None:
    """The task's tables, or None for an environment without a task."""
    try:
        return task_tables(environment)
    except ValueError:
        return None


def _size(environment: Environment) -> int:
    shape = jax.eval_shape(
        lambda key: environment.observe(environment.reset(key)), jax.random.key(0)
    )
    return int((shape.world if isinstance(shape, TaskObservation) else shape).shape[0])


def _undecided_row(tables: TaskTables) -> Floats:
    """The observation of the automaton state while the task is undecided."""
    delta, verdict = np.asarray(tables.delta), np.asarray(tables.verdict)
    rows = np.eye(len(delta)) if tables.embedding is None else np.asarray(tables.embedding)
    reached = {int(tables.initial)}
    while (more := reached | set(delta[list(reached)].ravel().tolist())) != reached:
        reached = more
    entered = np.unique(delta[list(reached)])  # an observation follows the first label
    undecided = entered[verdict[entered] == Verdict.UNDECIDED]
    distinct: Floats = np.unique(rows[undecided], axis=0)
    if len(distinct) > 1:
        raise ValueError(
            f"the policy observes {len(undecided)} undecided automaton states of its task, so that it is "
            "no function of the state alone; learn with embedding=np.zeros((Q, 1)), which hides them, "
            "or synthesize a policy with memory by synthesize_policy."
        )
    result: Floats = rows[int(tables.initial)] if not len(distinct) else distinct[0]
    return result


def learned_policy(policy: Policy, dynamics: Dynamics, formula: str | Formula) -> StatePolicy:
    """:func:`state_policy` of an agent that was learned in the dynamics, or in their task."""
    try:
        return state_policy(policy, dynamics)
    except ValueError:
        if not isinstance(policy, Agent) or jax.tree.leaves(policy.memory):
            raise
    return state_policy(policy, task_environment(dynamics.environment, formula))
