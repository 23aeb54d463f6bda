"""Float32 enclosures inside ``jit`` and ``vmap`` are as narrow as outside, and contain the truth."""

from __future__ import annotations

from functools import partial
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from benchmarks import float32_lanes as lanes

WIDTH = 1e-5


@pytest.mark.parametrize(
    ("question", "formula", "count"),
    [
        ("satisfaction", "!b U a", 2),
        *(
            pytest.param(
                question,
                formula,
                10,
                marks=pytest.mark.exhaustive if (i // 4 - i) % 4 else pytest.mark.slow,
            )
            for i, (question, formula) in enumerate(product(lanes.QUESTIONS, lanes.FORMULAS))
        ),
    ],
)
def test_lanes_are_certified_and_contain_the_exact_value(question, formula, count):
    """On walks of some 10^4 steps; `check` accepts a batch as it accepts one solution."""
    ask = lanes.QUESTIONS[question]
    with jax.enable_x64(False):
        models = lanes.random_products(formula, count)
        stack = jax.tree.map(lambda *x: jnp.stack(x), *models)
        found = jl.check(jax.jit(jax.vmap(partial(ask, width=WIDTH)))(stack))
        assert found.value.dtype == jnp.float32
        for i, model in enumerate(models):
            lane = jax.tree.map(lambda x, i=i: np.asarray(x)[i], found)
            assert (lane.lower <= lane.value).all() and (lane.value <= lane.upper).all()
            assert not lanes.wrong(lane, lanes.truth(ask, model))
            if i == 0:
                alone = jl.check(ask(model, WIDTH))
                np.testing.assert_allclose(alone.value, lane.value, rtol=2 * WIDTH, atol=2 * WIDTH)


@pytest.mark.slow
def test_small_probabilities_have_bounds_beyond_the_least_float():
    """A walk away from the target: .05^k, far below what float32 represents."""
    size = 40
    states = np.arange(size)
    successor = np.stack([(states - 1).clip(0), (states + 1).clip(0, size - 1)], -1)
    weight = np.tile([0.95, 0.05], (size, 1))
    weight[[0, -1]] = [1, 0]
    successor[[0, -1]] = states[[0, -1], None]
    with jax.enable_x64(False):
        mdp = jl.make_mdp(successor[:, None], weight[:, None])
        found = jax.jit(jl.reachability_probability)(mdp, states == size - 1)
        ratio = np.float64(19.0)
        exact = (ratio**states - 1) / (ratio ** (size - 1) - 1)
        assert found.status == jl.Status.CONVERGED
        assert (np.asarray(found.lower, float) <= exact * (1 + 1e-5)).all()
        assert (np.asarray(found.upper, float)[1:] >= exact[1:] * (1 - 1e-5)).all()
