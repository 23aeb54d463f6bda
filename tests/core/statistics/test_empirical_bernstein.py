"""Intervals of means of bounded numbers: coverage, for a fixed number and at any time."""

import numpy as np
import pytest

from jaxltl.core.statistics.binomial import bounded_mean

KINDS = {
    "rare": (0.01, lambda rng, n: (rng.random(n) < 0.01) * 1.0),
    "coin": (0.5, lambda rng, n: (rng.random(n) < 0.5) * 1.0),
    "often": (0.98, lambda rng, n: (rng.random(n) < 0.98) * 1.0),
    "narrow": (0.3, lambda rng, n: 0.3 + 0.02 * rng.uniform(-1, 1, n)),
    "flat": (0.5, lambda rng, n: rng.random(n)),
}


@pytest.mark.parametrize("number", [200, pytest.param(10_000, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("kind", KINDS)
def test_intervals_cover(kind, number):
    mean, draw = KINDS[kind]
    rng, missed = np.random.default_rng(0), 0
    for _ in range(number):
        lower, upper = bounded_mean(draw(rng, 200), 0.2, planned=200)
        assert 0 <= lower < upper <= 1
        missed += not lower <= mean <= upper
    assert missed <= 0.2 * number


@pytest.mark.parametrize("number", [50, pytest.param(2_000, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("kind", KINDS)
def test_intervals_cover_whenever_one_stops(kind, number):
    """Even if one stops as soon as the interval is wrong."""
    mean, draw = KINDS[kind]
    rng, missed = np.random.default_rng(1), 0
    for _ in range(number):
        x = draw(rng, 400)
        ends = [bounded_mean(x[:n], 0.2) for n in range(10, 401, 10)]
        missed += not all(lower <= mean <= upper for lower, upper in ends)
    assert missed <= 0.2 * number


def test_intervals_are_the_written_out_sums():
    rng = np.random.default_rng(2)
    x, failure = rng.random(30), 0.1
    for planned in (30, None):
        weights = weighted = spread = 0.0
        for t in range(1, 31):
            past = x[: t - 1]
            guesses = [(0.5 + past[: i + 1].sum()) / (i + 2) for i in range(len(past))]
            variance = (0.25 + sum((a - b) ** 2 for a, b in zip(past, guesses, strict=True))) / t
            many = t * np.log(1 + t) if planned is None else planned
            w = min(np.sqrt(2 * np.log(2 / failure) / (many * variance)), 0.5)
            weights, weighted = weights + w, weighted + w * x[t - 1]
            guess = (0.5 + past.sum()) / t
            spread += (x[t - 1] - guess) ** 2 * (-np.log(1 - w) - w)
        half = (np.log(2 / failure) + spread) / weights
        ends = weighted / weights - half, weighted / weights + half
        np.testing.assert_allclose(
            bounded_mean(x, failure, planned=planned), np.clip(ends, 0, 1), atol=1e-12
        )


def test_small_variance_is_used():
    """Far narrower than Hoeffding's, which knows the range alone."""
    x = 0.4 + 0.01 * np.random.default_rng(3).uniform(-1, 1, 5000)
    lower, upper = bounded_mean(x, 0.05, planned=5000)
    assert lower < 0.4 < upper and upper - lower < 0.1 * 2 * np.sqrt(np.log(40) / 10_000)


def test_without_numbers_nothing_is_known():
    assert bounded_mean(np.zeros(0), 0.05) == (0.0, 1.0)
    lower, upper = bounded_mean(np.array([7.0, -3.0]), 0.5)  # clipped to 1 and 0
    assert lower == 0.0 and upper == 1.0
