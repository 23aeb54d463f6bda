"""Optimal reachability where sweeps make hardly any progress, against exact fractions."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.graphs.end_components import end_components
from jaxltl.core.models.mdp import make_mdp
from jaxltl.core.types import Status
from jaxltl.core.values.reachability import reachability_probability
from jaxltl.core.values.stiff import reachability_bounds

RARE = 1e-3


def sticky_loop():
    """Two states that are left with probability RARE^2 a lap: 0 stays or goes to 1, 1 goes back.

    From 1, a rare step ends in the goal 2 with probability .3 (action 0) or .6 (action 1), which
    costs: action 1 ends at once in the trap 3 half of the time that it leaves.
    """
    stay = [[2, 2, 2]] * 2, [[3, 3, 3]] * 2
    successor = [[[0, 1, 1]] * 2, [[0, 2, 3]] * 2, *stay]
    rest = [[1, 0, 0]] * 2
    probability = [
        [[1 - RARE, RARE, 0]] * 2,
        [[1 - RARE, 0.3 * RARE, 0.7 * RARE], [1 - RARE, 0.6 * RARE, 0.4 * RARE]],
        rest, rest,
    ]
    return make_mdp(successor, probability, initial=[1, 0, 0, 0])


@pytest.mark.parametrize(("objective", "exact"), [("max", 0.6), ("min", 0.3)])
def test_a_loop_that_is_hardly_left(objective, exact):
    goal = jnp.array([False, False, True, False])
    found = reachability_probability(
        sticky_loop(), goal, objective=objective, tolerance=1e-8
    )
    assert int(found.status) == Status.CONVERGED
    assert (found.lower[:2] <= exact).all() and (exact <= found.upper[:2]).all()
    assert float(jnp.max(found.upper - found.lower)) <= 2e-8
    assert int(found.policy[1]) == (objective == "max")
    assert found.value[2:].tolist() == [1, 0]
    few = reachability_probability(sticky_loop(), goal, objective=objective, max_steps=100)
    assert int(few.status) == Status.MAX_STEPS


def random_case(rng, size):
    """Few successors, many rare steps, two ends."""
    shape = (size, 2, 3)
    successor = rng.integers(0, size, shape)
    weight = rng.random(shape) ** 8 + 1e-6
    successor[-2:] = np.array([size - 2, size - 1])[:, None, None]
    model = make_mdp(
        successor, weight / weight.sum(-1, keepdims=True), initial=np.eye(size)[0]
    )
    return model, jnp.arange(size) == size - 1


@pytest.mark.parametrize("objective", ["max", "min"])
def test_bounds_hold_those_of_sweeps(objective):
    rng = np.random.default_rng(3)
    compared = 0
    for _ in range(40):
        model, goal = random_case(rng, 7)
        plain = reachability_probability(model, goal, objective=objective, tolerance=1e-9)
        undecided = (plain.lower < 1) & (plain.upper > 0) & ~goal
        undecided &= plain.lower != plain.upper
        components = end_components(model, undecided) if objective == "max" else None
        bounds = reachability_bounds(model, plain.lower == 1, undecided, components, objective)
        assert bounds is not None
        compared += int(undecided.any())
        assert (bounds[0] <= plain.upper).all() and (plain.lower <= bounds[1]).all()
        assert float(jnp.max(bounds[1] - bounds[0])) < 1e-6
    assert compared > 10


def test_end_components_choose_together():
    # 0 and 1 form a component; only 1 can leave it, to 2 (the goal) or 3.
    model = make_mdp(
        [[[1, 1], [1, 1]], [[0, 0], [2, 3]], [[2, 2]] * 2, [[3, 3]] * 2],
        [[[1, 0]] * 2, [[1, 0], [0.25, 0.75]], [[1, 0]] * 2, [[1, 0]] * 2], initial=[1, 0, 0, 0],
    )
    undecided = jnp.array([True, True, False, False])
    bounds = reachability_bounds(
        model, jnp.arange(4) == 2, undecided, end_components(model, undecided), "max"
    )
    assert bounds is not None
    for bound in bounds:
        np.testing.assert_allclose(bound, [0.25, 0.25, 1, 0], atol=1e-13)
    assert (bounds[0] <= bounds[1]).all()
