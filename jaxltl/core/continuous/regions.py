"""Regions of a continuous state space: unions of boxes, half-spaces and positivity sets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core import validation
from jaxltl.core.array_types import Array
from jaxltl.core.enclosures.interval import may_be_nan
from jaxltl.core.enclosures.linear_bounds import over_boxes
from jaxltl.core.models.ops.array_namespace import enable_x64
from jaxltl.core.pretty_print import brief

Floats = NDArray[np.float64]
Function = Callable[[jax.Array], jax.Array]
Booleans = NDArray[np.bool_]

_CHUNK = 2**15  # cells of which a function is enclosed at a time


class UndefinedError(ValueError):
    """A value that may be NaN, of which nothing can be proven."""


@brief
@dataclass(frozen=True, eq=False)
class Region:
    """Union of boxes, half-spaces and sets ``{x: f(x) > 0}``; ``|`` is the union of two regions.

    Boxes are half-open, ``low <= x < high``, so that cells of a grid whose edges include the edges
    of a box lie either inside or outside.

    Attributes:
      low, high: ``float64[B, n]``, the boxes.
      normal, offset: ``float64[H, n]`` and ``float64[H]``, the half-spaces ``normal x <= offset``.
      functions: JAX functions f, ``float[n] -> float[]``.

    Example:
      >>> corners = box([0, 0], [1, 1]) | box([2, 2], [3, 3])
      >>> corners.contains(np.array([[0.5, 0.0], [1.0, 0.5]])).tolist()
      [True, False]
    """

    low: Floats
    high: Floats
    normal: Floats
    offset: Floats
    functions: tuple[Function, ...] = ()

    def __or__(self, other: Region) -> Region:
        return union(self, other)

    @property
    def num_states(self) -> int:
        """n; 0 for a region of functions alone, which fits any space."""
        result: int = max(self.low.shape[1], self.normal.shape[1])
        return result

    def contains(self, x: Array) -> Array:
        """``bool[...]``: membership of the states ``x float[..., n]``, NumPy or JAX; no derivative."""
        numpy = isinstance(x, np.ndarray)
        xp = np if numpy else jnp
        low, high, normal, offset = (
            xp.asarray(y, x.dtype) for y in (self.low, self.high, self.normal, self.offset)
        )
        inside: Array = xp.zeros(x.shape[:-1], bool)
        if len(low):
            y = x[..., None, :]
            inside = inside | ((low <= y) & (y < high)).all(-1).any(-1)
        if len(normal):
            inside = inside | (x @ normal.T <= offset).any(-1)
        for function in self.functions:
            flat = x.reshape(-1, x.shape[-1])
            positive = jax.vmap(function)(jnp.asarray(flat)) > 0
            inside = inside | (np.asarray(positive) if numpy else positive).reshape(inside.shape)
        return inside

    def membership(self, low: ArrayLike, high: ArrayLike) -> tuple[Booleans, Booleans]:
        """Cells inside the region, and cells that meet it.

        Certain cells ``bool[C]`` have all their states ``low <= x < high`` in the region, and only
        possible ones have any. Exact for boxes, but a cell covered by two boxes together is not
        certain; bounds of half-spaces and functions over the closed cell are rounded outward. Raises
        ValueError for a function that may be NaN on a cell.

        Example:
          >>> certain, possible = box([0.0], [1.0]).membership([[0.0], [0.5], [1.0]], [[1.0], [1.5], [2.0]])
          >>> certain.tolist(), possible.tolist()
          ([True, False, False], [True, True, False])
        """
        low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
        certain, possible = np.zeros((2, len(low)), bool)
        for first, last in zip(self.low, self.high, strict=True):
            certain |= ((first <= low) & (high <= last)).all(axis=1)
            possible |= ((first < high) & (low < last)).all(axis=1)
        for normal, offset in zip(self.normal, self.offset, strict=True):
            ends = np.where(normal >= 0, (low, high), (high, low))
            with np.errstate(invalid="ignore"):  # unbounded cells in directions of weight 0
                terms = np.where(normal == 0, 0.0, normal * ends)
            size = np.abs(terms).sum(axis=-1)
            error = (len(normal) + 2) * np.finfo(np.float64).eps * size
            lower, upper = terms.sum(axis=-1) + np.array([[-1], [1]]) * error
            certain |= upper <= offset
            possible |= ~(lower > offset)
        for function in self.functions:
            for start in range(0, len(low), _CHUNK):
                part = slice(start, start + _CHUNK)
                with enable_x64(True):  # constants of the function in double precision
                    known = over_boxes(function, low[part], high[part])
                    (bounds,) = known.outputs(True)
                output = known.intervals[known.program.outputs[0]]
                missing = np.asarray(may_be_nan(output))[:, 0] & ~certain[part]
                if missing.any():
                    i = start + int(np.argmax(missing))
                    raise UndefinedError(
                        f"a function of where_positive may be NaN on the cell {low[i].tolist()} to "
                        f"{high[i].tolist()}; define it in the whole domain, or give more cells."
                    )
                certain[part] |= np.asarray(bounds.low)[:, 0] > 0
                possible[part] |= ~(np.asarray(bounds.high)[:, 0] <= 0)
        return certain, possible | certain

    def breakpoints(self, axis: int) -> Floats:
        """``float64[...]``: the finite edges of the boxes along an axis, sorted and distinct."""
        edges = np.concatenate([side[:, axis : axis + 1].ravel() for side in (self.low, self.high)])
        return np.unique(edges[np.isfinite(edges)])


def _region(n: int, **parts: Any) -> Region:
    """A region of `n` coordinates of some parts; others are empty."""
    empty: dict[str, Any] = {name: np.zeros((0, n)) for name in ("low", "high", "normal")}
    return Region(**(empty | {"offset": np.zeros(0)} | parts))


def box(low: ArrayLike, high: ArrayLike) -> Region:
    """The boxes ``low <= x < high``.

    Args:
      low, high: ``float[n]``, or ``float[B, n]`` for the union of B boxes; may be infinite.

    Returns:
      :class:`Region`.

    Raises:
      ValueError: shapes that differ, NaN, or a lower bound that is not below the upper one.

    Example:
      >>> box([0.0, -np.inf], [1.0, 0.0]).high.tolist()
      [[1.0, 0.0]]
    """
    ends = [validation.float_array(name, x) for name, x in (("low", low), ("high", high))]
    if ends[0].shape != ends[1].shape or ends[0].ndim not in (1, 2) or ends[0].size == 0:
        shapes = " and ".join(str(list(x.shape)) for x in ends)
        raise ValueError(f"box: low and high have shapes {shapes}; give two of [n] or [B, n].")
    first, last = (np.atleast_2d(x) for x in ends)
    if not (first < last).all():
        place = np.argwhere(~(first < last))[0]
        raise ValueError(
            f"box: low={first[tuple(place)]:g} and high={last[tuple(place)]:g} at {place.tolist()}; "
            "low must be below high."
        )
    return _region(first.shape[1], low=first, high=last)


def half_space(normal: ArrayLike, offset: float) -> Region:
    """The half-space ``normal x <= offset``; one along an axis is a box with infinite sides.

    Args:
      normal, offset: ``float[n]`` and a number.

    Returns:
      :class:`Region`.

    Raises:
      ValueError: a normal that is zero or not ``float[n]``, or numbers that are not finite.

    Example:
      >>> half_space([1.0, 1.0], 0.5).contains(np.array([[0.0, 0.5], [1.0, 0.0]])).tolist()
      [True, False]
    """
    normal = validation.float_array("normal", normal)
    offset = validation.finite_number("offset", offset)
    if normal.ndim != 1 or not np.isfinite(normal).all() or not normal.any():
        raise ValueError(
            f"normal={validation.shorten(normal)}; give a finite vector float[n], not zero."
        )
    (axes,) = np.nonzero(normal)
    if len(axes) == 1:
        low, high = np.full((2, len(normal)), [[-np.inf], [np.inf]])
        (high if normal[axes[0]] > 0 else low)[axes[0]] = offset / normal[axes[0]]
        return box(low, high)
    return _region(len(normal), normal=normal[None], offset=np.array([offset]))


def where_positive(function: Function) -> Region:
    """The states at which a JAX function is positive.

    Args:
      function: JAX function ``float[n] -> float[]``; its sign over cells is bounded by
        :func:`jaxltl.enclose`.

    Returns:
      :class:`Region`.

    Raises:
      ValueError: an argument that is not a function.

    Example:
      >>> disc = where_positive(lambda x: 1 - x[0] ** 2 - x[1] ** 2)
      >>> certain, possible = disc.membership([[-0.5, -0.5], [2.0, 0.0]], [[0.5, 0.5], [3.0, 1.0]])
      >>> certain.tolist(), possible.tolist()
      ([True, False], [True, False])
    """
    return _region(0, functions=(validation.function("where_positive", function),))


def union(*regions: Region) -> Region:
    """The union of regions of one space.

    Args:
      regions: at least one.

    Returns:
      :class:`Region`.

    Raises:
      ValueError: no region, or regions of different dimensions.

    Example:
      >>> union(box([0.0], [1.0]), half_space([1.0], -1.0)).high.tolist()
      [[1.0], [-1.0]]
    """
    for region in regions:
        validation.instance("union", region, Region, "regions of box, half_space or where_positive")
    sizes = sorted({region.num_states for region in regions} - {0})
    if len(sizes) > 1 or not regions:
        fault = f"of {sizes} coordinates" if regions else "missing"
        raise ValueError(f"union: the regions are {fault}; give regions of one space.")
    shape = (-1, sizes[0]) if sizes else (0, 0)

    def joined(name: str) -> Floats:
        arrays = [getattr(r, name) for r in regions if r.num_states or not sizes]
        return np.concatenate([x.reshape(shape) for x in arrays])

    offset = np.concatenate([r.offset for r in regions])
    functions = sum((r.functions for r in regions), ())
    return Region(joined("low"), joined("high"), joined("normal"), offset, functions)


def as_region(name: str, value: Region | Sequence[ArrayLike], num_states: int) -> Region:
    """A region from a region or a pair of bounds, of `num_states` coordinates."""
    if not isinstance(value, Region):
        pair = value if isinstance(value, tuple | list) else ()
        if len(pair) != 2:
            raise ValueError(
                f"{name} is {validation.shorten(value)}; give a Region or (low, high)."
            )
        with validation.errors_in(f"{name}: "):
            value = box(*pair)
    if value.num_states not in (0, num_states):
        raise ValueError(
            f"{name} has {value.num_states} coordinates, and the domain {num_states}; give regions "
            "of the domain's space."
        )
    return value


def extended(region: Region, low: Floats, high: Floats) -> Region:
    """A region with box edges at or beyond the edges of a domain moved to infinity."""
    if not len(region.low):
        return region
    first = np.where(region.low <= low, -np.inf, region.low)
    last = np.where(region.high >= high, np.inf, region.high)
    return replace(region, low=first, high=last)
