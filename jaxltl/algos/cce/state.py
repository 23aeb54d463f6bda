"""Constrained search problems, hyperparameters, state and metrics of the cross-entropy method."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import NamedSharding
from numpy.typing import ArrayLike

from jaxltl.algos.cce import exponential_family as families
from jaxltl.algos.common.schedules import Polynomial as Polynomial, SLACK, Schedule
from jaxltl.algos.common.settings import COUNT, Number, RunState, static, traced
from jaxltl.core import struct, validation
from jaxltl.core.environments.environment import as_partial
from jaxltl.core.models.mesh import lanes
from jaxltl.core.models.protocols import Array, Key, PyTree
from jaxltl.core.types import require_shape
from jaxltl.core.validation import Range


@struct.dataclass
class Sample:
    """An evaluated policy: ``float[D]``, its objective, costs ``float[C]``, and its excess; or n of them.

    `excess` is ``max_c (cost_c - limit_c) / scale_c``; `valid` whether there is such a policy.
    """

    parameters: jax.Array
    objective: jax.Array
    cost: jax.Array
    excess: jax.Array
    valid: jax.Array


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


def excess_of(cost: jax.Array, limit: jax.Array, scale: jax.Array | float) -> jax.Array:
    """The largest normalised violation, ``float[...]`` of costs ``float[..., C]``."""
    return jnp.max((cost - limit) / scale, axis=-1, initial=-jnp.inf)


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
    excess = excess_of(cost, limit, scale)
    enough = jnp.sum(feasible) >= count
    rank = jnp.where(enough, objective, -excess)
    # Unusable samples rank after all usable ones, and -0 equals 0.
    largest = jnp.finfo(rank.dtype).max
    rank = jnp.where(rank == 0, 0, jnp.clip(rank, -largest, largest))
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


def rows_of(pool: Sample, index: jax.Array) -> Sample:
    """The policies of an index, gathered as columns, the memory order of populations."""
    return jax.tree.map(lambda x: x.T.at[..., index].get(mode="promise_in_bounds").T, pool)


def better(
    old: Sample, fresh: Sample, among: jax.Array, score: jax.Array, record: jax.Array
) -> Sample:
    """The old sample, or the one with the highest score if that exceeds the record."""
    i = jnp.argmax(jnp.where(among, score, -jnp.inf))
    new = replace(rows_of(fresh, i), valid=among[i])
    beats = among[i] & (~old.valid | (score[i] > record))
    return jax.tree.map(lambda x, y: jnp.where(beats, x, y), new, old)


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
    key: Key, problem: PyTree, hparams: PyTree, samples: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Objectives ``[n]`` and costs ``[n, C]`` of a population."""
    keys = jax.random.split(key, len(samples))
    samples, keys = lanes.split_axis((samples, keys), hparams.sharding)
    both = jax.vmap(lambda key, x: scores(key, problem, x))(keys, samples)
    # Every device ranks them all, in one order of operations.
    return lanes.replicate(both, hparams.sharding)


def scores(key: Key, problem: PyTree, parameters: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Objective and costs ``[C]`` of one evaluation."""
    objective, cost = split(problem.evaluate(parameters, key))
    require_shape("the cost that evaluate returned", cost, problem.limit.shape)
    return objective.astype(parameters.dtype), cost.astype(parameters.dtype)


@struct.dataclass
class Problem:
    """A constrained search problem; made by :func:`make_problem`.

    Attributes:
      evaluate: ``(float[D], key) -> (objective, cost)``, a pytree.
      family: the first distribution of policies.
      limit: ``float[C]``, bounds on the costs.
      scale: ``float[C]``, divisors of violations, which make constraints comparable.
    """

    evaluate: Callable[..., PyTree]
    family: PyTree
    limit: jax.Array
    scale: jax.Array


def make_problem(
    evaluate: Callable[..., PyTree],
    family: PyTree,
    *,
    limit: Array | float | None = None,
    scale: Array | float | None = None,
) -> Problem:
    """A checked :class:`Problem`, on the host.

    Args:
      evaluate: ``(parameters float[D], key) -> (objective, cost)`` of one policy, with a scalar
        objective and a cost ``float[]`` or ``float[C]``; or only the objective, without constraints.
        Pass arrays by ``jax.tree_util.Partial(function, *arrays)``: closures are compiled in.
      family: the first distribution, such as ``diagonal_gaussian(mean, std)``.
      limit: bound on the cost, a number or ``float[C]``; infinite for none. None: no constraint.
      scale: divisors of violations, a number or ``float[C]``; default ``|limit|``, or 1 where that is
        zero or infinite. Without effect for one cost.

    Raises:
      ValueError: evaluate returns other shapes, or a limit or scale is invalid.

    >>> family = families.diagonal_gaussian(jnp.zeros(2), 1.0)
    >>> make_problem(lambda x, key: (-jnp.sum(x**2), x[0]), family, limit=0.5).scale.tolist()
    [0.5]
    """
    evaluate = as_partial(evaluate, "evaluate")
    try:
        point = families.center(family)
    except TypeError as problem:
        raise ValueError(f"family: {problem}") from None
    shapes = jax.eval_shape(lambda e, x, k: split(e(x, k)), evaluate, point, jax.random.key(0))
    num_costs = shapes[1].shape[0]
    if num_costs == 0 and limit is not None:
        raise ValueError(
            f"limit={limit}, but evaluate returns no cost; return (objective, cost), or give no "
            "limit."
        )
    if num_costs > 1 and limit is not None and np.ndim(limit) == 0:
        raise ValueError(
            f"limit={limit}, but evaluate returns {num_costs} costs; give one limit for each, "
            f"float[{num_costs}], infinite where there is none."
        )
    limits = per_cost("limit", math.inf if limit is None else limit, num_costs)
    if np.isnan(limits).any() or (limits == -np.inf).any():
        raise ValueError(
            f"limit={limits.tolist()}; no cost is at most NaN or minus infinity: give numbers, or "
            "infinity for no limit."
        )
    if scale is None:
        size = np.abs(limits)
        scale = np.where((size > 0) & np.isfinite(size), size, 1.0)
    scales = per_cost("scale", scale, num_costs)
    if not ((scales > 0) & np.isfinite(scales)).all():
        raise ValueError(f"scale={scales.tolist()}; it must be positive and finite.")
    return Problem(
        evaluate, family, jnp.asarray(limits, point.dtype), jnp.asarray(scales, point.dtype)
    )


WEIGHTINGS = ("until_feasible", "literal", "uniform")


@struct.dataclass
class Hparams:
    """Settings; numbers are traced, None is static.

    The schedules of theorem 1 are ``rate=Polynomial(a, p)`` with p in [-1, 0) and
    ``num_samples=Polynomial(n, beta)``, with `weighting` ``"literal"``: see
    :func:`theorem_conditions`. The defaults do not satisfy its conditions.

    Attributes:
      rate: alpha_l, in (0, 1]; a schedule; default 0.1.
      sample_share: lambda_l, the weight in [0, 1] of the samples' mean against the last mean
        parameter; a schedule, or None for 0; default None.
      num_samples: n_l, a schedule, rounded and clipped to between 1 / rho and `population`; further
        samples are evaluated and masked. None: `population`. Default None.
      temperature: of the weights, positive; 1 if the objective is the logarithm of G. Default 1.0.
      margin: subtracted from the limits in the search, a number or ``float[C]``, not in
        :func:`result`. Random costs are feasible by chance: with normal noise of deviation s and rho
        .2, the search can rest .84 s above a limit without margin. Default 0.0.
      population: the largest n_l; static; default 100.
      rho: share of elites; static; default 0.2.
      weighting: static. ``"until_feasible"``: equal weights until k elites are feasible, then weights
        by G; ``"literal"``: always by G; ``"uniform"``: always equal. Default ``"until_feasible"``.
      elite_reuse: not in the theorem, like all further options: the last elites compete again with
        their old values; static. Default False.
      antithetic: mirrored pairs of samples; static; default False.
      variance_floor: lower bound of the variance in every direction; default None.
      noise: variance added after each step, a schedule (Szita and Lorincz 2006); default None.
      restart_below: the search restarts from the first distribution when all standard deviations are
        below this number, and keeps the best samples. Default None.
      sharding: of the population, such as ``NamedSharding(mesh, PartitionSpec("population"))``; static;
        default None.
    """

    rate: Schedule = traced(Range(0, 1, open_below=True), default=0.1, schedule=True)
    sample_share: Schedule = traced(Range(0, 1), default=None, schedule=True)
    num_samples: Schedule = traced(Range(0), default=None, schedule=True)
    temperature: Number = traced(Range(0, open_below=True, open_above=True), default=1.0)
    margin: jax.Array | float = 0.0
    population: int = static(COUNT, default=100)
    rho: float = static(Range(0, 1, open_below=True, open_above=True), default=0.2)
    weighting: str = static(WEIGHTINGS, default="until_feasible")
    elite_reuse: bool = static(bool, default=False)
    antithetic: bool = static(bool, default=False)
    variance_floor: Number | None = traced(Range(0), default=None)
    noise: Schedule = None
    restart_below: Number | None = traced(Range(0), default=None)
    sharding: NamedSharding | None = struct.field(pytree_node=False, default=None)


@struct.dataclass
class State(RunState):
    """A distribution of policies, and the best samples.

    Attributes:
      family: the distribution.
      best: the feasible sample with the highest objective by its one evaluation: parameters
        ``float[D]``, objective ``float[]`` and cost ``float[C]``.
      least: the sample of the least violation, likewise.
      elites: of the last step; None without reuse.
      num_evaluated, num_invalid: ``int32[]``, numbers of samples, and of those with an objective NaN
        or plus infinity, or a cost NaN; saturate at 2^31 - 1.
      num_restarts: ``int32[]``.
      status: ``int32[]``, NONFINITE if no sample of the last step was usable (the distribution then
        stays unchanged), else COMPLETED.
    """

    family: PyTree
    best: Sample
    least: Sample
    elites: PyTree
    num_evaluated: jax.Array
    num_invalid: jax.Array
    num_restarts: jax.Array
    status: jax.Array


@struct.dataclass
class Metrics:
    """Figures of a step; scalars unless a shape is given.

    Attributes:
      num_evaluated: samples so far.
      num_feasible, num_invalid: of this step's samples.
      enough_feasible: True if the objective chose the elites (case 2).
      objective, cost: means over this step's usable samples; the cost is ``float[C]``.
      best_objective: of the best feasible sample so far; minus infinity without any.
      least_excess: of the sample of the least violation so far.
      max_deviation: the largest standard deviation after the step.
      rate, num_restarts, status: alpha_l, and see :class:`State`.
    """

    num_evaluated: jax.Array
    num_feasible: jax.Array
    num_invalid: jax.Array
    enough_feasible: jax.Array
    objective: jax.Array
    cost: jax.Array
    best_objective: jax.Array
    least_excess: jax.Array
    max_deviation: jax.Array
    rate: jax.Array
    num_restarts: jax.Array
    status: jax.Array
