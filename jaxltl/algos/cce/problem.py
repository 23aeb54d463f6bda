"""Constrained search problems: an evaluation, limits on costs and a first distribution."""

from __future__ import annotations

import math
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxltl.core import struct

from jaxltl.algos.cce import exponential_family as families
from jaxltl.algos.cce._evaluation import per_cost, split
from jaxltl.algos.common.schedules import Polynomial as Polynomial
from jaxltl.core.environments.environment import as_partial
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.pretty_print import brief


@brief
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
    limit: chex.Array | float | None = None,
    scale: chex.Array | float | None = None,
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

    Example:
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
