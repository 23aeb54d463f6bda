"""Functions as arrays are the functions, and so are their slopes."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.models.parametric import make_polynomials, make_rationals


def random_terms(rng, num_parameters, count):
    """Coefficients by powers, of which many are zero and some are large."""
    return {
        tuple(int(x) for x in rng.choice([0, 0, 1, 2, 3, 13], num_parameters)): Fraction(
            int(rng.integers(-9, 10)) or 1, int(rng.integers(1, 7))
        )
        for _ in range(count)
    }


def value(terms, point):
    """The slow sum of products."""
    total = Fraction(0)
    for powers, c in terms.items():
        for x, power in zip(point, powers, strict=True):
            c *= x**power
        total += c
    return total


def slope(terms, point, d):
    lower = {}
    for powers, c in terms.items():
        if powers[d]:
            less = tuple(p - (i == d) for i, p in enumerate(powers))
            lower[less] = lower.get(less, 0) + c * powers[d]
    return value(lower, point)


def test_polynomials_and_their_slopes_are_exact_but_for_rounding():
    rng = np.random.default_rng(0)
    given = [random_terms(rng, 3, n) for n in (1, 4, 9, 2)] + [{}, {(0, 0, 0): Fraction(1, 3)}]
    found = make_polynomials(given, 3)
    look = jax.jit(lambda f, x: (f(x), jax.jacobian(lambda y: f(y))(x)))
    for point in ([0.5, -0.75, 1.25], [0.0, 1.0, -1.0], [0.9, 0.1, 0.0]):
        values, slopes = look(found, jnp.array(point))
        exact = [Fraction(x) for x in point]
        np.testing.assert_allclose(values, [float(value(t, exact)) for t in given], rtol=1e-13)
        expected = [[float(slope(t, exact, d)) for d in range(3)] for t in given]
        np.testing.assert_allclose(slopes, expected, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("constant", [True, False])
def test_quotients(constant):
    below = {(0,): Fraction(3)} if constant else {(1,): Fraction(1), (0,): Fraction(2)}
    pairs = [({(2,): Fraction(5)}, below), ({(1,): Fraction(1)}, {(0,): Fraction(7)})]
    found = make_rationals(pairs, 1)
    assert (found.denominator is None) == constant
    x = 0.25
    expected = [5 * x**2 / (3 if constant else x + 2), x / 7]
    np.testing.assert_allclose(found(jnp.array([x])), expected, rtol=1e-15)


def test_nothing_is_a_function_too():
    assert make_polynomials([{}, {}], 2)(jnp.ones(2)).tolist() == [0, 0]
    assert make_polynomials([{(): Fraction(2)}], 0)(jnp.ones(0)).tolist() == [2]
