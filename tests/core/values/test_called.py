"""Questions without a compiled engine, inside ``jit``: the host answers, lane by lane."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.types import Status

WORLD = jl.make_mdp(
    [[[1, 2], [1, 2]], [[1, 1]] * 2, [[2, 2]] * 2],
    [[[0.5, 0.5], [0.25, 0.75]], [[1.0, 0]] * 2, [[1.0, 0]] * 2],
    label={"a": [1]},
    initial=[1, 0, 0],
)
GAME = jl.make_game(WORLD, [False, True, True])


@pytest.mark.parametrize(
    ("model", "value"), [(jl.to_sparse(WORLD), 0.5), (GAME, 0.25), (jl.product(GAME, "F a"), 0.25)]
)
def test_a_label_is_reached_as_on_the_host(model, value):
    found = jax.jit(lambda m: jl.reachability_probability(m, "a"))(model)
    assert found.status == Status.CONVERGED
    assert found.lower.dtype == jnp.zeros(()).dtype
    assert float(found.at_initial.value) == value
    host = jl.reachability_probability(model, "a")
    np.testing.assert_array_equal(found.policy, host.policy)


def test_lanes_have_their_own_answers():
    first = jnp.array([0.1, 0.4, 0.9])

    def value(p):
        row = jnp.stack([p, 1 - p])
        world = WORLD.replace(probability=WORLD.probability.at[0, 1].set(row))
        game = jl.make_game(WORLD, [False, True, True]).replace(mdp=world)
        return jl.average_reward(game, jnp.array([[0.0, 0], [1.0, 1], [0.0, 0]])).at_initial

    found = jax.jit(jax.vmap(value))(first)
    np.testing.assert_allclose(found.value, np.minimum(first, 0.5), atol=1e-5)
    assert (found.lower <= found.value).all() and (found.value <= found.upper).all()


def test_a_concrete_product_stays_concrete_inside_jit():
    model = jl.product(jl.to_sparse(WORLD), "F a")
    reward = jnp.ones(model.state_shape).at[1].set(3.0)
    value = jax.jit(lambda discount: jl.optimal_value(model, reward, discount).value)(0.5)
    np.testing.assert_allclose(value, jl.optimal_value(model, reward, 0.5).value, rtol=1e-5)


@pytest.mark.few(2)
@pytest.mark.parametrize("number", [None, [3, 1, 0, 2], [1, 1, 0, 0]])
def test_actions_inside_jit_have_the_numbers_of_those_outside(number):
    # Numbers that a state has twice are none; actions are then numbered in their order.
    model = jl.make_sparse(
        [0, 2, 3, 4], [0, 2, 4, 5, 6], [1, 2] * 3, [0.25, 0.75, 0.5, 0.5, 1, 1], action=number
    )
    known = model.action_number
    reward = np.zeros((3, known.max() + 1))
    reward[0, known[:2]] = [7.0, 5.0]

    def ask(model, reward):
        best = jl.optimal_value(model, reward, 0.5)
        return best, jl.policy_value(model, best.policy, reward, 0.5)

    best, again = jax.jit(ask)(model, reward)
    assert best.policy.tolist() == [known[0], *known[2:]] and best.policy.dtype == jnp.int32
    for found in best, again, jl.optimal_value(model, reward, 0.5):
        np.testing.assert_allclose(found.value, [7, 0, 0], atol=1e-5)


@pytest.mark.parametrize(
    ("ask", "match"),
    [
        (lambda m: jl.reachability_probability(m, "zz"), "target mentions .*'zz'"),
        (lambda m: jl.reachability_probability(m, "a", stay="F a"), "stay: .* temporal"),
        (lambda m: jl.reachability_probability(m, "a", policy=jnp.zeros(7, int)), "policy has"),
        (lambda m: jl.reachability_probability(m, "a", policy=jnp.ones((7, 2))), "policy has"),
        (lambda m: jl.average_reward(m, np.ones((7, 2))), "reward has shape"),
        (lambda m: jl.average_reward(m, "zz"), "'zz'"),
        (lambda m: jl.average_reward(m, None), "reward"),
        (lambda m: jl.values.bounded_reachability(m, "a", -1), "num_steps=-1"),
        (lambda m: jl.values.bounded_reachability(m, "a", 2, by_step=True), "outside jit"),
        (lambda m: jl.values.reward_bounded_reachability(m, "a", np.ones(3), -1.0), "bound=-1"),
    ],
)
@pytest.mark.parametrize("model", [jl.to_sparse(WORLD), GAME])
def test_what_no_numbers_make_right_is_raised_at_once(model, ask, match):
    with pytest.raises(ValueError, match=match):
        jax.jit(ask)(model)


@pytest.mark.few(1)
@pytest.mark.parametrize("text", ["a & !b", "a xor init"])
def test_formulas_of_labels_are_read_inside_jit(text):
    world = WORLD.replace(label=jnp.array([[0, 1], [1, 0], [1, 1]], bool), propositions=("a", "b"))
    for model in world, jl.product(world, "F a"):
        found = jax.jit(lambda m: jl.reachability_probability(m, text).value)(model)
        np.testing.assert_allclose(found, jl.reachability_probability(model, text).value)
    for wrong, match in ("F a", "temporal"), ("c", "mentions .*'c'"):
        with pytest.raises(ValueError, match=match):
            jax.jit(lambda m, x=wrong: jl.reachability_probability(m, x))(world)


def test_rewards_for_ever_of_a_game_inside_jit():
    ask = lambda m: jl.total_reward(m, jnp.array([1.0, 0, 0])).value  # noqa: E731
    np.testing.assert_allclose(jax.jit(ask)(GAME), ask(GAME), rtol=1e-6)


def test_what_a_program_cannot_raise_is_a_status():
    model = jl.to_sparse(WORLD)
    solve = jax.jit(lambda p: jl.reachability_probability(model, "a", policy=p).status)
    assert int(solve(jnp.array([1, 0, 0]))) == Status.CONVERGED
    assert int(solve(jnp.array([2, 0, 0]))) == Status.INVALID
    with pytest.raises(ValueError, match="target has shape"):
        jax.jit(lambda m: jl.reachability_probability(m, jnp.ones(2, bool)))(GAME)
    with pytest.raises(ValueError, match=r"there are no labels|'b'"):
        jl.reachability_probability(GAME, "b")


def test_values_of_the_host_have_no_derivatives():
    def value(p):
        game = GAME.replace(mdp=WORLD.replace(probability=p))
        return jl.reachability_probability(game, "a").at_initial.value

    with pytest.raises(TypeError, match="no derivatives"):
        jax.grad(value)(WORLD.probability)


def test_options_and_throw_are_refused_where_nobody_reads_them():
    with pytest.raises(ValueError, match="max_steps is an option"):
        jax.jit(lambda m: jl.reachability_probability(m, "a", max_steps=3))(GAME)
    with pytest.raises(ValueError, match="outside jit"):
        jax.jit(lambda m: jl.reachability_probability(m, "a", throw=True))(GAME)
    sparse = jl.to_sparse(WORLD)
    slow = {"tolerance": 0.0, "throw": True}
    with pytest.raises(jl.NotConverged):
        jl.optimal_value(sparse, [0.1, 0.2, 0.3], 0.9, **slow)
