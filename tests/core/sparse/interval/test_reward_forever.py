"""Total rewards of interval models over the infinite horizon, against all policies and all vertices."""

import numpy as np
import pytest

from jaxltl.core.sparse.interval.reward_forever import reward_forever
from jaxltl.core.sparse.interval.robust_values import Query
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from tests.reference_intervals import chains, limit, optima, random_model


def positive(rng, **options):
    """A random model in which nature gives each successor some mass."""
    while True:
        model = random_model(rng, **options)
        lower = np.maximum(model.lower, 1 / 16)
        upper = np.maximum(model.upper, lower)
        if (model.sum_rows(lower) <= 1).all():
            wider = UncertainMDP(model.mdp, lower, upper)
            p = wider.extreme_distributions(rng.random(lower.size), maximize=True)
            host = HostMDP(model.mdp.row_start, model.mdp.entry_start, model.mdp.successor, p)
            return UncertainMDP(host, lower, upper)


def forever(matrix, cost):
    """Total rewards of chains ``[N, S]``."""
    leads = limit(0.5 * (matrix + np.eye(cost.size)))
    earns = np.where(leads > 1e-9, cost > 0, False)  # recurrent states that are reached
    infinite = earns.any(2)
    transient = np.abs(np.diagonal(leads, axis1=1, axis2=2)) < 1e-9
    inner = matrix * transient[:, :, None] * transient[:, None, :]
    value = np.linalg.solve(np.eye(cost.size) - inner, (cost * transient)[..., None])[..., 0]
    return np.where(infinite, np.inf, value)


def test_optima_of_all_policies_and_natures_are_enclosed_and_attained():
    rng = np.random.default_rng(11)
    infinite = 0
    for _ in range(20):
        model = positive(rng, num_states=4, width=2)
        cost = rng.choice([0.0, 0.0, 1.0, 2.0], model.mdp.num_rows)
        every = list(chains(model, np.zeros(4, bool)))
        answers = optima([forever(p, cost[list(rows)]) for rows, p in every])
        for (maximize, large), expected in answers.items():
            values = reward_forever(model, cost, Query(maximize, large, 1e-9))
            assert values.value == pytest.approx(expected, rel=1e-6), (maximize, large)
            assert (values.lower <= expected * (1 + 1e-12)).all()
            assert (values.upper >= expected * (1 - 1e-12)).all()
            infinite += np.isinf(expected).sum()
            # The policy attains it against the worst or best nature.
            rows = values.row
            natures = next(p for policy, p in every if list(policy) == rows.tolist())
            answer = forever(natures, cost[rows])
            attained = answer.max(0) if large else answer.min(0)
            assert attained == pytest.approx(expected, rel=1e-6), (maximize, large)
    assert 30 < infinite < 290


def test_a_successor_that_may_be_dropped_is_refused():
    model = random_model(np.random.default_rng(0))
    with pytest.raises(ValueError, match="lower ends are positive"):
        reward_forever(model, np.ones(model.mdp.num_rows), Query(True, True))
