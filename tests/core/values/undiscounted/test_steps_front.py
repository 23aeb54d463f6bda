"""Fronts of probability and steps, against linear programs over all policies."""

import numpy as np
import pytest
from scipy.optimize import linprog

import jaxltl as jl
from jaxltl.core.values.undiscounted.satisfaction_steps import (
    StepAnalysis,
    constrained_policy,
    quickest_policy,
    steps_front,
)
from tests.support import counts

S, A, GOAL, TRAP = 7, 3, 5, 6


def risky(rng):
    """A world in which quick actions tend to lead into the trap, and the task to reach the goal."""
    moves = rng.dirichlet(np.ones(S) / 3, (S, A))
    moves[:, 1:, TRAP] += rng.uniform(0, 0.2, (S, A - 1))
    moves[:, 1:, GOAL] += rng.uniform(0, 0.5, (S, A - 1))
    moves[:, 0, TRAP] *= 0.01
    moves[[GOAL, TRAP]] = np.eye(S)[[GOAL, TRAP]][:, None]
    moves /= moves.sum(-1, keepdims=True)
    initial = np.append(rng.dirichlet(np.ones(S - 2)), [0, 0])
    world = jl.from_dense(
        moves, label=np.arange(S)[:, None] == GOAL, propositions=["g"], initial=initial
    )
    return jl.product(world, "F g", label_on="exit"), moves, initial


def largest(moves, initial, steps):
    """The largest probability with at most so many expected steps, by a linear program."""
    inner = np.arange(S - 2)
    flow = np.repeat(np.eye(S - 2), A, 0) - moves[inner].reshape(-1, S)[:, inner]
    reach = moves[inner, :, GOAL].ravel()
    # The monitor reads the goal's label when it is left, one step later.
    spent = 1 + reach[None]
    found = linprog(-reach, A_ub=spent, b_ub=[steps], A_eq=flow.T, b_eq=initial[inner])
    return -found.fun


@counts(2, 20, slow=6)
def test_fronts_and_required_points_agree_with_linear_programs(count):
    several = met = refused = 0
    rng = np.random.default_rng(0)
    for _ in range(count):
        model, *facts = risky(rng)
        clock, quickest = StepAnalysis(model), quickest_policy(model)
        front = steps_front(model, quickest, max_points=20)
        assert front[0].probability[0] == pytest.approx(clock.probability(quickest.policy)[0])
        for one in front:
            assert clock.probability(one.policy) == one.probability
            best = largest(*facts, one.steps[0] * (1 + 1e-9))
            assert one.probability[0] == pytest.approx(best, abs=2e-3)
        several += len(front) > 1
        low, high = front[-1].steps[0], front[0].steps[0]
        for steps in rng.uniform(low, high, 3) if len(front) > 1 else [high * 1.5]:
            best = largest(*facts, steps)
            for asked in (best - 1e-5, best + 1e-5):
                found = constrained_policy(model, asked, steps, quickest)
                if found.policy is None:
                    assert found.upper < asked and asked > best
                    refused += 1
                else:
                    assert asked < best
                    assert clock.probability(found.policy)[1] >= asked
                    assert clock.steps(found.policy).upper <= steps
                    met += 1
            assert constrained_policy(model, best + 1e-5, steps, quickest).upper >= best - 1e-8
    assert several >= count / 2 and met and refused


def test_a_front_needs_a_decision():
    world = jl.from_dense([[[0.5, 0.5]]] * 2, label=[[1], [0]], propositions=["a"])
    with pytest.raises(ValueError, match="is for co-safe tasks, and this one is buchi"):
        steps_front(jl.product(world, "G F a"))
