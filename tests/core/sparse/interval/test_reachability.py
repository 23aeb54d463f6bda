"""Values of interval models are those of the best policy and the best vertices, and enclosed."""

import numpy as np
import pytest

from jaxltl.core.models.interval import interval_rows
from jaxltl.core.sparse.graph.accepting import accepting_region
from jaxltl.core.sparse.interval import reachability as interval_values
from jaxltl.core.sparse.interval import strategy_iteration
from jaxltl.core.sparse.interval.parity import parity_against_nature
from jaxltl.core.sparse.interval.robust_values import Query
from jaxltl.core.sparse.interval.total_reward import total_reward
from jaxltl.core.sparse.solvers.reachability import reachability
from tests.reference_intervals import chains, optima, random_model, reach

COUNTS = [10, pytest.param(500, marks=pytest.mark.exhaustive)]


def enclosed(found, value):
    """The value lies in the bounds, which are narrow."""
    finite = np.isfinite(value)
    size = np.where(finite, np.maximum(1, value), 1)
    assert (finite == np.isfinite(found.upper)).all()
    assert (finite == np.isfinite(found.lower)).all()
    value, low, high = (np.where(finite, x, 0) for x in (value, found.lower, found.upper))
    assert (low <= value + 1e-11 * size).all()
    assert (value <= high + 1e-11 * size).all()
    assert (high - low <= 1e-6 * size).all()


@pytest.mark.parametrize("count", COUNTS)
def test_probabilities(count):
    rng = np.random.default_rng(2)
    for _ in range(count):
        model = random_model(rng)
        goal = np.arange(4) == rng.integers(4)
        for (maximize, helpful), value in optima(
            [reach(p, goal) for _, p in chains(model, goal)]
        ).items():
            found = interval_values.reachability(model, goal, Query(maximize, helpful))
            enclosed(found, value)
            checks_out(model, found, goal, maximize, helpful)


def checks_out(model, found, goal, maximize, helpful):
    """Nature's distributions are possible, and prove one bound by themselves."""
    p = found.probability
    assert ((model.lower - 1e-15 <= p) & (p <= model.upper + 1e-15)).all()
    np.testing.assert_allclose(model.sum_rows(p), 1, rtol=1e-14)
    if maximize == helpful:
        part, entry = model.under_policy(found.row)
        alone = reachability(part.resolve(p[entry]), goal, maximize=True)
    else:
        alone = reachability(model.resolve(p), goal, maximize=maximize)
    np.testing.assert_allclose(alone.value, found.value, atol=1e-6)


def test_nature_that_is_against_a_parity_condition_is_returned():
    rng = np.random.default_rng(5)
    for _ in range(25):
        model = random_model(rng)
        priority = rng.integers(0, 3, 4)
        found = parity_against_nature(model, priority)
        p = found.probability
        assert ((model.lower - 1e-15 <= p) & (p <= model.upper + 1e-15)).all()
        mdp = model.resolve(p)
        region = accepting_region(mdp, priority[mdp.state[mdp.row]]).region
        best = reachability(mdp, region, maximize=True)
        np.testing.assert_allclose(best.value, found.value, atol=1e-6)


def test_slow_chains_keep_their_precision():
    """A walk that nature slows down to one step in 10^9 is still proven."""
    from tests.reference_intervals import HostMDP, UncertainMDP

    eps = 1e-9
    mdp = HostMDP(
        np.array([0, 1, 2, 3]),
        np.array([0, 3, 4, 5]),
        np.array([0, 1, 2, 1, 2]),
        np.array([1 - 2 * eps, eps, eps, 1, 1]),
    )
    lower = np.array([0.5, eps, eps, 1, 1])
    upper = np.array([1 - 2 * eps, 3 * eps, 0.5, 1, 1])
    model = UncertainMDP(mdp, lower, upper)
    goal = np.array([False, True, False])
    helped = interval_values.reachability(model, goal, Query(True, True))
    enclosed(helped, np.array([0.75, 1, 0]))
    hindered = interval_values.reachability(model, goal, Query(True, False))
    enclosed(hindered, np.array([eps / (0.5 + eps), 1, 0]))


def test_ties_and_scales():
    rng = np.random.default_rng(6)
    model = random_model(rng, num_states=6, most_rows=3)
    none = np.zeros(6, bool)
    for maximize in (True, False):
        for helpful in (True, False):
            found = interval_values.reachability(model, none, Query(maximize, helpful))
            assert (found.upper == 0).all()
            found = interval_values.reachability(model, ~none, Query(maximize, helpful))
            assert (found.lower == 1).all()


def test_a_reward_whose_first_way_there_would_hardly_end():
    """On a grid where every move slips, some rows lead to the goal by slips alone."""
    n, moves = 15, np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    place = np.stack(np.divmod(np.arange(n * n), n), 1)
    to = np.clip(place[:, None] + moves, 0, n - 1) @ [n, 1]
    slips = np.stack([np.roll(to, -k, 1) for k in (0, 1, 3)], 2)
    size = slips.size
    model = interval_rows(
        np.arange(0, 4 * n * n + 1, 4),
        np.arange(0, size + 1, 3),
        slips.ravel(),
        np.resize([0.7, 0.05, 0.05], size),
        np.resize([0.9, 0.15, 0.15], size),
    ).host
    goal = np.arange(n * n) == n * n - 1
    found = total_reward(model, np.ones(4 * n * n), goal, Query(False, True))
    value = np.zeros(n * n)
    for _ in range(400):
        ahead = value[model.mdp.successor]
        step = 1 + model.sum_rows(model.extreme_distributions(ahead, maximize=True) * ahead)
        value = np.where(goal, 0, step.reshape(n * n, 4).min(1))
    enclosed(found, value)


def test_who_stops_when_bounds_are_near(monkeypatch):
    """Bounds that are looked at in every round enclose the values too."""
    monkeypatch.setattr(strategy_iteration, "_tests_bounds", lambda rounds: True)
    rng = np.random.default_rng(11)
    for _ in range(15):
        model = random_model(rng)
        goal = np.arange(4) == rng.integers(4)
        for (maximize, helpful), value in optima(
            [reach(p, goal) for _, p in chains(model, goal)]
        ).items():
            enclosed(interval_values.reachability(model, goal, Query(maximize, helpful)), value)
