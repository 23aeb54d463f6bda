"""The loop of the solvers under ``vmap``, against one lane after another."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.values.engine.iterate import iterate

GRAPH = jnp.array([1, 2, 0, 3, 1])


def halve(graph, carry, given):
    value, scale = carry[graph] / 2, given
    return value * (scale[0] if value.ndim == 1 else scale[:1])


def settled(carry, given):
    return jnp.abs(carry).max(0) <= given[1]


def solve(carry, given, most):
    return iterate(
        halve, settled, (GRAPH, carry, given), max_steps=most, lanes="side by side", every=2
    )


@pytest.mark.few(2)
@pytest.mark.parametrize("lanes", [1, 7, 10, 16, 17])
def test_any_number_of_lanes_side_by_side_is_each_alone(lanes):
    rng = np.random.default_rng(lanes)
    start = jnp.asarray(rng.normal(size=(lanes, 5)))
    given = jnp.stack([jnp.ones(lanes), jnp.logspace(-1, -6, lanes)], axis=1)
    most = jnp.arange(lanes) % 7 + 5
    together = jax.jit(jax.vmap(solve))(start, given, most)
    nested = jax.vmap(jax.vmap(solve, (0, None, None)), (None, 0, 0))(start, given, most)
    for i in range(lanes):
        alone = solve(start[i], given[i], most[i])
        for found in (together, jax.tree.map(lambda x, i=i: x[i], nested)):
            for x, y in zip(found, alone, strict=True):
                np.testing.assert_array_equal(x[i], y)
