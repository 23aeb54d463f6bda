"""Interval models whose runs hardly ever end: bounds that exclude something, whatever methods do."""

import itertools
from fractions import Fraction

import numpy as np
import pytest

from jaxltl.core.models.interval import interval_rows
from jaxltl.core.sparse.interval import policy_iteration
from jaxltl.core.sparse.interval import reachability as module
from jaxltl.core.sparse.interval.reachability import reachability
from jaxltl.core.sparse.interval.robust_values import Query
from jaxltl.core.sparse.interval.total_reward import total_reward
from jaxltl.core.sparse.interval.vertices import swept_bounds, vertex_model
from jaxltl.core.sparse.solvers.reachability import reachability as mdp_reachability
from tests.core.sparse.linear.test_ordered_sweeps import ends, robot

SIDES = list(itertools.product((True, False), repeat=2))


def uncertain_robot(size, battery, slip, wide):
    """The robot with intervals of probabilities, the model in the middle, and its start."""
    host, start = robot(size, battery, slip)
    p = host.probability
    off = np.where(p == 1, 0, wide)
    rows = host.row_start, host.entry_start, host.successor
    return interval_rows(*rows, p - off, p + off).host, host, start


@pytest.mark.parametrize("maximize, nature", SIDES)
def test_rewards_of_a_robot_that_charges_its_battery(maximize, nature):
    """The optimum waits for 1e15 steps at the charger before it delivers."""
    model, host, start = uncertain_robot(4, 9, 0.05, 0.01)
    done, dead = ends(host)
    delivers = host.successor[host.entry_start[:-1]] == host.num_states - 2
    reward = np.where(host.state < host.num_states - 2, 7.0 * delivers, 0)
    query = Query(maximize, nature)
    found = total_reward(model, reward, done | dead, query)
    assert (found.upper - found.lower <= 1e-5).all()
    chance = reachability(model, done, query)
    assert (7 * chance.lower <= found.upper + 1e-9)[:-2].all()  # the end itself earns nothing
    assert (found.lower <= 7 * chance.upper + 1e-9)[:-2].all()
    if maximize:
        assert found.lower[start] > 6


@pytest.mark.parametrize("maximize", (True, False))
@pytest.mark.parametrize("short", (True, False))
def test_bounds_without_policy_iteration(maximize, short, monkeypatch):
    monkeypatch.setattr(policy_iteration._Search, "upper_bound", lambda *_: None)
    monkeypatch.setattr(policy_iteration._Search, "long_runs", lambda *_: (None, None))
    if not short:
        monkeypatch.setattr(module, "vertex_model", lambda _: None)
    model, host, start = uncertain_robot(3, 7, 0.2, 0.1)
    done, dead = ends(host)
    for target in (done, dead):
        found = reachability(model, target, Query(maximize, maximize))
        middle = mdp_reachability(host, target, maximize=maximize)
        if maximize:
            assert (found.upper >= middle.lower).all()
        else:
            assert (found.lower <= middle.upper).all()
        assert (found.lower <= found.upper).all()
        limit = 1e-6 if short else 0.9
        assert found.upper[start] - found.lower[start] <= limit
    chance = reachability(model, done, Query(maximize, maximize))
    taken = model.mdp.entry_start[chance.row]
    assert (model.lower <= chance.probability + 1e-12).all() and taken.size
    assert (chance.probability <= model.upper + 1e-12).all()


def test_vertices_are_all_extreme_distributions():
    rng = np.random.default_rng(4)
    for width in (1, 2, 3, 4):
        for _ in range(5):
            p = rng.random(width)
            p /= p.sum()
            off = rng.choice([0, 0.1, 1], width) * rng.random(width) * (width > 1)
            lower, upper = np.maximum(p - off, 0), np.minimum(p + off, 1)
            rows = np.arange(width, dtype=np.int32)
            loops = np.concatenate([rows, rows[1:]])
            starts = np.concatenate([[0], np.arange(width, 2 * width)])
            one = np.ones(width - 1)
            model = interval_rows(
                np.arange(width + 1),
                starts,
                loops,
                np.concatenate([lower, one]),
                np.concatenate([upper, one]),
            ).host
            vertices = vertex_model(model)
            assert vertices is not None
            mine = np.flatnonzero(vertices.row == 0)
            found = vertices.mdp.matrix.toarray()[mine]
            low, high = (x[: model.mdp.entry_start[1]] for x in (model.lower, model.upper))
            where = model.mdp.successor[: low.size]
            for row in found[:, where]:
                assert abs(sum(map(Fraction, row.tolist())) - 1) <= 1e-15
                assert (low <= row).all() and (row <= high).all()
            for _ in range(10):
                weight = rng.standard_normal(width)
                best = model.extreme_distributions(weight[model.mdp.successor], maximize=True)[
                    : low.size
                ]
                assert abs((found @ weight).max() - best @ weight[where]) <= 1e-12


def test_swept_bounds_enclose_the_optimum():
    model, host, _ = uncertain_robot(2, 4, 0.25, 0.1)
    done, dead = ends(host)
    for maximize in (True, False):
        exact = reachability(model, done, Query(maximize, maximize))
        none = np.zeros(host.num_rows)
        low, high = swept_bounds(model, ~(done | dead), done.astype(float), none, maximize=maximize)
        assert (low <= exact.upper).all() and (exact.lower <= high).all()
        assert (low >= exact.lower - 1e-6).all()
