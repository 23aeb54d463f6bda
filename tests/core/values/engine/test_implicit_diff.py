"""Linear systems and the implicit function theorem."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.values.engine.implicit_diff import implicit
from jaxltl.core.values.engine.linear import inverse, solve_linear
from tests.support import assert_gradients


def random_chain(rng, size):
    rows = rng.random((size, size)) ** 4
    return rows / rows.sum(axis=1, keepdims=True)


@pytest.mark.parametrize("discount", [0.0, 0.5, 0.99, 0.9999])
def test_linear_systems_of_chains(discount):
    rng = np.random.default_rng(0)
    matrix = np.eye(30) - discount * random_chain(rng, 30)
    b = rng.normal(size=30)
    expected = np.linalg.solve(matrix, b)
    by_steps = solve_linear(lambda x: jnp.asarray(matrix) @ x, jnp.asarray(b))
    for found in (by_steps, inverse(jnp.asarray(matrix)) @ b):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_linear_systems_keep_the_shape_of_the_right_hand_side():
    rng = np.random.default_rng(1)
    matrix = jnp.asarray(np.eye(6) - 0.9 * random_chain(rng, 6))
    b = jnp.asarray(rng.normal(size=(2, 3)))
    expected = np.linalg.solve(matrix, b.ravel()).reshape(2, 3)
    found = solve_linear(lambda x: (matrix @ x.ravel()).reshape(2, 3), b)
    np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_a_looser_tolerance_is_met_in_the_residual():
    rng = np.random.default_rng(2)
    matrix = jnp.asarray(np.eye(200) - 0.999 * random_chain(rng, 200))
    b = jnp.asarray(rng.normal(size=200))
    for tolerance in (1e-2, 1e-6):
        x = solve_linear(lambda x: matrix @ x, b, tolerance=tolerance)
        assert jnp.linalg.norm(b - matrix @ x) <= tolerance * jnp.linalg.norm(b) * (1 + 1e-9)


def test_the_zero_system():
    found = solve_linear(lambda x: 0.5 * x, jnp.zeros(4))
    assert not found.any()


def test_a_system_without_numbers_ends():
    found = solve_linear(lambda x: 0.5 * x, jnp.array([1.0, jnp.nan]))
    assert np.isnan(found).any()


def test_single_precision():
    with jax.enable_x64(False):
        rng = np.random.default_rng(3)
        matrix = np.eye(20) - 0.9 * random_chain(rng, 20)
        b = rng.normal(size=20)
        found = solve_linear(lambda x: jnp.asarray(matrix) @ x, jnp.asarray(b))
        assert found.dtype == jnp.float32
        np.testing.assert_allclose(found, np.linalg.solve(matrix, b), rtol=1e-4, atol=1e-4)


class Inverse(NamedTuple):
    matrix: jax.Array

    def solve(self, b):
        return self.matrix @ b

    def transpose_solve(self, b):
        return b @ self.matrix


@pytest.mark.parametrize("dense", [False, True])
def test_implicit_derivatives(dense):
    """The root of ``v = b + tanh(A v)``, found anyhow, has the derivatives of the theorem."""
    rng = np.random.default_rng(4)
    point = {"a": 0.2 * rng.normal(size=(5, 5)), "b": rng.normal(size=5)}

    def root(x):
        def operator(v):
            return x["b"] + jnp.tanh(x["a"] @ v)

        found = jax.lax.stop_gradient(
            jax.lax.fori_loop(0, 300, lambda _, v: operator(v), jnp.zeros(5))
        )
        if not dense:
            return implicit(operator, found)
        solved = inverse(jax.lax.stop_gradient(jnp.eye(5) - jax.jacobian(operator)(found)))
        return implicit(operator, found, Inverse(solved))

    assert_gradients(root, point, {k: rng.normal(size=v.shape) for k, v in point.items()})


def test_the_given_fixed_point_is_returned_and_its_own_derivative_dropped():
    def root(a, start):
        return implicit(lambda v: 1 + a * v, start)

    assert root(0.5, jnp.array(2.0)) == 2.0
    assert jax.grad(root, 1)(0.5, jnp.array(2.0)) == 0.0
    # dv/da = v / (1 - a)
    np.testing.assert_allclose(jax.grad(root)(0.5, jnp.array(2.0)), 4.0)


@pytest.mark.slow
def test_implicit_derivatives_of_both_kinds_inside_jit_and_vmap_and_of_second_order():
    """``v = 1 + w[i] a v`` has ``v = 1 / (1 - w[i] a)``; the index is traced, and no number."""
    weight = jnp.array([0.2, 0.4])

    @jax.jit
    def root(a, i):
        return implicit(lambda v: 1 + weight[i] * a * v, 1 / (1 - weight[i] * a))

    def expected(a, i):
        return 1 / (1 - weight[i] * a)

    points, indices = jnp.array([0.5, 1.5]), jnp.array([1, 0])
    for derive in (jax.jacfwd, jax.jacrev, jax.hessian, lambda f: jax.jacrev(jax.jacrev(f))):
        found, right = (jax.vmap(derive(f))(points, indices) for f in (root, expected))
        np.testing.assert_allclose(found, right, rtol=1e-5)
