"""Environments of the package navix."""

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
    copied,
    labels_of_state,
    observation_of,
    package,
    require_environment,
    reset_to_arrays,
    timestep,
)


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
        Partial(_step, held),
        Partial(observation_of),
        actions=len(env.action_set),
        labels=labels_of_state(labels),
        propositions=propositions,
        horizon=int(env.max_steps),
    )


def _step(held: Held, world: PyTree, action: PyTree, key: Key) -> Timestep:
    del key  # the state has one
    running = copied(world).replace(step_type=jnp.zeros_like(world.step_type))
    found = held.it.step(running, action)
    return timestep(found, world, found.reward, found.is_termination(), found.is_truncation())
