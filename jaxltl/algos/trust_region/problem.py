"""Environments with a horizon and a limit on costs, for trust-region methods."""

from __future__ import annotations

import math

import chex
import jax
import jax.numpy as jnp
from jaxltl.core import struct, validation

from jaxltl.core.environments.environment import (
    Box,
    Environment,
    clipped_action,
    flat_observation,
    require_environment,
    some_action,
)
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.pretty_print import brief
from jaxltl.core.types import require_shape


@brief
@struct.dataclass
class Problem:
    """An environment with a horizon and a limit on costs; made by :func:`make_problem`.

    Attributes:
      environment: with a box of actions; actions outside are clipped.
      limit: ``float[]``, on the expected cost of a trajectory, or None.
      horizon: T, maximal number of steps of a trajectory; static.
    """

    environment: Environment
    limit: jax.Array | None
    horizon: int = struct.field(pytree_node=False)


def make_problem(
    environment: Environment, *, horizon: int | None = None, limit: chex.Numeric | None = None
) -> Problem:
    """A checked :class:`Problem` of an `environment` with a box of floating-point actions.

    `horizon` is T, at least 1, by default the environment's; `limit` bounds the expected cost of a
    trajectory, and may be negative. CPO needs it.

    Raises:
      ValueError: not an environment, finitely many actions, no horizon, a horizon below 1, or a limit
        that is not a number.

    Example:
      >>> from jaxltl import make_environment
      >>> from jaxltl.core.environments.environment import Timestep, make_box
      >>> world = make_environment(
      ...     lambda key: jax.random.uniform(key, (1,)),
      ...     lambda place, action, key: Timestep(place, place[0], place[0] > 9, cost=action[0]),
      ...     lambda place: place, actions=make_box(-jnp.inf, jnp.inf, (1,)))
      >>> float(make_problem(world, horizon=5, limit=1.0).limit)
      1.0
    """
    environment = require_environment(environment)
    actions = environment.actions
    if not isinstance(actions, Box) or not jnp.issubdtype(jnp.dtype(actions.dtype), jnp.floating):
        raise ValueError(
            f"the environment's actions are {actions}; trust-region search draws from a Gaussian: "
            "give a box of floats, or learn finitely many actions with ppo."
        )
    if horizon is None:
        horizon = environment.horizon
    if horizon is None:
        raise ValueError(
            "episodes that never end: neither the environment nor horizon says after how many "
            "steps; give horizon, or with_time_limit(environment, num_steps)."
        )
    horizon = validation.integer("horizon", horizon, least=1, most=2**31 - 1)
    if limit is not None:
        known = isinstance(limit, jax.Array)
        limit = jnp.asarray(
            limit if known else validation.float_array("limit", limit), jnp.result_type(float)
        )
        require_shape("limit", limit, ())
    return Problem(environment=environment, limit=limit, horizon=horizon)


def observed_vector(problem: Problem, world: PyTree) -> jax.Array:
    """The flattened observation ``float[O]``."""
    return flat_observation(problem.environment.observe(world))


def action_size(problem: Problem) -> int:
    """A, the length of a flattened action."""
    return math.prod(some_action(problem.environment.actions).shape)


def as_action(problem: Problem, action: jax.Array) -> jax.Array:
    """The clipped action of a vector ``float[A]``."""
    actions: PyTree = problem.environment.actions
    return clipped_action(actions, action.reshape(actions.shape).astype(actions.dtype))
