"""MiniGrid environments of the packages xminigrid (XLand-MiniGrid) and navix."""

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
    labels_of_state,
    observation_of,
    package,
    params_of,
    refuse_wrappers,
    require_environment,
    reset_to_arrays,
    timestep,
)


def from_xminigrid(
    env: Foreign,
    params: Foreign = None,
    *,
    labels: Callable[..., jax.Array] | None = None,
    propositions: Sequence[str] = (),
) -> Environment:
    """An XLand-MiniGrid environment.

    The last timestep of an episode is terminated if its discount is 0, truncated otherwise. States are
    the package's timesteps.

    Args:
      env, params: as ``xminigrid.make(name)`` returns them; a ruleset in `params` is arrays of the
        result: other ones do not recompile.
      labels, propositions: ``state -> bool[P]``, of the package's state, and its names.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment`.

    Raises:
      ValueError: not an xminigrid environment, one with auto-reset, or no limit of steps in `params`.
      ImportError: xminigrid is not installed.

    >>> import xminigrid
    >>> from_xminigrid(*xminigrid.make("MiniGrid-Empty-5x5")).actions.num
    6
    """
    module, wrappers = package("xminigrid.environment"), package("xminigrid.wrappers")
    require_environment("xminigrid", env, module.Environment, "xminigrid.make(name)[0]")
    refuse_wrappers(
        "xminigrid",
        env,
        "_env",
        (wrappers.GymAutoResetWrapper, wrappers.DmEnvAutoResetWrapper),
        "give what is in it",
    )
    params = params_of("xminigrid", params, env.default_params())
    if params.max_steps is None:
        raise ValueError(
            "from_xminigrid: params.max_steps is None; give params.replace(max_steps=...)."
        )
    held = Held(env)
    return make_environment(
        Partial(_reset, held, params),
        Partial(_step, held, params),
        Partial(observation_of),
        actions=int(env.num_actions(params)),
        labels=labels_of_state(labels),
        propositions=propositions,
        horizon=int(params.max_steps),
    )


def _reset(held: Held, params: Foreign, key: Key) -> PyTree:
    return arrays(held.it.reset(params, key))


def _step(held: Held, params: Foreign, world: PyTree, action: PyTree, key: Key) -> Timestep:
    after = held.it.step(params, copied(world), action)
    over = after.discount == 0
    return timestep(after, world, after.reward, after.last() & over, after.last() & ~over)


def from_navix(
    env: Foreign,
    *,
    labels: Callable[..., jax.Array] | None = None,
    propositions: Sequence[str] = (),
) -> Environment:
    """A Navix environment.

    Its step types distinguish termination and truncation; where both hold, the episode is terminated.
    States are Navix's timesteps, which contain a key; the key of a step is not used.

    Args:
      env: as ``navix.make(name)`` returns it.
      labels, propositions: ``state -> bool[P]``, of Navix's state with the events of the last step,
        and its names.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment`.

    Raises:
      ValueError: not a Navix environment.
      ImportError: navix is not installed.

    >>> import navix
    >>> world = from_navix(navix.make("Navix-Empty-5x5-v0"), propositions=["goal"],
    ...                    labels=lambda state: state.events.goal_reached.happened[None])
    >>> world.actions.num, world.propositions
    (7, ('goal',))
    """
    require_environment("navix", env, package("navix").Environment, "navix.make(name)")
    held = Held(env)
    return make_environment(
        Partial(reset_to_arrays, held),
        Partial(_step_navix, held),
        Partial(observation_of),
        actions=len(env.action_set),
        labels=labels_of_state(labels),
        propositions=propositions,
        horizon=int(env.max_steps),
    )


def _step_navix(held: Held, world: PyTree, action: PyTree, key: Key) -> Timestep:
    after = held.it.step(copied(world).replace(step_type=jnp.zeros_like(world.step_type)), action)
    return timestep(after, world, after.reward, after.is_termination(), after.is_truncation())
