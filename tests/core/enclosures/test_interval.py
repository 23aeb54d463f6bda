"""Interval functions against extended precision, where rounding matters."""

import mpmath
import numpy as np
import pytest

from jaxltl.core.enclosures import interval as arithmetic
from jaxltl.core.enclosures.elementwise import INCREASING, bounds
from jaxltl.core.enclosures.interval import Interval
from jaxltl.core.enclosures.program import Elementwise

UNARY = {
    "exp": mpmath.exp, "exp2": lambda x: mpmath.mpf(2) ** x, "expm1": mpmath.expm1,
    "log": mpmath.log, "log1p": mpmath.log1p, "tanh": mpmath.tanh, "sqrt": mpmath.sqrt,
    "cbrt": lambda x: mpmath.sign(x) * mpmath.cbrt(abs(x)), "asinh": mpmath.asinh,
    "sinh": mpmath.sinh, "cosh": mpmath.cosh, "atan": mpmath.atan, "asin": mpmath.asin,
    "acos": mpmath.acos, "erf": mpmath.erf, "sin": mpmath.sin, "cos": mpmath.cos,
    "tan": mpmath.tan, "rsqrt": lambda x: 1 / mpmath.sqrt(x), "abs": abs, "square": lambda x: x * x,
    "logistic": lambda x: 1 / (1 + mpmath.exp(-x)), "neg": lambda x: -x,
}  # fmt: skip
DOMAIN = {
    "log": (1e-6, 1e6), "sqrt": (0, 1e6), "rsqrt": (1e-6, 1e6), "log1p": (-0.999, 1e3),
    "asin": (-1, 1), "acos": (-1, 1), "sin": (-2000, 2000), "cos": (-2000, 2000),
    "tan": (-300, 300),
}  # fmt: skip


def apply(name, *inputs, **params):
    """The rule of an elementwise function at intervals."""
    indices = tuple(range(len(inputs)))
    return bounds(Elementwise(name, params, indices, len(inputs), "here"), list(inputs))


def points(name, dtype, count):
    """Numbers of the function's domain at many scales, with its ends."""
    low, high = DOMAIN.get(name, (-20, 20))
    rng = np.random.default_rng(len(name))
    spread = rng.uniform(low, high, count)
    small = rng.choice([-1, 1], count) * 10.0 ** rng.uniform(-30, 0, count)
    small = small[(small > low) & (small < high)]
    return np.concatenate([spread, small, [low, high]]).astype(dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", UNARY)
def test_values_at_points_are_enclosed(name, dtype):
    x = points(name, dtype, 300)
    found = apply(name, Interval(x, x.copy()))
    with mpmath.workdps(60):
        exact = [UNARY[name](mpmath.mpf(float(v))) for v in x]
        for v, low, high, value in zip(x, found.low, found.high, exact, strict=True):
            assert mpmath.mpf(float(low)) <= value <= mpmath.mpf(float(high)), (name, v)
    finite = np.isfinite(found.low) & np.isfinite(found.high)
    assert finite.mean() > 0.99  # the bounds say something


@pytest.mark.parametrize("name", UNARY)
def test_values_inside_are_enclosed(name):
    low, high = DOMAIN.get(name, (-20, 20))
    rng = np.random.default_rng(1)
    centre = rng.uniform(low, high, 400)
    radius = 10.0 ** rng.uniform(-6, 1, 400)
    a, b = np.maximum(centre - radius, low), np.minimum(centre + radius, high)
    found = apply(name, Interval(a, b))
    with np.errstate(all="ignore"):
        function = _numpy(name)
        for share in np.linspace(0, 1, 33):
            value = function(np.clip(a + share * (b - a), a, b))
            slack = 1e-9 * np.abs(value)
            assert ((found.low <= value + slack) & (value - slack <= found.high)).all()


def _numpy(name):
    others = {"cos": np.cos, "sin": np.sin, "tan": np.tan, "acos": np.arccos, "cosh": np.cosh,
              "rsqrt": lambda x: x**-0.5, "abs": np.abs, "square": np.square,
              "neg": np.negative}  # fmt: skip
    return others.get(name) or INCREASING[name]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", ["add", "sub", "mul", "div"])
def test_arithmetic_rounds_outward(name, dtype):
    rng = np.random.default_rng(2)
    x, y = (
        (rng.choice([-1, 1], 500) * 10.0 ** rng.uniform(-18, 18, 500)).astype(dtype)
        for _ in range(2)
    )
    y[:100] = -x[:100] * (1 + np.finfo(dtype).eps)  # sums that cancel
    found = apply(name, Interval(x, x.copy()), Interval(y, y.copy()))
    operation = {"add": lambda a, b: a + b, "sub": lambda a, b: a - b,
                 "mul": lambda a, b: a * b, "div": lambda a, b: a / b}[name]  # fmt: skip
    with mpmath.workdps(60):
        for a, b, low, high in zip(x, y, found.low, found.high, strict=True):
            value = operation(mpmath.mpf(float(a)), mpmath.mpf(float(b)))
            assert mpmath.mpf(float(low)) <= value <= mpmath.mpf(float(high))


def test_quotients_by_zero_and_poles_are_unbounded():
    box = Interval(np.array([-1.0]), np.array([1.0]))
    one = Interval(np.array([1.0]), np.array([1.0]))
    assert np.isinf(apply("div", one, box).high[0])
    pole = Interval(np.array([1.5]), np.array([1.6]))
    assert np.isinf(apply("tan", pole).high[0]) and np.isinf(apply("tan", pole).low[0])
    assert arithmetic.sine(Interval(np.array([1.5]), np.array([1.6]))).high[0] == 1
    assert arithmetic.sine(Interval(np.array([-1e9]), np.array([-1e9]))).low[0] == -1


@pytest.mark.parametrize("exponent", [-3, -2, 0, 1, 2, 3, 7])
def test_integer_powers(exponent):
    rng = np.random.default_rng(3)
    a = rng.uniform(-2, 2, 200)
    b = a + 10.0 ** rng.uniform(-6, 0, 200)
    found = apply("integer_pow", Interval(a, b), y=exponent)
    for share in np.linspace(0, 1, 21):
        x = a + share * (b - a)
        value = x**exponent
        slack = 1e-12 * np.abs(value)
        assert ((found.low <= value + slack) & (value - slack <= found.high)).all()


def test_angles_over_boxes():
    rng = np.random.default_rng(4)
    centre, radius = rng.uniform(-2, 2, (2, 500)), rng.uniform(0, 0.5, (2, 500))
    low, high = centre - radius, centre + radius
    found = apply("atan2", Interval(low[0], high[0]), Interval(low[1], high[1]))
    for _ in range(50):
        y, x = rng.uniform(low, high)
        assert ((found.low <= np.arctan2(y, x)) & (np.arctan2(y, x) <= found.high)).all()
    assert (found.high - found.low).max() <= 2 * np.pi + 1e-9
