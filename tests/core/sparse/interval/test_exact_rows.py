"""Bounds hold for the numbers as they are, to the last bit: masses of the order of rounding."""

import itertools
from fractions import Fraction

import numpy as np
import pytest

from jaxltl.core.models.interval import interval_rows
from jaxltl.core.sparse.interval import reachability as interval_values
from jaxltl.core.sparse.interval.robust_values import Query
from jaxltl.core.sparse.interval.row_table import exact_sum, row_sums
from jaxltl.core.sparse.interval.total_reward import total_reward
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from tests.reference_fractions import values

COUNTS = [4, pytest.param(1000, marks=pytest.mark.exhaustive)]
UNIT = 2.0**-52


def tiny_model(rng, kind):
    """Two states, a good and a bad end; each row holds a distribution in units of 2**-52.

    One successor has almost all mass (in a "ball" every row has at most three).
    """
    row_start, entry_start, successor, lower, upper, center, radius = [0], [0], [], [], [], [], []
    for _ in range(2):
        for _ in range(rng.integers(1, 3)):
            width = int(rng.integers(2, 4 if kind == "ball" else 5))
            p = 2.0 ** rng.integers(0, 13, width) * UNIT * rng.integers(1, 4, width)
            large = rng.integers(width)
            p[large] = 0
            p[large] = 1 - p.sum()
            near = 2.0 ** rng.integers(0, 13, width) * UNIT
            low = np.choose(rng.integers(0, 4, width), [0 * p, p, p / 2, np.maximum(p - near, 0)])
            high = np.choose(rng.integers(0, 4, width), [p, p + 2 * near, p + near, 0 * p + 1])
            if kind == "firm":
                low = np.where(low > 0, low, p / 2)
            successor += np.sort(rng.choice(4, width, replace=False)).tolist()
            lower, upper = lower + low.tolist(), upper + np.minimum(high, 1).tolist()
            center += p.tolist()
            radius.append(rng.choice([0, 1, 2, 8, 2.0**52]) * UNIT)
            entry_start.append(len(successor))
        row_start.append(len(radius))
    for s in (2, 3):
        for of, x in ((successor, s), (lower, 1), (upper, 1), (center, 1), (radius, 0)):
            of.append(x)
        entry_start.append(len(successor))
        row_start.append(len(radius))
    ball = {"center": center, "radius": radius} if kind == "ball" else {}
    return interval_rows(row_start, entry_start, successor, lower, upper, **ball).host


@pytest.mark.few(2)
@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("kind", ["firm", "loose", "ball"])
def test_bounds_are_those_of_the_numbers_as_they_are(kind, count):
    rng = np.random.default_rng(11)
    goal, ends = np.arange(4) == 2, np.arange(4) >= 2
    narrow = 0
    for i in range(count):
        host = tiny_model(rng, kind)
        cost = rng.integers(1, 9, host.mdp.num_rows) / 4
        maximize, large = bool(i & 1), bool(i & 2)
        for earned in (None, cost):
            if earned is None:
                found = interval_values.reachability(host, goal, Query(maximize, large), stay=~ends)
            else:
                found = total_reward(host, cost, ends, Query(maximize, large))
            exact = values(host, goal, ends, earned, maximize=maximize, large=large)
            for low, high, x in zip(found.lower, found.upper, exact, strict=True):
                if x is None:
                    assert high == np.inf
                else:
                    assert np.isfinite(low) and Fraction(low) <= x
                    assert high == np.inf or x <= Fraction(high)
            scale = 1.0 if earned is None else np.maximum(found.upper, 1)
            with np.errstate(invalid="ignore"):
                width = np.where(found.lower == found.upper, 0, found.upper - found.lower)
                narrow += bool((width <= 1e-6 * scale).all())
    assert narrow >= count * (1.5 if kind == "firm" else 0.8)


def test_the_only_way_out_is_one_in_2_to_the_50():
    """Nature may leave a state by masses that are smaller than the rounding of its row."""
    d = 2.0**-50
    host = interval_rows(
        None, [0, 3, 4, 5], [0, 1, 2, 1, 2], [0.5, d / 4, d / 4, 1, 1], [1 - d, d, d, 1, 1]
    ).host
    goal = np.arange(3) == 1
    for large, value in ((True, 0.8), (False, 0.2)):
        found = interval_values.reachability(host, goal, Query(large, large))
        assert found.lower[0] <= value <= found.upper[0] <= found.lower[0] + 1e-6


def test_what_nature_may_drop_is_decided_by_the_last_bit():
    """Ends that sum to one exactly have room for all; one unit less leaves it to the third."""
    for less, keeps in ((0, True), (2.0**-53, False)):
        host = interval_rows(
            None, [0, 3, 4, 5], [0, 1, 2, 1, 2], [0, 0, 0, 1, 1], [0.5 - less, 0.5, 1, 1, 1]
        ).host
        assert host.can_stay_in(np.array([True, True, False]))[0] == keeps
        assert host.must_enter(np.array([0]), np.arange(3) == 2)[0] == (not keeps)


def test_where_decimals_are_in_doubt_both_are_enclosed():
    """``.7 + .3`` is less than one in binary: then the third must be entered some day."""
    host = interval_rows(
        None,
        [0, 3, 6, 7],
        [0, 1, 2, 0, 1, 2, 2],
        [0.7, 0.2, 0, 0.7, 0.2, 0, 1],
        [0.7, 0.3, 0.5, 0.7, 0.3, 0.5, 1],
    ).host
    goal = np.arange(3) == 2
    assert Fraction(0.7) + Fraction(0.3) < 1
    found = interval_values.reachability(host, goal, Query(False, False))
    assert (found.upper == 1).all() and (found.lower[:2] < 1e-6).all()
    enough = interval_rows(
        None,
        [0, 3, 6, 7],
        [0, 1, 2, 0, 1, 2, 2],
        [0.7, 0.2, 0, 0.7, 0.2, 0, 1],
        [0.8, 0.3, 0.5, 0.8, 0.3, 0.5, 1],
    ).host
    found = interval_values.reachability(enough, goal, Query(False, False))
    assert found.upper.tolist() == [0, 0, 1]


def test_rows_without_a_distribution_are_in_proportion():
    """Three thirds, upper ends and lower ends that miss one by rounding, a center of tenths."""
    third = 1 / 3
    short = interval_rows(
        None, [0, 3, 4, 5], [0, 1, 2, 1, 2], [0, 0, 0, 1, 1], [third, third, third, 1, 1]
    ).host
    assert Fraction(third) * 3 < 1 and short.lower.tolist() == short.upper.tolist()
    goal = np.arange(3) == 1
    for large in (True, False):
        found = interval_values.reachability(short, goal, Query(large, large))
        assert found.lower[0] <= 0.5 <= found.upper[0] <= found.lower[0] + 1e-6
        assert not short.can_stay_in(np.array([True, True, False]))[0]
    tenths = interval_rows(
        None,
        [0, 3, 4, 5],
        [0, 1, 2, 1, 2],
        [0, 0, 0, 1, 1],
        [1.0] * 5,
        center=[0.7, 0.2, 0.1, 1, 1],
        radius=[0.0, 0, 0],
    ).host
    found = interval_values.reachability(tenths, goal, Query(True, True))
    assert found.lower[0] <= 2 / 3 <= found.upper[0] <= found.lower[0] + 1e-6


def test_sums_have_the_right_sign():
    rng = np.random.default_rng(12)
    terms = 2.0 ** -rng.integers(0, 120, (6, 400)) * rng.integers(-3, 4, (6, 400))
    rest = rng.integers(-1, 2, (1, 400)) * 1e-30
    terms = np.concatenate([terms, -terms[rng.permutation(6)], rest])
    found = exact_sum(terms)
    for x, of in zip(found, terms.T, strict=True):
        exact = sum(Fraction(float(y)) for y in of)
        assert abs(Fraction(float(x)) - exact) <= abs(exact) / 2**29
    start = np.array([0, 2, 5, 9])
    q = np.array([0.5, 0.5, 0.7, 0.2, 0.1, 1 - 2.0**-50, 2.0**-51, 2.0**-51, 2.0**-80])
    assert np.sign(row_sums(q, start, -np.ones(3))).tolist() == [0, -1, 1]


def test_distributions_are_settled_to_the_last_digits():
    """What is missing of one goes to one successor, whose mass then has its own precision."""
    rng = np.random.default_rng(13)
    for kind in ("firm", "loose", "ball"):
        for _ in range(20):
            host: UncertainMDP = tiny_model(rng, kind)
            p = host.extreme_distributions(rng.random(host.lower.size), maximize=True)
            found, able = host.nearest_distributions(p)
            if not able:
                continue
            for first, last in itertools.pairwise(host.mdp.entry_start):
                mass = [Fraction(float(x)) for x in found[first:last]]
                k = int(np.argmin([abs(1 - sum(mass)) / x if x else np.inf for x in mass]))
                assert abs(1 - sum(mass)) <= mass[k] * Fraction(2.0**-51)
