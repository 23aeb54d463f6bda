"""Agents, episodes of an agent in a simulated environment, and time limits."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.tree_util import Partial

from jaxltl.core import struct, validation
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import (
    Environment,
    Timestep,
    allowed_in,
    as_partial,
    optional,
    require_environment,
    require_key,
)
from jaxltl.core.pretty_print import brief


def require_agent(agent: object) -> Agent:
    """Raises ValueError for anything but an :class:`Agent`."""
    return cast(
        Agent,
        validation.instance(
            "agent",
            agent,
            Agent,
            "an Agent, such as ppo.policy(state, problem, hparams), or "
            "make_agent(function) of (observation, key)",
        ),
    )


@struct.dataclass
class Agent:
    """An agent: a policy on observations, with memory.

    Attributes:
      act: ``(memory, observation, allowed, key) -> (action, memory)``; `allowed` is ``bool[A]``, or
        None where all actions are available.
      memory: the initial memory, a tree of arrays; ``()`` for none.
      probabilities: of an agent that samples, ``(act, memory, observation, allowed) -> float[A]``, the
        probabilities of its actions; static. None where they are not known.

    >>> first = Agent(lambda memory, observation, allowed, key: (allowed.argmax(), memory))
    >>> int(first.act((), None, jnp.array([False, True]), None)[0])
    1
    """

    act: Callable[..., tuple[PyTree, PyTree]]
    memory: PyTree = ()
    probabilities: Callable[..., jax.Array] | None = struct.field(pytree_node=False, default=None)


def make_agent(function: Callable[..., PyTree]) -> Agent:
    """A memoryless :class:`Agent` from a function; masks of actions apply to what it returns.

    Where its action is not available, the agent takes the first available one, as a shield that corrects
    actions after a learner has chosen them does (Alshiekh et al. 2018).

    Args:
      function: ``(observation, key) -> action``. One that chooses among the available actions itself has
        a parameter with the name ``allowed``, ``bool[A]`` or None: ``(observation, key, allowed)``.

    Returns:
      :class:`Agent`.

    >>> still = make_agent(lambda observation, key: 0)
    >>> still.act((), None, None, None)
    (0, ())
    >>> int(still.act((), None, jnp.array([False, True]), None)[0])
    1
    """
    called = function.func if isinstance(function, Partial) else function
    try:
        reads_mask = "allowed" in inspect.signature(called).parameters
    except (TypeError, ValueError):  # not a function, or one without a signature
        reads_mask = False
    return Agent(Partial(_without_memory, struct.Static(reads_mask), as_partial(function)))


def _without_memory(
    reads_mask: struct.Static,
    function: Callable[..., PyTree],
    memory: PyTree,
    observation: PyTree,
    allowed: jax.Array | None,
    key: Key,
) -> tuple[PyTree, PyTree]:
    if reads_mask.value:
        action = function(observation, key, allowed=allowed)
    else:
        action = function(observation, key)
    is_number = jnp.shape(action) == () and jnp.issubdtype(jnp.result_type(action), jnp.integer)
    if allowed is None or not is_number:  # the environment checks actions
        return action, memory
    mask, number = jnp.asarray(allowed), jnp.asarray(action)
    wrong = ~mask[jnp.clip(number, 0, mask.size - 1)] & (number >= 0) & (number < mask.size)
    first = jnp.argmax(mask).astype(number.dtype)
    return jnp.where(wrong & mask.any(), first, number), memory


@brief
class Episode(NamedTuple):
    """A trajectory of T steps; a batch has leading axes.

    Steps after the end of the episode repeat its last state and are not `valid`.

    Attributes:
      world: the states, a tree with a leading axis of T + 1.
      observation, action: trees with a leading axis of T.
      reward, cost: ``float[T]``, zero after the end.
      label: ``bool[T + 1, P]``, of the states.
      valid: ``bool[T]``, True for steps before the end.
      terminated, truncated: ``bool[]``; both False if T steps did not reach the end.
      discount: ``float[T]`` of the steps; one after the end.

    >>> seen = Episode(world=[0, 1], observation=[0], action=[1], reward=[1.0], cost=[0.0],
    ...                label=[[False], [True]], valid=[True], terminated=True, truncated=False,
    ...                discount=[1.0])
    >>> seen.world[-1], sum(seen.reward)
    (1, 1.0)
    """

    world: PyTree
    observation: PyTree
    action: PyTree
    reward: jax.Array
    cost: jax.Array
    label: jax.Array
    valid: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    discount: jax.Array


def run_episode(key: Key, environment: Environment, agent: Agent, *, num_steps: int) -> Episode:
    """One episode of an agent, from ``reset`` to its end or for `num_steps` steps.

    Runs under ``jit`` and ``vmap``; the compiler drops fields that the caller does not use.

    Args:
      key, environment, agent: the random key, the environment and the :class:`Agent`.
      num_steps: T; static.

    Returns:
      :class:`Episode`. Differentiable where the environment and the agent are.

    Raises:
      ValueError: `num_steps` below 1.

    >>> from jaxltl import environments, gridworld
    >>> world = environments.model_environment(gridworld("a . b", initial="a"), reward=[0, 0, 1])
    >>> right = make_agent(lambda seen, key: 3)
    >>> run = jax.jit(lambda key: run_episode(key, world, right, num_steps=3))
    >>> run(jax.random.key(0)).reward.tolist()
    [0.0, 0.0, 1.0]
    """
    num_steps = validation.integer("num_steps", num_steps, least=1, limit=2**31 - 1)
    environment, agent = require_environment(environment), require_agent(agent)
    begin, path = begin_episode(require_key(key), environment, agent)

    def move(now: Underway, time: jax.Array) -> tuple[Underway, Episode]:
        return continue_episode(jax.random.fold_in(path, time), now, environment, agent)

    end, steps = lax.scan(move, begin, jnp.arange(num_steps))

    def append(row: PyTree, end: PyTree) -> PyTree:
        return jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), row, end)

    return steps._replace(
        world=append(steps.world, end.world),
        label=append(steps.label, environment.labels(end.world)),
        terminated=end.terminated,
        truncated=end.truncated,
    )


@brief
class Underway(NamedTuple):
    """The state of an episode during its simulation."""

    world: PyTree
    memory: PyTree
    terminated: jax.Array
    truncated: jax.Array


def begin_episode(key: Key, environment: Environment, agent: Agent) -> tuple[Underway, Key]:
    """The initial state of an episode, and the key into which step numbers are folded."""
    start, path = jax.random.split(key)
    no = jnp.bool_(False)
    return Underway(environment.reset(start), agent.memory, no, no), path


def continue_episode(
    key: Key, now: Underway, environment: Environment, agent: Agent
) -> tuple[Underway, Episode]:
    """One step of an episode, with the state and the label before it; the identity after the end."""
    world, active = now.world, ~(now.terminated | now.truncated)
    act_key, step_key = jax.random.split(key)
    observation, allowed = environment.observe(world), allowed_in(environment, world)
    action, memory = agent.act(now.memory, observation, allowed, act_key)
    step = Timestep(*environment.step(world, action, step_key))
    reward, cost = (jnp.where(active, x, 0.0) for x in (step.reward, step.cost))
    discount = jnp.where(active, step.discount, 1.0)
    after = jax.tree.map(lambda x, y: jnp.where(active, x, y), step.world, world)
    terminated, truncated = (
        t | (active & jnp.asarray(f, bool))
        for t, f in ((now.terminated, step.terminated), (now.truncated, step.truncated))
    )
    return Underway(after, memory, terminated, truncated), Episode(
        world,
        observation,
        action,
        reward,
        cost,
        environment.labels(world),
        active,
        terminated,
        truncated,
        discount,
    )


def auto_reset_step(
    key: Key, environment: Environment, world: PyTree, action: PyTree
) -> tuple[PyTree, Timestep]:
    """A step that resets the environment where an episode ends.

    Args:
      key: random key, of the step and of the reset.
      environment, world, action: as for ``environment.step``.

    Returns:
      The next state, after a reset if the episode ended, and the :class:`Timestep` with the state
      before the reset.

    >>> import jaxltl as jl
    >>> coin = jl.environments.make_environment(
    ...     lambda key: jnp.int32(0),
    ...     lambda world, action, key: Timestep(action, 1.0, action == 1),
    ...     lambda world: world[None], actions=2)
    >>> onward, made = auto_reset_step(jax.random.key(0), coin, jnp.int32(0), jnp.int32(1))
    >>> int(onward), int(made.world)
    (0, 1)
    """
    step_key, reset_key = jax.random.split(key)
    step = Timestep(*environment.step(world, action, step_key))
    ended = jnp.asarray(step.terminated, bool) | jnp.asarray(step.truncated, bool)
    fresh = environment.reset(reset_key)
    return jax.tree.map(lambda x, y: jnp.where(ended, x, y), fresh, step.world), step


# --- time limits -------------------------------------------------------------------------------


def with_time_limit(environment: Environment, num_steps: int) -> Environment:
    """The environment with episodes truncated after `num_steps` steps.

    Its states are pairs ``(world, time)``; observations do not include the time.

    Args:
      environment, num_steps: the environment and the limit.

    Returns:
      The environment; its horizon is the smaller of `num_steps` and the horizon before.

    Raises:
      ValueError: a limit below 1.

    >>> from jaxltl import environments, gridworld
    >>> with_time_limit(environments.model_environment(gridworld("a b")), 10).horizon
    10
    """
    num_steps = validation.integer("num_steps", num_steps, least=1, limit=2**31 - 1)
    inner, limit = require_environment(environment), np.int32(num_steps)
    parts: dict[str, PyTree] = {n: optional(f, getattr(inner, n)) for n, f in _TIMED.items()}
    return replace(
        inner,
        step=Partial(_step_clock, limit, inner.step),
        outcomes=optional(_clocked, limit, inner.outcomes),
        horizon=min(num_steps, inner.horizon or num_steps),
        **parts,
    )


def without_time_limit(environment: Environment) -> tuple[Environment, int | None]:
    """The environment inside :func:`with_time_limit` and the limit; any other environment and None."""
    timed: PyTree = require_environment(environment)
    if getattr(timed.step, "func", None) is not _step_clock:
        return environment, None
    parts = {
        name: part and part.args[-1]
        for name in ("step", "outcomes", *_TIMED)
        for part in [getattr(timed, name)]
    }
    return replace(environment, horizon=None, **parts), int(timed.step.args[0])


def _reset_clock(reset: Callable[..., PyTree], key: Key) -> PyTree:
    return reset(key), jnp.int32(0)


def _step_clock(
    limit: jax.Array, step: Callable[..., Timestep], timed: PyTree, action: PyTree, key: Key
) -> Timestep:
    return _ticked(limit, Timestep(*step(timed[0], action, key)), timed[1] + 1)


def _ticked(limit: jax.Array, step: Timestep, time: jax.Array) -> Timestep:
    truncated = jnp.asarray(step.truncated, bool) | (time >= limit)
    return step._replace(world=(step.world, time), truncated=truncated)


def _start_clock(starts: Callable[..., PyTree]) -> PyTree:
    worlds, probability = starts()
    return (worlds, jnp.zeros(jnp.shape(probability), jnp.int32)), probability


def _clocked(
    limit: jax.Array, outcomes: Callable[..., PyTree], timed: PyTree, action: PyTree
) -> tuple[Timestep, jax.Array]:
    step, probability = outcomes(timed[0], action)
    times = jnp.full(jnp.shape(probability), timed[1] + 1)
    return _ticked(limit, Timestep(*step), times), probability


def _of_first(function: Callable[..., PyTree], timed: PyTree) -> PyTree:
    return function(timed[0])


_TIMED: dict[str, Callable[..., PyTree]] = {
    "reset": _reset_clock,
    "starts": _start_clock,
    **dict.fromkeys(("observe", "labels", "allowed"), _of_first),
}
