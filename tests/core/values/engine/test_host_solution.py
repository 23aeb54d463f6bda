"""Opposite events: exact ends, bounds outwards, the precision that was given."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.types import Solution, Status
from jaxltl.core.values.engine.host_solution import complement_event

VALUE = np.array([0.0, 1.0, 0.3, 1e-20, 0.5, 1 - 1e-16])


def solution(xp, dtype, width):
    value = VALUE.astype(dtype)
    lower, upper = np.maximum(value - width, 0), np.minimum(value + width, 1)
    return Solution(
        value=xp.asarray(value),
        policy=xp.zeros(6, int),
        lower=xp.asarray(lower.astype(dtype)),
        upper=xp.asarray(upper.astype(dtype)),
        residual=xp.asarray(0.0),
        num_steps=xp.asarray(1),
        status=xp.asarray(int(Status.CONVERGED)),
    )


@pytest.mark.parametrize(("xp", "dtype"), [(np, np.float64), (np, np.float32), (jnp, np.float32)])
@pytest.mark.parametrize("width", (0, 1e-3))
def test_bounds_hold_and_ends_stay_exact(xp, dtype, width):
    given = solution(xp, dtype, dtype(width))
    found = complement_event(given)
    assert found.value.dtype == dtype and isinstance(found.value, np.ndarray) == (xp is np)
    # In a wider type differences of these are told exactly, or nearly.
    lower, upper = (np.asarray(x).astype(np.longdouble) for x in (given.lower, given.upper))
    assert (np.asarray(found.lower) <= 1 - upper).all()
    assert (np.asarray(found.upper) >= 1 - lower).all()
    width = np.asarray(found.upper - found.lower)
    assert (width <= upper - lower + 3 * np.finfo(dtype).eps).all()
    ends = np.isin(np.asarray(given.upper), (0, 1))
    assert (np.asarray(found.lower)[ends] == 1 - np.asarray(given.upper)[ends]).all()
    back = complement_event(found)
    assert (np.asarray(back.lower) <= np.asarray(given.lower)).all()
    assert (np.asarray(back.upper) >= np.asarray(given.upper)).all()


def test_traced_and_differentiable():
    given = solution(jnp, np.float32, np.float32(1e-3))
    eager, traced = complement_event(given), jax.jit(complement_event)(given)
    for name in ("value", "lower", "upper"):
        np.testing.assert_array_equal(getattr(eager, name), getattr(traced, name))
    slope = jax.grad(lambda v: complement_event(given.replace(value=v)).value.sum())(given.value)
    np.testing.assert_array_equal(slope, -np.ones(6))
