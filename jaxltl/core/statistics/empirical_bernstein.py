"""Empirical-Bernstein confidence sequence of the mean of bounded random variables.

The predictable plug-in empirical-Bernstein confidence sequence (Waudby-Smith and Ramdas 2024,
"Estimating means of bounded random variables by betting", theorem 2): of numbers ``X_i`` in [0, 1]
that each have the conditional mean m given the past, with weights ``w_i`` in [0, 1) and guesses
``c_i`` of m that may depend on the past::

    sum_i w_i X_i / sum_i w_i  -+  (log(2 / failure) + sum_i (X_i - c_i)^2 psi(w_i)) / sum_i w_i,

where ``psi(w) = -log(1 - w) - w``. All intervals of one sequence hold at once with probability
``1 - failure``, so that the stopping time may depend on them.
"""

from __future__ import annotations

import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Floats
from jaxltl.core.statistics.binomial import around

_MOST = 0.5  # of a weight; more gains little where the variance is small, and loses much else


def bounded_mean(
    numbers: Floats, failure: float, *, planned: int | None = None
) -> tuple[float, float]:
    """Confidence interval of the mean of numbers in [0, 1]."""
    x = np.atleast_1d(validation.float_array("numbers", numbers))
    failure = validation.fraction("failure", failure, ends=(False, False))
    if planned is not None:
        planned = validation.integer("planned", planned, least=1)
    if x.ndim != 1 or np.isnan(x).any():
        raise ValueError(
            f"numbers is {validation.shorten(numbers)}; give one axis of them, none NaN."
        )
    x = np.clip(x, 0, 1)
    count = np.arange(1, x.size + 1)
    mean = (0.5 + np.cumsum(x)) / (count + 1)
    variance = (0.25 + np.cumsum((x - mean) ** 2)) / (count + 1)
    # Guesses from what came before each number.
    guess, old = np.append(0.5, mean)[:-1], np.append(0.25, variance)[:-1]
    many = count * np.log1p(count) if planned is None else planned
    weight = np.minimum(np.sqrt(2 * np.log(2 / failure) / (many * old)), _MOST)
    spread = (x - guess) ** 2 @ (-np.log1p(-weight) - weight)
    total = weight.sum()
    if not total:
        return 0.0, 1.0
    # Sums of n numbers are off by less than n roundings each.
    rounding = 8 * float(np.finfo(np.float64).eps) * (x.size + 8)
    deviation = (np.log(2 / failure) + spread) / total * (1 + rounding) + rounding
    lower, upper = around(np.array(weight @ x / total), np.array(deviation))
    return float(lower), float(upper)
