"""What learners that play share, against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.algos.common.explicit_games import cumulative, draw, draw_weighted


@pytest.mark.parametrize("size", [1, 2, 3, 7, 16, 17])
def test_states_are_drawn_by_the_inverse_of_the_cumulative_weights(size):
    rng = np.random.default_rng(size)
    weight = rng.random(size) * (rng.random(size) < 0.6)
    weight[rng.integers(size)] += 1.0
    table = cumulative(weight / weight.sum())
    edges = np.minimum(np.concatenate([table, table - 1, [0]]).astype(np.uint64) * 2, 2**32 - 1)
    words = np.concatenate([edges.astype(np.uint32), rng.integers(2**32, size=40, dtype=np.uint32)])
    expected = np.searchsorted(table, words >> 1, side="right")
    found = draw(jnp.asarray(table), jnp.asarray(words))
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(
        jax.vmap(draw, (None, 0))(jnp.asarray(table), jnp.asarray(words)), expected
    )
    assert np.all(weight[expected] > 0)


def test_actions_are_drawn_by_their_weights():
    rng = np.random.default_rng(0)
    weight = rng.dirichlet(np.ones(7), size=50) * (rng.random((50, 7)) < 0.6)
    weight[:, 2] += 1e-3
    words = np.linspace(0, 2**32 - 1, 20_001).astype(np.uint32)
    rows = jnp.asarray(weight, jnp.float32)[:, None], jnp.asarray(words)
    drawn = np.asarray(draw_weighted(*rows))
    share = np.stack([(drawn == a).mean(1) for a in range(7)], axis=1)
    np.testing.assert_allclose(share, weight / weight.sum(-1, keepdims=True), atol=1e-3)
    assert not share[weight == 0].any()
