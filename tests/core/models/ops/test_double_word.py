"""Double-word arithmetic keeps its error bounds inside ``jit``, where XLA fuses and folds."""

from __future__ import annotations

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.models.ops import double_word as dw
from jaxltl.core.models.ops.operators import expectation
from tests.core.values.test_one_reading import random_model

COUNT, SQUARE = 500, Fraction(1, 2**48)  # u^2 in single precision


def floats(rng):
    return (rng.standard_normal(COUNT) * 2.0 ** rng.integers(-20, 20, COUNT)).astype(np.float32)


def exact(x):
    """The fractions that double words or floats stand for."""
    x = np.asarray(x).ravel()
    return [Fraction(float(a.real)) + Fraction(float(a.imag)) for a in x]


def within(found, wanted, bound):
    assert all(abs(a - b) <= bound * SQUARE * abs(b) for a, b in zip(found, wanted, strict=True))


@pytest.mark.parametrize("constant", [False, True], ids=["argument", "constant"])
def test_errors_are_bounded_inside_jit(constant):
    """All operations in one program, on arguments and on constants that XLA could fold."""
    rng = np.random.default_rng(0)
    with jax.enable_x64(False):
        a, w = floats(rng), floats(rng)
        b = (a * floats(rng) * 1e-8).astype(np.float32)

        def run(a, b, w):
            x, one = dw.double_word(a, b), dw.double_word(jnp.ones_like(a), 1e-3 * b / a)
            y = dw.times(w, x)
            sums = dw.plus(x, y), dw.plus(one, x), dw.minus(x, one)
            return x, one, y, *sums, dw.product(x, y), dw.reciprocal(y)

        if constant:
            found = jax.jit(lambda w: run(jnp.asarray(a), jnp.asarray(b), w))(w)
        else:
            found = jax.jit(run)(a, b, w)
        x, one, y, plus, more, less, product, reciprocal = map(exact, found)
    assert x == [p + q for p, q in zip(exact(a), exact(b), strict=True)]
    within(y, [p * q for p, q in zip(exact(w), x, strict=True)], 64)
    within(plus, [p + q for p, q in zip(x, y, strict=True)], 4)
    within(more, [p + q for p, q in zip(one, x, strict=True)], 4)
    within(less, [p - q for p, q in zip(x, one, strict=True)], 2**24 + 4)
    within(product, [p * q for p, q in zip(x, y, strict=True)], 80)
    within(reciprocal, [1 / p for p in y], 128)


def test_bounds_are_rounded_outwards():
    with jax.enable_x64(False):
        x = dw.double_word(jnp.array([1.0, 1, 1, 0]), jnp.array([1e-9, -1e-9, 0, 0]))
        low, high = (jax.jit(dw.outwards, static_argnums=1)(x, end).tolist() for end in (-1, 1))
        assert low == [1, 1 - 2**-24, 1, 0] and high == [1 + 2**-23, 1, 1, 0]


def kinds():
    world = random_model(np.random.default_rng(0), 0.5)
    yield world
    yield jl.product(world, "F (a & F b)", label_on="exit")
    yield jl.product(jl.models.to_dense(world), "F a")


def test_backups_are_those_of_the_normalised_rows():
    rng = np.random.default_rng(1)

    def backup(model, policy, value):
        rows = dw.normalised_rows(model, policy)
        return rows.mean(rows.expectation(dw.double_word(value)))

    with jax.enable_x64(False):
        for model in kinds():
            value = rng.random(model.state_shape).astype(np.float32)
            policy = rng.dirichlet(np.ones(2), model.state_shape).astype(np.float32)
            found = np.asarray(jax.jit(backup)(model, policy, value)).astype(np.complex128)
            with jax.enable_x64(True):
                double = jax.tree.map(
                    lambda x: jnp.asarray(x, float) if x.dtype == jnp.float32 else x, model
                )
                mean = np.asarray(policy, float) / policy.sum(-1, dtype=float, keepdims=True)
                ahead, total = (
                    np.asarray(expectation(double, jnp.asarray(x, float)))
                    for x in (value, np.ones(value.shape))
                )
            wanted = (mean * ahead / total).sum(-1)
            np.testing.assert_allclose(found.real + found.imag, wanted, rtol=1e-13, atol=0)
