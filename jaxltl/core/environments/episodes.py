"""Episodes: an agent in a simulated world, from its start to its end, one step after the other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jax.tree_util import Partial

from jaxltl.core import validation
from jaxltl.core.environments.environment import (
    Environment,
    Timestep,
    allowed_in,
    as_partial,
    require_environment,
    require_key,
)
from jaxltl.core.models import facts
from jaxltl.core.pretty_print import brief


def require_agent(agent: Any) -> Agent:
    """Refuses what is no :class:`Agent`."""
    found: Agent = validation.instance(
        "agent",
        agent,
        Agent,
        "an Agent, such as ppo.policy(state, problem, hparams), or "
        "make_agent(function) of (observation, key)",
    )
    return found


@brief
@struct.dataclass
class Agent:
    """What acts in an environment, for :func:`run_episode` and evaluations.

    Attributes:
      act: ``(memory, observation, allowed, key) -> (action, memory)``; `allowed` is ``bool[A]``, or
        None where the environment allows everything.
      memory: before anything is seen; a tree of arrays, ``()`` for none.

    Example:
      >>> first = Agent(lambda memory, observation, allowed, key: (allowed.argmax(), memory))
      >>> int(first.act((), None, jnp.array([False, True]), None)[0])
      1
    """

    act: Callable[..., tuple[Any, Any]]
    memory: Any = ()


def make_agent(function: Callable[..., Any]) -> Agent:
    """An :class:`Agent` without memory that ignores masks, of a function.

    Args:
      function: ``(observation, key) -> action``, of one trajectory.

    Returns:
      :class:`Agent`.

    Example:
      >>> still = make_agent(lambda observation, key: 0)
      >>> still.act((), None, None, None)
      (0, ())
    """
    return Agent(Partial(_without_memory, as_partial(function)))


def _without_memory(
    function: Callable[..., Any], memory: Any, observation: Any, allowed: Any, key: chex.PRNGKey
) -> tuple[Any, Any]:
    del allowed
    return function(observation, key), memory


@brief(facts=facts.episode)
class Episode(NamedTuple):
    """One trajectory of T steps, or with a leading axis many.

    What comes after its end repeats the last world and is not `valid`.

    Attributes:
      world: before each step and after the last, a tree with a first axis of T + 1.
      observation: before each step, a tree with a first axis of T.
      action: a first axis of T.
      reward, cost: ``float[T]``, zero after the end.
      label: ``bool[T + 1, P]``, of the worlds.
      valid: ``bool[T]``, whether the step was made.
      terminated, truncated: ``bool[]``, how it ended; neither if T steps were not enough.
      discount: ``float[T]``, that of each step; one after the end.

    Example:
      >>> import jaxltl as jl
      >>> coin = jl.make_environment(
      ...     lambda key: jnp.int32(0),
      ...     lambda world, action, key: Timestep(action, 1.0, action == 1),
      ...     lambda world: world[None], actions=2)
      >>> seen = jax.eval_shape(
      ...     lambda key: run_episode(key, coin, make_agent(lambda seen, key: 1), num_steps=5),
      ...     jax.random.key(0))
      >>> seen.world.shape, seen.reward.shape, seen.terminated.shape
      ((6,), (5,), ())
    """

    world: Any
    observation: Any
    action: Any
    reward: jax.Array
    cost: jax.Array
    label: jax.Array
    valid: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    discount: jax.Array


def run_episode(
    key: chex.PRNGKey, environment: Environment, agent: Agent, *, num_steps: int
) -> Episode:
    """One episode of an agent, from ``reset`` to its end or for `num_steps` steps.

    For ``jit`` and ``vmap``; what is not used of the result is not computed under ``jit``.

    Args:
      key: of everything that is drawn; the same one gives the same episode.
      environment, agent: what is run.
      num_steps: T; static.

    Returns:
      :class:`Episode`. Differentiable where the environment and the agent are.

    Raises:
      ValueError: a number below 1.

    Example:
      >>> import jaxltl as jl
      >>> coin = jl.make_environment(
      ...     lambda key: jnp.int32(0),
      ...     lambda world, action, key: Timestep(action, 1.0, action == 1),
      ...     lambda world: world[None], actions=2)
      >>> run = jax.jit(
      ...     lambda key: run_episode(key, coin, make_agent(lambda seen, key: 1), num_steps=5))
      >>> found = run(jax.random.key(0))
      >>> found.reward.tolist(), bool(found.terminated)
      ([1.0, 0.0, 0.0, 0.0, 0.0], True)
    """
    num_steps = validation.integer("num_steps", num_steps, least=1, most=2**31 - 1)
    environment, agent = require_environment(environment), require_agent(agent)
    begin, path = begin_episode(require_key(key), environment, agent)

    def move(now: Underway, time: jax.Array) -> tuple[Underway, Move]:
        return continue_episode(now, environment, agent, jax.random.fold_in(path, time))

    end, made = lax.scan(move, begin, jnp.arange(num_steps))

    def append(row: Any, end: Any) -> Any:
        return jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), row, end)

    return Episode(
        append(made.world, end.world),
        made.observation,
        made.action,
        made.reward,
        made.cost,
        append(made.label, environment.labels(end.world)),
        made.valid,
        end.terminated,
        end.truncated,
        made.discount,
    )


@brief
class Underway(NamedTuple):
    """An episode that goes on unless it is terminated or truncated."""

    world: Any
    memory: Any
    terminated: jax.Array
    truncated: jax.Array


@brief
class Move(NamedTuple):
    """One row of an :class:`Episode`: what was there before a step, and what the step gave."""

    world: Any
    observation: Any
    action: Any
    reward: jax.Array
    cost: jax.Array
    label: jax.Array
    valid: jax.Array
    discount: jax.Array


def begin_episode(
    key: chex.PRNGKey, environment: Environment, agent: Agent
) -> tuple[Underway, chex.PRNGKey]:
    """The first world, and the key into which the number of each step is folded."""
    start, path = jax.random.split(key)
    no = jnp.bool_(False)
    return Underway(environment.reset(start), agent.memory, no, no), path


def continue_episode(
    now: Underway, environment: Environment, agent: Agent, key: chex.PRNGKey
) -> tuple[Underway, Move]:
    """One step of an episode that goes on; one that is over stays as it is, for nothing."""
    world, active = now.world, ~(now.terminated | now.truncated)
    act_key, step_key = jax.random.split(key)
    observation, allowed = environment.observe(world), allowed_in(environment, world)
    action, memory = agent.act(now.memory, observation, allowed, act_key)
    found = Timestep(*environment.step(world, action, step_key))
    reward, cost = (jnp.where(active, x, 0.0) for x in (found.reward, found.cost))
    discount = jnp.where(active, found.discount, 1.0)
    after = jax.tree.map(lambda x, y: jnp.where(active, x, y), found.world, world)
    terminated, truncated = (
        t | (active & jnp.asarray(f, bool))
        for t, f in ((now.terminated, found.terminated), (now.truncated, found.truncated))
    )
    label = environment.labels(world)
    return Underway(after, memory, terminated, truncated), Move(
        world, observation, action, reward, cost, label, active, discount
    )


def auto_reset_step(
    environment: Environment, world: Any, action: Any, key: chex.PRNGKey
) -> tuple[Any, Timestep]:
    """A step, and a fresh start where an episode ends with it; for episodes one after the other.

    Args:
      environment: the world.
      world: before the step.
      action: that is taken.
      key: of the step and of the fresh start.

    Returns:
      The world to go on from, and the :class:`Timestep`, whose world is the one that the step led
      to, also where the episode ended there.

    Example:
      >>> import jaxltl as jl
      >>> coin = jl.make_environment(
      ...     lambda key: jnp.int32(0),
      ...     lambda world, action, key: Timestep(action, 1.0, action == 1),
      ...     lambda world: world[None], actions=2)
      >>> onward, made = auto_reset_step(coin, jnp.int32(0), jnp.int32(1), jax.random.key(0))
      >>> int(onward), int(made.world)
      (0, 1)
    """
    step_key, reset_key = jax.random.split(key)
    found = Timestep(*environment.step(world, action, step_key))
    ended = jnp.asarray(found.terminated, bool) | jnp.asarray(found.truncated, bool)
    fresh = environment.reset(reset_key)
    return jax.tree.map(lambda x, y: jnp.where(ended, x, y), fresh, found.world), found
