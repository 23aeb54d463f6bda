"""Steps and budgets of games: mixed policies, choices of each step, and long horizons."""

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.sparse.bounded import backup
from jaxltl.core.types import check
from jaxltl.core.values.engine.row_form import row_of_action
from jaxltl.core.values.undiscounted.step_bounded import (
    bounded_reachability,
    cumulative_reward,
    instantaneous_reward,
    next_probability,
    reward_bounded_reachability,
)
from tests.model_kinds import KINDS, Subject
from tests.reference_matrix import random_case, vertices

BEST = {1: max, -1: min}


def recursion(s: Subject, weight, number, start, update, objective, nature):
    """Steps in which the system draws its action by weights, and all others optimise."""
    aims, case, value = s.aims(objective, nature), s.case, start
    towards = BEST.get(aims.nature, max)
    for _ in range(number):
        ahead = []
        for state in range(case.num_states):
            worth = {
                a: towards(
                    update(state, row @ value, case.reward[state, a])
                    for row in vertices(case, state, a, aims.nature != 0)
                )
                for a in np.flatnonzero(case.available[state])
            }
            if case.system[state] or not s.is_game:
                ahead.append(sum(weight[state, a] * x for a, x in worth.items()))
            else:
                ahead.append(BEST[aims.environment](worth.values()))
        value = np.array(ahead)
    return value


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_mixed_policies_are_evaluated(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    for objective, helpful in (("max", False), ("min", False), ("max", True)):
        s = Subject(kind, random_case(rng, 4, is_chain=kind[0] == "chain"))
        case = s.case
        weight = rng.choice([0.0, 0.25, 1.0], case.available.shape) + 2.0**-10
        weight *= case.available
        weight /= weight.sum(1, keepdims=True)
        nature = "cooperative" if helpful and s.has_intervals else None
        ask = {"objective": objective, "nature": nature, "policy": s.of_actions(weight)}
        a, b, zero = case.a, case.b, np.zeros(4)
        asked = (weight, objective, nature)

        def exact(number, start, update, asked=asked, s=s):
            weight, objective, nature = asked
            return recursion(s, weight, number, start, update, objective, nature)

        goal, stay = s.mask(b), s.mask(a)
        for found, expected in (
            (
                bounded_reachability(s.model, goal, 3, stay=stay, **ask),
                exact(3, b * 1.0, lambda t, x, _, a=a, b=b: 1.0 if b[t] else a[t] * x),
            ),
            (next_probability(s.model, goal, **ask), exact(1, b * 1.0, lambda t, x, _: x)),
            (
                cumulative_reward(s.model, s.reward, 3, **ask),
                exact(3, zero, lambda t, x, paid: x + paid),
            ),
        ):
            check(found)
            expected = np.broadcast_to(expected[:, None], (4, s.memory)).reshape(found.value.shape)
            assert (found.lower <= expected + 1e-14).all(), (found.lower, expected)
            assert (found.upper >= expected - 1e-14).all(), (found.upper, expected)
            assert (found.upper - found.lower).max() < 1e-11


def random_game(seed, base="sparse"):
    rng = np.random.default_rng(seed)
    case = random_case(rng, 6)
    return rng, case, Subject((base, 1, 0), case).model


@pytest.mark.parametrize("seed", range(8))
def test_choices_of_all_steps_attain_the_value_of_a_game(seed):
    _, case, game = random_game(seed)
    host, target, num_steps = game.mdp.host, case.b, 6
    found = bounded_reachability(game, target, num_steps, by_step=True)
    value = target.astype(float)
    rows = np.stack([row_of_action(game.mdp, x) for x in found.policy[::-1]])
    for row in rows:
        assert (host.state[row] == np.arange(6)).all()
        value = np.where(target, 1, host.expectation(value)[row])
    np.testing.assert_allclose(value, found.value, atol=1e-14)
    # No other choice of either player is better, in the last of these steps.
    later = bounded_reachability(game, target, num_steps - 1).value
    image = host.expectation(later)
    for s in np.flatnonzero(~target):
        best = max if case.system[s] else min
        assert best(image[host.state == s]) == pytest.approx(found.value[s], abs=1e-14)


@pytest.mark.few(4, 6)
@pytest.mark.parametrize("base", ["sparse", "rows"])
@pytest.mark.parametrize("seed", range(12))
def test_bounds_of_remaining_steps_enclose_all_backups(seed, base, monkeypatch):
    rng, case, game = random_game(seed, base)
    target, stay, num_steps = case.b, rng.random(6) < 0.8, int(rng.integers(3, 300))
    reward = rng.random(case.available.sum()) * (rng.random(case.available.sum()) < 0.6)
    reward -= seed % 4 == 1
    state, count = rng.random(6) - (seed % 4 == 2), case.available.sum(1)
    weight = rng.random(reward.size) + 0.1
    weight /= np.add.reduceat(weight, np.cumsum(count) - count).repeat(count)

    def answers():
        for objective in ("max", "min"):
            for policy in (None, weight):
                ask = {"objective": objective, "policy": policy}
                yield bounded_reachability(game, target, num_steps, stay=stay, **ask)
                yield cumulative_reward(game, reward, num_steps, **ask)
                yield instantaneous_reward(game, state, num_steps, **ask)

    whole = list(answers())
    for long, close, work in ((2, 1e-9, 2.0**38), (2, 1e-2, 2.0**38), (2, 0.0, 600_000.0)):
        for name, x in (("LONG", long), ("CLOSE", close), ("_WORK", work)):
            monkeypatch.setattr(backup, name, x)
        for exact, found in zip(whole, answers(), strict=True):
            assert (found.lower <= exact.upper + 1e-12).all()
            assert (exact.lower <= found.upper + 1e-12).all()


@pytest.mark.parametrize("rate", [0.5, 1e-7])
def test_a_huge_number_of_steps_of_a_game_is_answered_by_the_limit(rate):
    # The system starts the race, slowly; the environment chooses between two coins at its end.
    world = jl.make_sparse(
        [0, 1, 3, 4, 5],
        [0, 2, 4, 6, 7, 8],
        [0, 1, 2, 3, 2, 3, 2, 3],
        [1 - rate, rate, 0.25, 0.75, 0.5, 0.5, 1, 1],
    )
    target = np.arange(4) == 2
    for system, value in (([1, 0, 1, 1], 0.25), ([0, 1, 0, 0], 0.5)):
        game = jl.make_game(world, np.array(system, bool))
        found = check(bounded_reachability(game, target, 10**11))
        assert found.lower[0] <= value <= found.upper[0] <= found.lower[0] + 1e-8
        assert found.num_steps < 10**5


@pytest.mark.parametrize("seed", range(6))
def test_budgets_of_a_mixed_policy_are_those_of_its_chain(seed):
    rng, case, game = random_game(seed)
    world, count = game.mdp, case.available.sum(1)
    cost = rng.choice([0.0, 0.0, 0.5], 6)  # of states, so that some cycles are free
    weight = rng.random(count.sum()) + 0.1
    weight /= np.add.reduceat(weight, np.cumsum(count) - count).repeat(count)
    host = world.host
    matrix = np.add.reduceat(weight[:, None] * host.matrix.toarray(), host.row_start[:-1], axis=0)
    chain = jl.to_sparse(jl.from_dense(matrix[:, None]))
    for bound in (0.0, 1.0, 2.5):
        exact = reward_bounded_reachability(chain, case.b, cost, bound)
        found = check(reward_bounded_reachability(world, case.b, cost, bound, policy=weight))
        np.testing.assert_allclose(found.value, exact.value, atol=1e-6)
        assert (found.lower <= exact.upper + 1e-6).all()
        assert (found.upper >= exact.lower - 1e-6).all()


def test_too_large_budgets_of_games_are_refused(monkeypatch):
    _, case, game = random_game(0)
    with pytest.raises(ValueError, match="round the rewards to a larger unit"):
        reward_bounded_reachability(game, case.b, np.full(6, 1.0), 3e6)
