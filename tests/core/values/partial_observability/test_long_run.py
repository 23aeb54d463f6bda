"""Formulas of linear temporal logic on POMDPs: controllers of certified value, beside the visible optimum."""

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.values.partial_observability import controller_gradient, long_run
from jaxltl.core.values.partial_observability.controller_gradient import SoftmaxAscent
from jaxltl.core.values.partial_observability.long_run import (
    controller_satisfaction,
    satisfaction_problem,
)
from jaxltl.envs import partial_gridworld

CORRIDORS = """
# # # # # #
# a . . . b #
# . # # # . #
# . . c . . #
# # # # # # #
""".replace("# # # # # #\n", "# # # # # # #\n", 1)
ALTERNATE = "G F a & G F b & G (a -> X X b) & G (b -> X X a)"


def fork(initial=(1, 0, 0)):
    """A crossing between a and b, which look alike."""
    table = np.zeros((3, 2, 3))
    table[0, 0, 1] = table[0, 1, 2] = 1
    table[1:, :, 0] = 1
    world = jl.from_dense(table, initial=list(initial), label={"a": [1], "b": [2]})
    return jl.models.make_pomdp(world, [0, 1, 1])


def guess():
    """A patrol between a and b behind the right one of two doors; the other one leads to c."""
    table = np.zeros((5, 2, 5))
    table[0, [0, 1], [2, 4]] = table[1, [0, 1], [4, 2]] = 1
    table[2, :, 3] = table[3, :, 2] = table[4, :, 4] = 1
    world = jl.from_dense(
        table, initial=[0.75, 0.25, 0, 0, 0], label={"a": [2], "b": [3], "c": [4]}
    )
    return jl.models.make_pomdp(world, [0, 0, 1, 1, 1])


def memoryless(left):
    """The controller of one memory state that goes left with a probability."""
    action = np.array([[[left, 1 - left]], [[1.0, 0.0]]])
    return jl.FiniteMemoryPolicy(action, np.zeros(2, int), np.zeros((2, 1), int))


def test_one_memory_state_fails_and_two_succeed():
    pomdp = fork()
    # Every controller of one memory state repeats a side, almost surely.
    for left in (0.0, 0.3, 0.5, 1.0):
        assert controller_satisfaction(pomdp, memoryless(left), ALTERNATE) == (0.0, 0.0)
    answer = jl.optimal_satisfaction(pomdp, ALTERNATE)
    assert (float(answer.lower), float(answer.upper)) == (1.0, 1.0)
    assert answer.policy.next_memory.shape[1] == 2 and answer.status == jl.Status.CONVERGED
    # First left and then right: at most 1/4 of a memoryless controller, and 1 of one with memory.
    once = "X a & X X X b"
    low, high = controller_satisfaction(pomdp, memoryless(0.5), once)
    assert low <= 0.25 <= high and high - low < 1e-9
    assert float(jl.optimal_satisfaction(pomdp, once).lower) > 1 - 1e-9


def test_large_products_have_several_starts_within_a_limit_of_time(monkeypatch):
    monkeypatch.setattr(long_run, "_LARGE", 0)
    assert float(jl.optimal_satisfaction(fork(), ALTERNATE).lower) == 1
    monkeypatch.setattr(
        long_run, "_SECONDS", 0.0
    )  # then the first start alone, of one memory state
    alone = jl.optimal_satisfaction(fork(), ALTERNATE)
    assert (float(alone.lower), float(alone.upper)) == (0.0, 1.0)
    assert alone.status == jl.Status.MAX_STEPS


def test_the_other_bound_is_of_policies_that_see_the_states_or_of_beliefs_that_have_lost():
    pomdp, patrol = guess(), "G F a & G F b & G !c"
    best = jl.optimal_satisfaction(pomdp, patrol)
    # Seeing the door, a robot would succeed; over beliefs, a quarter of the runs is lost.
    assert abs(float(best.lower) - 0.75) < 1e-9 and 0.75 <= float(best.upper) < 0.751
    assert best.status == jl.Status.CONVERGED and "see the states" in best.method
    visible = jl.optimal_satisfaction(pomdp.fully_observable, patrol)
    assert float(visible.at_initial.lower) == 1
    low, high = controller_satisfaction(pomdp, best.policy, patrol)
    assert low <= 0.75 <= high and low == best.value
    least = jl.optimal_satisfaction(pomdp, patrol, objective="min")
    assert abs(float(least.value) - 0.25) < 1e-9 and 0.249 < float(least.lower) <= 0.25


@pytest.mark.parametrize("slip", [0.0, 0.1])
@pytest.mark.parametrize(
    "formula", ["G F a & G F b & G !c", "G (a -> F b) & G (b -> F a) & G !c & F b"]
)
def test_patrol_and_response_seen_through_a_window(formula, slip):
    pomdp = partial_gridworld(CORRIDORS, 3, slip=slip, initial="a", hidden=["c"])
    answer = jl.optimal_satisfaction(pomdp, formula)
    visible = jl.optimal_satisfaction(pomdp.fully_observable, formula).at_initial
    assert float(answer.upper) >= float(visible.value) - 1e-9
    assert float(answer.lower) == float(visible.value) == 1
    # The certificate is that of the chain, by another route.
    chain = jl.values.controlled_chain(pomdp, answer.policy)
    assert float(jl.optimal_satisfaction(chain, formula).at_initial.lower) == 1


def test_controllers_agree_with_the_solver_of_chains():
    rng = np.random.default_rng(0)
    for _ in range(4):
        size, actions, seen, memory = 5, 2, 3, 2
        table = rng.random((size, actions, size)) * (rng.random((size, actions, size)) < 0.4)
        table[np.arange(size), :, rng.integers(0, size, size)] += 0.1
        table /= table.sum(-1, keepdims=True)
        label = rng.random((size, 2)) < 0.4
        world = jl.from_dense(
            table, initial=np.full(size, 0.2), label=label, propositions=["a", "b"]
        )
        pomdp = jl.models.make_pomdp(world, np.r_[0, 1, 2, rng.integers(0, seen, size - seen)])
        action = rng.random((seen, memory, actions)) * (rng.random((seen, memory, 1)) < 0.7)
        action[..., 0] += 0.1
        policy = jl.FiniteMemoryPolicy(
            action / action.sum(-1, keepdims=True),
            rng.integers(0, memory, seen),
            rng.integers(0, memory, (seen, memory)),
        )
        chain = jl.values.controlled_chain(pomdp, policy)
        for formula in ("G F a & F G b", "F G a | G F b", "G (a -> F b)"):
            low, high = controller_satisfaction(pomdp, policy, formula)
            known = jl.optimal_satisfaction(chain, formula).at_initial
            assert low <= float(known.upper) + 1e-12 and float(known.lower) <= high + 1e-12
            assert high - low < 1e-8


def left(pomdp, formula, leak):
    """The objective of always going left."""
    problem = satisfaction_problem(pomdp, formula, maximize=True, leak=leak)
    ascent = SoftmaxAscent(problem, np.array([[[40.0, 0.0]] * 2]), np.zeros((1, 2, 1)))
    return ascent.gradient()[0]


def test_smooth_objectives_tend_to_the_probability():
    pomdp, formula = fork(), "G F a & F G !b | F G a"
    rough, fine = (left(pomdp, formula, leak) for leak in (0.1, 0.05))
    assert 0.9 < rough < fine - 0.01 < 1
    # The exact one is that of all actions at random.
    assert left(pomdp, "G F a & G F b", None) == 1
    none = satisfaction_problem(pomdp, ALTERNATE, maximize=True, leak=None)
    assert none.num_states == 0 and none.initial_gain == 0


def test_gradients_by_full_and_by_sparse_matrices(monkeypatch):
    problem = satisfaction_problem(guess(), "G F a & G F b & G !c", maximize=True)
    ascent = SoftmaxAscent.random(problem, 2, 1.0, 3)
    full = ascent.gradient()
    monkeypatch.setattr(controller_gradient, "_DENSE", 0)
    sparse = ascent.gradient()
    assert full[0] == pytest.approx(sparse[0], rel=1e-12)
    for a, b in zip(full[1], sparse[1], strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)
    # Along a direction, against differences.
    step = 1e-6 * np.random.default_rng(0).normal(size=ascent.action.shape)
    ends = [
        SoftmaxAscent(problem, ascent.action + sign * step, ascent.update).gradient()[0]
        for sign in (1, -1)
    ]
    assert (ends[0] - ends[1]) / 2 == pytest.approx((full[1][0] * step).sum(), rel=1e-6)
