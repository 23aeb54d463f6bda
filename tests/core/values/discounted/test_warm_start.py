"""Warm-started values of many models of one game, against the solver of one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.models.game import Game
from jaxltl.core.models.mdp import make_mdp
from jaxltl.core.models.ops.operators import expectation
from jaxltl.core.values.discounted.minimax import minimax_value
from jaxltl.core.values.discounted.warm_start import Models, span_iteration

SHAPE = (9, 3, 2)


def models(seed, num, shape=SHAPE):
    """One graph with several probabilities and gains; one state without any move."""
    rng = np.random.default_rng(seed)
    probability = rng.dirichlet(np.ones(shape[2]), size=(num, *shape[:2]))
    available = rng.random(shape[:2]) < 0.7
    available[:, 0] = True
    mdp = make_mdp(rng.integers(shape[0] - 1, size=shape), probability[0], available=available)
    game = Game(mdp, jnp.asarray(rng.random(shape[0]) < 0.5))
    allowed = available & (np.arange(shape[0]) != shape[0] - 1)[:, None]
    gain = rng.normal(size=(num, *shape[:2]))
    guess = rng.normal(size=(num, shape[0]))
    return game, jnp.asarray(allowed), *map(jnp.asarray, (probability, gain, guess))


def exact(game, allowed, probability, gain, discount):
    game = Game(game.mdp.replace(probability=probability, available=allowed), game.system)
    return np.asarray(minimax_value(game, gain, discount, tolerance=1e-10).value)[:-1]


@pytest.mark.few(1, 2)
@pytest.mark.parametrize("shape", [SHAPE, (6, 2, 1), (8, 2, 20)])
@pytest.mark.parametrize("enough", [1e-2, 1e-9])
def test_the_error_holds_what_it_says(shape, enough):
    game, allowed, probability, gain, guess = models(0, 4, shape)
    for i in range(4):
        value, error, quantity = span_iteration(
            game, allowed, Models(gain[i], probability[i], guess[i], 0.8, enough, True)
        )
        expected = exact(game, allowed, probability[i], gain[i], 0.8)
        assert error <= enough
        assert np.abs(value[:-1] - expected).max() <= error + 1e-9
        assert value[-1] == guess[i, -1], "a state without a move stays"
        model = game.mdp.replace(probability=probability[i])
        reached = expectation(model, value)
        moves = np.asarray(game.available)
        np.testing.assert_allclose(quantity[moves], (gain[i] + 0.8 * reached)[moves], atol=1e-12)


@pytest.mark.exhaustive
def test_lanes_are_as_if_alone_however_they_are_nested():
    game, allowed, probability, gain, guess = models(1, 6)
    discount, enough = jnp.linspace(0.3, 0.9, 6), jnp.logspace(-1, -8, 6)
    active = jnp.array([True, True, False, True, True, True])

    def solve(game, allowed, p, g, v, d, e, a):
        return span_iteration(game, allowed, Models(g, p, v, d, e, a))

    alone = [
        solve(game, allowed, *x)
        for x in zip(probability, gain, guess, discount, enough, active, strict=True)
    ]
    lanes = (probability, gain, guess, discount, enough, active)
    shared = (None, None, 0, 0, 0, 0, 0, 0)
    flat = jax.jit(jax.vmap(solve, shared))(game, allowed, *lanes)
    pairs = jax.tree.map(lambda x: x.reshape(2, 3, *x.shape[1:]), lanes)
    nested = jax.jit(jax.vmap(jax.vmap(solve, shared), shared))(game, allowed, *pairs)
    own = jax.tree.map(lambda x: jnp.stack([x] * 6), (game, allowed))
    graphs = jax.jit(jax.vmap(solve))(*own, *lanes)
    for i, expected in enumerate(alone):
        for found in (flat, jax.tree.map(lambda x: x.reshape(6, *x.shape[2:]), nested), graphs):
            for x, y in zip(found, expected, strict=True):
                np.testing.assert_allclose(x[i], y, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(flat[0][2], guess[2])
    assert flat[1][2] == np.inf


@pytest.mark.slow
def test_the_last_of_many_lanes_end_as_they_do_among_few():
    """Most begin with their value and end at once, which leaves few that go on by themselves."""
    game, allowed, probability, gain, guess = models(3, 64)
    enough = jnp.full(64, 1e-9)

    def solve(p, g, v, e, a):
        return span_iteration(game, allowed, Models(g, p, v, 0.8, e, a))

    few = jax.jit(jax.vmap(solve))

    def by_eights(value, active):
        groups = [
            few(*(x[i : i + 8] for x in (probability, gain, value, enough, active)))
            for i in range(0, 64, 8)
        ]
        return jax.tree.map(lambda *x: jnp.concatenate(x), *groups)

    near = by_eights(guess, jnp.ones(64, bool))[0]
    late = np.random.default_rng(0).permutation(64)[:12]
    near, active = near.at[late].set(guess[late]), jnp.ones(64, bool).at[late[0]].set(False)
    for value in (near, guess):
        together = jax.jit(jax.vmap(solve))(probability, gain, value, enough, active)
        for x, y in zip(together, by_eights(value, active), strict=True):
            np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-12)


def test_a_good_guess_and_a_constant_beside_it_end_at_once():
    game, allowed, probability, gain, _ = models(2, 1)
    lane = Models(gain[0], probability[0], jnp.zeros(9), 0.9, 1e-12, True)
    value, _, _ = span_iteration(game, allowed, lane)
    moved, error, _ = span_iteration(game, allowed, lane._replace(value=value + 5, enough=1e-9))
    assert error <= 1e-9
    np.testing.assert_allclose(moved[:-1], value[:-1], atol=1e-9)
