"""The extreme expectations over a ball, against linear programs."""

import itertools

import numpy as np
import pytest
from scipy.optimize import linprog

from jaxltl.core.sparse.interval.l1_ball import Ball
from jaxltl.core.sparse.interval.uncertainty_set import uncertainty_sets


def l1_expectation(value, center, radius, start, *, maximize):
    """``sum_t p_t v_t`` for the extreme p with ``sum_t |p_t - c_t| <= radius``, and p."""
    ball = Ball(center, np.minimum(radius / 2, 1))
    sets = uncertainty_sets(start, np.zeros_like(center), np.ones_like(center), ball)
    p = sets.extreme_distributions(value, maximize=maximize)
    return sets.sum_rows(p * value), p


def by_program(value, center, radius, maximize):
    """The extreme over p and d with ``|p - center| <= d``, ``sum d <= radius``."""
    size = value.size
    one, zero = np.eye(size), np.zeros(size)
    sign = -1 if maximize else 1
    found = linprog(
        sign * np.concatenate([value, zero]),
        A_ub=np.block([[one, -one], [-one, -one], [zero[None], zero[None] + 1]]),
        b_ub=np.concatenate([center, -center, [radius]]),
        A_eq=np.concatenate([zero + 1, zero])[None],
        b_eq=[1],
        bounds=(0, None),
    )
    assert found.status == 0
    return sign * found.fun


def random_rows(rng, num_rows):
    width = rng.integers(1, 7, num_rows)
    start = np.concatenate([[0], width.cumsum()])
    center = np.concatenate([rng.dirichlet(np.full(k, 0.5)) for k in width])
    for i in np.flatnonzero(width > 2)[::3]:  # some are never seen
        center[start[i]] += center[start[i] + 1]
        center[start[i] + 1] = 0
    value = np.round(rng.normal(size=start[-1]), 1)  # with ties
    radius = rng.choice([0, 0.05, 0.4, 1.0, 2.0], num_rows)
    return value, center, radius, start


@pytest.mark.parametrize("maximize", [False, True])
def test_greedy_is_extreme(maximize):
    value, center, radius, start = random_rows(np.random.default_rng(0), 150)
    found, chosen = l1_expectation(value, center, radius, start, maximize=maximize)
    for i, (a, b) in enumerate(itertools.pairwise(start)):
        best = by_program(value[a:b], center[a:b], radius[i], maximize)
        assert found[i] == pytest.approx(best, abs=1e-6)  # the program's tolerance is 1e-7
        assert chosen[a:b].sum() == pytest.approx(1, abs=1e-12) and (chosen[a:b] >= 0).all()
        assert np.abs(chosen[a:b] - center[a:b]).sum() <= radius[i] + 1e-12
        assert chosen[a:b] @ value[a:b] == pytest.approx(found[i], abs=1e-12)


def test_no_radius_and_a_full_one():
    value, center, _, start = random_rows(np.random.default_rng(1), 30)
    rows = start.size - 1
    same, _ = l1_expectation(value, center, np.zeros(rows), start, maximize=False)
    assert same == pytest.approx(np.add.reduceat(center * value, start[:-1]))
    free, _ = l1_expectation(value, center, np.full(rows, 2.0), start, maximize=True)
    assert free == pytest.approx(np.maximum.reduceat(value, start[:-1]))
