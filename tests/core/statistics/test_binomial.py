"""Intervals of a probability, against exact sums of binomial chances."""

from decimal import Decimal, localcontext
from fractions import Fraction
from math import comb

import numpy as np
import pytest

from jaxltl.core.statistics.binomial import anytime, clopper_pearson, hoeffding

METHODS = {f.__name__: f for f in (clopper_pearson, hoeffding, anytime)}


def at_most(k, n, p):
    """``P(Bin(n, p) <= k)``, exactly."""
    p = Fraction(p)
    a, b = p.numerator, p.denominator
    return Fraction(sum(comb(n, j) * a**j * (b - a) ** (n - j) for j in range(k + 1)), b**n)


def at_least(k, n, p):
    return at_most(n - k, n, 1 - Fraction(p))


def tail_of_many(k, n, p):
    """``P(Bin(n, p) >= k)`` to 30 digits, for k above ``n p``, by its terms from the first on."""
    with localcontext() as context:
        context.prec = 50
        p, term = Decimal(p), Decimal(1)
        for i in range(min(k, n - k)):
            term = term * (n - i) / (i + 1)
        term *= p**k * (1 - p) ** (n - k)
        total, j = Decimal(0), k
        while j <= n and term > total * Decimal(10) ** -30:
            total += term
            term = term * (n - j) / (j + 1) * p / (1 - p)
            j += 1
        return float(total)


def much(p):
    """More than an end may give away: a share of what is on its nearer side, or floats near 1."""
    p = Fraction(p)
    return min(p, 1 - p) / 10**6 + (p > Fraction(1, 2)) * Fraction(1, 2**51)


@pytest.mark.parametrize("failure", [0.9, 0.05, 1e-6, 1e-13])
def test_clopper_and_pearson_exactly(failure):
    side = Fraction(failure) / 2
    for n in (1, 2, 3, 7, 20, 61):
        k = np.arange(n + 1)
        lower, upper = clopper_pearson(k, np.full(n + 1, n), failure)
        assert lower[0] == 0 and upper[-1] == 1
        for i in range(n):
            assert at_most(i, n, upper[i]) <= side < at_most(i, n, upper[i] - much(upper[i]))
            low = lower[i + 1]
            assert at_least(i + 1, n, low) <= side < at_least(i + 1, n, low + much(low))


@pytest.mark.parametrize(
    ("k", "n"),
    [
        (1, 10**9),
        (3, 10**12),
        (1000, 10**9),
        (2000, 10**6),
        (10**9 - 5, 10**9),
        (10**6, 10**6),
        (10**12, 10**12),
        (10**12 - 3, 10**12),
        (10**13, 10**13),
    ],
)
def test_clopper_and_pearson_of_many(k, n):
    for failure in (0.05, 1e-9, 1e-15):
        (lower,), (upper,) = clopper_pearson(np.array([k]), np.array([n]), failure)
        chance = tail_of_many(k, n, lower)
        assert chance <= failure / 2
        # What is lost: the margin, and near one the distance of floats.
        if lower > 1 - 1e-6:
            assert chance > failure / 2 * 0.99
        else:
            assert tail_of_many(k, n, lower * (1 + 1e-6)) > failure / 2
        (other,), (mirrored,) = clopper_pearson(np.array([n - k]), np.array([n]), failure)
        assert mirrored == min(np.nextafter(1 - lower, 2), 1)
        assert upper == min(np.nextafter(1 - other, 2), 1)


@pytest.mark.few(1)
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("failure", [0.3, 0.01])
def test_intervals_hold_with_their_chance(name, failure):
    for n in (1, 4, 15, 40):
        lower, upper = METHODS[name](np.arange(n + 1), np.full(n + 1, n), failure)
        assert (lower <= np.arange(n + 1) / n).all() and (np.arange(n + 1) / n <= upper).all()
        ends = np.concatenate([lower, upper])
        # A chance of holding falls only where an end is passed.
        tried = np.concatenate([np.nextafter(ends, 0), np.nextafter(ends, 1), [0, 0.3, 1]])
        for p in tried[(tried >= 0) & (tried <= 1)]:
            holds = (lower <= p) & (p <= upper)
            chance = [
                comb(n, k) * Fraction(p) ** k * (1 - Fraction(p)) ** (n - k)
                for k in np.flatnonzero(~holds).tolist()
            ]
            assert sum(chance) <= Fraction(failure)


def ever_missed(name, p, failure, most):
    """The chance that some interval of the first throws misses p, by all counts of all times."""
    total, count = np.nonzero(np.tri(most + 1))
    lower, upper = METHODS[name](count, total, failure)
    misses = (p < lower) | (p > upper)
    chance, missed = np.array([1.0]), 0.0
    for n in range(1, most + 1):
        chance = np.append(chance * (1 - p), 0) + np.append(0, chance * p)
        out = misses[total == n]
        missed += chance[out].sum()
        chance[out] = 0
    return missed


@pytest.mark.parametrize("p", [0.5, 0.1, 0.003])
def test_at_any_time(p):
    assert ever_missed("anytime", p, 0.1, 200) <= 0.1


def test_others_do_not_hold_at_all_times():
    assert ever_missed("clopper_pearson", 0.5, 0.1, 200) > 0.2
    assert ever_missed("hoeffding", 0.5, 0.1, 200) > 0.13


def test_at_any_time_is_what_it_says():
    k, n = np.array([0, 1, 3, 10, 500, 999]), np.array([5, 5, 8, 10, 1000, 1000])
    lower, upper = anytime(k, n, 0.01)
    for i in range(k.size):
        grid = np.concatenate([np.linspace(0, 1, 20_001)[1:-1], [lower[i] or 0.5, upper[i]]])
        ones, others = int(k[i]), int(n[i] - k[i])
        half = [Fraction(2 * j + 1, 2) for j in range(int(n[i]))]
        mixture = np.prod([1.0])  # log B(k + 1/2, n - k + 1/2) / B(1/2, 1/2), by its product
        mixture = (
            sum(np.log(float(x)) for x in half[:ones])
            + sum(np.log(float(x)) for x in half[:others])
            - sum(np.log(j) for j in range(1, n[i] + 1))
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            fit = ones * np.log(grid) + (others * np.log1p(-grid) if others else 0)
        inside = fit >= np.log(0.01) + mixture
        strictly = (grid > lower[i] * (1 + 1e-9)) & (grid < upper[i] * (1 - 1e-9))
        assert inside[strictly].all() and not inside[(grid < lower[i]) | (grid > upper[i])].any()


@pytest.mark.parametrize("name", METHODS)
def test_nothing_tried(name):
    lower, upper = METHODS[name](np.array([0, 0]), np.array([0, 3]), 0.05)
    assert lower.tolist() == [0, 0] and upper[0] == 1 and upper[1] < 1
