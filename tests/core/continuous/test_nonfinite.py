"""Policies, steps, labels and noise that may be NaN: nothing is proven from them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.algos import ppo
from jaxltl.core.continuous import (
    certify_policy,
    from_cdf,
    make_dynamics,
    synthesize_policy,
    uniform,
    where_positive,
)
from jaxltl.core.continuous.images import gain_program
from jaxltl.core.types import Status

HIDDEN = np.full((1, 4), 0.3, np.float32)


def world(step=lambda x, u, w: 0.5 * x + 0.1 * u, **options):
    """A world in which every number is inside and has the label `ok`."""
    defaults = {
        "domain": ([-1.0], [1.0]),
        "labels": {"ok": ([-1.0], [1.0]), "u": ([0.9], [1.0])},
        "actions": ([-1.0], [1.0]),
        "initial": ([-0.9], [0.8]),
    }
    return make_dynamics(step, **(defaults | options))


POLICIES = {
    "everywhere": lambda x: x * jnp.nan,
    "constant": lambda x: jnp.array([jnp.nan]),
    "on one side": lambda x: jnp.where(x < 0, jnp.nan, x),
    "logarithm": jnp.log,
    "root": lambda x: jnp.sqrt(x + 0.5),
    "arcsine": lambda x: jnp.arcsin(2 * x),
    "power": lambda x: (x - 0.25) ** 1.5,
    "quotient": lambda x: x / x,
    "last layer": lambda x: jnp.tanh(x @ HIDDEN) @ np.full((4, 1), np.nan, np.float32),
    "hidden layer": lambda x: jnp.tanh(x @ (HIDDEN * np.nan)) @ HIDDEN.T,
    "bias": lambda x: jnp.tanh(x @ HIDDEN + np.nan) @ HIDDEN.T,
    "branch": lambda x: jax.lax.cond(x[0] > 0, lambda y: y, lambda y: y * jnp.nan, x),
}


@pytest.mark.few(12)
@pytest.mark.parametrize("outside", ["violates", "clip", "far"])
@pytest.mark.parametrize("name", POLICIES)
def test_policies_that_may_be_nan_prove_nothing(name, outside):
    dynamics = world(outside=outside)
    for formula in ("G ok", "G !u", "G F ok", "F u"):
        proof = certify_policy(dynamics, POLICIES[name], formula, cells=[20], max_cells=100)
        assert proof.status == Status.NONFINITE, formula
        assert proof.initial_bounds == (0, 1)
        assert not proof.lower.any() and (proof.upper == 1).all() and not proof.how.any()
        assert "NaN on the cell" in proof.summary()


def test_formulas_that_the_first_state_decides_need_no_policy():
    proof = certify_policy(world(), POLICIES["everywhere"], "F ok", cells=[20])
    assert proof.initial_bounds == (1, 1) and proof.status == Status.CONVERGED


def test_learned_parameters_that_are_nan():
    dynamics = world()
    problem, hparams = ppo.make_problem(dynamics), ppo.Hparams(discount=0.9)
    state = ppo.init(jax.random.key(0), problem, hparams)
    state = jax.tree.map(
        lambda x: x * jnp.nan if jnp.issubdtype(x.dtype, jnp.floating) else x, state
    )
    proof = certify_policy(dynamics, ppo.greedy(state, problem, hparams), "G ok", cells=[20])
    assert proof.status == Status.NONFINITE and proof.initial_bounds == (0, 1)


def test_steps_that_may_be_nan_prove_nothing():
    # NaN at 0 alone, which no sampled state is.
    dynamics = world(lambda x, u, w: jnp.clip(0.5 * x + 0.0 * x / x, -1, 1))
    proof = certify_policy(dynamics, lambda x: x, "G ok", cells=[20])
    assert proof.status == Status.NONFINITE and proof.initial_bounds == (0, 1)
    grid = world(lambda x, u, w: jnp.clip(0.5 * x + 0.0 * x / x, -1, 1), actions=[[-1.0], [1.0]])
    found = synthesize_policy(grid, "G ok", cells=[20]).certificate
    assert found.status == Status.NONFINITE and found.initial_bounds == (0, 1)


def test_labels_that_may_be_nan_prove_nothing():
    half = where_positive(lambda x: jnp.sqrt(x[0]) + 1)
    for formula in ("G half", "G !half", "F half"):
        proof = certify_policy(world(labels={"half": half}), lambda x: x, formula, cells=[20])
        assert proof.status == Status.NONFINITE and proof.initial_bounds == (0, 1)
    with pytest.raises(ValueError, match="may be NaN on the cell"):
        half.membership([[-1.0]], [[1.0]])


def test_distribution_functions_that_are_nan_somewhere_are_refused():
    gap = from_cdf(lambda x: jnp.where(jnp.abs(x - 0.5) < 1e-7, jnp.nan, x), 0.0, 1.0)
    with pytest.raises(ValueError, match=r"not a number at 0\.5"):
        gap.cdf(np.array([0.5]))


def test_derivatives_without_bounds_are_reported():
    specs = [jax.ShapeDtypeStruct((1,), np.float64)] * 3
    with pytest.warns(UserWarning, match="may jump in the noise: all noise is treated"):
        gain_program(lambda x, u, w: x + jnp.sign(w), specs)
    with pytest.warns(UserWarning, match="derivative of the step in the noise has no enclosure"):
        gain_program(lambda x, u, w: x + without_derivative(w), specs)
    noisy = world(lambda x, u, w: 0.5 * x + 0.1 * jnp.sqrt(w + 1), noise=uniform(-1.0, 1.0))
    with pytest.warns(UserWarning, match="derivative of the step in the noise is unbounded"):
        certify_policy(noisy, lambda x: x, "F G ok", cells=[20])


@jax.custom_jvp
def without_derivative(w):
    return w * 1.0


@without_derivative.defjvp
def _(primals, tangents):
    return without_derivative(*primals), tangents[0] * jnp.sort(primals[0])
