"""Intervals of a probability from how often it came true, with ends that err outward.

Each function takes ``count`` of ``total`` and the chance `failure` of a miss, and gives ends
``(lower, upper)`` in double precision. Rounding is accounted for: what an end excludes is excluded
by the mathematics, too.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jaxltl.core.host.rows import Integers
from jaxltl.core.host.sparse import Floats

_EPS = float(np.finfo(np.float64).eps)
# The tails of SciPy err by less than 1e-10 of themselves for up to 1e12 trials. What an interval
# gives away for this margin is less than its 1e-6th part.
_MARGIN = 1e-7
_HALVINGS = 80  # until neighbours are apart, from a bracket of some standard deviations

Ends = tuple[Floats, Floats]


def clopper_pearson(count: Integers, total: Integers, failure: float) -> Ends:
    """The ends that a binomial test on each side excludes (Clopper and Pearson 1934).

    ``P(Bin(n, lower) >= k) = P(Bin(n, upper) <= k) = failure / 2``. Each side misses with a chance
    of at most ``failure / 2``, whatever the probability, if n does not depend on what came.

    Args:
      count: ``int[N]``, k, from 0 to n.
      total: ``int[N]``, n, below 2^53.
      failure: in (0, 1).

    Returns:
      ``float64[N]`` each; 0 and 1 where nothing was tried.

    Example:
      >>> lower, upper = clopper_pearson(np.array([0, 5]), np.array([10, 10]), 0.05)
      >>> lower.round(4).tolist(), upper.round(4).tolist()
      ([0.0, 0.1871], [0.3085, 0.8129])
    """
    return _of_distinct(_tails, count, total, failure)


def hoeffding(count: Integers, total: Integers, failure: float) -> Ends:
    """The frequency and as much on both sides as Hoeffding (1963, theorem 1) allows.

    ``k / n -+ sqrt(log(2 / failure) / (2 n))``, if n does not depend on what came.

    Args, Returns: as of :func:`clopper_pearson`.

    Example:
      >>> lower, upper = hoeffding(np.array([0, 50]), np.array([10, 100]), 0.05)
      >>> lower.round(4).tolist(), upper.round(4).tolist()
      ([0.0, 0.3642], [0.4295, 0.6358])
    """
    return around(frequency(count, total), hoeffding_deviation(total, failure))


def anytime(count: Integers, total: Integers, failure: float) -> Ends:
    """The probabilities that a mixture of all others does not outbid, at any time.

    ``p^k (1 - p)^(n - k) >= failure B(k + 1/2, n - k + 1/2) / B(1/2, 1/2)``: the likelihood of
    Jeffreys' mixture over that of p is a martingale, so the chance that it ever exceeds
    ``1 / failure`` is at most `failure` (Ville; Robbins 1970; Waudby-Smith and Ramdas 2020). The
    intervals of all n hold at once: n may depend on what came, as where one tries until
    something happens, or looks at the intervals in order to go on.

    Args, Returns: as of :func:`clopper_pearson`.

    Example:
      >>> lower, upper = anytime(np.array([0, 5]), np.array([10, 10]), 0.05)
      >>> lower.round(4).tolist(), upper.round(4).tolist()
      ([0.0, 0.1176], [0.377, 0.8824])
    """
    return _of_distinct(_mixed, count, total, failure)


def frequency(count: Integers, total: Integers) -> Floats:
    """``count / total``, and 0 where nothing was tried."""
    return np.asarray(count, np.float64) / np.maximum(total, 1)


def hoeffding_deviation(total: Integers, failure: float) -> Floats:
    """By how much a frequency misses at most, but for a chance of `failure`."""
    with np.errstate(divide="ignore"):
        return np.sqrt((np.log(2) - np.log(failure)) / (2.0 * np.asarray(total)))


def around(center: Floats, deviation: Floats) -> Ends:
    """What lies within a deviation, and in [0, 1]; a little more than rounding could hide."""
    deviation = deviation * (1 + 16 * _EPS) + 4 * _EPS
    return np.maximum(center - deviation, 0), np.minimum(center + deviation, 1)


def _of_distinct(
    lower_ends: Callable[[Integers, Integers, float], Floats],
    count: Integers,
    total: Integers,
    failure: float,
) -> Ends:
    """Both ends from the lower ones, by symmetry, of each pair of numbers once."""
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

    SciPy's inverse is a guess: for large n and small k it misses by far (1.17.1: a thousand of
    1e9). Its tails are right, and decide.
    """
    from scipy.special import betainc, betaincinv  # a tenth of a second that few need

    side = failure / 2

    def tail(x: Floats, of: slice | Integers = slice(None)) -> Floats:
        return betainc(k[of], n[of] - k[of] + 1, x)

    found = betaincinv(k, n - k + 1, side * (1 - 5 * _MARGIN))
    chance = tail(found)
    near = (chance <= side * (1 - _MARGIN)) & (chance >= side * (1 - 10 * _MARGIN))
    if near.all():
        return found
    rest = np.flatnonzero(~near)
    low, _ = hoeffding(k[rest], n[rest], failure)
    # Chernoff's bound, k / n (failure / 2)^(1 / k) / e, is above zero.
    low = np.maximum(low, np.exp(np.log(side) / k[rest] - 1) * (k / n)[rest] * (1 - _MARGIN))
    low = np.where(tail(low, rest) <= side * (1 - _MARGIN), low, 0)
    found[rest] = _last(
        lambda x: tail(x, rest) <= side * (1 - _MARGIN), low, frequency(k[rest], n[rest])
    )
    return found


def _mixed(k: Integers, n: Integers, failure: float) -> Floats:
    """The lower ends of :func:`anytime` for k > 0."""
    from scipy.special import betaln

    mixture = betaln(k + 0.5, n - k + 0.5) - np.log(np.pi)

    def excluded(x: Floats) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            ones = np.where(x > 0, k * np.log(x), -np.inf)
            others = np.where(n > k, (n - k) * np.log1p(-x), 0)
        slack = 1e-12 + 64 * _EPS * (np.abs(mixture) + np.abs(ones) + np.abs(others))
        return (x <= 0) | (ones + others < np.log(failure) + mixture - slack)

    # With log m the mixture's, k log x <= log failure + log m - 1 is excluded.
    low = np.exp((np.log(failure) + mixture - 1) / k)
    return _last(excluded, np.where(excluded(low), low, 0), frequency(k, n))


def _last(holds: Callable[[Floats], np.ndarray], low: Floats, high: Floats) -> Floats:
    """The largest numbers, or nearly, where something holds; it does at `low`, not at `high`."""
    for _ in range(_HALVINGS):
        apart = high > low * (1 + 4 * _EPS)
        if not apart.any():
            break
        # The lower end may be of any order of magnitude: quickly to it, then by halves.
        middle = np.where(high > 4 * low, np.sqrt(np.maximum(low, 1e-300) * high), (low + high) / 2)
        inside = holds(middle)
        low = np.where(apart & inside, middle, low)  # what is found depends on no other number
        high = np.where(apart & ~inside, middle, high)
    return low
