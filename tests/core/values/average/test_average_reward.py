"""Long-run averages: all memoryless policies in fractions, slow chains, and Storm."""

import itertools
from fractions import Fraction

import numpy as np
import pytest

from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.core.sparse.graph.components import strong_components
from jaxltl.core.sparse.solvers.average_reward import average
from jaxltl.core.types import check
from jaxltl.core.values.average.average_reward import average_reward
from tests.sparse_models import (
    exact_matrix,
    exact_solve,
    random_sparse,
    storm_model,
    storm_values,
)


def exact_average(chain, reward):
    """Long-run averages of a chain in fractions: of its closed classes, and of reaching these."""
    size = len(reward)
    source, target = np.nonzero(np.array([[bool(x) for x in row] for row in chain]))
    label = strong_components(source, target, size)
    closed = [
        c
        for c in np.unique(label)
        if all(label[t] == c for s, t in zip(source, target, strict=True) if label[s] == c)
    ]
    value = [Fraction(0)] * size
    for c in closed:
        states = np.flatnonzero(label == c)
        # The stationary distribution: one balance equation gives way to the sum of all.
        rows = [[chain[t][s] - (s == t) for t in states] for s in states[1:]]
        share = exact_solve(
            [[Fraction(1)] * len(states), *rows], [Fraction(1)] + [Fraction(0)] * (len(states) - 1)
        )
        for s in states:
            value[s] = sum((p * reward[t] for p, t in zip(share, states, strict=True)), Fraction(0))
    rest = [s for s in range(size) if label[s] not in closed]
    if rest:
        system = [[Fraction(s == t) - chain[s][t] for t in rest] for s in rest]
        known = [
            sum((chain[s][t] * value[t] for t in range(size) if t not in rest), Fraction(0))
            for s in rest
        ]
        for s, x in zip(rest, exact_solve(system, known), strict=True):
            value[s] = x
    return value


def exact_optimum(model, reward, best):
    matrix = exact_matrix(model)
    choices = [range(*model.row_start[s : s + 2]) for s in range(model.num_states)]
    values = [
        exact_average([matrix[r] for r in policy], [reward[r] for r in policy])
        for policy in itertools.product(*choices)
    ]
    return [best(x) for x in zip(*values, strict=True)]


@pytest.mark.few(12)
@pytest.mark.parametrize("seed", range(30))
def test_bounds_enclose_the_best_of_all_policies(seed):
    rng = np.random.default_rng(seed)
    size = int(rng.integers(2, 5))
    model = random_sparse(
        rng, size, chain=seed % 5 == 0, width=int(rng.integers(1, 3)), fractions=8
    )
    reward = rng.integers(-2, 3, model.num_rows) / (1 + seed % 3)
    exact = [Fraction(float(x)) for x in reward]
    matrix = exact_matrix(model)
    for objective, best in (("max", max), ("min", min)):
        found = check(average_reward(model, Rewards(choice=reward), objective=objective))
        value = exact_optimum(model, exact, best)
        for low, x, high in zip(found.lower, value, found.upper, strict=True):
            assert Fraction(float(low)) <= x <= Fraction(float(high))
            assert high - low <= 2e-6 * max(abs(x), 1e-6)
        row = model.row_start[:-1] + found.policy
        attained = exact_average([matrix[r] for r in row], [exact[r] for r in row])
        for low, x, high in zip(found.lower, attained, found.upper, strict=True):
            assert low - 1e-12 <= x <= high + 1e-12


def sticky_model(rng, num_states, digits, chain):
    """Rows with self-loops near 1: other transitions have probabilities down to 10**-digits."""
    start, successor, probability, row_start = [0], [], [], [0]
    for s in range(num_states):
        for _ in range(1 if chain else rng.integers(1, 4)):
            others = [t for t in range(num_states) if t != s]
            targets = rng.choice(others, rng.integers(1, 3), replace=False)
            weight = 10.0 ** -rng.uniform(0, digits, targets.size) / targets.size
            row = dict(zip(targets.tolist(), weight.tolist(), strict=True))
            row[s] = 1 - sum(row.values())
            successor += sorted(row)
            probability += [row[t] for t in sorted(row)]
            start.append(len(successor))
        row_start.append(len(start) - 1)
    return make_sparse(row_start, start, successor, probability)


@pytest.mark.parametrize("seed", range(24))
def test_self_loops_near_one_take_no_longer(seed):
    rng = np.random.default_rng(seed)
    model = sticky_model(rng, 4 if seed % 2 else 5, (9, 12, 15)[seed % 3], chain=not seed % 2)
    reward = rng.uniform(-1 if seed % 4 > 1 else 0, 1, model.num_rows)
    exact = [Fraction(float(x)) for x in reward]
    matrix = exact_matrix(model)
    for r, row in enumerate(matrix):  # the loop is what the other transitions leave
        s = int(model.host.state[r])
        row[s] = 1 - sum(x for t, x in enumerate(row) if t != s)
    choices = [range(*model.row_start[s : s + 2]) for s in range(model.num_states)]
    values = [
        exact_average([matrix[r] for r in policy], [exact[r] for r in policy])
        for policy in itertools.product(*choices)
    ]
    for objective, best in (("max", max), ("min", min)):
        found = check(average_reward(model, Rewards(choice=reward), objective=objective))
        assert found.num_steps < 5000  # value iteration takes 10**12
        for low, high, x in zip(found.lower, found.upper, zip(*values, strict=True), strict=True):
            assert Fraction(float(low)) <= best(x) <= Fraction(float(high))
            assert high - low <= 2e-6


@pytest.mark.parametrize("seed", range(12))
def test_bounds_enclose_however_narrow(seed):
    """With nothing but rounding between them, of rows that sum to one but for theirs."""
    rng = np.random.default_rng(seed)
    model = random_sparse(rng, int(rng.integers(3, 6)), chain=True)
    reward = rng.random(model.num_rows)
    matrix = [[x / sum(row) for x in row] for row in exact_matrix(model)]
    value = exact_average(matrix, [Fraction(float(x)) for x in reward])
    found = average_reward(model, Rewards(choice=reward), tolerance=0, max_steps=1000)
    for low, x, high in zip(found.lower, value, found.upper, strict=True):
        assert Fraction(float(low)) <= x <= Fraction(float(high))
        assert high - low < 1e-12


def test_a_component_is_left_where_that_is_best():
    """From the state where it can be left; the others go there, not round and round."""
    model = make_sparse([0, 2, 4, 6, 7], np.arange(8), [0, 1, 1, 2, 0, 3, 3], np.ones(7))
    reward = Rewards(choice=np.array([1.0, 0, 1.0, 0, 0, 0, 5.0]))
    found = check(average_reward(model, reward))
    assert found.policy.tolist() == [1, 1, 1, 0]
    np.testing.assert_allclose(found.value, 5)
    least = check(average_reward(model, reward, objective="min"))
    assert least.policy.tolist() == [1, 1, 0, 0]
    np.testing.assert_allclose(least.value, [0, 0, 0, 5], atol=1e-9)


def ring(num_states, leave):
    """States that are left by two choices, with small probabilities, forth and back."""
    rows = []
    for s in range(num_states):
        for rate in (leave, 2 * leave):
            row = {s: 1 - rate, (s + 1) % num_states: 0.6 * rate, (s - 1) % num_states: 0.4 * rate}
            rows.append(sorted(row.items()))
    start = np.concatenate([[0], np.cumsum([len(row) for row in rows])])
    entries = [x for row in rows for x in row]
    return make_sparse(
        np.arange(num_states + 1) * 2, start, [t for t, _ in entries], [p for _, p in entries]
    )


@pytest.mark.parametrize("leave", [0.4, 1e-3, 1e-9])
def test_how_slowly_it_mixes_does_not_matter(leave):
    reward = np.random.default_rng(0).random(60)
    model = ring(60, leave)
    for objective in ("max", "min"):
        found = check(average_reward(model, reward, objective=objective))
        assert (found.upper - found.lower).max() < 1e-6
        # What matters is where it stays; the speed is the same for all choices.
        same = average_reward(ring(60, 0.2), reward, objective=objective)
        np.testing.assert_allclose(found.value, same.value, atol=1e-6)


def test_circles_of_any_period_and_components_of_any_gain():
    size = 1000
    circle = make_sparse(None, np.arange(size + 1), (np.arange(size) + 1) % size, np.ones(size))
    reward = np.arange(size, dtype=float)
    found = check(average_reward(circle, reward))
    np.testing.assert_allclose(found.value, reward.mean(), rtol=1e-12)
    rare = make_sparse(None, [0, 2, 4], [0, 1, 0, 1], [1 - 1e-12, 1e-12, 1e-9, 1 - 1e-9])
    found = check(average_reward(rare, [0.0, 1.0]))
    np.testing.assert_allclose(found.value, 1e-12 / (1e-12 + 1e-9), rtol=1e-3)
    scales = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
    found = check(average_reward(scales, [0.0, 1e-9, 1e9]))
    np.testing.assert_allclose(found.value, [0.5e9 + 0.5e-9, 1e-9, 1e9], rtol=1e-12)


def test_what_is_wrong_is_named():
    model = make_sparse(None, [0, 1, 2], [1, 1], [1.0, 1.0])
    with pytest.raises(ValueError, match="make it finite"):
        average_reward(model, [np.inf, 1.0])
    with pytest.raises(ValueError, match="objective='sup'"):
        average_reward(model, [1.0, 1.0], objective="sup")
    with pytest.raises(ValueError, match="name the reward"):
        average_reward(model, None)


def lazy(model):
    """The same with a loop in every row: Storm does not end on some models with a period."""
    mdp = model.host
    start = mdp.entry_start + np.arange(model.num_rows + 1)
    first = mdp.entry_start[:-1]
    return make_sparse(
        model.row_start,
        start,
        np.insert(mdp.successor, first, mdp.state),
        np.insert(mdp.probability * 0.75, first, 0.25),
    )


@pytest.mark.parametrize("seed", range(8))
def test_storm_finds_the_same(seed):
    pytest.importorskip("stormpy")
    rng = np.random.default_rng(seed)
    model = lazy(random_sparse(rng, 12, chain=seed % 4 == 0, width=2))
    reward = Rewards(state=rng.random(12), choice=rng.random(model.num_rows))
    storm = storm_model(model, rewards={"r": reward})
    for objective in ("max", "min"):
        found = check(average_reward(model, reward, objective=objective))
        theirs = storm_values(storm, f'R{{"r"}}{objective}=? [ LRA ]')
        np.testing.assert_allclose(found.value, theirs, atol=1e-5)


def test_sweeps_that_would_not_end_are_not_waited_for():
    """A walk of many states mixes too slowly; that is seen after some sweeps."""
    size = 300
    states = np.arange(size)
    entry, target = (
        2 * np.arange(size + 1),
        np.stack([np.maximum(states - 1, 0), np.minimum(states + 1, size - 1)], 1),
    )
    model = make_sparse(None, entry, target.ravel(), np.full(2 * size, 0.5))
    reward = states / size
    found = average(model.host, reward, reward, tolerance=1e-6, max_steps=10**6)
    assert found.rounds < 150
    exact = (size - 1) / size / 2
    assert (found.lower <= exact).all() and (exact <= found.upper).all()
    assert (found.upper - found.lower <= 1e-6).all()
