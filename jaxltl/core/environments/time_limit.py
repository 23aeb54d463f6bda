"""Time limits: truncation of episodes after a number of steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jaxltl.core import validation
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import (
    Environment,
    Timestep,
    optional,
    require_environment,
)


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
    num_steps = validation.integer("num_steps", num_steps, least=1, most=2**31 - 1)
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
    if timed.step.func is not _step_clock:
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
    found, time = Timestep(*step(timed[0], action, key)), timed[1] + 1
    return found._replace(
        world=(found.world, time), truncated=jnp.asarray(found.truncated, bool) | (time >= limit)
    )


def _start_clock(starts: Callable[..., PyTree]) -> PyTree:
    worlds, probability = starts()
    return (worlds, jnp.zeros(jnp.shape(probability), jnp.int32)), probability


def _clocked(
    limit: jax.Array, outcomes: Callable[..., PyTree], timed: PyTree, action: PyTree
) -> tuple[Timestep, jax.Array]:
    found, probability = outcomes(timed[0], action)
    found, time = Timestep(*found), timed[1] + 1
    times = jnp.full(jnp.shape(probability), time)
    return found._replace(
        world=(found.world, times), truncated=jnp.asarray(found.truncated, bool) | (time >= limit)
    ), probability


def _of_first(function: Callable[..., PyTree], timed: PyTree) -> PyTree:
    return function(timed[0])


_TIMED: dict[str, Callable[..., PyTree]] = {
    "reset": _reset_clock,
    "starts": _start_clock,
    **dict.fromkeys(("observe", "labels", "allowed"), _of_first),
}
