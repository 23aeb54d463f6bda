"""Bounds of both sides at once: against those that solve one player inside the other."""

import numpy as np
import pytest
from scipy import sparse

from jaxltl.core.host import interval_optimum, interval_values
from jaxltl.core.host.interval_systems import Systems
from jaxltl.core.models.interval import interval_rows


def walks(size, rng, drift):
    """A walk on a line with two choices, which some of both keep in the middle; ends absorb."""
    rows, lower, upper = [], [], []
    for s in range(size):
        for up in ((0.5,) if s in (0, size - 1) else (0.5 + drift, 0.5 - drift)):
            rows.append([s] if s in (0, size - 1) else [s - 1, s, s + 1])
            p = np.array([1.0] if len(rows[-1]) == 1 else [0.9 * (1 - up), 0.1, 0.9 * up])
            wide = 0 if p.size == 1 else 0.1 * rng.random(p.size)
            lower.append(p * (1 - wide))
            upper.append(np.minimum(p * (1 + wide), 1))
    starts = np.cumsum([0, *map(len, rows)])
    many = np.cumsum([0, *(1 if s in (0, size - 1) else 2 for s in range(size))])
    return interval_rows(
        many, starts, np.concatenate(rows), np.concatenate(lower), np.concatenate(upper)).host


@pytest.mark.parametrize("maximize", (True, False))
def test_both_sides_at_once(maximize, monkeypatch):
    rng = np.random.default_rng(5)
    for size in (3, 12, 40):
        model = walks(size, rng, 0.05)
        goal = np.arange(size) == size - 1
        ask = {"maximize": maximize, "helpful": not maximize}
        found = interval_values.reachability(model, goal, **ask)
        with monkeypatch.context() as patch:
            patch.setattr(interval_values, "_opposed_reachability", lambda *_: None)
            other = interval_values.reachability(model, goal, **ask)
        assert (found.upper - found.lower <= 1e-6).all()
        assert (found.lower <= other.upper).all() and (other.lower <= found.upper).all()


@pytest.mark.parametrize("maximize", (True, False))
def test_who_could_go_round_where_nothing_is_lost(maximize, monkeypatch):
    """Values within rounding of one (or of zero) among choices that stay for ages."""
    monkeypatch.setattr(interval_optimum, "_LARGE", 50)
    model = walks(201, np.random.default_rng(6), 0.3)
    goal = np.arange(201) == 200
    found = interval_values.reachability(model, goal, maximize=maximize, helpful=maximize)
    assert (found.upper - found.lower <= 1e-6).all()
    assert found.lower[100] > 1 - 1e-6 if maximize else found.upper[100] < 1e-6


@pytest.mark.parametrize("mixes", (True, False))
def test_systems_of_changing_choices(mixes, monkeypatch):
    monkeypatch.setattr("jaxltl.core.host.interval_systems._DIRECT", 0)
    rng = np.random.default_rng(7)
    dense = rng.random((60, 60)) * (rng.random((60, 60)) < 0.1)
    dense = 0.95 * dense / np.maximum(dense.sum(1), 1)[:, None]
    systems, x = Systems(lambda: np.zeros(60, np.int64), mixes), np.zeros(60)
    for _ in range(4):
        dense[rng.integers(60)] *= 0.5
        b = rng.random(60)
        x = systems.solve(sparse.csr_array(dense), b, x, 1e-9)
        np.testing.assert_allclose(x, np.linalg.solve(np.eye(60) - dense, b), atol=1e-6)
