"""Reachability of small concrete models on the host: exact numbers, and the traced engine."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.models.mdp import make_mdp
from jaxltl.core.models.ops.operators import induced_chain
from jaxltl.core.types import Status
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from tests.core.graphs.test_engines import counted_programs

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
        rest,
        rest,
    ]
    return make_mdp(successor, probability, initial=[1, 0, 0, 0])


@pytest.mark.parametrize(("objective", "exact"), [("max", 0.6), ("min", 0.3)])
def test_a_loop_that_is_hardly_left(objective, exact):
    goal = jnp.array([False, False, True, False])
    found = reachability_probability(sticky_loop(), goal, objective=objective, tolerance=1e-8)
    assert int(found.status) == Status.CONVERGED
    assert (found.lower[:2] <= exact).all() and (exact <= found.upper[:2]).all()
    assert float(jnp.max(found.upper - found.lower)) <= 2e-8
    assert int(found.policy[1]) == (objective == "max")
    assert found.value[2:].tolist() == [1, 0]
    few = jax.jit(lambda m, n: reachability_probability(m, goal, objective=objective, max_steps=n))(
        sticky_loop(), 100
    )
    assert int(few.status) == Status.MAX_STEPS
    assert int(few.num_steps) == 100


def random_case(rng, size):
    """Few successors, many rare steps, two ends."""
    shape = (size, 2, 3)
    successor = rng.integers(0, size, shape)
    weight = rng.random(shape) ** 8 + 1e-6
    successor[-2:] = np.array([size - 2, size - 1])[:, None, None]
    model = make_mdp(successor, weight / weight.sum(-1, keepdims=True), initial=np.eye(size)[0])
    return model, jnp.arange(size) == size - 1


def solve(model, goal, policy, objective):
    given = {"policy": policy} if objective == "policy" else {"objective": objective}
    return reachability_probability(model, goal, tolerance=1e-7, **given)


traced = jax.jit(solve, static_argnames="objective")


@pytest.mark.few(1)
@pytest.mark.parametrize("objective", ["max", "min", "policy"])
def test_both_engines_give_the_same_bounds_and_regions(objective):
    rng = np.random.default_rng(3)
    compared = 0
    for _ in range(20):
        model, goal = random_case(rng, 7)
        policy = jnp.asarray(rng.dirichlet(np.ones(2), 7))
        one, other = (f(model, goal, policy, objective) for f in (solve, traced))
        assert int(one.status) == Status.CONVERGED
        assert (one.lower <= other.upper).all() and (other.lower <= one.upper).all()
        for certain in (0, 1):
            np.testing.assert_array_equal(one.value == certain, other.value == certain)
        assert float(jnp.max(one.upper - one.lower)) < 1e-6
        compared += int(((one.lower < one.upper) & (one.value > 1e-3)).any())
        if objective != "policy":
            attained = reachability_probability(model, goal, policy=one.policy)
            reached = attained.upper >= one.lower - 1e-12
            assert (reached if objective == "max" else attained.lower <= one.upper + 1e-12).all()
    assert compared > 5


def test_end_components_choose_together():
    # 0 and 1 form a component; only 1 can leave it, to 2 (the goal) or 3.
    model = make_mdp(
        [[[1, 1], [1, 1]], [[0, 0], [2, 3]], [[2, 2]] * 2, [[3, 3]] * 2],
        [[[1, 0]] * 2, [[1, 0], [0.25, 0.75]], [[1, 0]] * 2, [[1, 0]] * 2],
        initial=[1, 0, 0, 0],
    )
    found = reachability_probability(model, jnp.arange(4) == 2)
    np.testing.assert_allclose(found.value, [0.25, 0.25, 1, 0], atol=1e-13)
    assert (found.lower <= found.upper).all()
    assert found.policy[1] == 1


@pytest.mark.parametrize("task", ["F g", "G !r", "G F g & G F y", "F G g", "(G F g) -> (G F y)"])
def test_probabilities_of_small_tasks_compile_nothing(task):
    with counted_programs() as compiled:
        model = jl.product(jl.gridworld("g . r\n. s y", slip=0.2, initial="s"), task)
        policy = np.full((*model.state_shape, model.num_actions), 0.25)
        found = jl.satisfaction_probability(model, policy)
        best, worst = (jl.optimal_satisfaction(model, objective=x) for x in ("max", "min"))
    assert not compiled
    for solution in (found, best, worst):
        jl.check(solution)
    assert (np.asarray(worst.lower) <= found.upper).all()
    assert (np.asarray(found.lower) <= best.upper).all()
    attained = jl.satisfaction_probability(model, best.policy)
    np.testing.assert_allclose(attained.value, best.value, atol=1e-9)


def test_a_model_of_ones_own_is_solved_by_its_primitives():
    """What is no table of rows is left to the compiled engine, however small and concrete."""

    class Walk:
        """From 1 to 3 evenly to both sides; 0 and 4 are ends."""

        state_shape, num_states, num_actions, num_successors = (5,), 5, 1, 2
        dtype, available = jnp.result_type(float), jnp.ones((5, 1), bool)

    def sides(x):
        return jnp.append(x[:1], x[:-1]).at[4].set(x[4]), jnp.append(x[1:], x[-1]).at[0].set(x[0])

    jl.models.expectation.register(Walk, lambda _, x: (sum(sides(x)) / 2)[:, None])
    jl.models.exists_successor.register(Walk, lambda _, x: jnp.logical_or(*sides(x))[:, None])
    jl.models.forall_successor.register(Walk, lambda _, x: jnp.logical_and(*sides(x))[:, None])
    probability = np.full((5, 1, 2), 0.5)
    successor = np.array([[0, 0], [0, 2], [1, 3], [2, 4], [4, 4]])[:, None]
    induced_chain.register(Walk, lambda *_: make_mdp(successor, probability))
    jax.tree_util.register_pytree_node(Walk, lambda _: ((), None), lambda *_: Walk())
    found = reachability_probability(Walk(), np.arange(5) == 4, tolerance=1e-9)
    np.testing.assert_allclose(found.value, [0, 0.25, 0.5, 0.75, 1], atol=1e-9)
