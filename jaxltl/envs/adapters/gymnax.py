"""Environments of the package gymnax."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
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
