"""Nature's distributions are extreme, and its graph is decided right."""

import numpy as np
import pytest
from scipy.optimize import linprog

from jaxltl.core.sparse.interval.qualitative import zero_one_states
from jaxltl.core.sparse.interval.robust_values import Query
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from tests.reference_intervals import chains, optima, random_model, reach


def wide_model(rng, most):
    """Rows of up to so many successors, in one state each."""
    width = rng.integers(1, most + 1, 12)
    starts = np.concatenate([[0], width.cumsum()])
    successor = np.concatenate([np.sort(rng.choice(most, k, replace=False)) for k in width])
    lower, upper = [], []
    for k in width:
        p = rng.dirichlet(np.ones(k))
        off = rng.uniform(0, 0.3, k) * (rng.random(k) < 0.7)
        lower.append(np.maximum(p - off, 0))
        upper.append(np.minimum(p + off * rng.random(k), 1))
    lower, upper = np.concatenate(lower), np.concatenate(upper)
    return UncertainMDP(HostMDP(np.arange(13), starts, successor, lower), lower, upper)


@pytest.mark.parametrize("most", [3, 8, 60])
def test_nature_is_extreme(most):
    """Against linear programs; rows of many widths are sorted in groups."""
    rng = np.random.default_rng(most)
    model = wide_model(rng, most)
    quantity = rng.normal(size=model.lower.size)
    for maximize, sign in ((True, -1), (False, 1)):
        p = model.extreme_distributions(quantity, maximize=maximize)
        assert ((model.lower <= p) & (p <= model.upper)).all()
        np.testing.assert_allclose(model.sum_rows(p), 1, rtol=1e-14)
        for r in range(12):
            of = slice(model.mdp.entry_start[r], model.mdp.entry_start[r + 1])
            bounds = list(zip(model.lower[of], model.upper[of], strict=True))
            best = linprog(
                sign * quantity[of], A_eq=np.ones((1, len(bounds))), b_eq=[1], bounds=bounds
            )
            assert abs(sign * best.fun - (p * quantity)[of].sum()) < 1e-9


def test_decimals_that_add_up_to_one_are_one_if_ends_are_widened():
    """``.1 + .2 + .7`` is less than one in binary; nature may nearly drop the fourth successor."""
    model = UncertainMDP(
        HostMDP(np.array([0, 1]), np.array([0, 4]), np.arange(4), np.full(4, 0.25)),
        np.zeros(4),
        np.array([0.7, 0.2, 0.1, 0.5]),
    )
    p = model.extreme_distributions(np.array([0.0, 1.0, 2.0, 3.0]), maximize=False)
    assert p.tolist() == [0.7, 0.2, 0.1, 0.0]
    assert not model.can_stay_in(np.array([True, True, True, False])).any()
    assert model.enlarged.can_stay_in(np.array([True, True, True, False])).all()
    assert not model.enlarged.can_stay_in(np.array([True, True, False, False])).any()


def test_distributions_within():
    """All of a support that nature may keep to, and no more."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        model = random_model(rng)
        region = rng.random(4) < 0.6
        entries = region[model.mdp.successor]
        able = model.can_stay_in(region)[model.mdp.row]
        p = model.interior_distributions(entries)
        np.testing.assert_allclose(model.sum_rows(p), 1, rtol=1e-14)
        assert ((p <= model.upper + 1e-15) & (p >= model.lower - 1e-15) | ~entries | ~able).all()
        assert (p[able & ~entries] == 0).all()


def test_what_is_certain_is_decided():
    """Where probabilities are 0 and 1, by all policies and all vertices of nature's."""
    rng = np.random.default_rng(1)
    for _ in range(60):
        model = random_model(rng)
        goal = np.arange(4) == rng.integers(4)
        halted, _ = model.with_absorbing(goal)
        for (maximize, helpful), value in optima(
            [reach(p, goal) for _, p in chains(model, goal)]
        ).items():
            found = zero_one_states(halted, goal, Query(maximize, helpful))
            assert (found.zero == (value < 1e-12)).all()
            assert (found.one == (value > 1 - 1e-12)).all()
