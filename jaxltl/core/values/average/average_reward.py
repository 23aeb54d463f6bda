"""Long-run average rewards of Markov chains and decision processes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxltl.core.values.engine.validated import validated
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.sparse.solvers.average_reward import average
from jaxltl.core.types import Solution
from jaxltl.core.values.engine.state_quantities import (
    solution_from_error,
    finite_reward,
    reduction_for,
)


@validated()
def average_reward(
    model: Model,
    reward: Array | str,
    *,
    objective: str = "max",
    tolerance: float = 1e-6,
    max_steps: int = 1_000_000,
) -> Solution:
    """Optimal expected long-run average reward per step: ``lim 1/n E[r_1 + ... + r_n]``.

    For multichain models too (Puterman 1994, chapter 9): the best expected gain of the end
    component in which a trajectory ends. Gains are enclosed by the span of ``T v - v`` and are the
    terminal rewards of an optimal stopping problem. Games have :func:`mean_payoff`.

    Args:
      model: a SparseMDP, or any concrete model that :func:`to_sparse` takes.
      reward: as for :func:`~jaxltl.core.models.sparse.choice_reward`; finite.
      objective: ``"max"`` or ``"min"``; irrelevant for chains.
      tolerance: width of the enclosure, relative to the value; for small values relative to a
        millionth of the largest reward (a thousandth, if some are negative).
      max_steps: sweeps of value iteration at most.

    Returns:
      :class:`Solution`; `value` is ``float64[S]``, `policy` rows ``int32[S]`` that attain the bound
      on the safe side (`lower` of a maximum). `residual` is half the width of the gain's widest
      enclosure. Concrete arrays only; not differentiable.

    Raises:
      ValueError: the reward, the objective, or a model with intervals.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 2, 3, 4, 5], [1, 2, 0, 1, 2],
      ...                     [0.25, 0.75, 1, 1, 1])
      >>> found = average_reward(model, [3.0, 8.0, 4.0])
      >>> found.value.round(9).tolist(), found.policy.tolist()
      ([5.0, 8.0, 4.0], [0, 2, 3])
    """
    if hasattr(model, "nominal"):
        raise ValueError(
            "averages in the long run are not solved for where probabilities are "
            "intervals; ask robust_discounted_value, with a discount near 1, or "
            "total_reward until a target, or give model.nominal, which is one "
            "choice of nature."
        )
    model = to_sparse(model)
    sign = 1 if reduction_for(objective) is np.maximum else -1
    earned, magnitude = finite_reward(model, reward)
    found = average(
        model.host, sign * earned, magnitude, tolerance=tolerance, max_steps=max_steps, sign=sign
    )
    small = 1e-6 if (earned >= 0).all() else 1e-3
    error = np.maximum(found.upper - found.value, found.value - found.lower)
    least = small * float(magnitude.max())
    solution = solution_from_error(
        sign * found.value,
        error,
        found.row.astype(np.int32),
        found.rounds,
        enough=tolerance * np.maximum(np.abs(found.value), least),
    )
    residual: Array = np.float64(found.residual)
    return replace(solution, residual=residual)
