"""Bounds of partially observable models against exhaustive controllers and exact trees of beliefs."""

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.values.partial_observability.solve import belief_bounds, controller_value

from .reference import controller_values, random_pomdp, tree_value

FEW = {"tolerance": 1e-3, "max_beliefs": 150}


def check_probability(seed, objective, depth=4):
    pomdp, table = random_pomdp(seed)
    target = len(table) - 2
    answer = belief_bounds(pomdp, "goal", objective=objective, **FEW)
    lower, upper = float(answer.lower), float(answer.upper)
    values, _ = controller_values(pomdp, table, target)
    tree = float(tree_value(pomdp, table, target, depth, objective))
    assert 0 <= lower <= upper <= 1
    if objective == "max":
        assert upper >= values.max() - 1e-12, (seed, upper, values.max())
        assert lower <= tree + 1e-9, (seed, lower, tree)
    else:  # values of controllers are from below, up to what is left after the sweeps
        assert lower <= values.min() + 1e-9, (seed, lower, values.min())
        assert upper >= tree - 1e-9, (seed, upper, tree)
    if answer.status == jl.Status.CONVERGED:
        assert upper - lower <= 1e-3
    attained = controller_value(pomdp, answer.policy, "goal")
    ends = float(attained.lower) - 1e-9, float(attained.upper) + 1e-9
    assert ends[0] <= float(answer.value) <= ends[1], seed


@pytest.mark.parametrize("objective", ["max", "min"])
@pytest.mark.parametrize("seed", range(4))
def test_probabilities_are_on_the_right_side(seed, objective):
    check_probability(seed, objective)


@pytest.mark.slow
@pytest.mark.parametrize("objective", ["max", "min"])
def test_probabilities_of_many_models_are_on_the_right_side(objective):
    for seed in range(4, 154):
        check_probability(seed, objective)


def test_rewards_are_on_the_right_side():
    checked = 0
    for seed in range(40):
        pomdp, table = random_pomdp(seed)
        target = len(table) - 2
        table[-1, :, -1], table[-1, :, target] = 0.5, 0.5  # the target is reached from everywhere
        world = jl.to_sparse(jl.from_dense(table, initial=pomdp.initial, label={"goal": [target]}))
        pomdp = jl.models.make_pomdp(world, pomdp.observation)
        values, reach = controller_values(pomdp, table, target, sweeps=600, cost=1.0)
        if not (reach > 1 - 1e-9).any():
            continue
        least = values[reach > 1 - 1e-9].min()
        reward = np.ones(world.num_rows)
        options = {"reward": reward, "objective": "min", "max_beliefs": 60}
        answer = belief_bounds(pomdp, "goal", **options)
        assert float(answer.lower) <= least + 1e-6 * least
        seen = jl.total_reward(world, reward, world.states_with_label("goal"), objective="min")
        assert float(answer.upper) >= float(seen.at_initial.lower) - 1e-9
        attained = controller_value(pomdp, answer.policy, "goal", reward=reward)
        np.testing.assert_allclose(attained.value, answer.value, rtol=1e-5)
        checked += 1
        if checked == 4:
            return
    raise AssertionError("too few models have a controller that reaches the target")


CYCLE = jl.make_sparse(
    # 0 and 1 look alike and swap; from both one may guess: right leads to 2 (goal), wrong to 3.
    [0, 3, 6, 7, 8],
    np.arange(9),
    [1, 2, 3, 0, 3, 2, 2, 3],
    np.ones(8),
    initial=[0.5, 0.5, 0, 0],
    label={"goal": [2]},
)


def test_beliefs_in_end_components_are_exact():
    pomdp = jl.models.make_pomdp(CYCLE, [0, 0, 1, 2])
    answer = belief_bounds(pomdp, "goal", tolerance=1e-9)
    # Swapping for ever keeps the belief; rounding there would add up to one.
    assert float(answer.upper) == pytest.approx(0.5, abs=1e-9)
    assert float(answer.lower) == pytest.approx(0.5, abs=1e-9)


def test_questions_of_the_door():
    pomdp = jl.models.make_pomdp(CYCLE, [0, 0, 1, 2])
    best = jl.reachability_probability(pomdp, "goal")
    assert float(best.at_initial.value) == pytest.approx(0.5)
    again = jl.reachability_probability(pomdp, "goal", policy=best.policy)
    assert float(again.lower) <= float(best.value) + 1e-9 and again.status == jl.Status.CONVERGED
    assert float(jl.optimal_satisfaction(pomdp, "F goal").upper) == pytest.approx(0.5, abs=1e-3)
    safe = jl.optimal_satisfaction(pomdp, "G !goal")
    assert float(safe.lower) == pytest.approx(1) and float(safe.policy.action.max()) >= 0
    answer = jl.solve_property(pomdp, 'Pmax>=0.7 [ F "goal" ]')
    assert answer.holds == [False]
    assert jl.solve_property(pomdp, 'Pmax=? [ F "goal" ]').strategy is not None
    again_and_again = jl.solve_property(pomdp, 'Pmax=? [ G F "goal" ]')
    assert again_and_again.lower[0] == pytest.approx(0.5) and again_and_again.upper[0] >= 0.5
    with pytest.raises(ValueError, match="upper bound of a maximum"):
        belief_bounds(pomdp, "goal", reward=np.ones(8))
    with pytest.raises(ValueError, match="POMDP"):
        belief_bounds(CYCLE, "goal")


def test_a_limit_keeps_the_bounds_and_an_interrupt_too():
    pomdp, _ = random_pomdp(3)
    seen = []

    def stop(count, lower, upper):
        seen.append((count, lower, upper))
        raise KeyboardInterrupt

    few = belief_bounds(pomdp, "goal", tolerance=0.0, max_beliefs=1)
    stopped = belief_bounds(pomdp, "goal", tolerance=0.0, max_beliefs=1, report=stop)
    for answer in (few, stopped):
        assert 0 <= float(answer.lower) <= float(answer.upper) <= 1
    assert seen and seen[0][1] <= seen[0][2]


def test_a_controller_as_a_chain():
    pomdp = jl.models.make_pomdp(CYCLE, [0, 0, 1, 2])
    # Swap twice, then guess 1.
    action = np.array([[0, 0, 1], [0, 0, 0], [0, 0, 0]])
    update = np.array([[1, 2, 2], [0, 1, 2], [0, 1, 2]])
    policy = jl.FiniteMemoryPolicy(action, np.zeros(3, int), update)
    chain = jl.values.controlled_chain(pomdp, policy)
    assert jl.solve_property(chain, 'P=? [ F "goal" ]').value.mean() == pytest.approx(0.5)
    assert jl.solve_property(chain, 'P=? [ F<=2 "goal" ]').value.tolist() == [0, 0]
    wrong = policy.replace(action=np.array([[0, 0, 3], [0, 0, 0], [0, 0, 0]]))
    for bad in (wrong, policy.replace(next_memory=update[:2], action=action[:2]), None):
        with pytest.raises(ValueError, match=r"policy"):
            jl.values.controlled_chain(pomdp, bad)


def test_infinite_rewards_are_decided_without_warnings_and_rewards_are_finite():
    # The target may be missed from the start, so that every controller has an infinite reward.
    world = jl.make_sparse(
        [0, 2, 3, 4], [0, 2, 3, 4, 5], [1, 2, 0, 1, 2], [0.5, 0.5, 1, 1, 1], initial=[1, 0, 0]
    )
    pomdp, goal = jl.models.make_pomdp(world, [0, 1, 1]), np.arange(3) == 1
    ask = lambda reward: jl.total_reward(pomdp, np.array(reward), goal, objective="min")  # noqa: E731
    found = ask([1.0, 0, 0])
    assert found.value == found.lower == found.upper == np.inf and found.status == 0
    for wrong in (np.nan, np.inf, -1.0):
        with pytest.raises(ValueError, match="finite rewards of at least 0"):
            ask([wrong, 0, 0])
