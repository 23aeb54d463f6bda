"""Evaluation of a population: objectives and costs."""

from __future__ import annotations

from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.models.mesh import lanes
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.types import require_shape


def per_cost(name: str, value: ArrayLike, num_costs: int) -> np.ndarray:
    """One number for each cost, broadcast from a scalar."""
    value = validation.float_array(name, value)
    if value.ndim:
        require_shape(name, value, (num_costs,))
    return np.broadcast_to(value, (num_costs,))


def split(value: PyTree) -> tuple[jax.Array, jax.Array]:
    """The objective and costs ``[C]`` in the result of ``evaluate``."""
    if isinstance(value, tuple | list):
        if len(value) != 2:
            raise ValueError(
                f"evaluate returned {len(value)} things; return (objective, cost), or the "
                "objective alone."
            )
        objective, cost = map(jnp.asarray, value)
    else:
        objective, cost = jnp.asarray(value), jnp.zeros((0,))
    if objective.shape != ():
        raise ValueError(
            f"evaluate returned an objective of shape {objective.shape}; it is called with one "
            "policy at a time and returns one number, shape ()."
        )
    if cost.ndim > 1:
        raise ValueError(
            f"evaluate returned a cost of shape {cost.shape}; return a number or one axis of "
            "costs, [C]."
        )
    return objective, jnp.atleast_1d(cost)


def evaluate_all(
    problem: PyTree, hparams: PyTree, samples: jax.Array, key: chex.PRNGKey
) -> tuple[jax.Array, jax.Array]:
    """Objectives ``[n]`` and costs ``[n, C]`` of a population."""
    keys = jax.random.split(key, len(samples))
    samples, keys = lanes.split_axis((samples, keys), hparams.sharding)
    found = jax.vmap(partial(scores, problem))(samples, keys)
    # Every device ranks them all, in one order of operations.
    return lanes.replicate(found, hparams.sharding)


def scores(
    problem: PyTree, parameters: jax.Array, key: chex.PRNGKey
) -> tuple[jax.Array, jax.Array]:
    """Objective and costs ``[C]`` of one evaluation."""
    objective, cost = split(problem.evaluate(parameters, key))
    require_shape("the cost that evaluate returned", cost, problem.limit.shape)
    return objective.astype(parameters.dtype), cost.astype(parameters.dtype)
