"""Discounted values: certified enclosures on random models, and what Boltzmann's has of its own."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl import Status
from jaxltl.core.models.construct.batch import stack_products
from jaxltl.core.values.discounted.discounted import expected_reward
from jaxltl.core.values.discounted.soft import boltzmann_expansion, soft_value
from jaxltl.envs import temporal_gridworld as grid
from tests import reference
from tests.support import as_mdp, assert_encloses, mass_preserving, stack

NUM_MODELS = 150
SHAPE = (5, 3, 2)  # states, actions, successors
# Dyadic, so that float32 and float64 hold them exactly.
DISCOUNTS = (0.0, 0.5, 0.875, 0.96875, 0.9921875)


def random_case(rng):
    model = reference.random_model(rng, *SHAPE)
    reward = reference.random_reward(rng, *SHAPE[:2])
    return model, reference.random_policy(rng, model), reward, rng.choice(DISCOUNTS)


@pytest.fixture(scope="module")
def cases():
    rng = np.random.default_rng(0)
    return [random_case(rng) for _ in range(NUM_MODELS)]


@pytest.fixture(scope="module")
def exact_policy(cases):
    return np.stack([reference.exact_policy_value(m, p, r, d) for m, p, r, d in cases])


@pytest.fixture(scope="module")
def exact_optimal(cases):
    return np.stack([reference.exact_optimal_value(m, r, d) for m, _, r, d in cases])


def batch_of(cases):
    models, policies, rewards, discounts = zip(*cases, strict=True)
    return stack([as_mdp(m) for m in models]), *(stack(x) for x in (policies, rewards, discounts))


@pytest.fixture(scope="module")
def batch(cases):
    return batch_of(cases)


def assert_certified(solution, exact, tolerance=None):
    """Every lane converged to an enclosure of the truth, as tight as was asked."""
    assert (solution.status == Status.CONVERGED).all()
    assert_encloses(solution, exact)
    width = np.asarray(solution.upper) - np.asarray(solution.lower)
    scale = 1 + np.abs(np.asarray(exact, float)).max(axis=-1, keepdims=True)
    eps = jnp.finfo(solution.value.dtype).eps
    allowed = 2 * tolerance + 8 * eps * scale if tolerance else 1e5 * eps * scale
    assert (width <= allowed).all()
    assert (solution.lower <= solution.value).all()
    assert (solution.value <= solution.upper).all()


SINGLE = 200  # lanes that are repeated in single precision


def some(usual, other):
    """Methods and tolerances; that of the usual method without one is compiled below, too."""
    more = [(usual, None), (other, 1e-6)]
    return [
        (usual, 1e-6),
        (other, None),
        *(pytest.param(*x, marks=pytest.mark.exhaustive) for x in more),
    ]


@pytest.mark.few(1)
@pytest.mark.parametrize("tolerance", [None, 1e-6])
def test_policy_values_are_enclosed(batch, exact_policy, tolerance):
    solution = jax.jit(
        jax.vmap(lambda m, p, r, d: jl.policy_value(m, p, r, d, tolerance=tolerance))
    )(*batch)
    assert_certified(solution, exact_policy, tolerance)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("method", "tolerance"), some("modified_policy_iteration", "value_iteration")
)
def test_optimal_values_are_enclosed(cases, batch, exact_optimal, method, tolerance):
    mdps, _, rewards, discounts = batch
    solution = jax.jit(
        jax.vmap(lambda m, r, d: jl.optimal_value(m, r, d, method=method, tolerance=tolerance))
    )(mdps, rewards, discounts)
    assert_certified(solution, exact_optimal, tolerance)
    for i in range(100):
        model, _, reward, discount = cases[i]
        greedy = reference.one_hot(np.asarray(solution.policy[i]), SHAPE[1])
        attained = reference.exact_policy_value(model, greedy, reward, discount)
        assert (attained >= reference.FRACTION(solution.lower[i])).all()


@pytest.mark.slow
def test_values_are_enclosed_in_single_precision(cases, exact_policy, exact_optimal):
    with jax.enable_x64(False):
        mdps, policies, rewards, discounts = batch_of(cases[:SINGLE])
        assert mdps.dtype == jnp.float32
        solution = jax.jit(jax.vmap(jl.policy_value))(mdps, policies, rewards, discounts)
        assert_certified(solution, exact_policy[:SINGLE])
        solution = jax.jit(jax.vmap(jl.optimal_value))(mdps, rewards, discounts)
        assert_certified(solution, exact_optimal[:SINGLE])


# --- soft and Boltzmann values, whose truth is computed in extended precision ------------------


def smooth_reference(cases, discounts, operator, num_steps):
    return reference.iterate_values(
        np.stack([m.transition for m, *_ in cases]),
        np.stack([m.available for m, *_ in cases]),
        np.stack([r for _, _, r, _ in cases]),
        discounts[:, None, None],
        operator,
        num_steps,
    )


@pytest.fixture(scope="module")
def soft(cases):
    """Discounts up to .875, and the soft values after an error has shrunk to 1e-20."""
    discounts = np.array([min(d, 0.875) for *_, d in cases])
    return discounts, smooth_reference(cases, discounts, "soft", 750)


@pytest.mark.parametrize(("method", "tolerance"), some("newton", "value_iteration"))
def test_soft_values_are_enclosed(batch, soft, method, tolerance):
    mdps, _, rewards, _ = batch
    discounts, exact = soft
    solution = jax.jit(
        jax.vmap(lambda m, r, d: jl.soft_value(m, r, d, method=method, tolerance=tolerance))
    )(mdps, rewards, jnp.asarray(discounts))
    assert_certified(solution, exact, tolerance)
    np.testing.assert_allclose(solution.policy.sum(-1), 1, atol=1e-12)
    assert not np.asarray(solution.policy)[~np.asarray(mdps.available)].any()


def test_soft_values_are_enclosed_in_single_precision(cases, soft):
    discounts, exact = soft
    with jax.enable_x64(False):
        mdps, _, rewards, _ = batch_of(cases[:SINGLE])
        solution = jax.jit(jax.vmap(jl.soft_value))(mdps, rewards, jnp.asarray(discounts[:SINGLE]))
        assert_certified(solution, exact[:SINGLE])


def test_boltzmann_values_are_enclosed_where_the_operator_contracts(cases, batch):
    mdps, _, rewards, _ = batch
    discounts = np.array([min(d, 0.6875) for *_, d in cases])
    assert discounts.max() * boltzmann_expansion(SHAPE[1]) < 1
    exact = smooth_reference(cases, discounts, "boltzmann", 600)
    solution = jax.jit(jax.vmap(jl.values.boltzmann_value))(mdps, rewards, jnp.asarray(discounts))
    assert_certified(solution, exact)


def test_soft_values_at_high_discounts():
    """Newton's method does not slow down with the discount; the residual proves the answer."""
    model = reference.random_model(np.random.default_rng(1), *SHAPE)
    reward = reference.random_reward(np.random.default_rng(1), *SHAPE[:2])
    for discount in (0.99, 0.9999):
        solution = jl.check(jl.soft_value(as_mdp(model), jnp.asarray(reward), discount))
        assert solution.num_steps < 120
        value = np.asarray(solution.value, np.longdouble)
        q = reward + np.longdouble(discount) * (model.transition @ value)
        residual = np.abs(reference.soft_maximum(q, model.available, "soft") - value).max()
        assert residual / (1 - discount) < 1e-7


# --- rewards on transitions, and errors --------------------------------------------------------


def test_rewards_on_transitions_count_by_their_expectation():
    rng = np.random.default_rng(2)
    model = reference.random_model(rng, *SHAPE)
    mdp, reward = as_mdp(model), rng.normal(size=SHAPE)
    expected = (model.probability * reward).sum(-1)
    np.testing.assert_allclose(expected_reward(mdp, reward), expected, atol=1e-14)
    np.testing.assert_array_equal(expected_reward(mdp, expected), expected)
    one, other = (jl.optimal_value(mdp, r, 0.9).value for r in (reward, expected))
    np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


def test_bad_arguments_are_named():
    mdp = as_mdp(reference.random_model(np.random.default_rng(3), *SHAPE))
    reward, policy = jnp.zeros(SHAPE[:2]), jnp.zeros(5, int)
    shape = r"reward has shape \(4,\); expected \(5,\), \(5, 3\) or \(5, 3, 2\)"
    for solve in (jl.optimal_value, jl.soft_value, jl.values.boltzmann_value):
        with pytest.raises(ValueError, match=shape):
            solve(mdp, jnp.zeros(4), 0.9)
    with pytest.raises(ValueError, match=shape):
        jl.policy_value(mdp, policy, jnp.zeros(4), 0.9)
    with pytest.raises(ValueError, match=r"policy has shape \(4,\)"):
        jl.policy_value(mdp, policy[:4], reward, 0.9)
    with pytest.raises(ValueError, match="method='fast'; choose one of auto, policy_iteration"):
        jl.optimal_value(mdp, reward, 0.9, method="fast")
    with pytest.raises(ValueError, match="method='fast'; choose one of newton, value_iteration"):
        jl.soft_value(mdp, reward, 0.9, method="fast")
    with pytest.raises(ValueError, match="method='fast'; choose one of damped, newton"):
        jl.values.boltzmann_value(mdp, reward, 0.9, method="fast")
    with pytest.raises(ValueError, match="adjoint='none'; choose one of exact, approximate"):
        jl.values.boltzmann_value(mdp, reward, 0.9, adjoint="none")


# --- the Boltzmann operator --------------------------------------------------------------------

LOOP_OR_END = jl.make_mdp(
    [[[0], [1]], [[1], [1]]],
    [[[1.0], [1.0]], [[1.0], [0.0]]],
)  # state 0: action 0 loops, action 1 ends in state 1
LOOP_REWARD = jnp.array([[0.2, 0.0], [0.0, 0.0]])
CYCLE = jl.make_mdp([[[1], [0]], [[1], [0]]], np.ones((2, 2, 1)))
CYCLE_REWARD = np.array([[0.72582924, -4.90532791], [-2.7250461, -1.09577739]])


def backup(model, reward, discount, value):
    """One application of the Boltzmann operator, in NumPy."""
    q = reward + discount * (model.transition @ value)
    return reference.soft_maximum(q, model.available, "boltzmann")


def test_the_answer_depends_on_the_start_where_there_are_several():
    low = jl.values.boltzmann_value(LOOP_OR_END, LOOP_REWARD, 0.99)
    high = jl.values.boltzmann_value(LOOP_OR_END, LOOP_REWARD, 0.99, guess=jnp.array([15.0, 0.0]))
    np.testing.assert_allclose([low.value[0], high.value[0]], [0.3345, 20.0], atol=1e-3)


def test_a_fixed_point_that_plain_iteration_misses():
    model = reference.Model(
        np.array([[[1], [0]], [[1], [0]]]),
        np.ones((2, 2, 1)),
        np.ones((2, 2), bool),
        np.ones(2) / 2,
    )
    value = np.zeros(2)
    for _ in range(500):
        value = backup(model, CYCLE_REWARD, 0.9, value)
    other = backup(model, CYCLE_REWARD, 0.9, value)
    pair = sorted([value.tolist(), other.tolist()])
    np.testing.assert_allclose(pair, [[-3.273, -2.809], [-1.817, -4.320]], atol=1e-3)

    solution = jl.values.boltzmann_value(CYCLE, jnp.asarray(CYCLE_REWARD), 0.9)
    with pytest.raises(jl.NotConverged, match=r"UNCERTIFIED.*certified=False"):
        jl.check(solution)
    jl.check(solution, certified=False)
    np.testing.assert_allclose(solution.value, [-2.46366, -3.49686], atol=1e-5)
    np.testing.assert_allclose(
        backup(model, CYCLE_REWARD, 0.9, np.asarray(solution.value)), solution.value, atol=1e-12
    )


def test_random_models_beyond_contraction():
    """Of 150 models with 6 states and 4 actions at discount .95, plain iteration fails on many."""
    rng = np.random.default_rng(0)
    transition = rng.dirichlet(np.full(6, 0.01), (150, 6, 4))
    reward = rng.normal(size=(150, 6, 4)) * 3
    available = np.ones((150, 6, 4), bool)
    dense = jl.DenseMDP(
        jnp.asarray(transition),
        jnp.asarray(available),
        jnp.full((150, 6), 1 / 6),
        jnp.zeros((150, 6, 0), bool),
    )
    solution = jax.jit(jax.vmap(jl.values.boltzmann_value, (0, 0, None)))(
        dense, jnp.asarray(reward), 0.95
    )
    value = np.asarray(solution.value)
    q = reward + 0.95 * np.einsum("nsat,nt->nsa", transition, value)
    residual = np.abs(reference.soft_maximum(q, available, "boltzmann") - value).max(axis=1)
    converged = np.asarray(solution.status) == Status.UNCERTIFIED
    assert residual[converged].max() < 1e-10
    assert converged.sum() >= 148, f"only {converged.sum()} of 150 converged"
    plain = np.zeros((150, 6))
    for _ in range(1000):
        q = reward + 0.95 * np.einsum("nsat,nt->nsa", transition, plain)
        plain, last = reference.soft_maximum(q, available, "boltzmann"), plain
    failed = np.abs(plain - last).max(axis=1) > 1e-3
    assert failed.sum() > 20, "many of the examples are hard"


@pytest.mark.parametrize("num_actions", [2, 3, 4, 7])
def test_expansion_bounds_every_jacobian_and_is_nearly_attained(num_actions):
    """Row sums ``sum_a |pi_a (1 + q_a - v)|`` at random q, and a random search for the largest."""
    rng = np.random.default_rng(6)

    def row_sum(q):
        policy = np.exp(q - q.max(axis=-1, keepdims=True))
        policy /= policy.sum(axis=-1, keepdims=True)
        mean = (policy * q).sum(axis=-1, keepdims=True)
        return np.abs(policy * (1 + q - mean)).sum(axis=-1)

    bound = boltzmann_expansion(num_actions)
    q = rng.normal(size=(50_000, num_actions)) * rng.uniform(0, 10, (50_000, 1))
    best = q[row_sum(q).argmax()]
    for scale in np.geomspace(3, 1e-3, 200):
        near = best + scale * rng.normal(size=(500, num_actions))
        best = max((best, near[row_sum(near).argmax()]), key=row_sum)
    assert row_sum(q).max() <= row_sum(best) <= bound <= row_sum(best) + 1e-4


def test_expansion_as_published():
    np.testing.assert_allclose(
        [boltzmann_expansion(n) for n in (1, 2, 3, 4)], [1, 1.2, 1.327, 1.4225], atol=5e-4
    )


def explicit_sensitivity(model, policy, q, value, direction, discount, constant_policy):
    """d value and d Q along a direction of Q's constant part.

    ``d V = sum_a w_a d Q_a`` with w the policy (2.7), or with the policy's own change in it.
    """
    weight = policy if constant_policy else policy * (1 + q - value[:, None])
    chain = np.einsum("sa,sat->st", weight, model.transition)
    slope = np.linalg.solve(np.eye(len(value)) - discount * chain, (weight * direction).sum(1))
    return slope, direction + discount * (model.transition @ slope)


@pytest.mark.few(1)
@pytest.mark.parametrize("adjoint", ["exact", "approximate"])
def test_sensitivities_equal_the_explicit_equations(adjoint):
    """In the reward and the probabilities; the two adjoints differ, except at zero reward."""
    rng = np.random.default_rng(7)
    model = reference.random_model(rng, 6, 3, 3, 0.2)
    mdp, discount = as_mdp(model), 0.8
    toward_reward = rng.normal(size=(6, 3))
    toward_probability = mass_preserving(rng, model.probability)
    cotangent = rng.normal(size=6)

    def answer(reward, probability):
        solution = jl.values.boltzmann_value(
            mdp.replace(probability=probability), reward, discount, adjoint=adjoint
        )
        return solution.value, solution.policy

    @jax.jit
    def derivatives(reward):
        found, forward = jax.linearize(answer, reward, mdp.probability)
        zero = jnp.zeros_like(reward), jnp.zeros_like(mdp.probability)
        backward = jax.linear_transpose(forward, reward, mdp.probability)
        return (
            found,
            forward(toward_reward, zero[1]),
            forward(zero[0], toward_probability),
            backward((jnp.asarray(cotangent), zero[0])),
        )

    for reward in (2 * rng.normal(size=(6, 3)), np.zeros((6, 3))):
        found, *forward, backward = jax.tree.map(np.asarray, derivatives(reward))
        value, policy = found
        q = np.where(model.available, reward + discount * (model.transition @ value), 0)
        change = discount * (toward_probability * value[model.successor]).sum(-1)
        along = zip(
            (toward_reward, change),
            forward,
            (toward_reward, toward_probability),
            backward,
            strict=True,
        )
        for direction, (dvalue, dpolicy), input_direction, gradient in along:
            slope, dq = explicit_sensitivity(
                model, policy, q, value, direction, discount, adjoint == "approximate"
            )
            np.testing.assert_allclose(dvalue, slope, rtol=1e-9, atol=1e-10)
            softmax_slope = policy * (dq - (policy * dq).sum(1, keepdims=True))
            np.testing.assert_allclose(dpolicy, softmax_slope, rtol=1e-8, atol=1e-10)
            np.testing.assert_allclose(
                np.vdot(gradient, input_direction), cotangent @ slope, rtol=1e-8, atol=1e-10
            )
            other, _ = explicit_sensitivity(
                model, policy, q, value, direction, discount, adjoint == "exact"
            )
            if reward.any():
                assert np.abs(other - slope).max() > 1e-2
            else:
                np.testing.assert_allclose(other, slope, atol=1e-12)


@pytest.mark.slow
def test_soft_newton_passes_linear_systems_that_single_precision_does_not_solve():
    """In this world the linear solver gets nowhere in the second step; a sweep leads on."""
    model = stack_products([grid.random_world(9).mdp], grid.COMPLETE)
    model = jax.tree.map(lambda x: x[0].astype(jnp.float32) if x.dtype == float else x[0], model)
    found = soft_value(model, grid.expert_reward(model), 0.95, max_steps=5000)
    assert found.status == Status.CONVERGED
    assert jnp.max(found.upper - found.lower) < 0.02


@pytest.mark.few(1)
@pytest.mark.parametrize("place", ["inside", "float32", "argument"])
def test_single_precision_means_the_discount_as_given(place):
    """Inside ``jit``; a number of Python that ``jit`` itself rounds leaves wider bounds."""
    with jax.enable_x64(False):
        model = jl.from_dense(np.ones((1, 1, 1), np.float32))
        reward = jnp.full((1, 1), 1e-3, jnp.float32)
        number = np.float32(0.999) if place == "float32" else 0.999
        if place == "inside":
            found = jax.jit(lambda m: jl.optimal_value(m, reward, number))(model)
        else:
            found = jax.jit(lambda m, d: jl.optimal_value(m, reward, d))(model, number)
        low, high = float(found.lower[0]), float(found.upper[0])
    exact = Fraction(float(reward[0, 0])) / (1 - Fraction(float(number)))
    assert Fraction(low) <= exact <= Fraction(high)
    assert (high - low < 3e-7) == (place != "argument")


@pytest.mark.parametrize("players", [1, 2])
def test_a_reward_of_states_is_one_of_their_actions(players):
    world = jl.from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 1.0]]])
    model = jl.make_game(world, [True, False]) if players == 2 else world
    reward = np.array([1.0, 2.0])
    for solve in (jl.optimal_value, jax.jit(jl.optimal_value)):
        assert np.allclose(solve(model, reward, 0.5).value, [3, 4])
    assert np.allclose(jl.policy_value(model, np.array([0, 0]), reward, 0.5).value, [2, 4])
