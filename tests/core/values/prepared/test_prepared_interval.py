"""Prepared solves of interval models against brute force and against the host's engine."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.models.interval import interval_rows
from jaxltl.core.types import Status
from jaxltl.core.values.interval.robust_policy_iteration import greedy_distributions
from jaxltl.core.values.interval.sensitivity import robust_sensitivity
from jaxltl.core.values.prepared.prepared import prepare, solve_prepared
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.core.values.undiscounted.total_reward import total_reward
from tests.reference_intervals import vertices
from tests.support import nature_word

DIRECTIONS = list(itertools.product(("max", "min"), repeat=2))
GOAL = np.array([True, False, False, False, False])
STAY = np.array([True, False, True, True, True])
# States 0 and 1 stand still; each other one has two rows of three successors.
ROW_START = [0, 1, 2, 4, 6, 8]
ENTRY_START = [0, 1, 2, 5, 8, 11, 14, 17, 20]


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


def _successors(rng):
    rows = [np.sort(rng.choice(5, 3, replace=False)) for _ in range(6)]
    return np.concatenate([[0, 1], *rows])


def _ends(rng, zeros):
    """Intervals in eighths around distributions; some lower ends are 0."""
    lower, upper = [1.0, 1.0], [1.0, 1.0]
    for r in range(6):
        p = rng.multinomial(5, np.ones(3) / 3) + 1
        a = np.maximum(p - rng.integers(0, 3, 3), 0 if zeros[r] else 1)
        lower += list(np.where(zeros[r], 0, a) / 8)
        upper += list(np.minimum(p + rng.integers(0, 3, 3), 8) / 8)
    return np.array(lower), np.array(upper)


def _model(successor, lower, upper):
    return interval_rows(ROW_START, ENTRY_START, successor, lower, upper, initial=np.ones(5) / 5)


def _by_force(model, cost=None):
    """Values of all policies and natures, ``[policies, natures, S]``, by squaring matrices."""
    mdp, rows = model.host.mdp, []
    for r in range(mdp.num_rows):
        part = slice(mdp.entry_start[r], mdp.entry_start[r + 1])
        corners = vertices(model.host.lower[part], model.host.upper[part])
        rows.append(np.zeros((len(corners), 5)))
        rows[r][:, mdp.successor[part]] = list(corners)
    found = []
    for policy in itertools.product((2, 3), (4, 5), (6, 7)):
        chains = [np.stack(x) for x in itertools.product(*(rows[r] for r in (0, 1, *policy)))]
        power = np.array(chains)
        for _ in range(50):
            power = power @ power
        reached = power[:, :, 0]
        if cost is None:
            found.append(reached)
            continue
        sure = reached > 1 - 1e-9
        moves = np.array(chains) * (sure & ~GOAL)[:, :, None] * (sure & ~GOAL)[:, None, :]
        paid = np.where(GOAL, 0, cost[[0, 1, *policy]]) * sure
        total = np.linalg.solve(np.eye(5) - moves, paid[..., None])[..., 0]
        found.append(np.where(sure, total, np.inf))
    return found


def _optimum(values, objective, nature):
    opt = {"max": np.max, "min": np.min}
    return opt[objective]([opt[nature](x, axis=0) for x in values], axis=0)


def _cases(seed, count):
    """A graph, and several ends with the same positive ones."""
    rng = np.random.default_rng(seed)
    successor, zeros = _successors(rng), rng.random(6) < 0.4
    ends = []
    while len(ends) < count:
        lower, upper = _ends(rng, zeros)
        if _model(successor, lower, upper).num_transitions == 20:
            ends.append((lower, upper))
    cost = np.array([0, 0, *rng.integers(0, 3, 6)], np.float64)
    return successor, *map(np.array, zip(*ends, strict=True)), cost


@pytest.mark.few(2)
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize(("objective", "nature"), DIRECTIONS)
def test_all_ends_of_a_batch_are_enclosed_as_by_brute_force(seed, objective, nature):
    successor, lower, upper, cost = _cases(seed, 12)
    model = _model(successor, lower[0], upper[0])
    for reward in (None, cost):
        prepared = prepare(
            model, GOAL, reward=reward, objective=objective, nature=nature_word(objective, nature)
        )
        solve = jax.jit(jax.vmap(lambda a, b, p=prepared: solve_prepared(p, lower=a, upper=b)))
        found = solve(lower, upper)
        assert int(found.status[0]) == Status.CONVERGED
        assert set(np.asarray(found.status).tolist()) <= {Status.CONVERGED, Status.INVALID}
        for i in np.flatnonzero(np.asarray(found.status) == Status.CONVERGED):
            value = _optimum(
                _by_force(_model(successor, lower[i], upper[i]), reward), objective, nature
            )
            finite = np.isfinite(value)
            low, high = np.asarray(found.lower[i]), np.asarray(found.upper[i])
            np.testing.assert_array_equal(np.isfinite(high), finite)
            size = 1 + value[finite]
            assert (low[finite] <= value[finite] + 1e-12 * size).all()
            assert (value[finite] <= high[finite] + 1e-12 * size).all()
            assert (high[finite] - low[finite] <= 1e-6 * size).all()


@pytest.mark.few(2)
@pytest.mark.parametrize(("objective", "nature"), DIRECTIONS)
def test_policy_and_nature_attain_what_they_are_shown_for(objective, nature):
    successor, lower, upper, _ = _cases(3, 1)
    model = _model(successor, lower[0], upper[0])
    found = solve_prepared(
        prepare(model, GOAL, stay=STAY, objective=objective, nature=nature_word(objective, nature))
    )
    host = reachability_probability(
        model, GOAL, stay=STAY, objective=objective, nature=nature_word(objective, nature)
    )
    p = np.asarray(found.nature)
    assert (p >= model.lower - 1e-15).all() and (p <= model.upper + 1e-15).all()
    np.testing.assert_allclose(np.add.reduceat(p, ENTRY_START[:-1]), 1, rtol=1e-14)
    fixed = _model(successor, p, np.maximum(p, 1e-300))  # what is left out has no room
    side = reachability_probability(fixed, GOAL, stay=STAY, objective=objective)
    mine = reachability_probability(
        model, GOAL, stay=STAY, policy=np.asarray(found.policy), nature=nature_word("max", nature)
    )
    np.testing.assert_allclose(mine.value, host.value, atol=2e-6)
    np.testing.assert_allclose(side.value, host.value, atol=2e-6)


@pytest.mark.slow
def test_given_policies_are_evaluated():
    successor, lower, upper, cost = _cases(4, 1)
    model = _model(successor, lower[0], upper[0])
    policy = np.array([0, 0, 1, 0, 1], np.int32)
    for nature in ("adversarial", "cooperative"):
        question = {"policy": policy, "nature": nature}
        found = solve_prepared(prepare(model, GOAL, **question))
        host = reachability_probability(model, GOAL, **question)
        np.testing.assert_allclose(found.value, host.value, atol=1e-6)
        np.testing.assert_array_equal(found.policy, policy)
        found = solve_prepared(prepare(model, GOAL, reward=cost, **question))
        host = total_reward(model, cost, GOAL, **question)
        np.testing.assert_allclose(found.value, host.value, rtol=1e-6)


# Compiling derivatives takes seconds; by default each direction and each question occurs.
@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("objective", "nature", "question"),
    [
        pytest.param(*ways, question, marks=[] if usual else pytest.mark.exhaustive)
        for i, ways in enumerate(DIRECTIONS)
        for usual, question in ((i in (0, 3), "probability"), (i in (1, 2), "reward"))
    ],
)
def test_derivatives_in_the_ends_are_differences(objective, nature, question):
    rng = np.random.default_rng(5)
    successor = np.concatenate([[0, 1], *([0, 1, s] for s in (2, 3, 4, 2, 3, 4))])
    p = np.concatenate([[1, 1], *rng.dirichlet(3 * np.ones(3), 6)])
    wide = np.concatenate([[0, 0], 0.3 * rng.random(18)])
    model = _model(successor, p * (1 - wide), np.minimum(p * (1 + wide), 1))
    way = rng.normal(size=(2, 20)) * (wide > 0)
    cost, weight = np.append([0, 0], rng.random(6)), rng.random(5)
    ask = {"objective": objective, "nature": nature_word(objective, nature)}
    reward = cost if question == "reward" else None
    # The reward is earned until either end is met, where it is finite.
    goal = GOAL if reward is None else ~np.array([False, False, True, True, True])

    def host(model):
        if reward is None:
            return reachability_probability(model, goal, stay=STAY, tolerance=1e-12, **ask)
        return total_reward(model, reward, goal, tolerance=1e-12, **ask)

    prepared = prepare(model, goal, stay=STAY if reward is None else None, reward=reward, **ask)

    def derivatives(ends):
        """The slope and the change on the way, both of one linear program."""
        _, forward = jax.linearize(
            lambda a, b: solve_prepared(prepared, lower=a, upper=b).value @ weight, *ends
        )
        return jax.linear_transpose(forward, *ends)(1.0), forward(*way)

    ends = np.asarray(model.lower), np.asarray(model.upper)
    there, back = (
        host(model.replace(lower=ends[0] + h * way[0], upper=ends[1] + h * way[1]))
        for h in (1e-6, -1e-6)
    )
    change = (there.value - back.value) @ weight / 2e-6
    assert abs(change) > 1e-4
    slope, forward = jax.jit(derivatives)(ends)
    small = robust_sensitivity(
        model,
        host(model),
        goal,
        **ask,
        initial=weight,
        stay=STAY if reward is None else None,
    )
    np.testing.assert_allclose(slope[0] @ way[0] + slope[1] @ way[1], change, rtol=1e-5)
    np.testing.assert_allclose(forward, change, rtol=1e-5)
    np.testing.assert_allclose(small.lower @ way[0] + small.upper @ way[1], change, rtol=1e-5)


@pytest.mark.slow
def test_other_graphs_are_refused_inside_jit():
    successor, lower, upper, _ = _cases(6, 1)
    model = _model(successor, lower[0], upper[0])
    prepared = prepare(model, GOAL, objective="max", nature="adversarial")

    def status(lower, upper):
        return int(solve_prepared(prepared, lower=lower, upper=upper).status)

    low, high = lower[0], upper[0]
    assert status(low, high) == Status.CONVERGED
    entry = 2 + int(np.argmax(low[2:] > 0))
    assert status(np.where(np.arange(20) == entry, 0, low), high) == Status.INVALID
    assert status(low, np.where(np.arange(20) == entry, 0, high)) == Status.INVALID
    assert status(high, low) == Status.INVALID
    assert status(low * np.nan, high) == Status.NONFINITE
    assert status(low, np.where(np.arange(20) < 5, high, low)) == Status.INVALID  # sums below one


def test_nature_that_may_drop_other_successors_is_refused():
    """State 1 reaches 0 surely only as long as nature cannot put all mass on what leads back."""

    def model(room):
        return interval_rows(None, [0, 1, 3], [0, 0, 1], [1, 0, 0], [1, 0.75, room])

    goal = np.array([True, False])
    prepared = prepare(model(0.5), goal, objective="min", nature="cooperative")
    ends = [(m.lower, m.upper) for m in map(model, (0.5, 0.75, 1.0))]
    found = [solve_prepared(prepared, lower=a, upper=b) for a, b in ends]
    assert [int(x.status) for x in found] == [Status.CONVERGED] * 2 + [Status.INVALID]
    assert float(found[0].value[1]) == 1
    again = prepare(model(1.0), goal, objective="min", nature="cooperative")
    assert float(solve_prepared(again).value[1]) == 0


@pytest.mark.parametrize("width", [3, 20])
def test_nature_gives_mass_in_order(width):
    rng = np.random.default_rng(width)
    p = rng.dirichlet(np.ones(width), 10)
    lower, upper = p * rng.random(p.shape), np.minimum(p * (1 + rng.random(p.shape)), 1)
    key = rng.integers(0, 5, p.shape).astype(float)
    found = greedy_distributions(*map(jnp.asarray, (lower, upper, key)))
    for mine, low, high, order in zip(found, lower, upper, key, strict=True):
        rest, best = 1 - low.sum(), low.copy()
        for i in np.argsort(order, kind="stable"):
            given = min(rest, high[i] - low[i])
            best[i], rest = best[i] + given, rest - given
        np.testing.assert_allclose(mine, best, atol=1e-15)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"stay": STAY, "reward": np.ones(8)}, "leave stay out"),
        ({"nature": "up"}, "nature='up'"),
        ({"objective": "policy"}, "objective='policy'"),
        ({"policy": np.full(5, 2, np.int32)}, "takes action 2 in state 0"),
        ({"policy": np.ones(8)}, "actions, int"),
        ({"reward": -np.ones(8)}, "at least 0"),
    ],
)
def test_misuse_is_told_in_words(change, words):
    successor, lower, upper, _ = _cases(0, 1)
    with pytest.raises(ValueError, match=words):
        prepare(_model(successor, lower[0], upper[0]), GOAL, **change)
