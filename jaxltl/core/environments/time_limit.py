"""Time limits: truncation of episodes after a number of steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jaxltl.core import validation
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.environments.environment import Environment, Timestep, require_environment


def with_time_limit(environment: Environment, num_steps: int) -> Environment:
    """The environment with episodes truncated after `num_steps` steps.

    Its states are pairs ``(world, time)``; observations do not include the time.

    Args:
      environment, num_steps: the environment and the limit.

    Returns:
      The environment; its horizon is the smaller of `num_steps` and the horizon before.

    Raises:
      ValueError: a limit below 1.

    Example:
      >>> from jaxltl import environments, gridworld
      >>> with_time_limit(environments.model_environment(gridworld("a b")), 10).horizon
      10
    """
    num_steps = validation.integer("num_steps", num_steps, least=1, most=2**31 - 1)
    inner = require_environment(environment)
    return replace(
        inner,
        reset=Partial(_reset_clock, inner.reset),
        step=Partial(_step_clock, inner.step, np.int32(num_steps)),
        observe=Partial(_of_first, inner.observe),
        labels=Partial(_of_first, inner.labels),
        allowed=None if inner.allowed is None else Partial(_of_first, inner.allowed),
        horizon=min(num_steps, inner.horizon or num_steps),
        starts=None if inner.starts is None else Partial(_start_clock, inner.starts),
        outcomes=None
        if inner.outcomes is None
        else Partial(_clocked, inner.outcomes, np.int32(num_steps)),
    )


def without_time_limit(environment: Environment) -> tuple[Environment, int | None]:
    """The environment inside :func:`with_time_limit` and the limit; any other environment and None."""
    timed: PyTree = require_environment(environment)
    if timed.step.func is not _step_clock:
        return environment, None
    parts = {
        name: part and part.args[0]
        for name in ("reset", "step", "observe", "labels", "allowed", "starts", "outcomes")
        for part in [getattr(timed, name)]
    }
    return replace(environment, horizon=None, **parts), int(timed.step.args[1])


def _reset_clock(reset: Callable[..., PyTree], key: chex.PRNGKey) -> PyTree:
    return reset(key), jnp.int32(0)


def _step_clock(
    step: Callable[..., Timestep],
    limit: jax.Array,
    timed: PyTree,
    action: PyTree,
    key: chex.PRNGKey,
) -> Timestep:
    found, time = Timestep(*step(timed[0], action, key)), timed[1] + 1
    return found._replace(
        world=(found.world, time), truncated=jnp.asarray(found.truncated, bool) | (time >= limit)
    )


def _start_clock(starts: Callable[..., PyTree]) -> PyTree:
    worlds, probability = starts()
    return (worlds, jnp.zeros(jnp.shape(probability), jnp.int32)), probability


def _clocked(
    outcomes: Callable[..., PyTree], limit: jax.Array, timed: PyTree, action: PyTree
) -> tuple[Timestep, jax.Array]:
    found, probability = outcomes(timed[0], action)
    found, time = Timestep(*found), timed[1] + 1
    times = jnp.full(jnp.shape(probability), time)
    return found._replace(
        world=(found.world, times), truncated=jnp.asarray(found.truncated, bool) | (time >= limit)
    ), probability


def _of_first(function: Callable[..., PyTree], timed: PyTree) -> PyTree:
    return function(timed[0])
