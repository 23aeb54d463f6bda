"""Confidence intervals of binomial proportions and of means of bounded variables.

Each function takes ``count`` of ``total`` and the chance `failure` of a miss, and gives ends
``(lower, upper)`` in double precision. Rounding is accounted for: what an end excludes is excluded
by the mathematics, too.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Floats, Integers

_EPS = float(np.finfo(np.float64).eps)
# The tails of SciPy err by less than 1e-10 of themselves for up to 1e12 trials. What an interval
# gives away for this margin is less than its 1e-6th part.
_MARGIN = 1e-7
_STEPS = 100  # of Newton; a few are enough

Ends = tuple[Floats, Floats]


def clopper_pearson(count: Integers, total: Integers, failure: float) -> Ends:
    """Clopper-Pearson interval (1934), from one binomial test on each side.

    ``P(Bin(n, lower) >= k) = P(Bin(n, upper) <= k) = failure / 2``. Each side misses with a chance
    of at most ``failure / 2`` for every probability, if n does not depend on earlier outcomes.
    """
    return _of_distinct(_tails, count, total, failure)


def hoeffding(count: Integers, total: Integers, failure: float) -> Ends:
    """Hoeffding interval (1963, thm. 1) for fixed n: ``k / n -+ sqrt(log(2 / failure) / (2 n))``."""
    with np.errstate(divide="ignore"):
        deviation = np.sqrt((np.log(2) - np.log(failure)) / (2.0 * np.asarray(total)))
    return around(frequency(count, total), deviation)


def anytime(count: Integers, total: Integers, failure: float) -> Ends:
    """Anytime-valid interval from a beta mixture martingale.

    ``p^k (1 - p)^(n - k) >= failure B(k + 1/2, n - k + 1/2) / B(1/2, 1/2)``: the likelihood of
    Jeffreys' mixture over that of p is a martingale, so the chance that it ever exceeds
    ``1 / failure`` is at most `failure` (Ville; Robbins 1970; Waudby-Smith and Ramdas 2020). The
    intervals of all n hold at once: n may depend on outcomes and on the intervals.
    """
    return _of_distinct(_mixed, count, total, failure)


def frequency(count: Integers, total: Integers) -> Floats:
    """``count / total``, and 0 where nothing was tried."""
    return np.asarray(count, np.float64) / np.maximum(total, 1)


def around(center: Floats, deviation: Floats) -> Ends:
    """The interval of a deviation around a center, clipped to [0, 1] and rounded outwards."""
    deviation = deviation * (1 + 16 * _EPS) + 4 * _EPS
    return np.maximum(center - deviation, 0), np.minimum(center + deviation, 1)


def _of_distinct(
    lower_ends: Callable[[Integers, Integers, float], Floats],
    count: Integers,
    total: Integers,
    failure: float,
) -> Ends:
    """Both ends from lower ends, by symmetry, computed once for each pair of counts."""
    count, total = np.broadcast_arrays(np.asarray(count), np.asarray(total))
    pair, place = np.unique(count.ravel() + 1j * total.ravel(), return_inverse=True)
    k, n = (x.astype(np.int64) for x in (pair.real, pair.imag))
    lower, mirrored = np.zeros(k.size), np.zeros(k.size)
    for end, number in ((lower, k), (mirrored, n - k)):
        some = number > 0
        end[some] = lower_ends(number[some], n[some], failure)
    upper = np.where(mirrored > 0, np.nextafter(1 - mirrored, 2), 1)
    upper = np.minimum(upper, 1)
    return lower[place].reshape(count.shape), upper[place].reshape(count.shape)


def _tails(k: Integers, n: Integers, failure: float) -> Floats:
    """The lower ends of Clopper and Pearson for k > 0.

    SciPy's inverse of the tail misses by far for large n and small k (1.17.1: a thousand of 1e9);
    the tail itself is right.
    """
    from scipy.special import betainc, betaln  # a tenth of a second that few need

    side = np.log(failure / 2)

    def gap(x: Floats, i: Integers) -> Ends:
        ones, others = k[i], n[i] - k[i]
        with np.errstate(divide="ignore"):
            tail = np.log(betainc(ones, others + 1, x))
        fit = ones * np.log(x) + others * np.log1p(-x) - betaln(ones, others + 1)
        return tail - side, np.exp(np.minimum(fit - tail, 500))

    return _climbed(gap, k, n, -side)


def _mixed(k: Integers, n: Integers, failure: float) -> Floats:
    """The lower ends of :func:`anytime` for k > 0."""
    from scipy.special import betaln

    mixture = betaln(k + 0.5, n - k + 0.5) - np.log(np.pi)
    best = k * np.log(k / n) + (n - k) * np.log1p(-np.minimum(k / n, 1 - _EPS))

    def gap(x: Floats, i: Integers) -> Ends:
        ones, others = k[i] * np.log(x), (n - k)[i] * np.log1p(-x)
        rounding = 64 * _EPS * (np.abs(mixture[i]) + np.abs(ones) + np.abs(others))
        above = ones + others + rounding - mixture[i] - np.log(failure)
        return above, k[i] - (n - k)[i] * x / (1 - x)

    return _climbed(gap, k, n, np.maximum(best - mixture - np.log(failure), 0))


def _climbed(
    gap: Callable[[Floats, Integers], Ends], k: Integers, n: Integers, deviance: Floats | float
) -> Floats:
    """Newton's method for the root of an increasing concave function of log x, from the left.

    Newton's steps end left of the zero, where the function is below its tangents, so they climb to
    it; the root does not depend on the other elements.
    """
    # The lower end of Wilson's interval.
    share, half = k / n, deviance / n
    x = share * share / (share + half + np.sqrt(half * (half + 2 * share * (1 - share))))
    x = np.minimum(x, 1 - _EPS)
    bound, active = np.zeros(k.size), np.arange(k.size)
    for _ in range(_STEPS):
        at = x[active]
        above, slope = gap(at, active)
        below = above <= -_MARGIN
        bound[active[below]] = np.maximum(bound[active], at)[below]
        with np.errstate(invalid="ignore"):
            step = (-5 * _MARGIN - above) / slope
        lost = ~np.isfinite(step)  # so far left that it rounds to zero
        step = np.where(lost, np.log(share[active] / at) / 2, np.maximum(step, -100))
        new = np.minimum(at * np.exp(step), 1 - _EPS)
        new = np.where(below, new, np.minimum(new, np.nextafter(at, 0)))
        done = below & ~lost & (new <= at * (1 + 1e-9 * np.minimum(1, (1 - at) / at)))
        x[active] = new
        active = active[~done]
        if not active.size:
            break
    return bound


# --- means of bounded numbers ------------------------------------------------------------------


_LIMIT = 0.5  # of a weight; more gains little where the variance is small, and loses much else


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
    weight = np.minimum(np.sqrt(2 * np.log(2 / failure) / (many * old)), _LIMIT)
    sum_of_squares = (x - guess) ** 2 @ (-np.log1p(-weight) - weight)
    total = weight.sum()
    if not total:
        return 0.0, 1.0
    # Sums of n numbers are off by less than n roundings each.
    rounding = 8 * float(np.finfo(np.float64).eps) * (x.size + 8)
    deviation = (np.log(2 / failure) + sum_of_squares) / total * (1 + rounding) + rounding
    lower, upper = around(np.array(weight @ x / total), np.array(deviation))
    return float(lower), float(upper)
