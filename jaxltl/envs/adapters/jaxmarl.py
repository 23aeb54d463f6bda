"""Environments of the package JaxMARL, for one agent among others with a fixed policy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jaxltl.core import validation
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import (
    Box,
    Environment,
    Timestep,
    as_partial,
    make_box,
    make_environment,
)
from jaxltl.envs.adapters.common import (
    Foreign,
    Held,
    Seen,
    arrays,
    copied,
    labels_of_state,
    package,
    require_environment,
    some_allowed,
    timestep,
)


def from_jaxmarl(
    env: Foreign,
    others: Callable[..., Mapping[str, PyTree]] | None = None,
    agent: str | None = None,
    *,
    labels: Callable[..., jax.Array] | None = None,
    propositions: Sequence[str] = (),
) -> Environment:
    """A JaxMARL environment for one of its agents; the others follow a fixed policy.

    All agents move at once. An episode ends when the package ends it for all agents or for this one; an
    end at ``env.max_steps`` is truncated. Available actions, where the package has them, are `allowed`.

    Args:
      env: as ``jaxmarl.make(name)`` returns it, without wrappers.
      others: ``(observations, key) -> actions``, both dicts with the names of agents as keys; the
        observations of all agents, and the actions of at least all others. A function or a ``Partial``;
        None for environments of one agent.
      agent: the name of the learning agent; default: the first one.
      labels, propositions: ``state -> bool[P]``, of JaxMARL's state, and its names.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment`; its states are pairs of JaxMARL's
      ``state`` and the ``observation`` of all agents.

    Raises:
      ValueError: not a JaxMARL environment, no such agent, no policy of the others, or actions that
        are neither finite nor a box.
      ImportError: jaxmarl is not installed.

    >>> import jaxmarl
    >>> from_jaxmarl(jaxmarl.make("MPE_simple_v3")).actions.num
    5
    """
    module, spaces = package("jaxmarl.environments"), package("jaxmarl.environments.spaces")
    require_environment("jaxmarl", env, module.MultiAgentEnv, "jaxmarl.make(name)")
    names = list(env.agents)
    agent = names[0] if agent is None else agent
    validation.choice("agent", agent, names)
    if (others is None) != (len(names) == 1):
        raise ValueError(
            f"from_jaxmarl: the environment has {len(names)} agents; give others, (observations, key) "
            "-> actions, where there are several, and None where there is one."
        )
    space = env.action_space(agent)
    if isinstance(space, spaces.Discrete):
        actions: int | Box = int(space.n)
    elif isinstance(space, spaces.Box):
        actions = make_box(space.low, space.high, space.shape, np.float32)
    else:
        raise ValueError(
            f"from_jaxmarl: {agent} has the action space {type(space).__name__}; supported are "
            "Discrete and Box."
        )
    held = Held(env)
    return make_environment(
        Partial(_reset, held),
        Partial(_step, held, agent, None if others is None else as_partial(others)),
        Partial(_observe, agent),
        actions=actions,
        labels=labels_of_state(labels),
        propositions=propositions,
        allowed=Partial(_allowed, held, agent)
        if isinstance(actions, int) and _has_masks(env)
        else None,
    )


def _has_masks(env: Foreign) -> bool:
    try:
        jax.eval_shape(lambda key: env.get_avail_actions(env.reset(key)[1]), jax.random.key(0))
    except NotImplementedError:
        return False
    return True


def _reset(held: Held, key: Key) -> Seen:
    observation, state = held.it.reset(key)
    return Seen(arrays(state), arrays(observation))


def _step(
    held: Held, agent: str, others: Partial | None, world: Seen, action: PyTree, key: Key
) -> Timestep:
    choose, go = jax.random.split(key)
    actions = {} if others is None else dict(others(copied(world.observation), choose))
    if missing := [x for x in held.it.agents if x != agent and x not in actions]:
        raise ValueError(f"others returns no action of {', '.join(missing)}.")
    observation, state, reward, done, _ = held.it.step_env(
        go, copied(world.state), actions | {agent: action}
    )
    over, step = done["__all__"] | done[agent], getattr(state, "step", None)
    limit = getattr(held.it, "max_steps", None)
    late = jnp.all(step >= limit) if limit is not None and step is not None else False
    return timestep(Seen(state, observation), world, reward[agent], over & ~late, over & late)


def _observe(agent: str, world: Seen) -> PyTree:
    return world.observation[agent]


def _allowed(held: Held, agent: str, world: Seen) -> jax.Array:
    return some_allowed(jnp.asarray(held.it.get_avail_actions(world.state)[agent], bool))
