"""Visitation measures: exact enclosures, flow, and duality with values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl import Status
from tests import reference
from tests.support import (
    REPRESENTATIONS,
    as_mdp,
    assert_encloses,
    assert_gradients,
    random_representation,
    stack,
)

DISCOUNTS = (0.0, 0.5, 0.875, 0.96875)


@pytest.fixture(scope="module")
def cases():
    rng = np.random.default_rng(0)
    models = [reference.random_model(rng, 5, 3, 2) for _ in range(1000)]
    return [(m, reference.random_policy(rng, m), rng.choice(DISCOUNTS)) for m in models]


def batch_of(cases):
    models, policies, discounts = zip(*cases, strict=True)
    return stack([as_mdp(m) for m in models]), stack(policies), stack(discounts)


@pytest.mark.few(1)
@pytest.mark.parametrize("tolerance", [None, 1e-6])
def test_occupancies_are_enclosed(cases, tolerance):
    solution = jax.jit(
        jax.vmap(lambda m, p, d: jl.occupancy_measure(m, p, d, tolerance=tolerance))
    )(*batch_of(cases))
    assert (solution.status == Status.CONVERGED).all()
    assert_encloses(solution, np.stack([reference.exact_occupancy(*case) for case in cases]))
    assert (solution.upper - solution.lower).max() <= (2 * tolerance if tolerance else 1e-9)
    # Mass is kept: a run never ends.
    totals = [1 / (1 - d) for *_, d in cases]
    np.testing.assert_allclose(solution.value.sum(axis=(1, 2)), totals, rtol=1e-11)


def test_occupancies_are_enclosed_in_single_precision(cases):
    with jax.enable_x64(False):
        solution = jax.jit(jax.vmap(jl.occupancy_measure))(*batch_of(cases[:200]))
        assert solution.value.dtype == jnp.float32
        assert (solution.status == Status.CONVERGED).all()
        assert_encloses(
            solution, np.stack([reference.exact_occupancy(*case) for case in cases[:200]])
        )


@pytest.mark.few(1)
@pytest.mark.parametrize("kind", REPRESENTATIONS)
def test_occupancy_and_value_are_dual(kind):
    """``<x, R> = <initial, V>``: the reward collected is the value of the start."""
    rng = np.random.default_rng(1)
    model, explicit = random_representation(rng, kind)
    policy = jnp.asarray(reference.random_policy(rng, explicit).reshape(model.available.shape))
    reward = jnp.asarray(rng.normal(size=model.available.shape))
    x = jl.check(jl.occupancy_measure(model, policy, 0.9)).value
    value = jl.check(jl.policy_value(model, policy, reward, 0.9)).value
    np.testing.assert_allclose(jnp.vdot(x, reward), jnp.vdot(model.initial, value), rtol=1e-11)


def test_another_start():
    rng = np.random.default_rng(2)
    model = reference.random_model(rng, 5, 3, 2)
    policy, start = reference.random_policy(rng, model), reference.random_distribution(rng, 5)
    solution = jl.occupancy_measure(as_mdp(model), jnp.asarray(policy), 0.875, initial=start)
    assert_encloses(solution, reference.exact_occupancy(model, policy, 0.875, start))


def test_it_is_differentiable_in_the_start():
    rng = np.random.default_rng(3)
    model = reference.random_model(rng, 5, 3, 2)
    mdp, policy = as_mdp(model), jnp.asarray(reference.random_policy(rng, model))
    assert_gradients(
        lambda x: jl.occupancy_measure(mdp, policy, 0.9, initial=x["initial"]).value,
        {"initial": model.initial},
        {"initial": rng.normal(size=5)},
    )


@pytest.mark.parametrize("kind", REPRESENTATIONS)
def test_feature_expectations_by_hand(kind):
    rng = np.random.default_rng(4)
    model, _ = random_representation(rng, kind)
    x = rng.random(model.available.shape)
    features = rng.normal(size=(*model.available.shape, 2))
    expected = (x.ravel()[:, None] * features.reshape(-1, 2)).sum(axis=0)
    np.testing.assert_allclose(jl.values.feature_expectation(x, features), expected, rtol=1e-12)


def test_bad_policies_are_named():
    mdp = as_mdp(reference.random_model(np.random.default_rng(5), 5, 3, 2))
    with pytest.raises(ValueError, match=r"policy has shape \(5, 2\)"):
        jl.occupancy_measure(mdp, jnp.zeros((5, 2)), 0.9)


@pytest.mark.few(1)
@pytest.mark.parametrize("kind", ["padded", "rows"])
def test_what_flows_into_a_hub_is_enclosed_in_single_precision(kind):
    """Of a sum of many terms more is lost than of a few."""
    size = 2**17
    start = np.random.default_rng(5).random(size).astype(np.float32)
    start /= start.sum()
    with jax.enable_x64(False):
        model = jl.make_mdp(np.zeros((size, 1, 1), int), np.ones((size, 1, 1)))
        policy = np.zeros(size, np.int32)
        if kind == "rows":
            model = jl.to_sparse(model)
        found = jl.occupancy_measure(model, policy, np.float32(0.9), initial=start)
    discount, exact = float(np.float32(0.9)), start.astype(float)
    exact[0] = (exact[0] + discount * exact[1:].sum()) / (1 - discount)
    assert found.value.dtype == np.float32
    assert np.abs(found.value.ravel() - exact).max() > 1e-4
    assert_encloses(found, exact)
