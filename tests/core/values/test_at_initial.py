"""Values from the initial distribution: bounds hold the exact mean, and derivatives are those of the sum."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.types import Solution

WORLD = jl.make_mdp(
    [[[1, 2]], [[1, 1]], [[2, 2]]],
    [[[0.25, 0.75]], [[1.0, 0]], [[1.0, 0]]],
    label={"a": [1]},
    initial=[0.5, 0.25, 0.25],
)


@pytest.mark.parametrize("seed", range(20))
def test_bounds_hold_the_exact_mean(seed):
    rng = np.random.default_rng(seed)
    dtype = (np.float32, np.float64)[seed % 2]
    initial = (rng.random(50) * (rng.random(50) < 0.5)).astype(dtype)
    initial[0] += 0.1
    value = (rng.normal(size=50) * 10.0 ** rng.integers(-3, 4, 50)).astype(dtype)
    zero, one = np.zeros(50, np.int32), np.int32(0)
    found = Solution(value, zero, value, value, one, one, one, initial=initial).at_initial
    share = [Fraction(float(x)) for x in initial]
    exact = sum(p * Fraction(float(x)) for p, x in zip(share, value, strict=True)) / sum(share)
    assert Fraction(float(found.lower)) <= exact <= Fraction(float(found.upper))
    assert found.lower <= found.value <= found.upper
    assert found.upper - found.lower <= 1e3 * np.finfo(dtype).eps * np.abs(value).max()


def test_one_state_and_infinite_values_are_exact():
    spread = jl.total_reward(WORLD, np.ones(3), "a").at_initial
    assert [float(x) for x in spread] == [np.inf] * 3
    start = WORLD.replace(initial=jnp.array([1.0, 0, 0]))
    found = jl.reachability_probability(start, "a")
    assert [float(x) for x in found.at_initial] == [
        float(x[0]) for x in (found.value, found.lower, found.upper)
    ]


def test_lanes_and_products_have_their_own():
    model = jl.product(WORLD, "F a")
    best = jl.optimal_satisfaction(model)
    expected = float((model.initial * best.value).sum())
    assert float(best.at_initial.value) == pytest.approx(expected)
    lanes = jax.vmap(lambda r: jl.optimal_value(WORLD, r * jnp.ones((3, 1)), 0.5))(jnp.arange(3.0))
    np.testing.assert_allclose(lanes.at_initial.value, [0, 2, 4], rtol=1e-6)


def test_derivatives_are_those_of_the_sum():
    def value(probability):
        model = WORLD.replace(probability=probability)
        return jl.reachability_probability(model, "a").at_initial.value

    slope = jax.jit(jax.grad(value))(WORLD.probability)
    assert slope[0, 0].tolist() == [0.5, 0.0]


def test_solutions_without_a_model_say_so():
    solution = jl.reachability_probability(WORLD, "a").replace(initial=None)
    with pytest.raises(ValueError, match="no initial distribution"):
        _ = solution.at_initial
