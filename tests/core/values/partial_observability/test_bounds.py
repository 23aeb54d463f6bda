"""Bounds of partially observable models against exhaustive controllers and exact trees of beliefs."""

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy
from jaxltl.core.values.partial_observability import exploration
from jaxltl.core.values.partial_observability.solve import belief_bounds, controller_value

from .reference import controller_values, random_pomdp, tree_value

QUESTIONS = ["Pmax", "Pmin", "Rmax", "Rmin", "Rmin with cycles"]


def question(seed, kind):
    """A random POMDP of 4 to 6 states and 1 to 3 observations, its table and the costs of a question."""
    sizes = {"num_states": 4 + seed % 3, "num_observations": 1 + seed // 3 % 3}
    pomdp, table = random_pomdp(seed, **sizes)
    if kind[0] == "P":
        return pomdp, table, None
    target = len(table) - 2
    if kind == "Rmin with cycles":
        table[-1] = 0
        table[-1, :, -1], table[-1, :, target] = 0.5, 0.5
    else:  # every policy reaches the target
        table *= 0.875
        table[:, :, target] += 0.125
    world = jl.to_sparse(jl.from_dense(table, initial=pomdp.initial, label={"goal": [target]}))
    cost = np.random.default_rng(seed).integers(4, size=table.shape[:2]) + 0.5
    return jl.models.make_pomdp(world, pomdp.observation), table, cost


def check_bounds(seed, kind, depth=4, max_beliefs=100):
    """Bounds between all controllers of two memory states and a tree of beliefs; None if all are infinite."""
    pomdp, table, cost = question(seed, kind)
    target, objective = len(table) - 2, kind[1:4]
    reward = None if cost is None else cost.ravel()
    values, reach = controller_values(pomdp, table, target, cost)
    if cost is not None:
        values = values[reach > 1 - 1e-9]
        seen = jl.total_reward(pomdp.fully_observable, reward, "goal", objective=objective)
        if not values.size or not np.isfinite(seen.upper).all():
            return None
    options = {"objective": objective, "tolerance": 1e-3, "max_beliefs": max_beliefs}
    answer = belief_bounds(pomdp, "goal", reward=reward, **options)
    lower, upper = float(answer.lower), float(answer.upper)
    tree = float(tree_value(pomdp, table, target, depth, objective, cost))
    slack = 1e-9 * max(1.0, abs(tree))
    assert 0 <= lower <= upper
    if objective == "max":
        assert upper >= values.max() - slack / 1000, (seed, kind, upper, values.max())
        assert lower <= tree + slack, (seed, kind, lower, tree)
    else:  # values of controllers are from below
        assert lower <= values.min() + slack, (seed, kind, lower, values.min())
        assert upper >= tree - slack, (seed, kind, upper, tree)
    if answer.status == jl.Status.CONVERGED:
        assert upper - lower <= 1e-3 * (1 if cost is None else max(1.0, upper))
    attained = controller_value(pomdp, answer.policy, "goal", reward=reward)
    width = 1e-6 * max(1.0, upper)
    assert float(attained.lower) - width <= float(answer.value) <= float(attained.upper) + width
    return answer, upper - lower


@pytest.mark.parametrize("kind", QUESTIONS)
@pytest.mark.parametrize("seed", [2, 4, 6])
def test_bounds_are_on_the_right_side(seed, kind):
    check_bounds(seed, kind)


@pytest.mark.parametrize("kind", QUESTIONS)
def test_bounds_that_begin_by_rollouts_are_on_the_right_side(kind, monkeypatch):
    monkeypatch.setattr(exploration, "_SMALL", 10)  # beliefs of an exploration without rollouts
    for seed in (3, 5):
        check_bounds(seed, kind)


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", QUESTIONS)
def test_bounds_of_many_models_are_on_the_right_side(kind):
    checked = [check_bounds(seed, kind) for seed in range(300)]
    assert sum(x is not None for x in checked) >= (300 if kind != "Rmin with cycles" else 100)


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
    with pytest.raises(ValueError, match="maximal reward from state 0 is infinite"):
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


def test_one_limit_of_time_holds_for_both_explorations():
    """After the first beliefs controllers are learned, and a second exploration begins, if time is left."""
    for seed in (3, 24, 36):
        pomdp, _ = random_pomdp(seed)
        for objective in ("max", "min"):
            rounds = []
            answer = belief_bounds(
                pomdp,
                "goal",
                objective=objective,
                tolerance=0.0,
                max_seconds=1e-9,
                report=lambda *x, rounds=rounds: rounds.append(x),
            )
            assert len(rounds) == 1 and answer.lower <= answer.upper
            again = controller_value(pomdp, answer.policy, "goal")
            assert abs(float(again.value) - float(answer.value)) < 1e-5


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


def test_rare_actions_are_left_out_of_distributions_alone():
    start = np.zeros(2, int), np.zeros((2, 1), int)
    mixed = FiniteMemoryPolicy(np.array([[[0.05, 0.95, 0]], [[0.5, 0.1, 0.4]]]), *start)
    fewer = jl.values.without_rare_actions(mixed, 0.1).action
    np.testing.assert_allclose(fewer, [[[0, 1, 0]], [[5 / 9, 0, 4 / 9]]], atol=1e-15)
    np.testing.assert_array_equal(jl.values.without_rare_actions(mixed, 0.0).action, mixed.action)
    rare = FiniteMemoryPolicy(np.array([[[0.3, 0.3, 0.4]], [[0.5, 0.5, 0]]]), *start)
    fewer = jl.values.without_rare_actions(rare, 0.9).action  # the likeliest actions stay
    np.testing.assert_array_equal(fewer, [[[0, 0, 1]], [[0.5, 0.5, 0]]])
    chosen = FiniteMemoryPolicy(np.array([[1], [2]]), *start)
    assert jl.values.without_rare_actions(chosen, 0.1) is chosen
    for row in ([np.nan] * 2, [0.0, 0.0], [1.5, -0.5], [0.5, np.inf]):
        wrong = FiniteMemoryPolicy(np.array([[[0.5, 0.5]], [row]]), *start)
        with pytest.raises(ValueError, match=r"actions at \(1, 0\) have the probabilities"):
            jl.values.without_rare_actions(wrong, 0.1)
    for least in (-0.1, 1.0, np.nan):
        with pytest.raises(ValueError, match="least"):
            jl.values.without_rare_actions(mixed, least)
