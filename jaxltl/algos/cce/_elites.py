"""Elites of a population and their weights (algorithm 2, steps 7 to 10)."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.algos.common.schedules import SLACK
from jaxltl.core import struct


@struct.dataclass
class Sample:
    """An evaluated policy: ``float[D]``, its objective, costs ``float[C]``, and its excess.

    `excess` is ``max_c (cost_c - limit_c) / scale_c``; `found` whether there is such a policy.
    """

    parameters: jax.Array
    objective: jax.Array
    cost: jax.Array
    excess: jax.Array
    found: jax.Array


@struct.dataclass
class Pool:
    """Evaluated policies: ``float[n, D]``, ``float[n]``, ``float[n, C]``, and which of them are `active`."""

    parameters: jax.Array
    objective: jax.Array
    cost: jax.Array
    active: jax.Array


def num_elites(rho: float, num_samples: int) -> int:
    """``k = ceil(rho n)``, where a product that should be an integer is one."""
    return math.ceil(rho * num_samples - SLACK)


@struct.dataclass
class Elites:
    """The elites among n samples.

    Attributes:
      index: ``int32[num]``, best first.
      taken: ``bool[num]``, which of these count: the first k_l, if usable.
      enough_feasible: whether at least k_l are feasible, so that the objective decided.
      feasible, usable: ``bool[n]``.
      excess: ``float[n]``, the largest normalised violation.
    """

    index: jax.Array
    taken: jax.Array
    enough_feasible: jax.Array
    feasible: jax.Array
    usable: jax.Array
    excess: jax.Array


def select(
    objective: jax.Array,
    cost: jax.Array,
    limit: jax.Array,
    *,
    num: int,
    count: jax.Array | int | None = None,
    scale: jax.Array | float = 1.0,
) -> Elites:
    """The k feasible samples with the highest objective, or if there are fewer, with the least excess.

    Ties go to the earlier sample, so that there are always k, where the indicator of (4.4) takes all
    of them. Samples with an objective NaN or plus infinity, or a cost NaN, are last and never taken.
    """
    count = num if count is None else count
    usable = (objective < jnp.inf) & ~jnp.isnan(cost).any(-1)
    feasible = usable & (cost <= limit).all(-1)
    excess = jnp.max((cost - limit) / scale, axis=-1, initial=-jnp.inf)
    enough = jnp.sum(feasible) >= count
    rank = jnp.where(enough, objective, -excess)
    # Unusable samples rank after all usable ones, and -0 equals 0.
    most = jnp.finfo(rank.dtype).max
    rank = jnp.where(rank == 0, 0, jnp.clip(rank, -most, most))
    rank = jnp.where(jnp.where(enough, feasible, usable), rank, -jnp.inf)
    top, index = lax.top_k(rank, num)
    taken = (top > -jnp.inf) & (jnp.arange(num) < count)
    return Elites(index, taken, enough, feasible, usable, excess)


def elite_weights(
    objective: jax.Array,
    taken: jax.Array,
    enough_feasible: jax.Array,
    *,
    weighting: str = "until_feasible",
    temperature: jax.Array | float = 1.0,
) -> jax.Array:
    """Weights of the elites, with sum 1, or 0 if none is taken; see :class:`Hparams`."""
    least = jnp.finfo(objective.dtype).min
    logit = jnp.clip(objective / temperature, least, -least)
    if weighting != "literal":
        logit = jnp.where(enough_feasible & (weighting == "until_feasible"), logit, 0)
    top = jnp.max(jnp.where(taken, logit, least))
    weight = jnp.where(taken, jnp.exp(jnp.where(taken, logit - top, 0)), 0)
    return weight / jnp.maximum(jnp.sum(weight), 1)


def rows_of(pool: Pool, index: jax.Array) -> Pool:
    """The policies of an index, gathered as columns, the memory order of populations."""
    return jax.tree.map(lambda x: x.T.at[..., index].get(mode="promise_in_bounds").T, pool)


def better(
    old: Sample,
    fresh: Pool,
    excess: jax.Array,
    among: jax.Array,
    score: jax.Array,
    record: jax.Array,
) -> Sample:
    """The old sample, or the one with the highest score if that exceeds the record."""
    i = jnp.argmax(jnp.where(among, score, -jnp.inf))
    one = rows_of(fresh, i)
    new = Sample(one.parameters, one.objective, one.cost, excess[i], among[i])
    beats = among[i] & (~old.found | (score[i] > record))
    return jax.tree.map(lambda x, y: jnp.where(beats, x, y), new, old)
