"""Interval arithmetic with outward rounding (Moore 1966), on NumPy or JAX arrays."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
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
    "sin": 16, "tan": 32, "atan2": 16, "pow": 64, "sqrt": 1, "rsqrt": 8, "cbrt": 16,
}  # fmt: skip
LARGEST_ANGLE = 1e4  # larger arguments of sin, cos and tan are not reduced: all values are possible


@brief
@dataclass(frozen=True)
class Interval:
    """Elementwise bounds of an array.

    Attributes:
      low, high: arrays of one shape; infinite where no bound is known.

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
        """A point inside, elementwise; near the centre."""
        xp = module_of(self.low)
        result: Array = xp.clip(0.5 * self.low + 0.5 * self.high, self.low, self.high)
        return result

    @property
    def radius(self) -> Array:
        """At least the distance from :attr:`middle` to either bound."""
        xp, middle = module_of(self.low), self.middle
        distance = xp.maximum(self.high - middle, middle - self.low)
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
    return float(jnp.finfo(x.dtype).eps)


def tiny(x: Array) -> float:
    """An absolute error that covers the flush of subnormal numbers to zero."""
    return float(4 * jnp.finfo(x.dtype).tiny)


def point(x: Array) -> Interval:
    """An array as an interval of width 0."""
    return Interval(x, x)


def outward(low: Array, high: Array, ulps: float = 1) -> Interval:
    """Interval with bounds moved outward by `ulps` units in the last place; NaN is unbounded.

    A result `x` with an error of k ulps satisfies `|x - exact| <= k eps |x| + tiny`.
    """
    if low.dtype.kind in "biu":  # counts of Boolean variables
        return Interval(low, high)
    xp, relative, absolute = module_of(low), ulps * eps(low), tiny(low)
    down = low - (size_of(low) * relative + absolute)
    up = high + (size_of(high) * relative + absolute)
    return Interval(xp.where(xp.isnan(down), -xp.inf, down), xp.where(xp.isnan(up), xp.inf, up))


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
    """Sum."""
    return outward(x.low + y.low, x.high + y.high)


def subtract(x: Interval, y: Interval) -> Interval:
    """Difference of independent arrays."""
    return outward(x.low - y.high, x.high - y.low)


def multiply(x: Interval, y: Interval) -> Interval:
    """Product of independent arrays; `0 * inf` is 0, since bounds are limits of numbers."""
    ends = [y.low] if y.low is y.high else [y.low, y.high]
    return outward(*_hull([times(a, b) for a in (x.low, x.high) for b in ends]))


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
    return where(safe, bounds, unbounded(x.low))


def absolute(x: Interval) -> Interval:
    """Absolute value."""
    xp = module_of(x.low)
    return Interval(xp.maximum(xp.maximum(x.low, -x.high), 0), x.magnitude)


def power(x: Interval, exponent: int) -> Interval:
    """`x ** exponent` for a constant integer."""
    if exponent < 0:
        return reciprocal(power(x, -exponent))
    if exponent == 0:
        ones = x.low * 0 + 1
        return Interval(ones, ones)
    even = exponent % 2 == 0
    base = absolute(x) if even else x
    # Repeated multiplication: each factor adds one rounding.
    bounds = outward(base.low**exponent, base.high**exponent, 2 * exponent)
    return Interval(module_of(x.low).maximum(bounds.low, 0), bounds.high) if even else bounds


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
    return Interval(
        xp.where(bottom, -1.0, xp.maximum(bounds.low - reduction, -1)).astype(x.low.dtype),
        xp.where(top, 1.0, xp.minimum(bounds.high + reduction, 1)).astype(x.low.dtype),
    )


def tangent(x: Interval) -> Interval:
    """Tangent: increasing between two poles; unbounded where a pole may lie inside."""
    xp, (unreduced, error) = module_of(x.low), _angle_reduction(x)
    pole = _contains_multiple(x, -math.pi / 2, math.pi) | unreduced
    bounds = monotone(xp.tan, x, ULPS["tan"])
    low, high = (xp.where(pole, 0.0, side) for side in (bounds.low, bounds.high))
    # The derivative 1 + tan^2 multiplies the error.
    return Interval(
        xp.where(pole, -xp.inf, low - error * (1 + low * low)),
        xp.where(pole, xp.inf, high + error * (1 + high * high)),
    )


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
    return Interval(xp.where(cut, -pi, bounds.low), xp.where(cut, pi, bounds.high))


def _contains_multiple(x: Interval, shift: float, period: float) -> Array:
    """True where `x + shift` may contain a multiple of the period."""
    xp = module_of(x.low)
    first, last = (x.low + shift) / period, (x.high + shift) / period
    slack = 256 * eps(x.low) * (1 + size_of(first) + size_of(last))
    result: Array = xp.floor(last + slack) >= xp.ceil(first - slack)
    return result
