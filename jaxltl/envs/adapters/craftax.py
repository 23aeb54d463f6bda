"""Environments of the package craftax."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import Environment, Timestep, make_environment
from jaxltl.envs.adapters.common import (
    Foreign,
    Held,
    arrays,
    copied,
    package,
    params_of,
    require_environment,
    timestep,
)
from jaxltl.envs.adapters.gymnax import space_of_actions


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
        Partial(_reset, held, params),
        Partial(_step, held, params),
        Partial(_observe, held),
        actions=space_of_actions("craftax", env.action_space(params)),
        labels=labels,
        propositions=propositions,
        horizon=limit if isinstance(limit, int) else None,
    )


def _reset(held: Held, params: Foreign, key: Key) -> PyTree:
    _, state = held.it.reset_env(key, params)
    return arrays(state)


def _step(held: Held, params: Foreign, world: PyTree, action: PyTree, key: Key) -> Timestep:
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


def _observe(held: Held, world: PyTree) -> PyTree:
    return held.it.get_obs(world)
