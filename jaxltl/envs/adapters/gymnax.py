"""Environments of the packages gymnax and craftax."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import (
    Box,
    Environment,
    Finite,
    Timestep,
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
    observation_of,
    package,
    params_of,
    require_environment,
    timestep,
)


def from_gymnax(
    env: Foreign,
    params: Foreign = None,
    *,
    labels: Callable[..., jax.Array] | None = None,
    propositions: Sequence[str] = (),
) -> Environment:
    """A gymnax environment, through its ``step_env``, which does not reset.

    An episode is terminated by ``step_env``, and truncated by ``is_truncated``. States are pairs of
    gymnax's ``state`` and ``observation``.

    Args:
      env, params: as ``gymnax.make(name)`` returns them; `params` (default: the environment's own)
        are arrays of the result: other ones do not recompile.
      labels, propositions: ``state -> bool[P]``, of gymnax's state, and its names.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment`.

    Raises:
      ValueError: not a gymnax environment, a wrapper, or actions that are neither finite nor in a box.
      ImportError: gymnax is not installed.

    >>> import gymnax
    >>> world = from_gymnax(*gymnax.make("CartPole-v1"), propositions=["near"],
    ...                     labels=lambda state: abs(state.x)[None] < 0.4)
    >>> world.actions.num, world.horizon, world.propositions
    (2, 500, ('near',))
    """
    module = package("gymnax.environments.environment")
    require_environment(
        "gymnax",
        env,
        module.Environment,
        "gymnax.make(name)[0], without wrappers, which start anew by themselves",
    )
    params = params_of("gymnax", params, env.default_params)
    held, limit = Held(env), getattr(params, "max_steps_in_episode", None)
    known = type(env).is_truncated is module.Environment.is_truncated and isinstance(limit, int)
    return make_environment(
        Partial(_reset, held, params),
        Partial(_step, held, params),
        Partial(observation_of),
        actions=space_of_actions("gymnax", env.action_space(params)),
        labels=labels_of_state(labels),
        propositions=propositions,
        horizon=limit if known else None,
    )


def space_of_actions(root: str, space: Foreign) -> Finite | Box:
    """Action space from a gymnax space."""
    if hasattr(space, "n"):
        return Finite(int(space.n))
    if hasattr(space, "low") and hasattr(space, "high"):
        return make_box(space.low, space.high, space.shape, space.dtype)
    raise ValueError(f"from_{root}: actions are {space!r}; they must be finite or in a box.")


def _reset(held: Held, params: Foreign, key: Key) -> Seen:
    observation, state = held.it.reset(key, params)
    return arrays(Seen(state, observation))


def _step(held: Held, params: Foreign, world: Seen, action: PyTree, key: Key) -> Timestep:
    env = held.it
    observation, state, reward, terminated, _ = env.step_env(
        key, copied(world.state), action, params
    )
    return timestep(
        Seen(state, observation), world, reward, terminated, env.is_truncated(state, params)
    )


def from_craftax(
    env: Foreign,
    params: Foreign = None,
    *,
    labels: Callable[..., jax.Array] | None = None,
    propositions: Sequence[str] = (),
) -> Environment:
    """A Craftax environment, through its ``step_env``, which does not reset.

    Episodes are truncated at ``params.max_timesteps``, and terminated if they would end without that
    limit. States are Craftax's.

    Args:
      env: as ``make_craftax_env_from_name(name, auto_reset=False)`` returns it.
      params: default: the environment's own; arrays of the result.
      labels, propositions: ``state -> bool[P]``, of Craftax's state, and its names.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment`.

    Raises:
      ValueError: not a Craftax environment, or one with auto-reset.
      ImportError: craftax is not installed.

    >>> from craftax.craftax_env import make_craftax_env_from_name
    >>> own = make_craftax_env_from_name("Craftax-Classic-Symbolic-v1", auto_reset=False)
    >>> from_craftax(own).actions.num
    17
    """
    bases = package("craftax.environment_base.environment_bases")
    make = "craftax_env.make_craftax_env_from_name(name, auto_reset=False)"
    require_environment(
        "craftax", env, (bases.EnvironmentNoAutoReset, bases.EnvironmentAutoReset), make
    )
    if isinstance(env, bases.EnvironmentAutoReset):
        raise ValueError(f"from_craftax: {type(env).__name__} starts anew by itself; give {make}.")
    params = params_of("craftax", params, env.default_params)
    held, limit = Held(env), params.max_timesteps
    return make_environment(
        Partial(_reset_craftax, held, params),
        Partial(_step_craftax, held, params),
        Partial(_observe_craftax, held),
        actions=space_of_actions("craftax", env.action_space(params)),
        labels=labels,
        propositions=propositions,
        horizon=limit if isinstance(limit, int) else None,
    )


def _reset_craftax(held: Held, params: Foreign, key: Key) -> PyTree:
    _, state = held.it.reset_env(key, params)
    return arrays(state)


def _step_craftax(held: Held, params: Foreign, world: PyTree, action: PyTree, key: Key) -> Timestep:
    env = held.it
    _, state, reward, _, _ = env.step_env(key, copied(world), action, params)
    endless = params.replace(max_timesteps=jnp.iinfo(jnp.int32).max)
    return timestep(
        state,
        world,
        reward,
        env.is_terminal(state, endless),
        state.timestep >= params.max_timesteps,
    )


def _observe_craftax(held: Held, world: PyTree) -> PyTree:
    return held.it.get_obs(world)
