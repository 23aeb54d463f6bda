"""Solvers of the host inside ``jit``: shapes, precision, lanes, errors, and NumPy alone."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.types import Solution, Status
from jaxltl.core.values.engine.host_callback import (
    fitted,
    on_host_inside_jit,
    rounded_outwards,
    solution_layout,
)

FIELDS = ("value", "policy", "lower", "upper", "num_steps", "status")


def coin(probability=0.5):
    """State 0 repeats, or ends in the target 1 or in the sink 2; a second choice leads to the sink."""
    p = probability
    return jl.make_sparse(
        [0, 2, 3, 4], [0, 3, 4, 5, 6], [0, 1, 2, 2, 1, 2], [1 - p, p / 2, p / 2, 1, 1, 1]
    )


TARGET = np.array([False, True, False])


def reach(model, target, *, derivative=None):
    solve = partial(jl.reachability_probability)
    return on_host_inside_jit(solve, solution_layout(model), model, target, derivative=derivative)


def numpy_only(solve):
    """The solver, in a thread in which JAX may move no array."""

    def guarded(*arguments):
        with jax.transfer_guard("disallow_explicit"):
            return solve(*arguments)

    return guarded


def until(model, target):
    stay = np.ones(target.shape, bool)
    return jl.reachability_probability(model, target, stay=stay)


def interval_model():
    model = coin()
    ends = (np.clip(model.probability + x, 0, 1) for x in (-0.05, 0.05))
    return jl.make_interval(model, *ends)


def padded():
    return jl.from_dense([[[0.4, 0.3, 0.3]], [[0, 1.0, 0]], [[0, 0, 1.0]]])


QUESTIONS = {
    "sparse": (coin, jl.reachability_probability),
    "until": (padded, until),
    "average": (coin, lambda m, t: jl.average_reward(m, np.arange(4.0))),
    "interval": (interval_model, jl.reachability_probability),
    "rewards": (coin, lambda m, t: jl.total_reward(m, np.ones(4), t | (np.arange(3) == 2))),
}


@pytest.mark.parametrize("name", QUESTIONS)
def test_it_is_the_answer_of_the_host(name):
    build, solve = QUESTIONS[name]
    model = build()
    alone = solve(model, TARGET)
    layout = solution_layout(model, policy=alone.policy, nature=alone.nature)

    @jax.jit
    def inside(model, target):
        return on_host_inside_jit(numpy_only(solve), layout, model, target)

    found = inside(model, TARGET)
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(found, field), getattr(alone, field), field)


def test_lanes_are_answers_alone():
    chances = jnp.array([0.1, 0.5, 0.9])
    targets = jnp.stack([jnp.asarray(TARGET), jnp.zeros(3, bool), jnp.ones(3, bool)])
    model = coin()

    def one(p, target):
        row = jnp.stack([1 - p, p / 2, p / 2])
        moved = model.replace(probability=jnp.concatenate([row, jnp.ones(3)]))
        return reach(moved, target)

    lanes = jax.jit(jax.vmap(one))(chances, targets)
    for i, p in enumerate(np.asarray(chances)):
        alone = jl.reachability_probability(coin(p), np.asarray(targets[i]))
        np.testing.assert_array_equal(lanes.value[i], alone.value)
        np.testing.assert_array_equal(lanes.policy[i], alone.policy)


def test_invalid_numbers_give_a_status():
    model = coin()

    @jax.jit
    def one(probability):
        return reach(model.replace(probability=probability), TARGET)

    found = one(jnp.full(6, 0.7))
    assert found.status == Status.INVALID
    assert jnp.isnan(found.value).all()
    assert (found.lower == -jnp.inf).all() and (found.upper == jnp.inf).all()
    with pytest.raises(ValueError, match="invalid"):
        jl.check(found)


def test_invalid_intervals_give_a_status():
    model = interval_model()

    @jax.jit
    def one(lower):
        moved = model.replace(lower=lower)
        return on_host_inside_jit(
            jl.reachability_probability,
            solution_layout(model, nature=model.lower),
            moved,
            TARGET,
        )

    assert one(model.lower).status == Status.CONVERGED
    assert one(model.lower + 1).status == Status.INVALID


def test_derivatives_raise_unless_given():
    model = coin()

    def value(probability):
        return reach(model.replace(probability=probability), TARGET).value[0]

    for derivative in (jax.grad, jax.jacfwd, lambda f: jax.jit(jax.grad(f))):
        with pytest.raises(TypeError, match="no derivatives"):
            derivative(value)(jnp.asarray(model.probability))
    # Other derivatives are not affected.
    slope = jax.jit(jax.grad(lambda x: x * value(jnp.asarray(model.probability))))(2.0)
    np.testing.assert_allclose(slope, 0.5, rtol=1e-6)

    def twice(x):
        solution = reach(
            model.replace(probability=x), TARGET, derivative=lambda found: found.value * x[0]
        )
        return solution.value[0]

    slope = jax.jit(jax.grad(twice))(jnp.asarray(model.probability))
    np.testing.assert_allclose(slope, [0.5, 0, 0, 0, 0, 0], rtol=1e-6)


def test_single_precision_rounds_outwards():
    with jax.enable_x64(False):
        model = coin(0.3)
        found = jax.jit(reach)(model, TARGET)
        assert found.value.dtype == np.float32 and found.policy.dtype == np.int32
        alone = jl.reachability_probability(model, TARGET)
        assert (np.asarray(found.lower, float) <= alone.lower).all()
        assert (np.asarray(found.upper, float) >= alone.upper).all()
        assert found.status == Status.CONVERGED


@pytest.mark.parametrize("bound", [0.1, 1.0, 0.0, 1e-50, -1e-50, 1e50, -1e50, 1e-40, np.inf, -0.7])
def test_bounds_are_rounded_outwards(bound):
    low, high = (rounded_outwards(np.array([bound]), np.dtype(np.float32), end) for end in (-1, 1))
    assert low.dtype == high.dtype == np.float32
    assert float(low[0]) <= bound <= float(high[0])
    tiny = np.finfo(np.float32).tiny
    assert all(x == 0 or abs(x) >= tiny for x in (low[0], high[0]))
    if bound in (0, 1, np.inf):
        assert low[0] == high[0] == bound


def test_a_tolerance_below_single_precision_is_not_claimed():
    value = np.full(3, 0.1)
    solution = Solution(
        value, np.zeros(3, np.int32), value, value, np.float64(0), np.int32(1), np.int32(0)
    )
    with jax.enable_x64(False):
        layout = solution_layout(coin())
        assert fitted(solution, layout, 1e-3, relative=False).status == Status.CONVERGED
        assert fitted(solution, layout, 1e-9, relative=False).status == Status.PRECISION


def test_many_callbacks_do_not_wait_for_each_other():
    chain, target = coin(), TARGET

    @jax.jit
    def loop(shift):
        def step(i, total):
            return total + reach(chain, jnp.roll(target, i)).value.sum()

        return jax.lax.fori_loop(0, 20, step, shift)

    results = [loop(jnp.asarray(float(i))) for i in range(8)]  # asynchronous
    assert np.isfinite(jax.device_get(results)).all()
