"""Sets from counts: what they claim, against sums over all counts, and how often they hold."""

import itertools
from fractions import Fraction
from math import factorial, prod

import numpy as np
import pytest

from jaxltl.core.statistics.binomial import anytime, around, clopper_pearson, hoeffding
from jaxltl.core.statistics.confidence_sets import (
    intervals_from_counts,
    l1_radius,
    samples_needed,
)

METHODS = ("clopper-pearson", "hoeffding", "weissman", "anytime")


def all_counts(total, width):
    """All that can come of some throws."""
    if width == 1:
        return [(total,)]
    return [(i, *rest) for i in range(total + 1) for rest in all_counts(total - i, width - 1)]


def holds(sets, row, truth):
    """Whether a row's set has a distribution, and whether that is within the intervals, too."""
    inside = ((sets.lower[row] <= truth) & (truth <= sets.upper[row])).all()
    if sets.radius is None:
        return inside
    near = np.abs(truth - sets.center[row]).sum() <= sets.radius[row]
    assert inside or not near
    return near


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("truth", [(0.5, 0.3, 0.2), (0.9, 0.1, 0.0), (0.34, 0.33, 0.33)])
def test_a_row_holds_with_its_chance(method, truth):
    total = 12
    counts = np.array(all_counts(total, 3))
    missed = Fraction(0)
    exact = [Fraction(p).limit_denominator(100) for p in truth]
    for count in counts:  # one row each, so that its claims share all of the chance
        sets = intervals_from_counts(count[None], 0.7, method=method)
        assert sets.num_claims == (1 if method == "weissman" else 3)
        if not holds(sets, 0, np.array(truth)):
            ways = factorial(total) // prod(factorial(int(k)) for k in count)
            missed += ways * prod(p ** int(k) for p, k in zip(exact, count, strict=True))
    assert missed <= Fraction(3, 10)
    if method != "weissman":  # something is ever missed, or the test tells nothing
        assert missed > 0


def test_two_outcomes_make_one_claim():
    """The chance that either interval misses is that of one."""
    counts = np.array([[7, 3]])
    for name, ends in (("clopper-pearson", clopper_pearson), ("hoeffding", hoeffding)):
        sets = intervals_from_counts(counts, 0.95, method=name)
        lower, upper = ends(counts[0], np.array(10), 1 - 0.95)
        assert sets.num_claims == 1
        assert (sets.lower[0] == lower).all() and (sets.upper[0] == upper).all()
        assert abs(sets.lower[0] + sets.upper[0, ::-1] - 1).max() < 1e-15


def test_what_is_claimed():
    counts = np.array([[4, 0, 0, 0], [4, 2, 0, 0], [4, 2, 0, 1], [0, 0, 0, 0], [0, 0, 0, 0]])
    listed = np.array([1, 2, 4, 3, 0])
    used = np.arange(4) < listed[:, None]
    for method in METHODS:
        sets = intervals_from_counts(counts, 0.9, method=method, used=used)
        assert sets.num_claims == (3 if method == "weissman" else 0 + 1 + 4 + 3)
        assert (sets.lower[~used] == 0).all() and (sets.upper[~used] == 0).all()
        assert sets.lower[0, 0] == sets.upper[0, 0] == 1, "one successor is certain"
        assert (sets.lower[2, :3] <= counts[2, :3] / 7).all() and sets.lower[2, 2] == 0
        assert (sets.upper[3, :3] == 1).all() and (sets.lower[3] == 0).all(), "never seen"
        assert (sets.center.sum(-1)[:4] == 1).all() and (sets.rest == 0).all()
        assert sets.num_samples.tolist() == [4, 6, 7, 0, 0]
        some = np.array([True, True, False, False, False])
        few = intervals_from_counts(counts, 0.9, method=method, used=used, rows=some)
        assert few.num_claims == 1
        assert (few.upper[2] == 1).all() and (few.lower[2] == 0).all()
        assert few.lower[0, 0] == 1 and few.lower[1, 0] > sets.lower[1, 0]
        if method == "weissman":
            assert sets.radius[0] == 0 and sets.radius[3] == 2
            assert few.radius.tolist()[2:4] == [2, 2]


def test_rows_without_padding():
    rng = np.random.default_rng(0)
    listed = rng.integers(1, 5, 12)
    used = (np.arange(4) < listed[:, None]).reshape(4, 3, 4)
    counts = rng.integers(0, 30, (4, 3, 4)) * used
    start = np.concatenate([[0], listed.cumsum()])
    outcomes = np.full(12, 4)
    rows = rng.random(12) < 0.7
    for method in METHODS:
        padded = intervals_from_counts(
            counts, 0.9, method=method, used=used, rows=rows.reshape(4, 3), num_outcomes=4
        )
        plain = intervals_from_counts(
            counts[used], 0.9, method=method, entry_start=start, rows=rows, num_outcomes=outcomes
        )
        assert padded.num_claims == plain.num_claims
        for name in ("lower", "upper", "center"):
            assert (getattr(padded, name)[used] == getattr(plain, name)).all()
        for name in ("rest", "radius", "num_samples"):
            if getattr(plain, name) is not None:
                assert (getattr(padded, name).ravel() == getattr(plain, name)).all()


@pytest.mark.parametrize("method", METHODS)
def test_a_graph_that_is_not_known(method):
    """What is not listed has what a full table says of it, all of it together."""
    counts = np.array([[30, 10, 0, 0, 0], [0, 0, 0, 0, 0], [3, 0, 0, 0, 0]])
    full = intervals_from_counts(counts, 0.9, method=method)
    used = counts > 0
    sets = intervals_from_counts(counts, 0.9, method=method, used=used, num_outcomes=5)
    assert sets.num_claims == full.num_claims
    assert (sets.lower[used] == full.lower[used]).all()
    assert (sets.upper[used] == full.upper[used]).all()
    left = np.where(used, 0, full.upper).sum(-1)
    bound = np.minimum(left, 1 - full.lower.sum(-1))
    if method == "weissman":
        bound = np.minimum(bound, full.radius / 2)
    assert (sets.rest >= bound - 1e-15).all() and (sets.rest <= bound + 1e-13).all()
    assert sets.rest[1] == 1, "of what was never seen, all may be"
    one = intervals_from_counts([[5]], 0.9, method=method, num_outcomes=2)
    assert one.num_claims == 1 and one.lower[0, 0] < 1
    assert abs(one.rest[0] - (1 - one.lower[0, 0])) < 1e-12


def test_the_ball_of_weissman():
    total, outcomes = np.array([10, 1000, 10**6, 0, 5]), np.array([2, 3, 500, 4, 1])
    radius = l1_radius(total, outcomes, 0.01)
    assert radius[3] == 2 and radius[4] == 0
    for n, j, r in zip(total[:3], outcomes[:3], radius[:3], strict=True):
        events = np.log(float(2 ** int(j) - 2)) if j < 1000 else 0
        assert r == pytest.approx(np.sqrt(2 / n * (events - np.log(0.01))), rel=1e-12)
    # Of two outcomes it is Hoeffding's interval.
    lower, _ = hoeffding(np.array([500]), np.array([1000]), 0.01)
    assert l1_radius(np.array([1000]), np.array([2]), 0.01)[0] == pytest.approx(1 - 2 * lower[0])


def test_dtypes_and_empty_tables():
    ones = np.array([[3.0, 1.0]], np.float32)
    whole = intervals_from_counts([[3, 1]], 0.9)
    assert (intervals_from_counts(ones, 0.9).lower == whole.lower).all()
    none = intervals_from_counts(np.zeros((0, 3), int), 0.9)
    assert none.num_claims == 0 and none.lower.shape == (0, 3)
    certain = intervals_from_counts([[7], [0]], 0.9)
    assert certain.num_claims == 0 and (certain.lower == 1).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"confidence": 0.0}, "confidence=0.0"),
        ({"confidence": 1}, "confidence=1;"),
        ({"confidence": float("nan")}, "confidence=nan"),
        ({"confidence": -3}, "strictly between"),
        ({"confidence": None}, "confidence=None"),
        ({"confidence": "0.9"}, "confidence='0.9'"),
        ({"method": "exact"}, "method='exact'; choose one of clopper-pearson"),
        ({"counts": [[1, -1]]}, r"counts\[0, 1\] is -1"),
        ({"counts": [[1.5, 1]]}, r"counts\[0, 0\] is 1.5"),
        ({"counts": [[np.nan, 1]]}, r"counts\[0, 0\] is nan"),
        ({"counts": [[2**53, 1]]}, "counts are integers from 0 to"),
        ({"counts": [[[2**53 - 1, 1]]]}, "state 0, action 0 was thrown"),
        ({"counts": 3}, "counts is a number"),
        ({"used": [[True, False]]}, r"counts\[0, 1\] is 1, at an entry that is no successor"),
        ({"used": [[True]]}, "used has shape"),
        ({"counts": [1, 1], "entry_start": [0, 1]}, "entry_start must ascend"),
        ({"counts": [1, 1], "entry_start": [0, 2], "used": [True, True]}, "both given"),
        ({"rows": [1]}, "rows is int64"),
        ({"num_outcomes": 1}, r"row \[0\] lists 2 successors, more than its num_outcomes, 1"),
        ({"num_claims": 0}, "num_claims=0; the rows make 1"),
        ({"num_claims": 1.5}, "num_claims=1.5"),
        ({"num_outcomes": 2.5}, "num_outcomes is float64"),
    ],
)
def test_what_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        intervals_from_counts(**{"counts": [[1, 1]], "confidence": 0.9} | arguments)


@pytest.mark.parametrize("method", METHODS)
def test_samples_that_are_needed(method):
    ends = {"clopper-pearson": clopper_pearson, "hoeffding": hoeffding, "anytime": anytime}

    def widest(n, failure):
        """Over all that can come."""
        count = np.arange(n + 1)
        if method == "weissman":
            radius = l1_radius(np.full(n + 1, n), np.full(n + 1, 4), failure)
            lower, upper = around(count / n, radius / 2)
        else:
            lower, upper = ends[method](count, np.full(n + 1, n), failure)
        return (upper - lower).max()

    for width, claims in ((0.4, 1), (0.1, 10)):
        found = samples_needed(width, 0.9, method=method, num_claims=claims, num_outcomes=4)
        failure = (1 - 0.9) / claims
        assert widest(found, failure) <= width < widest(found - 1, failure)


def test_samples_that_cannot_be_asked_for():
    for bad in (
        {"width": 0.0},
        {"width": 1},
        {"confidence": 1.0},
        {"method": "x"},
        {"num_claims": 0},
        {"num_claims": -5},
        {"num_outcomes": 1},
    ):
        with pytest.raises(ValueError, match=next(iter(bad))):
            samples_needed(**{"width": 0.1, "confidence": 0.9} | bad)
    with pytest.raises(ValueError, match="more than 2"):
        samples_needed(1e-9, 0.9, method="hoeffding")


def simulated(rng, method, confidence, adaptive):
    """Whether all claims hold, for a random model and data drawn from it."""
    num_rows, width = int(rng.integers(1, 6)), int(rng.integers(2, 5))
    truth = rng.dirichlet(np.full(width, rng.choice([0.2, 1.0, 5.0])), num_rows)
    counts = np.stack(
        [rng.multinomial(n, p) for n, p in zip(rng.integers(0, 200, num_rows), truth, strict=True)]
    )
    if adaptive:  # goes on throwing the row that looks best
        for _ in range(100):
            row = int(np.argmax(counts[:, 0] / (counts.sum(-1) + 1)))
            counts[row, rng.choice(width, p=truth[row])] += 1
    sets = intervals_from_counts(counts, confidence, method=method)
    return all(holds(sets, row, truth[row]) for row in range(num_rows))


def test_all_claims_hold_at_once():
    rng = np.random.default_rng(1)
    for method in METHODS:
        found = sum(simulated(rng, method, 0.8, method == "anytime") for _ in range(200))
        assert found >= 160, "three standard deviations above what is promised"


def test_many_rows_at_once():
    """Claims are shared by all rows, and ends are those of each row alone."""
    counts = np.array(list(itertools.product(range(4), repeat=3)))
    sets = intervals_from_counts(counts, 0.9)
    assert sets.num_claims == 3 * 64
    for i in (0, 5, 63):
        one = intervals_from_counts(counts[i : i + 1], 1 - (1 - 0.9) / 64)
        assert np.abs(one.lower[0] - sets.lower[i]).max() < 1e-9
        assert np.abs(one.upper[0] - sets.upper[i]).max() < 1e-9


def test_more_claims_than_rows():
    rows = [[3, 4], [6, 2], [1, 9]]
    for method in METHODS:
        few = intervals_from_counts(rows[:1], 0.9, method=method, num_claims=3)
        all_rows = intervals_from_counts(rows, 0.9, method=method)
        assert few.num_claims == 3 and (few.lower[0] == all_rows.lower[0]).all()
