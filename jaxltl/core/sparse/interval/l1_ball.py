"""Rows whose distributions lie in a ball around a center, and what nature makes of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxltl.core.array_types import Floats, Integers
from jaxltl.core.sparse.interval.l1_distance import Ball
from jaxltl.core.sparse.interval.uncertainty_set import HostInterval
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core import validation


def l1_expectation(
    value: Floats, center: Floats, radius: Floats, entry_start: Integers, *, maximize: bool
) -> tuple[Floats, Floats]:
    """The extreme of ``sum_t p_t v_t`` over ``sum_t |p_t - center_t| <= radius``, in every row.

    Half of the radius is moved, from the worst successors to the best one (Strehl and Littman 2008,
    section 3.2).

    Args:
      value: ``float64[T]``, finite, of each entry: ``v[successor]``.
      center: ``float64[T]``, distributions; entries of zero can gain.
      radius: ``float64[R]``, from 0.
      entry_start: ``int[R + 1]``, where rows begin; none is empty.
      maximize: whether nature makes the expectation large.

    Returns:
      The expectations ``float64[R]``, and distributions ``float64[T]`` that attain them.

    Raises:
      ValueError: shapes do not fit, a row is empty, or a radius is negative.

    Example:
      >>> least, chosen = l1_expectation(np.array([0.0, 1.0, 2.0]), np.array([0.5, 0.25, 0.25]),
      ...                                np.array([0.8]), np.array([0, 3]), maximize=False)
      >>> least.round(9).tolist(), chosen.round(9).tolist()
      ([0.1], [0.9, 0.1, 0.0])
    """
    value, center, radius = (
        validation.float_array(name, x)
        for name, x in (("value", value), ("center", center), ("radius", radius))
    )
    start: Any = validation.integer_array("entry_start", entry_start).reshape(-1)
    if value.shape != center.shape or (start.size - 1,) != radius.shape:
        raise ValueError(
            f"value has shape {value.shape}, center {center.shape} and radius {radius.shape}; "
            f"expected [T], [T] and [{start.size - 1}], an entry for each row."
        )
    width = np.diff(start)
    if start[0] != 0 or start[-1] != value.size or (width <= 0).any():
        raise ValueError(
            f"entry_start goes from {start[0]} to {start[-1]}; it must ascend from 0 to "
            f"{value.size}, without an empty row."
        )
    if not (np.isfinite(value) & np.isfinite(center)).all():
        raise ValueError("value or center is not finite in some entry; give numbers.")
    if not (radius >= 0).all():
        r = int(np.argmin(radius >= 0))
        raise ValueError(f"the radius of row {r} is {radius[r]}; it must be at least 0.")
    states: Any = np.zeros(start.size, np.int64)  # what is done here needs no states
    ball = HostInterval(
        HostMDP(states, start, states[:0], center),
        np.zeros_like(center),
        np.ones_like(center),
        Ball(center, np.minimum(radius / 2, 1)),
    )
    chosen = ball.nature(value, maximize=bool(maximize))
    return ball.total(chosen * value), chosen
