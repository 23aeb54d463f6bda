"""Rows whose distributions lie in a ball around a center, and what nature makes of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxltl.core.host.interval import HostInterval
from jaxltl.core.host.rows import Integers
from jaxltl.core.host.sparse import Floats, HostMDP


def l1_expectation(
    value: Floats, center: Floats, radius: Floats, entry_start: Integers, *, maximize: bool
) -> tuple[Floats, Floats]:
    """The extreme of ``sum_t p_t v_t`` over ``sum_t |p_t - center_t| <= radius``, in every row.

    Half of the radius is moved, from the worst successors to the best one (Strehl and Littman 2008,
    section 3.2): the greedy distribution of the intervals ``[0, center]``, where that of the best
    is ``[0, center + radius / 2]``.

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
    value, center, radius = (np.asarray(x, np.float64) for x in (value, center, radius))
    start: Any = np.asarray(entry_start)
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
    if not (radius >= 0).all():
        r = int(np.argmin(radius >= 0))
        raise ValueError(f"the radius of row {r} is {radius[r]}; it must be at least 0.")
    row = np.repeat(np.arange(radius.size), width)
    key = -value if maximize else value
    order = np.lexsort((key, row))
    best = order[start[:-1]]
    upper = center.copy()
    upper[best] = np.minimum(center[best] + radius / 2, 1)
    states: Any = np.zeros(start.size, np.int64)  # what is done here needs no states
    box = HostInterval(HostMDP(states, start, row, center), np.zeros_like(center), upper)
    chosen = box.nature(value, maximize=maximize)
    return box.total(chosen * value), chosen
