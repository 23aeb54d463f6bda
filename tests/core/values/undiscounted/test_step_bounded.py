"""Questions about so many steps or so much reward: explicit loops, fractions, and Storm."""

from fractions import Fraction

import numpy as np
import pytest

from jaxltl.core.models.interval import make_interval
from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.core.sparse.bounded import backup, reward_bounded
from jaxltl.core.sparse.bounded import step_bounded as bounded
from jaxltl.core.types import Status, check
from jaxltl.core.values.properties.solve_property import solve_property
from jaxltl.core.values.undiscounted.step_bounded import (
    bounded_reachability,
    cumulative_reward,
    instantaneous_reward,
    next_probability,
    reward_bounded_reachability,
)
from tests.sparse_models import BEST, exact_matrix, random_sparse, storm_model, storm_values


def exact_until(model, target, stay, num_steps, best):
    """The probability in fractions, state by state."""
    matrix = exact_matrix(model)
    value = [Fraction(int(t)) for t in target]
    for _ in range(num_steps):
        ahead = []
        for s in range(model.num_states):
            sums = [
                sum((p * x for p, x in zip(matrix[r], value, strict=True)), Fraction(0))
                for r in range(*model.row_start[s : s + 2])
            ]
            ahead.append(Fraction(1) if target[s] else best(sums) if stay[s] else Fraction(0))
        value = ahead
    return value


@pytest.mark.parametrize("seed", range(20))
def test_bounds_of_steps_enclose_exact_fractions(seed, monkeypatch):
    monkeypatch.setattr(bounded, "_MANY", 4)  # some with all states, some with those near enough
    rng = np.random.default_rng(seed)
    model = random_sparse(rng, 6, chain=seed % 4 == 0, fractions=64)
    target, stay = rng.random(6) < 0.3, rng.random(6) < 0.8
    num_steps = int(rng.integers(0, 7))
    for objective, best in (("max", max), ("min", min)):
        exact = exact_until(model, target, stay, num_steps, best)
        found = check(
            bounded_reachability(model, target, num_steps, stay=stay, objective=objective)
        )
        for low, x, high in zip(found.lower, exact, found.upper, strict=True):
            assert Fraction(float(low)) <= x <= Fraction(float(high))
            assert high - low < 1e-12
            assert (x in (0, 1)) == (low == high and low in (0, 1))


def test_what_rounding_takes_is_enclosed_and_no_probability_becomes_zero():
    model = make_sparse(None, [0, 2, 3, 4], [1, 2, 0, 2], [1e-200, 1 - 1e-200, 1, 1])
    lost = make_sparse(None, [0, 2, 4, 5, 6], [1, 3, 2, 3, 2, 3], [1e-200, 1, 1e-200, 1, 1, 1])
    found = bounded_reachability(lost, [False, False, True, False], 2)
    assert found.lower[0] == 0 < found.upper[0] < 1e-299
    assert found.upper[3] == 0
    assert bounded_reachability(model, [False, True, False], 5).value[0] == 1e-200


@pytest.mark.parametrize("seed", range(6))
def test_choices_of_all_steps_attain_the_value(seed):
    rng = np.random.default_rng(seed)
    model = random_sparse(rng, 8)
    mdp, target, num_steps = model.host, rng.random(8) < 0.3, 6
    reward = rng.random(model.num_rows)
    for objective in BEST:
        found = bounded_reachability(model, target, num_steps, objective=objective, by_step=True)
        value = target.astype(float)
        for row in model.row_start[:-1] + found.policy[::-1]:
            assert (mdp.state[row] == np.arange(8)).all()
            value = np.where(target, 1, mdp.expectation(value)[row])
        np.testing.assert_allclose(value, found.value, atol=1e-14)
        first = bounded_reachability(model, target, num_steps, objective=objective).policy
        assert (first == found.policy[0]).all()
        found = cumulative_reward(
            model, Rewards(choice=reward), num_steps, objective=objective, by_step=True
        )
        value = np.zeros(8)
        for row in model.row_start[:-1] + found.policy[::-1]:
            value = (reward + mdp.expectation(value))[row]
        np.testing.assert_allclose(value, found.value, atol=1e-14)


def test_nothing_more_happens_after_it_came_to_rest():
    model = make_sparse(None, [0, 1, 2, 3], [1, 2, 2], [1.0, 1.0, 1.0])
    found = bounded_reachability(model, [False, False, True], 10**6, by_step=False)
    assert found.num_steps == 3
    assert found.value.tolist() == [1, 1, 1]
    assert found.lower.tolist() == [1, 1, 1]


def by_levels(model, target, stay, cost, most, best, sweeps=400):
    """``x[l]``: the probability to reach the target at a cost of at most l, by plain sweeps."""
    mdp, found = model.host, np.zeros((most + 1, model.num_states))
    for level in range(most + 1):
        for _ in range(sweeps):
            left = level - cost
            ahead = np.where(left >= 0, found[np.maximum(left, 0), mdp.successor], 0)
            image = np.bincount(mdp.row, mdp.probability * ahead, mdp.num_rows)
            found[level] = np.where(target, 1, np.where(stay, mdp.over_choices(best, image), 0))
    return found


@pytest.mark.few(12)
@pytest.mark.parametrize("depth", [1, 64, None])
@pytest.mark.parametrize("seed", range(16))
def test_rewards_are_spent_level_by_level(seed, depth, monkeypatch):
    monkeypatch.setattr(reward_bounded, "_DEPTH", depth)  # 1 leaves no substitution
    unfolded = depth is None
    rng = np.random.default_rng(seed)
    model = random_sparse(rng, 7, chain=seed % 4 == 0)
    target, stay = rng.random(7) < 0.25, rng.random(7) < 0.9
    cost = rng.choice([0, 0, 1, 2], model.num_transitions)
    if seed % 2:  # whole choices without cost, so that there are end components of them
        cost = rng.choice([0, 0, 0, 2], model.num_rows)[model.host.row]
    most = int(rng.integers(0, 5))
    for objective, best in BEST.items():
        expected = by_levels(model, target, stay, cost, most, best)
        found = check(
            reward_bounded_reachability(
                make_interval(model, *[model.probability] * 2) if unfolded else model,
                target,
                Rewards(transition=cost * 0.1),
                most * 0.1,
                stay=stay,
                objective=objective,
                by_level=True,
            )
        )
        np.testing.assert_allclose(found.value, expected[-1], atol=1e-8)
        assert (found.lower <= expected[-1] + 1e-9).all()
        assert (found.upper >= expected[-1] - 1e-9).all()
        # The choices attain it.
        value = np.zeros_like(expected)
        for level in range(len(expected) if found.num_steps == most + 1 else 0):
            row = model.row_start[:-1] + found.policy[level]
            for _ in range(400):
                left = level - cost
                ahead = np.where(left >= 0, value[np.maximum(left, 0), model.successor], 0)
                image = np.bincount(model.host.row, model.probability * ahead, model.num_rows)
                value[level] = np.where(target, 1, np.where(stay, image[row], 0))
            np.testing.assert_allclose(value[level], expected[level], atol=1e-8)


def test_what_is_wrong_is_named():
    model = make_sparse(
        None, [0, 1, 2], [1, 1], [1.0, 1.0], rewards={"r": Rewards(choice=[1.0, 0])}
    )
    goal = np.array([False, True])
    with pytest.raises(ValueError, match=r"target is \[0.5, 1.0\]"):
        bounded_reachability(model, [0.5, 1.0], 3)
    with pytest.raises(ValueError, match="num_steps=-1"):
        bounded_reachability(model, goal, -1)
    with pytest.raises(ValueError, match="objective='most'"):
        next_probability(model, goal, objective="most")
    with pytest.raises(ValueError, match="no reward 'q'"):
        cumulative_reward(model, "q", 3)
    with pytest.raises(ValueError, match="needs a reward on states"):
        instantaneous_reward(model, "r", 3)
    with pytest.raises(ValueError, match="state 0, choice 0 is inf"):
        cumulative_reward(model, [np.inf, 0], 3)
    with pytest.raises(ValueError, match="no unit in common"):
        reward_bounded_reachability(model, [False, False], [np.pi, 1e-9], 10.0)
    with pytest.raises(ValueError, match="needs rewards of at least 0"):
        reward_bounded_reachability(model, goal, [-1.0, 0], 10.0)
    with pytest.raises(ValueError, match="bound=-1"):
        reward_bounded_reachability(model, goal, "r", -1)


def test_too_many_roundings_are_said():
    ring = make_sparse(None, [0, 3, 4, 5, 6], [1, 2, 3, 0, 2, 3], [0.5, 0.25, 0.25, 1, 1, 1])
    found = check(bounded_reachability(ring, np.arange(4) == 2, 10**18))
    assert found.lower[0] <= 0.5 <= found.upper[0] <= found.lower[0] + 1e-8
    found = instantaneous_reward(ring, [0.0, 0.0, 1.0, -1.0], 10**18)
    assert found.lower[0] <= 0 <= found.upper[0]
    assert found.status == Status.PRECISION


@pytest.mark.parametrize("seed", range(6))
def test_storm_finds_the_same(seed):
    pytest.importorskip("stormpy")
    rng = np.random.default_rng(seed)
    model = random_sparse(rng, 8, chain=seed % 3 == 0)
    target = rng.random(8) < 0.3
    reward = rng.integers(0, 3, 8).astype(float)
    storm = storm_model(model, {"goal": target}, {"r": Rewards(state=reward)})
    for objective in ("max", "min"):
        ours = {
            f'P{objective}=? [ X "goal" ]': next_probability(model, target, objective=objective),
            f'P{objective}=? [ F<=5 "goal" ]': bounded_reachability(
                model, target, 5, objective=objective
            ),
            f'R{{"r"}}{objective}=? [ C<=5 ]': cumulative_reward(
                model, Rewards(state=reward), 5, objective=objective
            ),
            f'R{{"r"}}{objective}=? [ I=4 ]': instantaneous_reward(
                model, Rewards(state=reward), 4, objective=objective
            ),
        }
        for text, found in ours.items():
            np.testing.assert_allclose(
                found.value, storm_values(storm, text), atol=1e-6, err_msg=text
            )


def chain_left_with(probability, **names):
    return make_sparse(
        None, [0, 2, 3], [0, 1, 1], [1 - probability, probability, 1.0], initial=[1, 0], **names
    )


@pytest.mark.parametrize("probability", [0.5, 0.3, 1e-6, 1e-9])
def test_a_huge_number_of_steps_is_answered_at_once(probability):
    num_steps = 99_999_999_999
    model = chain_left_with(probability, label={"a": [1]})
    for objective in ("max", "min"):
        found = check(bounded_reachability(model, "a", num_steps, objective=objective))
        truth = -np.expm1(num_steps * np.log1p(-probability))
        assert found.lower[0] <= truth <= found.upper[0]
        assert found.upper[0] - found.lower[0] <= 1e-8
    assert check(solve_property(model, f'P=? [ F<={num_steps} "a" ]')).value[0] > 0.99


@pytest.mark.parametrize("num_steps", [10**4, 3 * 10**6, 10**9])
def test_long_horizons_of_chains_are_those_of_their_closed_form(num_steps):
    p = 1e-6
    model = chain_left_with(p)
    left = np.exp(num_steps * np.log1p(-p))
    reached = bounded_reachability(model, [False, True], num_steps)
    earned = cumulative_reward(model, [1.0, 0.0], num_steps)
    final = instantaneous_reward(model, [1.0, 0.0], num_steps)
    for found, truth in ((reached, 1 - left), (earned, (1 - left) / p), (final, left)):
        slack = 1e-10 * truth  # of the closed form
        assert found.lower[0] - slack <= truth <= found.upper[0] + slack
        assert found.upper[0] - found.lower[0] <= 1e-4 * max(truth, 1)
    check(reached)
    assert num_steps == 10**9 or check(earned)


def test_average_growth_bounds_a_huge_sum():
    model = make_sparse([0, 2, 3], [0, 1, 2, 4], [0, 1, 0, 1], [1.0, 1.0, 0.5, 0.5])
    found = check(cumulative_reward(model, [1.0, 2.0, 4.0], 10**11))
    # Gain 10 / 3 by leaving state 0 at once and returning after two steps in the mean.
    assert np.allclose(found.value / 10**11, 10 / 3, rtol=1e-9)
    assert (found.upper - found.lower <= 1e-6 * found.value).all()


@pytest.mark.few(8)
@pytest.mark.parametrize("seed", range(24))
def test_bounds_of_remaining_steps_enclose_all_backups(seed, monkeypatch):
    rng = np.random.default_rng(seed)
    model = random_sparse(rng, 6, chain=seed % 3 == 0)
    target, stay, num_steps = rng.random(6) < 0.3, rng.random(6) < 0.8, int(rng.integers(3, 300))
    reward = rng.random(model.num_rows) * (rng.random(model.num_rows) < 0.6) - (seed % 4 == 1)
    state = rng.random(6) - (seed % 4 == 2)

    def answers():
        for objective in ("max", "min"):
            yield bounded_reachability(model, target, num_steps, stay=stay, objective=objective)
            yield cumulative_reward(model, reward, num_steps, objective=objective)
            yield instantaneous_reward(model, state, num_steps, objective=objective)

    whole = list(answers())
    for long, close, work in ((2, 1e-9, 2.0**38), (2, 1e-2, 2.0**38), (2, 0.0, 80_000.0)):
        for name, x in (("LONG", long), ("CLOSE", close), ("_WORK", work)):
            monkeypatch.setattr(backup, name, x)
        for exact, found in zip(whole, answers(), strict=True):
            assert (found.lower <= exact.upper + 1e-12).all()
            assert (exact.lower <= found.upper + 1e-12).all()


def test_choices_of_too_many_steps_are_refused_with_their_size():
    with pytest.raises(ValueError, match=r"GB; leave out by_step"):
        bounded_reachability(chain_left_with(0.5), [False, True], 10**11, by_step=True)


def test_a_state_without_reward_ahead_is_worth_zero_where_remaining_steps_are_bounded(monkeypatch):
    monkeypatch.setattr(backup, "_WORK", 1e8)
    stay = 1 - 1e-6
    model = make_sparse([0, 2, 3], [0, 2, 4, 5], [0, 1, 0, 1, 1], [stay, 1e-6, stay, 1e-6, 1.0])
    found = cumulative_reward(model, [-1.0, 0.0], 10**7)
    assert found.value[1] == found.lower[1] == found.upper[1] == 0
    assert found.num_steps < 10**7 and found.lower[0] <= -1e6 * (1 - np.exp(-10)) <= found.upper[0]
