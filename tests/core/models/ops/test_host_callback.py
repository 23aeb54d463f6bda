"""Callbacks keep double precision, also where only the calling thread has enabled it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.graphs.graph import TracedGraph
from jaxltl.core.models.ops.array_namespace import host_callback


@pytest.fixture
def double_here_only():
    """Double precision in this thread, single precision in all others, as is JAX's default."""
    jax.config.update("jax_enable_x64", False)
    try:
        with jax.enable_x64(True):
            yield
    finally:
        jax.config.update("jax_enable_x64", True)


def test_numbers_pass_unrounded(double_here_only):
    tree = {
        "double": jnp.asarray([1e-200, 1 + 1e-15, np.inf]),
        "long": jnp.asarray([[2**60 + 1, -1]]),
        "none": jnp.zeros((0, 3)),
        "single": jnp.float32([0.5, 3]),
        "scalar": jnp.asarray(np.pi),
        "bool": jnp.asarray([True, False]),
    }
    given = jax.tree.map(np.asarray, tree)

    def host(x):
        jax.tree.map(np.testing.assert_array_equal, x, given)
        assert all(np.asarray(y).dtype == given[name].dtype for name, y in x.items())
        return x

    result = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree)
    found = jax.jit(lambda x: host_callback(host, result, x))(tree)
    jax.tree.map(np.testing.assert_array_equal, found, given)


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int32, np.int64])
def test_results_are_converted_and_lanes_are_mapped(kind, double_here_only):
    def ramp(x):
        result = jax.ShapeDtypeStruct((3,), kind)
        return host_callback(lambda x: [float(x), 1.0, 2.0], result, x)

    found = jax.jit(jax.vmap(ramp))(jnp.arange(4.0))
    assert found.dtype == kind
    np.testing.assert_array_equal(found, [[i, 1, 2] for i in range(4)])


@pytest.mark.slow
def test_derivatives_by_elimination(double_here_only):
    """A walk so long that Krylov steps do not suffice: the gambler's ruin."""
    size, start = 701, 350
    step = np.arange(size)[:, None, None] + np.array([1, -1])
    step[[0, -1]] = np.array([0, size - 1])[:, None, None]
    model = jl.make_mdp(step, np.full(step.shape, 0.5))
    target = np.arange(size) == size - 1
    n = size - 1

    def value(p):
        weight = jnp.broadcast_to(jnp.stack([p, 1 - p]), step.shape)
        policy = jnp.zeros(size, int)
        found = jl.reachability_probability(
            model.replace(probability=weight), target, policy=policy, tolerance=1.0
        )
        return found.value[start]

    slope = jax.jit(jax.grad(value))(0.5)
    assert slope.dtype == np.float64
    # With r = (1 - p) / p the probability is (1 - r^i) / (1 - r^n); its slope in p at 1/2:
    np.testing.assert_allclose(slope, 2 * start * (n - start) / n, rtol=1e-6)


def test_a_tiny_probability_is_an_edge(double_here_only):
    """In single precision 1e-200 is zero, and the two states would not be a component."""
    model = jl.make_mdp([[[0, 1]], [[0, 0]]], [[[1 - 1e-200, 1e-200]], [[1.0, 0]]])
    everywhere = jnp.ones(2, bool), jnp.ones((2, 1), bool)
    number, _ = jax.jit(lambda m: TracedGraph(m).components(*everywhere, closed=False))(model)
    assert number[0] == number[1]
