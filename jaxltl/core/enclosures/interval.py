"""Interval arithmetic with outward rounding (Moore 1966), on NumPy or JAX arrays.

A value may be NaN, as a logarithm of a negative number is: then both bounds are NaN, and every result
that depends on it has NaN bounds too. A value with an infinite bound may be infinite itself, so that
`inf - inf`, `0 * inf` and the sine of infinity may be NaN.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, reduce
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxltl.core.array_types import Array
from jaxltl.core.pretty_print import brief

# Bounds of the errors of NumPy's and XLA's functions in units in the last place of the result, with
# a margin of at least 4 over the largest error seen against mpmath (tests/core/enclosures).
# Arithmetic and square roots round correctly (.5).
ULPS = {
    "exp": 16, "exp2": 16, "expm1": 32, "log": 16, "log2": 16, "log1p": 32, "logistic": 32, "tanh": 32,
    "atan": 16, "asin": 32, "asinh": 32, "acos": 32, "sinh": 32, "cosh": 32, "erf": 32,
    "sin": 16, "tan": 32, "atan2": 16, "pow": 64, "sqrt": 1, "rsqrt": 8, "cbrt": 16, "acosh": 32,
    "atanh": 32,
}  # fmt: skip
LARGEST_ANGLE = 1e4  # larger arguments of sin, cos and tan are not reduced: all values are possible


@brief
@dataclass(frozen=True)
class Interval:
    """Elementwise bounds of an array.

    Attributes:
      low, high: arrays of one shape; infinite where no bound is known, and both NaN where the value
        may be NaN.

    Example:
      >>> x = Interval(np.array([-1.0]), np.array([3.0]))
      >>> x.magnitude.tolist(), x.middle.tolist()
      ([3.0], [1.0])
    """

    low: Array
    high: Array

    @property
    def magnitude(self) -> Array:
        """Largest absolute value, elementwise."""
        xp = module_of(self.low)
        result: Array = xp.maximum(size_of(self.low), size_of(self.high))
        return result

    @property
    def middle(self) -> Array:
        """A point inside, elementwise; near the centre, and finite if there is a finite one."""
        xp = module_of(self.low)
        centre = 0.5 * self.low + 0.5 * self.high
        if xp is jnp or not np.isfinite(centre).all():
            centre = xp.where(xp.isfinite(centre), centre, 0)
        result: Array = xp.minimum(xp.maximum(centre, self.low), self.high)
        return result

    @property
    def radius(self) -> Array:
        """At least the distance from :attr:`middle` to either bound."""
        xp, middle = module_of(self.low), self.middle
        distance = xp.maximum(self.high - middle, middle - self.low)
        if xp is jnp or not np.isfinite(distance).all():
            distance = xp.where(xp.isfinite(distance), distance, xp.inf)
        result: Array = distance * (1 + 4 * eps(self.low)) + tiny(self.low)
        return result


def module_of(x: Array) -> Any:
    """NumPy or jax.numpy, by the kind of an array."""
    return np if isinstance(x, np.ndarray | np.generic) else jnp


def size_of(x: Array) -> Array:
    """Absolute value of an array."""
    size: Array = module_of(x).abs(x)
    return size


def eps(x: Array) -> float:
    """The unit in the last place of 1."""
    return _limits(x.dtype)[0]


def tiny(x: Array) -> float:
    """An absolute error that covers the flush of subnormal numbers to zero."""
    return _limits(x.dtype)[1]


@cache
def _limits(dtype: np.dtype) -> tuple[float, float, float]:
    """Unit in the last place of 1, four times the least normal number, and the largest number."""
    limits = jnp.finfo(dtype)
    return float(limits.eps), float(4 * limits.tiny), float(limits.max)


def point(x: Array) -> Interval:
    """An array as an interval of width 0."""
    return Interval(x, x)


def outward(low: Array, high: Array, ulps: float = 1) -> Interval:
    """Interval with bounds moved outward by `ulps` units in the last place; NaN remains.

    A result `x` with an error of k ulps satisfies `|x - exact| <= k eps |x| + tiny`, or overflows.
    """
    if low.dtype.kind in "biu":  # counts of Boolean variables
        return Interval(low, high)
    xp, (unit, absolute, most) = module_of(low), _limits(low.dtype)
    relative = ulps * unit
    down = low - (size_of(low) * relative + absolute)
    up = high + (size_of(high) * relative + absolute)
    return Interval(xp.where(low == xp.inf, most, down), xp.where(high == -xp.inf, -most, up))


def without_nan(x: Interval) -> Interval:
    """The same bounds, infinite where they are NaN.

    For bounds that do not decide whether a value may be NaN, and for results.
    """
    xp = module_of(x.low)
    if xp is np and not (np.isnan(x.low).any() or np.isnan(x.high).any()):
        return x
    missing = xp.isnan(x.low) | xp.isnan(x.high)
    return Interval(xp.where(missing, -xp.inf, x.low), xp.where(missing, xp.inf, x.high))


def undefined(where: Array, x: Interval) -> Interval:
    """The same bounds, NaN where the value may be NaN."""
    xp = module_of(x.low)
    if xp is np and not np.any(where):
        return x
    return Interval(xp.where(where, xp.nan, x.low), xp.where(where, xp.nan, x.high))


def may_be_nan(x: Interval) -> Array:
    """True where the value may be NaN."""
    xp = module_of(x.low)
    result: Array = xp.isnan(x.low) | xp.isnan(x.high)
    return result


def may_be_infinite(x: Interval) -> Array:
    """True where the value may be infinite, or NaN."""
    xp = module_of(x.low)
    result: Array = ~(xp.isfinite(x.low) & xp.isfinite(x.high))
    return result


def _are_finite(*intervals: Interval) -> bool:
    """True if all bounds are seen to be finite."""
    return all(
        module_of(x.low) is np and bool(np.isfinite(x.low).all() and np.isfinite(x.high).all())
        for x in intervals
    )


def _signed(
    x: Interval, nonnegative: Callable[[], Array], nonpositive: Callable[[], Array]
) -> Interval:
    """Bounds without values of a sign that rounding alone has added."""
    xp, low, high = module_of(x.low), x.low, x.high
    small = tiny(low) * 4
    if xp is jnp or bool(((low < 0) & (low >= -small)).any()):
        low = xp.where(nonnegative(), xp.maximum(low, 0), low)
    if xp is jnp or bool(((high > 0) & (high <= small)).any()):
        high = xp.where(nonpositive(), xp.minimum(high, 0), high)
    return Interval(low, high)


def unbounded(like: Array) -> Interval:
    """An interval of all numbers, in the shape of an array."""
    xp = module_of(like)
    return Interval(xp.full_like(like, -xp.inf), xp.full_like(like, xp.inf))


def intersect(x: Interval, y: Interval) -> Interval:
    """Intersection of two enclosures of the same array."""
    xp = module_of(x.low)
    return Interval(xp.maximum(x.low, y.low), xp.minimum(x.high, y.high))


def where(test: Array, x: Interval, y: Interval) -> Interval:
    """Elementwise choice."""
    xp = module_of(test)
    return Interval(xp.where(test, x.low, y.low), xp.where(test, x.high, y.high))


def negate(x: Interval) -> Interval:
    """Opposite."""
    return Interval(-x.high, -x.low)


def add(x: Interval, y: Interval) -> Interval:
    """Sum; NaN where infinities may cancel."""
    if x.low.dtype.kind in "biu":
        return Interval(x.low + y.low, x.high + y.high)
    xp, result = module_of(x.low), outward(x.low + y.low, x.high + y.high)
    result = _signed(result, lambda: x.low >= -y.low, lambda: x.high <= -y.high)
    if _are_finite(result):
        return result
    cancel = ((x.high == xp.inf) & (y.low == -xp.inf)) | ((x.low == -xp.inf) & (y.high == xp.inf))
    return undefined(cancel | may_be_nan(x) | may_be_nan(y), result)


def subtract(x: Interval, y: Interval) -> Interval:
    """Difference of independent arrays."""
    return add(x, negate(y))


def multiply(x: Interval, y: Interval) -> Interval:
    """Product of independent arrays; NaN where one may be 0 and the other infinite.

    `0 * inf` is 0 elsewhere, since bounds are limits of numbers.
    """
    ends = [y.low] if y.low is y.high else [y.low, y.high]
    finite = _are_finite(x, y)
    product = module_of(x.low).multiply if finite else times
    result = outward(*_hull([product(a, b) for a in (x.low, x.high) for b in ends]))
    if result.low.dtype.kind in "biu":
        return result
    result = _signed(
        result,
        lambda: ((x.low >= 0) & (y.low >= 0)) | ((x.high <= 0) & (y.high <= 0)),
        lambda: ((x.low >= 0) & (y.high <= 0)) | ((x.high <= 0) & (y.low >= 0)),
    )
    if finite:
        return result
    zero_x, zero_y = ((z.low <= 0) & (z.high >= 0) for z in (x, y))
    missing = (zero_x & may_be_infinite(y)) | (zero_y & may_be_infinite(x))
    return undefined(missing | may_be_nan(x) | may_be_nan(y), result)


def _hull(values: list[Array]) -> tuple[Array, Array]:
    """The least and the largest value, elementwise."""
    xp = module_of(values[0])
    return reduce(xp.minimum, values), reduce(xp.maximum, values)


def times(a: Array, b: Array) -> Array:
    """`a b`, with 0 for `0 * inf`."""
    xp = module_of(a)
    result: Array = xp.where((a == 0) | (b == 0), 0, a * b)
    return result


def reciprocal(x: Interval) -> Interval:
    """`1 / x`; unbounded where x may be 0."""
    xp = module_of(x.low)
    safe = (x.low > 0) | (x.high < 0)
    bounds = outward(1 / xp.where(safe, x.high, 1), 1 / xp.where(safe, x.low, 1))
    bounds = _signed(bounds, lambda: x.low > 0, lambda: x.high < 0)
    return undefined(may_be_nan(x), where(safe, bounds, unbounded(x.low)))


def absolute(x: Interval) -> Interval:
    """Absolute value."""
    xp = module_of(x.low)
    return Interval(xp.maximum(xp.maximum(x.low, -x.high), 0), x.magnitude)


def power(x: Interval, exponent: int) -> Interval:
    """`x ** exponent` for a constant integer."""
    if exponent < 0:
        return reciprocal(power(x, -exponent))
    if exponent == 0:
        ones = module_of(x.low).ones_like(x.low)
        return Interval(ones, ones)
    even = exponent % 2 == 0
    base = absolute(x) if even else x
    # Repeated multiplication: each factor adds one rounding.
    bounds = outward(base.low**exponent, base.high**exponent, 2 * exponent)
    return _signed(bounds, lambda: base.low >= 0, lambda: base.high <= 0)


def monotone(function: Callable[[Array], Array], x: Interval, ulps: float) -> Interval:
    """Values of an increasing function."""
    if not ulps:
        return Interval(function(x.low), function(x.high))
    return outward(function(x.low), function(x.high), ulps)


def sine(x: Interval, phase: float = 0.0) -> Interval:
    """`sin(x + phase)` with phase 0 or pi / 2 (the cosine).

    The value 1 is attained where `(x + phase) / (2 pi) - 1 / 4` contains an integer, and -1 half a
    period later; whether one lies inside is decided with a margin for rounding, so that an extremum
    outside may be counted but none inside is missed.
    """
    xp = module_of(x.low)
    function = xp.cos if phase else xp.sin
    at_low, at_high = function(x.low), function(x.high)
    bounds = outward(xp.minimum(at_low, at_high), xp.maximum(at_low, at_high), ULPS["sin"])
    unreduced, reduction = _angle_reduction(x)
    top = _contains_multiple(x, phase - math.pi / 2, 2 * math.pi) | unreduced
    bottom = _contains_multiple(x, phase + math.pi / 2, 2 * math.pi) | unreduced
    result = Interval(
        xp.where(bottom, -1.0, xp.maximum(bounds.low - reduction, -1)).astype(x.low.dtype),
        xp.where(top, 1.0, xp.minimum(bounds.high + reduction, 1)).astype(x.low.dtype),
    )
    return undefined(may_be_infinite(x), result)


def tangent(x: Interval) -> Interval:
    """Tangent: increasing between two poles; unbounded where a pole may lie inside."""
    xp, (unreduced, error) = module_of(x.low), _angle_reduction(x)
    pole = _contains_multiple(x, -math.pi / 2, math.pi) | unreduced
    bounds = monotone(xp.tan, x, ULPS["tan"])
    low, high = (xp.where(pole, 0.0, side) for side in (bounds.low, bounds.high))
    # The derivative 1 + tan^2 multiplies the error.
    result = Interval(
        xp.where(pole, -xp.inf, low - error * (1 + low * low)),
        xp.where(pole, xp.inf, high + error * (1 + high * high)),
    )
    return undefined(may_be_infinite(x), result)


def _angle_reduction(x: Interval) -> tuple[Array, Array]:
    """Arguments too large to be reduced, and the error of a reduced one, which is absolute."""
    size = module_of(x.low).minimum(x.magnitude, LARGEST_ANGLE)
    return ~(x.magnitude <= LARGEST_ANGLE), 8 * eps(x.low) * (1 + size)


def angle(y: Interval, x: Interval) -> Interval:
    """`atan2(y, x)` over a box: extrema at corners, or all angles where the negative axis is met."""
    xp = module_of(x.low)
    corners = [xp.arctan2(b, a) for a in (x.low, x.high) for b in (y.low, y.high)]
    bounds = outward(*_hull(corners), ULPS["atan2"])
    cut = (x.low <= 0) & (y.low <= 0) & (y.high >= 0)
    pi = math.pi * (1 + 4 * eps(x.low))
    result = Interval(xp.where(cut, -pi, bounds.low), xp.where(cut, pi, bounds.high))
    return undefined(may_be_nan(x) | may_be_nan(y), result)


def _contains_multiple(x: Interval, shift: float, period: float) -> Array:
    """True where `x + shift` may contain a multiple of the period."""
    xp = module_of(x.low)
    first, last = (x.low + shift) / period, (x.high + shift) / period
    slack = 256 * eps(x.low) * (1 + size_of(first) + size_of(last))
    result: Array = xp.floor(last + slack) >= xp.ceil(first - slack)
    return result
