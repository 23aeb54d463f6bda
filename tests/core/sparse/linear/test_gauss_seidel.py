"""Sweeps in place enclose what elimination encloses, or say that they cannot."""

import numpy as np
import pytest

from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.sparse.linear import gauss_seidel as relaxation
from jaxltl.core.sparse.solvers import discounted
from jaxltl.core.sparse.solvers import reachability as optimal
from jaxltl.core.sparse.solvers.policy_iteration import policy_iteration
from jaxltl.core.sparse.solvers.shortest_path_problem import ShortestPathProblem
from tests.sparse_models import random_sparse


@pytest.fixture
def always(monkeypatch):
    """Sweeps are tried whatever the model, and their answers counted."""
    found = []

    def tried(problem, **options):
        enclosed = optimal.sweep_shortest_path(problem, **options)
        found.append(enclosed)
        return policy_iteration(problem, **options) if enclosed is None else enclosed

    monkeypatch.setattr(optimal, "solve_shortest_path", tried)
    monkeypatch.setattr(discounted, "solve_shortest_path", tried)
    return found


def cases(count, seed, **options):
    rng = np.random.default_rng(seed)
    for i in range(count):
        size = int(rng.integers(3, 30))
        host = random_sparse(rng, size, chain=i % 4 == 0, **options).host
        yield rng, host, rng.random(size) < 0.15


def agree(ours, other, relative=False):
    size = np.maximum(other.upper, 1) if relative else 1.0
    finite = np.isfinite(other.upper)
    assert (np.isfinite(ours.upper) == finite).all()
    slack = 1e-13 * size
    assert (np.maximum(ours.lower, other.lower) <= np.minimum(ours.upper, other.upper) + slack)[
        finite
    ].all()
    assert ((ours.lower <= ours.value) & (ours.value <= ours.upper))[finite].all()


def reaches(host, row, goal, ends):
    """The probability of being at a goal after 2^30 steps of a policy, by squaring."""
    chain = np.where(ends[:, None], np.eye(goal.size), host.matrix.toarray()[row])
    for _ in range(30):
        chain = chain @ chain
        chain /= chain.sum(1, keepdims=True)
    return chain @ goal


@pytest.mark.parametrize("count", [40, pytest.param(4000, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("maximize", [True, False])
def test_probabilities(always, maximize, count, monkeypatch):
    for rng, host, goal in cases(count, 1):
        stay = rng.random(goal.size) < 0.8
        asked = {"maximize": maximize, "stay": stay, "tolerance": 1e-7}
        ours = optimal.reachability(host, goal, **asked)
        with monkeypatch.context() as patch:
            patch.setattr(optimal, "solve_shortest_path", policy_iteration)
            other = optimal.reachability(host, goal, **asked)
        agree(ours, other)
        assert (ours.upper - ours.lower).max() <= 1e-7
        attained = reaches(host, ours.row, goal, goal | ~stay)
        if maximize:
            assert (attained >= ours.lower - 1e-9).all()
        else:
            assert (attained <= ours.upper + 1e-9).all()
    swept = [x is not None for x in always]
    assert len(swept) > count / 4
    assert np.mean(swept) > 0.8


@pytest.mark.parametrize("maximize", [True, False])
def test_rewards(always, maximize, monkeypatch):
    for rng, host, goal in cases(40, 2):
        reward = np.where(rng.random(host.num_rows) < 0.3, 0, rng.random(host.num_rows) * 1e3)
        ours = optimal.total_reward(host, reward, goal, maximize=maximize, tolerance=1e-7)
        with monkeypatch.context() as patch:
            patch.setattr(optimal, "solve_shortest_path", policy_iteration)
            other = optimal.total_reward(host, reward, goal, maximize=maximize, tolerance=1e-7)
        agree(ours, other, relative=True)
    assert np.mean([x is not None for x in always]) > 0.5


def test_only_what_spreads_is_swept(monkeypatch):
    """A few steps from a state lead to many, on a random graph, or to few, on a line."""
    rng = np.random.default_rng(3)
    size = 6000
    where = np.arange(size)
    near = (where[:, None] + np.arange(4)) % size
    for target, spreads in ((rng.integers(0, size, (size, 4)), True), (near, False)):
        target = np.sort(target, -1)
        kept = np.diff(target, axis=-1, prepend=-1) > 0
        weight = np.where(kept, 1 / kept.sum(-1, keepdims=True), 0)
        host = make_sparse(
            None, np.concatenate([[0], kept.sum(-1).cumsum()]), target[kept], weight[kept]
        ).host
        problem = ShortestPathProblem(host, np.ones(size, bool), np.zeros(size), np.zeros(size))
        monkeypatch.setattr(optimal, "_LARGE", size)
        assert optimal.mixes(problem, size) == spreads


def test_small_models_of_wide_rows_are_swept_too():
    """Elimination would fill all of them; what is found is the same."""
    rng = np.random.default_rng(5)
    size, width = 500, 60
    target = np.sort(np.stack([rng.permutation(size)[:width] for _ in range(size)]), -1)
    host = make_sparse(
        None, width * np.arange(size + 1), target.ravel(), np.full(target.size, 1 / width)
    ).host
    goal = np.arange(size) < 50
    ours = optimal.total_reward(host, np.ones(size), goal, maximize=False)
    assert ours.method == "sweeps in place"
    nodes = np.flatnonzero(~goal)
    inner = np.zeros((size, size))
    np.add.at(inner, (np.repeat(np.arange(size), width), target.ravel()), 1 / width)
    exact = np.linalg.solve(np.eye(nodes.size) - inner[nodes][:, nodes], np.ones(nodes.size))
    assert (ours.lower[nodes] <= exact * (1 + 1e-12)).all()
    assert (exact <= ours.upper[nodes] * (1 + 1e-12)).all()
    assert (ours.upper - ours.lower <= 1e-6 * ours.upper).all()


def test_what_mixes_slowly_is_left_to_others():
    """A walk on a long line: sweeps would take as long as it does."""
    size = 300
    where = np.arange(1, size - 1)
    host = make_sparse(
        None,
        [0, 1, *(2 * where + 1), 2 * size - 2],
        [0, *np.stack([where - 1, where + 1], -1).ravel(), size - 1],
        [1, *[0.5] * (2 * size - 4), 1],
    ).host
    open_ = (np.arange(size) > 0) & (np.arange(size) < size - 1)
    goal = (np.arange(size) == 0).astype(float)
    problem = ShortestPathProblem(host, open_, goal, np.zeros(size))
    assert (
        optimal.sweep_shortest_path(problem, maximize=True, tolerance=1e-8, relative=False) is None
    )
    found = optimal.solve_shortest_path(problem, maximize=True, tolerance=1e-8, relative=False)
    np.testing.assert_allclose(found.value, 1 - np.arange(size) / (size - 1), atol=1e-8)


@pytest.mark.parametrize("maximize", [True, False])
def test_what_sweeps_leave_unsolved_is_not_proven(always, maximize, monkeypatch):
    """Sweeps that end much too early find bounds that hold, or none."""
    sweep = relaxation._SweepSearch.sweep
    monkeypatch.setattr(
        relaxation._SweepSearch,
        "sweep",
        lambda self, value, extra, rough: sweep(self, value, extra, max(rough, 0.2)),
    )
    for rng, host, goal in cases(40, 4):
        stay = rng.random(goal.size) < 0.8
        asked = {"maximize": maximize, "stay": stay, "tolerance": 1e-7}
        ours = optimal.reachability(host, goal, **asked)
        with monkeypatch.context() as patch:
            patch.setattr(optimal, "solve_shortest_path", policy_iteration)
            agree(ours, optimal.reachability(host, goal, **asked))
    assert any(x is None for x in always)
