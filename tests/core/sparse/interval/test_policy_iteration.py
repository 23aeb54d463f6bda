"""Bounds of both sides at once: against those that solve one player inside the other."""

from fractions import Fraction

import numpy as np
import pytest
from scipy import sparse

from jaxltl.core.models.interval import interval_rows
from jaxltl.core.sparse.interval import policy_iteration as interval_optimum
from jaxltl.core.sparse.interval import reachability as interval_values
from jaxltl.core.sparse.interval.policy_iteration import PathAccuracy, PathProblem
from jaxltl.core.sparse.interval.robust_values import Query
from jaxltl.core.sparse.interval.row_operator import PolicyPair
from jaxltl.core.sparse.linear import elimination
from jaxltl.core.sparse.linear.elimination import SystemSequence


def walks(size, rng, drift):
    """A walk on a line with two choices, which some of both keep in the middle; ends absorb."""
    rows, lower, upper = [], [], []
    for s in range(size):
        for up in (0.5,) if s in (0, size - 1) else (0.5 + drift, 0.5 - drift):
            rows.append([s] if s in (0, size - 1) else [s - 1, s, s + 1])
            p = np.array([1.0] if len(rows[-1]) == 1 else [0.9 * (1 - up), 0.1, 0.9 * up])
            wide = 0 if p.size == 1 else 0.1 * rng.random(p.size)
            lower.append(p * (1 - wide))
            upper.append(np.minimum(p * (1 + wide), 1))
    starts = np.cumsum([0, *map(len, rows)])
    many = np.cumsum([0, *(1 if s in (0, size - 1) else 2 for s in range(size))])
    return interval_rows(
        many, starts, np.concatenate(rows), np.concatenate(lower), np.concatenate(upper)
    ).host


@pytest.mark.parametrize("maximize", (True, False))
def test_both_sides_at_once(maximize, monkeypatch):
    rng = np.random.default_rng(5)
    for size in (3, 12, 40):
        model = walks(size, rng, 0.05)
        goal = np.arange(size) == size - 1
        ask = Query(maximize, not maximize)
        found = interval_values.reachability(model, goal, ask)
        with monkeypatch.context() as patch:
            patch.setattr(interval_values, "_opposed", lambda *_: None)
            other = interval_values.reachability(model, goal, ask)
        assert (found.upper - found.lower <= 1e-6).all()
        assert (found.lower <= other.upper).all() and (other.lower <= found.upper).all()


@pytest.mark.parametrize("maximize", (True, False))
def test_who_could_go_round_where_nothing_is_lost(maximize, monkeypatch):
    """Values within rounding of one (or of zero) among choices that stay for ages."""
    monkeypatch.setattr(interval_optimum, "_LARGE", 50)
    model = walks(201, np.random.default_rng(6), 0.3)
    goal = np.arange(201) == 200
    found = interval_values.reachability(model, goal, Query(maximize, maximize))
    assert (found.upper - found.lower <= 1e-6).all()
    assert found.lower[100] > 1 - 1e-6 if maximize else found.upper[100] < 1e-6


@pytest.mark.parametrize("mixes", (True, False))
def test_systems_of_changing_choices(mixes, monkeypatch):
    monkeypatch.setattr(elimination, "_DIRECT", 0)
    rng = np.random.default_rng(7)
    dense = rng.random((60, 60)) * (rng.random((60, 60)) < 0.1)
    dense = 0.95 * dense / np.maximum(dense.sum(1), 1)[:, None]
    systems, x = SystemSequence(lambda: np.zeros(60, np.int64), mixes), np.zeros(60)
    for _ in range(4):
        dense[rng.integers(60)] *= 0.5
        b = rng.random(60)
        x = systems.solve(sparse.csr_array(dense), b, x, 1e-9)
        np.testing.assert_allclose(x, np.linalg.solve(np.eye(60) - dense, b), atol=1e-6)


def test_systems_on_which_a_krylov_method_breaks_down():
    """Its first step is orthogonal to where it began."""
    systems = SystemSequence(lambda: np.array([1, 0]), True)
    matrix = sparse.csr_array([[0, 2.0], [0, 0]])
    assert systems.solve(matrix, np.ones(2), np.zeros(2), 1e-9).tolist() == [3, 1]


@pytest.mark.parametrize("maximize", (True, False))
def test_who_may_stay_for_ever_proves_nothing(maximize):
    """Nature may stay in state 0, where nothing is gained or lost; what is claimed is false."""
    host = interval_rows(
        [0, 1, 2, 3, 4],
        [0, 2, 4, 5, 6],
        [0, 1, 2, 3, 2, 3],
        [0, 0, 0.5, 0.5, 1, 1],
        [1, 1, 0.5, 0.5, 1, 1],
    ).host
    open_, known = np.array([True, True, False, False]), np.array([0, 0, 1.0, 0])
    nodes = PathProblem(
        host, open_, known, np.zeros(4), np.arange(4), maximize=maximize, adversarial=True
    ).operator()
    here = PolicyPair(np.array([0, 1]), nodes.interior(), np.zeros(2), np.ones(2))
    if maximize:  # nature stays, and the target is never reached
        assert not nodes.proves_attained(np.array([0.3, 0.4]), here)
    else:  # nature goes on, and has a half
        assert nodes.proves_upper_bound(np.array([-0.9, -0.4])) is None
        assert nodes.proves_upper_bound(np.array([-0.3, -0.4])) is not None


@pytest.mark.parametrize("against", (True, False))
def test_what_is_nearly_certain_is_proven_too(against):
    host = interval_rows(
        None, [0, 2, 3, 4], [1, 2, 1, 2], [0.9999, 1e-4, 1, 1], [0.9999, 1e-4, 1, 1]
    ).host
    nodes = PathProblem(
        host,
        np.arange(3) == 0,
        np.array([0, 1.0, 0]),
        np.zeros(3),
        np.arange(3),
        maximize=True,
        adversarial=against,
    ).operator()
    assert nodes.proves_upper_bound(np.array([0.9995])) is None
    assert nodes.proves_upper_bound(np.array([0.99995])) is not None
    assert nodes.proves_upper_bound(np.array([1.0])) is not None


@pytest.mark.parametrize("against", (True, False))
def test_what_rows_gain_is_bounded_with_its_rounding(against):
    """By exact fractions, of rows that mostly stay and leave what rounding makes to the rest."""
    rng = np.random.default_rng(8)
    many = 60
    leave = 10.0 ** rng.uniform(-12, -1, many)
    low = leave[:, None] * rng.random((many, 2)) / 4
    high = low + leave[:, None] * rng.random((many, 2))
    stays = 1 - leave * (1 - rng.random(many) / 8)
    lower = np.append(np.column_stack([1 - leave * 1.5, low]).ravel(), [1, 1])
    upper = np.append(np.column_stack([stays, high + leave[:, None]]).ravel(), [1, 1])
    host = interval_rows(
        [0, many, many + 1, many + 2],
        [*range(0, 3 * many + 1, 3), 3 * many + 1, 3 * many + 2],
        [0, 1, 2] * many + [1, 2],
        lower,
        upper,
    ).host
    nodes = PathProblem(
        host,
        np.array([True, False, False]),
        np.array([0, 0.83, 0.1]),
        rng.random(many + 2) * 1e-9,
        np.arange(3),
        maximize=True,
        adversarial=against,
    ).operator()
    value = rng.random(1)
    (block,) = nodes.blocks
    gain = block.differences(nodes.values(value))
    least, most = (
        nodes.gain_bound(
            block, gain, nodes.answer(block, gain), sign, over_all=(sign > 0) != against
        )
        for sign in (-1, 1)
    )
    ahead = [Fraction(float(x)) - Fraction(float(value[0])) for x in (value[0], 0.83, 0.1)]
    order = sorted(range(3), key=lambda k: ahead[k], reverse=not against)
    for i, r in enumerate(block.table.row):
        mine = slice(3 * r, 3 * r + 3)
        p, ends = ([Fraction(float(x)) for x in of[mine]] for of in (host.lower, host.upper))
        for k in order:
            p[k] += min(ends[k] - p[k], 1 - sum(p))
        exact = sum(x * y for x, y in zip(p, ahead, strict=True)) + Fraction(float(nodes.cost[r]))
        assert Fraction(float(least[i])) <= exact <= Fraction(float(most[i]))


def test_who_goes_round_where_nothing_is_lacking_attains_that(monkeypatch):
    """A walk that is held in its middle, nearly worth one: its steps there need not be dear."""
    size, goal = 60, np.arange(60) == 59
    model = walks(size, np.random.default_rng(5), 0.1)
    problem = PathProblem(
        model,
        (np.arange(size) > 0) & ~goal,
        goal.astype(float),
        np.zeros(model.mdp.num_rows),
        np.arange(size),
        maximize=True,
    )
    nodes = problem.operator()
    search = interval_optimum._PolicySearch(nodes, PathAccuracy(1e-6), False)
    chosen, p = nodes.exit_rows(positive=True), nodes.interior()
    begin = PolicyPair(chosen, p, np.zeros(nodes.size), np.ones(nodes.size))
    far = search.upper_bound(search.approximate(begin) or begin)
    assert far is not None and not far.steps.all()
    near = search.proportional_bound(far)
    assert near is not None
    chain = nodes.system(near)
    value = np.linalg.solve(np.eye(nodes.size) - chain.matrix.toarray(), chain.earned)
    assert (near.bound <= value + 1e-12).all() and (value - near.bound).max() < 1e-9
    found = interval_optimum.enclose_paths(problem, PathAccuracy(1e-6))
    open_ = problem.interior
    assert (found.beyond - found.attained)[open_].max() < 6e-7
    monkeypatch.setattr(interval_optimum._PolicySearch, "proportional_bound", lambda *_: None)
    other = interval_optimum.enclose_paths(problem, PathAccuracy(1e-6))
    assert (found.attained <= other.beyond + 1e-12)[open_].all()
    assert (other.attained <= found.beyond + 1e-12)[open_].all()


@pytest.mark.parametrize("maximize", (True, False))
@pytest.mark.parametrize("adversarial", (True, False))
def test_refined_bounds_are_narrower_and_agree(maximize, adversarial):
    """Walks that last up to 10^8 steps: bounds beyond the rounding of one float in each step."""
    rng = np.random.default_rng(12)
    for size in (8, 40, 70):
        model, goal = walks(size, rng, 0.1), np.arange(size) == size - 1
        open_ = (np.arange(size) > 0) & ~goal
        problem = PathProblem(
            model,
            open_,
            goal.astype(float),
            np.zeros(model.mdp.num_rows),
            np.arange(size),
            maximize=maximize,
            adversarial=adversarial,
        )
        found = interval_optimum.enclose_paths(problem, PathAccuracy(1e-6))
        search = interval_optimum._PolicySearch(problem.operator(), PathAccuracy(1e-6), False)
        operator = search.operator
        begin = PolicyPair(
            operator.exit_rows(positive=maximize),
            operator.interior(),
            np.zeros(operator.size),
            np.ones(operator.size),
        )
        pair = search.approximate(begin)
        upper, attained = (search.refined_bound(pair, side, 1e-10) for side in (1, -1))
        assert upper is not None and attained is not None
        assert (attained.bound <= upper.bound).all()
        assert (upper.bound - attained.bound).max() <= 1e-10
        sign = 1 if maximize else -1
        beyond, within = sign * found.beyond[open_], sign * found.attained[open_]
        assert (attained.bound <= beyond + 1e-15).all() and (within <= upper.bound + 1e-15).all()
