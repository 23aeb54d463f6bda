"""Enclosures of elementwise functions: intervals, and linear lower and upper bounds over boxes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
import scipy.special

from jaxltl.core.array_types import Array
from jaxltl.core.enclosures import interval as arithmetic
from jaxltl.core.enclosures.interval import (
    ULPS,
    Interval,
    eps,
    may_be_nan,
    module_of,
    monotone,
    outward,
    size_of,
    point,
    unbounded,
    undefined,
)
from jaxltl.core.enclosures.primitives import narrows
from jaxltl.core.enclosures.program import Elementwise

Function = Callable[[Array], Array]
Rule = Callable[[Elementwise, list[Interval]], Interval]


def _logistic(x: Array) -> Array:
    return scipy.special.expit(x) if module_of(x) is np else jax.nn.sigmoid(x)


def _erf(x: Array) -> Array:
    return scipy.special.erf(x) if module_of(x) is np else jax.scipy.special.erf(x)


def _acosh(x: Array) -> Array:
    xp = module_of(x)
    result: Array = xp.log1p((x - 1) + xp.sqrt(x - 1) * xp.sqrt(x + 1))  # accurate near 1
    return result


def _named(name: str) -> Function:
    return lambda x: getattr(module_of(x), name)(x)


INCREASING: dict[str, Function] = {
    **{name: _named(name) for name in (
        "exp", "exp2", "expm1", "log", "log2", "log1p", "tanh", "sqrt", "cbrt", "asinh", "sinh", "floor",
        "ceil", "sign")},
    "atan": _named("arctan"), "asin": _named("arcsin"), "asinh": _named("arcsinh"),
    "logistic": _logistic, "erf": _erf, "acosh": _acosh, "atanh": _named("arctanh"),
}  # fmt: skip
_RANGE = {"exp": (0, np.inf), "exp2": (0, np.inf), "sqrt": (0, np.inf), "logistic": (0, 1),
          "tanh": (-1, 1), "erf": (-1, 1), "cosh": (1, np.inf), "expm1": (-1, np.inf),
          "acosh": (0, np.inf), "rsqrt": (0, np.inf), "pow": (0, np.inf), "share": (0, 1)}  # fmt: skip
# Elsewhere values are NaN.
_DOMAIN = {"log": (0, np.inf), "log2": (0, np.inf), "log1p": (-1, np.inf), "sqrt": (0, np.inf), "rsqrt": (0, np.inf),
           "asin": (-1, 1), "acos": (-1, 1), "atanh": (-1, 1), "acosh": (1, np.inf),
           "pow": (0, np.inf)}  # fmt: skip


def bounds(operation: Elementwise, inputs: list[Interval]) -> Interval:
    """Enclosure of an elementwise function by intervals.

    For Boolean results `low` is whether it is certainly true, and `high` whether possibly.
    """
    name, x = operation.name, inputs[0]
    if name in _COMPARISONS:
        return _compare(operation, *inputs)
    if name in INCREASING:
        result = _clip(name, _increasing(name, x))
    else:
        result = _clip(name, _RULES[name](operation, inputs))
    if name not in _DOMAIN:
        return result
    low, high = _DOMAIN[name]
    return undefined(~((x.low >= low) & (x.high <= high)), result)


def _increasing(name: str, x: Interval) -> Interval:
    return monotone(INCREASING[name], x, ULPS.get(name, 0))


def _clip(name: str, x: Interval) -> Interval:
    if name not in _RANGE:
        return x
    low, high = _RANGE[name]
    xp = module_of(x.low)
    return Interval(xp.clip(x.low, low, high), xp.clip(x.high, low, high))


# --- intervals ------------------------------------------------------------------------------------

_COMPARISONS = ("lt", "le", "gt", "ge", "eq", "ne")


def _compare(operation: Elementwise, x: Interval, y: Interval) -> Interval:
    if operation.name in ("gt", "ge"):
        x, y = y, x
    # With NaN, each comparison below is false: its result is possible, and not certain.
    if operation.name in ("lt", "gt"):
        return Interval(x.high < y.low, ~(x.low >= y.high))
    if operation.name in ("le", "ge"):
        return Interval(x.high <= y.low, ~(x.low > y.high))
    certain = (x.low == x.high) & (y.low == y.high) & (x.low == y.low)
    possible = ~((x.low > y.high) | (y.low > x.high))
    if operation.inputs[0] == operation.inputs[1]:  # a test for NaN
        certain, possible = x.low <= x.high, possible | True
    return Interval(certain, possible) if operation.name == "eq" else Interval(~possible, ~certain)


def _select(_: Elementwise, inputs: list[Interval]) -> Interval:
    """Hull of the cases that are possible."""
    if inputs[0].low.dtype != bool:
        return _select_case(*inputs)
    test, no, yes = inputs
    xp = module_of(no.low)
    hull = Interval(xp.minimum(no.low, yes.low), xp.maximum(no.high, yes.high))
    return arithmetic.where(test.low, yes, arithmetic.where(test.high, hull, no))


def _select_case(which: Interval, *cases: Interval) -> Interval:
    """Hull of the cases from a lower to an upper index."""
    xp, hull = module_of(which.low), cases[-1]
    for i, case in reversed(list(enumerate(cases[:-1]))):
        joined = Interval(xp.minimum(case.low, hull.low), xp.maximum(case.high, hull.high))
        # `hull` has the cases behind, from the lower index on, if that is larger.
        joined = arithmetic.where(which.high <= i, case, joined)
        hull = arithmetic.where(which.low > i, hull, joined)
    return hull


def _convert(operation: Elementwise, inputs: list[Interval]) -> Interval:
    x, new = inputs[0], np.dtype(operation.params["new_dtype"])
    was_float = jnp.issubdtype(x.low.dtype, jnp.floating)
    if was_float and not jnp.issubdtype(new, jnp.floating):
        raise ValueError(
            f"{operation.place}: a number that depends on the argument, or is NaN, is converted to {new}; "
            "keep it a float."
        )
    ulps = 1 if narrows(new, x.low.dtype) else 0
    return monotone(lambda side: side.astype(new), x, ulps)


def _power(operation: Elementwise, inputs: list[Interval]) -> Interval:
    """`x ** y` for x that is not negative: monotone in both, so that extrema are at corners."""
    x, y = inputs
    xp, base = module_of(x.low), arithmetic.absolute(x)
    exponents = [y.low] if y.low is y.high else [y.low, y.high]
    corners = [side**exponent for side in (base.low, base.high) for exponent in exponents]
    hull = outward(reduce(xp.minimum, corners), reduce(xp.maximum, corners), ULPS["pow"])
    return undefined(may_be_nan(x) | may_be_nan(y), hull)


def _round(operation: Elementwise, inputs: list[Interval]) -> Interval:
    """To the nearest integer, ties to even or away from zero."""
    to_even = operation.params.get("rounding_method", jax.lax.RoundingMethod.TO_NEAREST_EVEN)
    if to_even == jax.lax.RoundingMethod.TO_NEAREST_EVEN:
        return monotone(_named("round"), inputs[0], 0)

    def away(x: Array) -> Array:
        xp = module_of(x)
        whole = xp.trunc(x)
        rest = xp.where(xp.isfinite(x), size_of(x - whole), 0)
        result: Array = whole + xp.where(rest >= 0.5, xp.sign(x), 0)
        return result

    return monotone(away, inputs[0], 0)


def _is_finite(_: Elementwise, inputs: list[Interval]) -> Interval:
    certain = ~arithmetic.may_be_infinite(inputs[0])
    return Interval(certain, certain | True)


def _share(_: Elementwise, inputs: list[Interval]) -> Interval:
    """`e / (e + rest)` for `e = exp(x)` and a sum `rest` of exponentials: in [0, 1] for finite x."""
    part, rest, x = inputs
    xp = module_of(part.low)

    def ratio(a: Array, b: Array, empty: float) -> Array:
        safe = xp.isfinite(a) & xp.isfinite(b) & (a + b > 0)
        result: Array = xp.where(safe, a / xp.where(safe, a + b, 1), empty)
        return result

    quotient = outward(ratio(part.low, rest.high, 0.0), ratio(part.high, rest.low, 1.0), 4)
    return undefined(arithmetic.may_be_infinite(x) | may_be_nan(rest), quotient)


def _by_sides(name: str) -> Rule:
    """A function that is increasing in all arguments, without rounding."""

    def rule(_: Elementwise, inputs: list[Interval]) -> Interval:
        function = getattr(module_of(inputs[0].low), name)
        return Interval(function(*(x.low for x in inputs)), function(*(x.high for x in inputs)))

    return rule


def _multiply(operation: Elementwise, inputs: list[Interval]) -> Interval:
    if operation.inputs[0] == operation.inputs[1]:
        return arithmetic.power(inputs[0], 2)
    return arithmetic.multiply(*inputs)


def _decreasing(function: Function) -> Rule:
    return lambda o, x: outward(function(x[0].high), function(x[0].low), ULPS[o.name])


_RULES: dict[str, Rule] = {
    "round": _round,
    "is_finite": _is_finite,
    "share": _share,
    "add": lambda _, x: arithmetic.add(*x),
    "sub": lambda _, x: arithmetic.subtract(*x),
    "mul": _multiply,
    "div": lambda _, x: arithmetic.multiply(x[0], arithmetic.reciprocal(x[1])),
    "neg": lambda _, x: arithmetic.negate(x[0]),
    "abs": lambda _, x: arithmetic.absolute(x[0]),
    "square": lambda _, x: arithmetic.power(x[0], 2),
    "integer_pow": lambda o, x: arithmetic.power(x[0], o.params["y"]),
    "pow": _power,
    "max": _by_sides("maximum"),
    "min": _by_sides("minimum"),
    "select_n": _select,
    "convert_element_type": _convert,
    "and": _by_sides("bitwise_and"),
    "or": _by_sides("bitwise_or"),
    "not": lambda _, x: Interval(~x[0].high, ~x[0].low),
    "sin": lambda _, x: arithmetic.sine(x[0]),
    "cos": lambda _, x: arithmetic.sine(x[0], np.pi / 2),
    "tan": lambda _, x: arithmetic.tangent(x[0]),
    "one_minus_square": lambda _, x: _one_minus_square(x[0]),
    "atan2": lambda _, x: arithmetic.angle(*x),
    "acos": _decreasing(_named("arccos")),
    "rsqrt": _decreasing(lambda x: 1 / module_of(x).sqrt(x)),
    "cosh": lambda _, x: monotone(_named("cosh"), arithmetic.absolute(x[0]), ULPS["cosh"]),
}


# --- linear bounds --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Relaxation:
    """`sum_i lower_slope_i x_i + lower <= y <= sum_i upper_slope_i x_i + upper`, elementwise.

    The bounds hold for the slopes as exact numbers: offsets include the errors of their computation.
    """

    lower_slope: tuple[Array, ...]  # one for each input
    lower: Array
    upper_slope: tuple[Array, ...]
    upper: Array


def relax(
    operation: Elementwise, inputs: list[Interval], output: Interval, parallel: bool = False
) -> Relaxation:
    """Linear bounds over the inputs' boxes (CROWN, Zhang et al. 2018).

    `output` encloses the values; its bounds are used where no linear ones are known. Exact for sums
    and opposites, whose rounding is the caller's. With `parallel`, the slopes of both bounds are
    equal, as they are for all but extrema.
    """
    name, xp = operation.name, module_of(output.low)
    zero = xp.where(xp.isnan(output.low * 0), 0, output.low * 0)
    exact = name == "convert_element_type" and (
        jnp.issubdtype(inputs[0].low.dtype, jnp.floating)
        and not narrows(output.low.dtype, inputs[0].low.dtype)
    )
    if exact or name in ("add", "sub", "neg"):
        last = zero + 1 if exact or name == "add" else -(zero + 1)
        slopes = (zero + 1, last)[-len(inputs) :]
        return Relaxation(slopes, zero, slopes, zero)
    if name in ("max", "min"):
        return _relax_extreme(name, inputs[0], inputs[1], parallel)
    if name == "mul" and operation.inputs[0] == operation.inputs[1]:
        square = _smooth(operation, inputs[0], output, _DERIVATIVES["square"])
        zero = square.lower_slope[0] * 0
        slopes = (*square.lower_slope, zero)
        return Relaxation(slopes, square.lower, slopes, square.upper)
    if name == "mul":
        return _relax_product(*inputs)
    if name == "div":
        inverse = arithmetic.reciprocal(inputs[1])
        slope = arithmetic.multiply(arithmetic.negate(inputs[0]), arithmetic.power(inverse, 2))
        return _mean_value(operation, inputs, (inverse, slope))
    if name == "share":
        part, rest, _ = inputs
        scale = arithmetic.power(arithmetic.reciprocal(arithmetic.add(part, rest)), 2)
        derivatives = (
            arithmetic.multiply(rest, scale),
            arithmetic.multiply(arithmetic.negate(part), scale),
            point(zero),
        )
        return _mean_value(operation, inputs, derivatives)
    if name == "atan2":
        return _relax_angle(operation, inputs)
    if name == "integer_pow":
        n = operation.params["y"]
        return _smooth(operation, inputs[0], output, lambda x: arithmetic.multiply(
            point(x.low * 0 + n), arithmetic.power(x, n - 1)))  # fmt: skip
    if name in _DERIVATIVES:
        return _smooth(operation, inputs[0], output, _DERIVATIVES[name])
    if name == "select_n":
        return _relax_select(inputs, output)
    return _constant(inputs, output)


def _constant(inputs: list[Interval], output: Interval) -> Relaxation:
    """The output's own bounds."""
    zeros = (module_of(output.low).zeros_like(output.low),) * len(inputs)
    return Relaxation(zeros, output.low, zeros, output.high)


def _smooth(
    operation: Elementwise,
    x: Interval,
    output: Interval,
    derivative: Callable[[Interval], Interval],
) -> Relaxation:
    """Bounds of f with the slope of its secant.

    Let `g(x) = f(x) - s x` on [l, u] with `d1 <= f' <= d2`. From `g' >= d1 - s` right of l and
    `g' <= d2 - s` left of u, `g >= max(g(l) + (d1 - s)(x - l), g(u) - (d2 - s)(u - x))`, which is
    least where both are equal: with g(l) and g(u) replaced by the smaller one,

        g >= min(g(l), g(u)) - (s - d1)(d2 - s)(u - l) / (d2 - d1),

    and symmetrically above.
    """
    xp, width = module_of(x.low), x.high - x.low
    low, high = (_at(operation, [side]) for side in (x.low, x.high))
    slopes = derivative(x)
    first, last = slopes.low, slopes.high
    positive = width > 0
    secant = (high.middle - low.middle) / xp.where(positive, width, 1)
    usable = positive & xp.isfinite(first) & xp.isfinite(last) & xp.isfinite(secant)
    slope = xp.where(usable, xp.clip(secant, first, last), 0)
    slope_width = xp.where(usable & (last > first), last - first, 1)
    gap = xp.where(
        usable,
        arithmetic.times(arithmetic.times(slope - first, last - slope), width) / slope_width,
        0,
    )
    gap = gap * (1 + 16 * eps(gap)) + arithmetic.tiny(gap)
    ends = [
        arithmetic.subtract(value, arithmetic.multiply(point(side), point(slope)))
        for value, side in ((low, x.low), (high, x.high))
    ]
    padded = outward(
        xp.minimum(ends[0].low, ends[1].low) - gap, xp.maximum(ends[0].high, ends[1].high) + gap, 2
    )
    offsets = arithmetic.where(usable, padded, output)
    return Relaxation((slope,), offsets.low, (slope,), offsets.high)


def _at(operation: Elementwise, points: list[Array]) -> Interval:
    """Enclosure of the function at points."""
    return bounds(operation, [Interval(x, x + 0) for x in points])


def _relax_extreme(name: str, x: Interval, y: Interval, parallel: bool) -> Relaxation:
    """Maximum as `y + relu(x - y)`, minimum as `y - relu(y - x)`.

    For `z` in [l, u] with l < 0 < u, relu(z) is at most `u (z - l) / (u - l)` and at least `a z`
    for any a in [0, 1]; a is 1 where u > -l, and 0 elsewhere; if `parallel`, the slope above.
    """
    xp = module_of(x.low)
    z = arithmetic.subtract(x, y) if name == "max" else arithmetic.subtract(y, x)
    finite = xp.isfinite(z.low) & xp.isfinite(z.high)
    crossing = (z.low < 0) & (z.high > 0) & finite
    passed = xp.where(z.low >= 0, 1.0, 0.0).astype(z.low.dtype)
    above = xp.where(crossing, z.high / xp.where(crossing, z.high - z.low, 1), passed)
    below = above
    if not parallel:
        below = xp.where(crossing, (z.high > -z.low).astype(passed.dtype), passed)
    low, high = (xp.where(crossing, side, 0) for side in (z.low, z.high))
    # The slope and 1 - slope, which y multiplies, are rounded: the offset fits both ends.
    offset = xp.maximum(-above * low, high - above * high)
    offset = outward(offset, offset + xp.where(crossing, y.magnitude, 0) * eps(offset), 4).high
    offset = xp.where(crossing, offset, 0)
    decided = finite | (z.high <= 0) | (z.low >= 0)
    offset = xp.where(decided, offset, xp.inf)
    zero = offset * 0 if xp is jnp else np.zeros_like(offset)
    zero = xp.where(xp.isnan(zero), 0, zero)
    if name == "max":
        return Relaxation((below, 1 - below), zero, (above, 1 - above), offset)
    return Relaxation((above, 1 - above), -offset, (below, 1 - below), zero)


def _relax_product(x: Interval, y: Interval) -> Relaxation:
    """`x y = my x + mx y - mx my + (x - mx)(y - my)`; the last term is at most `rx ry` in size."""
    xp = module_of(x.low)
    middle = arithmetic.multiply(point(x.middle), point(y.middle))
    rest = arithmetic.multiply(point(x.radius), point(y.radius)).high
    offsets = outward(-middle.high - rest, -middle.low + rest, 2)
    slopes = tuple(xp.broadcast_to(side.middle, offsets.low.shape) for side in (y, x))
    # Of infinite or NaN factors, of which no slope is a bound.
    missing = ~(xp.isfinite(offsets.low) & xp.isfinite(offsets.high))
    if xp is jnp or missing.any():
        offsets = arithmetic.where(missing, unbounded(offsets.low), offsets)
        slopes = tuple(xp.where(missing, 0, slope) for slope in slopes)
    return Relaxation(slopes, offsets.low, slopes, offsets.high)


def _relax_angle(operation: Elementwise, inputs: list[Interval]) -> Relaxation:
    """Mean-value bounds, where neither the origin nor the negative x axis is in the box."""
    y, x = inputs
    square = arithmetic.add(arithmetic.power(x, 2), arithmetic.power(y, 2))
    outside = ~((x.low <= 0) & (y.low <= 0) & (y.high >= 0)) & (square.low > 0)
    scale = arithmetic.where(outside, arithmetic.reciprocal(square), unbounded(square.low))
    slopes = (arithmetic.multiply(x, scale), arithmetic.multiply(arithmetic.negate(y), scale))
    return _mean_value(operation, inputs, slopes)


def _mean_value(
    operation: Elementwise, inputs: list[Interval], derivatives: tuple[Interval, ...]
) -> Relaxation:
    """`f(x) - f(m)` lies in `sum_i D_i (x_i - m_i)` for derivatives within D_i over the box.

    With slopes in the middles of the D_i, the rest is at most the sum of `rad(D_i) rad(x_i)`.
    """
    centre = _at(operation, [x.middle for x in inputs])
    xp, low, high = module_of(centre.low), centre.low, centre.high
    usable = xp.isfinite(low) & xp.isfinite(high)
    for d in derivatives:
        usable = usable & xp.isfinite(d.low) & xp.isfinite(d.high)
    slopes = tuple(xp.where(usable, d.middle, 0) for d in derivatives)
    for slope, x, d in zip(slopes, inputs, derivatives, strict=True):
        shift = arithmetic.multiply(point(slope), point(x.middle))
        rest = arithmetic.multiply(point(d.radius), point(x.radius)).high
        here = outward(low - shift.high - rest, high - shift.low + rest, 3)
        low, high = here.low, here.high
    return Relaxation(
        slopes, xp.where(usable, low, -xp.inf), slopes, xp.where(usable, high, xp.inf)
    )


def _relax_select(inputs: list[Interval], output: Interval) -> Relaxation:
    """The case itself where the test is certain, and constants elsewhere."""
    xp, dtype = module_of(output.low), output.low.dtype
    if len(inputs) > 3 or inputs[0].low.dtype != bool:
        return _constant(inputs, output)
    yes, no = inputs[0].low, ~inputs[0].high
    slopes = tuple(
        xp.broadcast_to(case, output.low.shape).astype(dtype) for case in (yes & no, no, yes)
    )
    lower, upper = (xp.where(yes | no, 0, side) for side in (output.low, output.high))
    return Relaxation(slopes, lower, slopes, upper)


def _one_minus_square(x: Interval) -> Interval:
    square = arithmetic.power(x, 2)
    return outward(1 - square.high, 1 - square.low)


def _derivative_logistic(x: Interval) -> Interval:
    """`s (1 - s) = (1 - (2 s - 1)^2) / 4`."""
    s = _increasing("logistic", x)
    rest = _one_minus_square(outward(2 * s.low - 1, 2 * s.high - 1, 2))
    return Interval(rest.low / 4, rest.high / 4)


def _derivative_erf(x: Interval) -> Interval:
    """`2 / sqrt(pi) exp(-x^2)`."""
    bell = _increasing("exp", arithmetic.negate(arithmetic.power(x, 2)))
    factor = 1.1283791670955126
    return outward(bell.low * factor, bell.high * factor, 4)


def _for_positive(derivative: Interval, x: Interval) -> Interval:
    """A derivative that holds for positive arguments alone."""
    return arithmetic.where(x.low > 0, derivative, unbounded(x.low))


def _twice(x: Interval) -> Interval:
    return Interval(2 * x.low, 2 * x.high)


_DERIVATIVES: dict[str, Callable[[Interval], Interval]] = {
    "square": _twice,
    "one_minus_square": lambda x: arithmetic.negate(_twice(x)),
    "tanh": lambda x: _one_minus_square(_increasing("tanh", x)),
    "logistic": _derivative_logistic,
    "erf": _derivative_erf,
    "exp": lambda x: _increasing("exp", x),
    "expm1": lambda x: _increasing("exp", x),
    "log": lambda x: _for_positive(arithmetic.reciprocal(x), x),
    "log2": lambda x: _for_positive(
        arithmetic.multiply(arithmetic.reciprocal(x), point(x.low * 0 + 1.4426950408889634)), x
    ),
    "log1p": lambda x: arithmetic.reciprocal(outward(x.low + 1, x.high + 1)),
    "sqrt": lambda x: _for_positive(arithmetic.reciprocal(_twice(_increasing("sqrt", x))), x),
    "sin": lambda x: arithmetic.sine(x, np.pi / 2),
    "cos": lambda x: arithmetic.negate(arithmetic.sine(x)),
    "tan": lambda x: _plus_one(arithmetic.power(arithmetic.tangent(x), 2)),
    "atan": lambda x: arithmetic.reciprocal(_plus_one(arithmetic.power(x, 2))),
    "abs": lambda x: Interval(
        module_of(x.low).where(x.low >= 0, 1.0, -1.0).astype(x.low.dtype),
        module_of(x.low).where(x.high <= 0, -1.0, 1.0).astype(x.low.dtype),
    ),
}


def _plus_one(x: Interval) -> Interval:
    return outward(x.low + 1, x.high + 1)
