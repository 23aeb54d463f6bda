"""Enclosures of products with a matrix by intervals."""

from __future__ import annotations

import numpy as np

from jaxltl.core.array_types import Array
from jaxltl.core.enclosures.interval import (
    Interval,
    eps,
    may_be_infinite,
    may_be_nan,
    module_of,
    outward,
    size_of,
    tiny,
    undefined,
)
from jaxltl.core.enclosures.program import MatrixProduct


def product(operation: MatrixProduct, x: Interval) -> Interval:
    """Products with a matrix by middle and radius (Rump 1999)."""
    xp = module_of(x.low)
    matrix = xp.asarray(operation.matrix)
    size = size_of(matrix).T
    middle, radius = x.middle @ matrix.T, x.radius @ size
    error = (x.magnitude @ size) * (2 * (matrix.shape[1] + 2) * eps(middle))
    bounds = outward(middle - radius - error, middle + radius + error, 4)
    finite = xp.isfinite(error)
    low = xp.where(finite, bounds.low, -xp.inf)
    result = Interval(low, xp.where(finite, bounds.high, xp.inf))
    result = nonnegative(operation, x, result)
    if operation.is_finite and isinstance(finite, np.ndarray) and finite.all():
        return result
    return undefined(_sum_may_be_nan(operation, matrix, x), result)


def nonnegative(operation: MatrixProduct, x: Interval, result: Interval) -> Interval:
    """Bounds of a sum, which is not negative if its terms are not: then it has a square root."""
    if not operation.nonnegative:
        return result
    xp, positive = module_of(x.low), (x.low >= 0).all(-1, keepdims=True)
    terms = x.low @ xp.asarray(operation.matrix).T
    rounded = terms * (1 - 2 * (x.low.shape[-1] + 2) * eps(terms)) - tiny(terms)
    low = xp.maximum(result.low, xp.where(xp.isfinite(rounded), xp.maximum(rounded, 0), 0))
    return Interval(xp.where(positive, low, result.low), result.high)


def _sum_may_be_nan(operation: MatrixProduct, matrix: Array, x: Interval) -> Array:
    """Entries ``bool[C, n]`` of a product with an infinite matrix, NaN, or infinities that cancel."""
    xp = module_of(x.low)
    finite = xp.isfinite(matrix)
    weight = xp.where(finite, matrix, 0)
    infinite, size = may_be_infinite(x).astype(weight.dtype), size_of(xp.sign(weight)).T
    up, down = xp.maximum(xp.sign(weight), 0).T, xp.maximum(-xp.sign(weight), 0).T
    most, least = (side.astype(weight.dtype) for side in (x.high == xp.inf, x.low == -xp.inf))
    rises, falls = most @ up + least @ down > 0, most @ down + least @ up > 0
    cancel = rises & falls & (infinite @ size > 1)
    if operation.zeros_count:  # 0 times infinity
        cancel = cancel | (infinite @ (1 - size) > 0)
    missing = may_be_nan(x).astype(weight.dtype)
    result: Array = (
        cancel
        | (missing @ size > 0)
        | ~finite.all(1)
        | ((missing.sum(-1, keepdims=True) > 0) & operation.zeros_count)
    )
    return result
