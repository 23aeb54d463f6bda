"""Expectations under the distributions that nature picks in an interval model."""

from __future__ import annotations

import numpy as np
from jax.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.models.interval import IntervalMDP, require_interval
from jaxltl.core.models.refusals import on_host
from jaxltl.core.types import require_shape
from jaxltl.core.values.interval.sides import directions


@on_host
def robust_expectation(
    model: IntervalMDP, value: ArrayLike, *, objective: str = "max", nature: str | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Robust expectation of the next state's value, for each choice.

    ``min_p sum_t p_t value(t)``, or the maximum, over the distributions of each row.

    Args:
      model: the model.
      value: ``float[S]``, finite.
      objective, nature: as of :func:`reachability_probability`; the default is the least expectation.

    Returns:
      ``float64[R]``, and nature's distributions, ``float64[T]``. Concrete arrays only; not
      differentiable.

    Raises:
      ValueError: a wrong direction or shape, a model without intervals, or a value of a successor
        that is not finite.

    Example:
      >>> from jaxltl.core.models import interval_rows
      >>> model = interval_rows(None, [0, 2, 3], [0, 1, 1], [.25, .5, 1], [.5, .75, 1])
      >>> robust_expectation(model, [0.0, 4.0])[0].tolist()
      [2.0, 4.0]
    """
    maximize = directions(objective, nature).nature
    require_interval(model)
    require_shape("value", value, model.state_shape)
    ahead = validation.float_array("value", value)[model.host.mdp.successor]
    if not np.isfinite(ahead).all():
        raise ValueError("value is not finite in some successor; give numbers.")
    p = model.host.extreme_distributions(ahead, maximize=maximize)
    return model.host.sum_rows(p * ahead), p
