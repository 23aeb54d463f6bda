"""Rectilinear grids of half-open cells, and sets of cells queried by boxes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.pretty_print import brief

_BOXES = 2**16  # counted at once, which bounds the memory


@brief
@dataclass(frozen=True, eq=False)
class Grid:
    """Cells `[e_i, e_(i + 1))` along each axis; the last one includes its upper edge.

    Attributes:
      edges: increasing ``float64[K_i + 1]`` for each of n axes.

    Example:
      >>> grid = Grid((np.linspace(0, 1, 5), np.linspace(0, 1, 3)))
      >>> grid.shape, grid.num_cells, int(grid.locate(np.array([0.3, 0.9])))
      ((4, 2), 8, 3)
    """

    edges: tuple[Floats, ...]

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Number of cells along each axis."""
        return tuple(len(e) - 1 for e in self.edges)

    @property
    def num_axes(self) -> int:
        """Dimensions n of the state."""
        return len(self.edges)

    @cached_property
    def num_cells(self) -> int:
        """C, the product of the shape."""
        return int(np.prod(self.shape))

    def boxes(self, cells: Integers | None = None) -> tuple[Floats, Floats]:
        """Lower and upper corners ``float64[C, n]`` of cells, all by default."""
        index = np.unravel_index(np.arange(self.num_cells) if cells is None else cells, self.shape)
        low = np.stack([e[i] for e, i in zip(self.edges, index, strict=True)], -1)
        high = np.stack([e[i + 1] for e, i in zip(self.edges, index, strict=True)], -1)
        return low, high

    def locate(self, states: Floats) -> Integers:
        """The cells of states ``float[..., n]``; -1 outside the domain."""
        states = np.asarray(states, np.float64)
        if states.shape[-1:] != (self.num_axes,):
            raise ValueError(f"states of shape {list(states.shape)}; give [..., {self.num_axes}].")
        inside = np.ones(states.shape[:-1], bool)
        index = []
        for axis, e in enumerate(self.edges):
            x = states[..., axis]
            inside &= (x >= e[0]) & (x <= e[-1])
            index.append(np.clip(np.searchsorted(e, x, "right") - 1, 0, len(e) - 2))
        return np.where(inside, np.ravel_multi_index(tuple(index), self.shape), -1)

    def ranges(self, low: Floats, high: Floats) -> tuple[Integers, Integers, Booleans]:
        """Cells met by boxes ``[R, n]``: first and last-plus-one index, and if a box leaves the grid.

        The range is empty along an axis where the box lies outside.
        """
        start, stop, outside = [], [], np.zeros(len(low), bool)
        for axis, e in enumerate(self.edges):
            a, b = low[:, axis], high[:, axis]
            outside |= (a < e[0]) | (b > e[-1])
            first = np.clip(np.searchsorted(e, a, "right") - 1, 0, len(e) - 2)
            start.append(np.where(a > e[-1], len(e) - 1, first))
            end = np.where(b >= e[-1], len(e) - 1, np.searchsorted(e, b, "right"))
            stop.append(np.where(a > e[-1], start[-1], np.maximum(end, 0)))
        return np.stack(start, -1).astype(np.int32), np.stack(stop, -1).astype(np.int32), outside

    def halve(self, cells: Booleans) -> tuple[Grid, tuple[Integers, ...]]:
        """A grid with intervals that contain a cell of ``bool[C]`` halved, and the parents of its own."""
        chosen, edges, parents = cells.reshape(self.shape), [], []
        for axis, e in enumerate(self.edges):
            cut = chosen.any(tuple(i for i in range(self.num_axes) if i != axis))
            middle = e[:-1] + np.diff(e) / 2
            cut &= (e[:-1] < middle) & (middle < e[1:])
            edges.append(np.sort(np.concatenate([e, middle[cut]])))
            parents.append(np.repeat(np.arange(len(cut)), 1 + cut))
        return Grid(tuple(edges)), tuple(parents)


def make_grid(
    low: Floats, high: Floats, shape: Sequence[int], breakpoints: Sequence[Floats] = ()
) -> Grid:
    """Grid of a box with about equal cells; edges near breakpoints are moved to them.

    Args:
      low, high: ``float[n]``, the domain.
      shape: number of cells along each axis.
      breakpoints: for each axis, coordinates that must be edges; two that are closest to one edge
        add an edge.

    Returns:
      :class:`Grid`.

    Raises:
      ValueError: a shape that is not positive, or of another length than the domain.

    Example:
      >>> make_grid(np.zeros(1), np.ones(1), [4], [[0.3]]).edges[0].tolist()
      [0.0, 0.3, 0.5, 0.75, 1.0]
    """
    low, high = validation.float_array("low", low), validation.float_array("high", high)
    sizes = validation.sequence("cells", shape)
    if low.ndim != 1 or high.shape != low.shape or len(sizes) != len(low):
        raise ValueError(
            f"cells={validation.shorten(sizes)} for a domain of shapes {list(low.shape)} and "
            f"{list(high.shape)}; give low and high float[n], and one positive number for each axis."
        )
    shape = [validation.integer("cells", k, least=1, limit=2**31 - 1) for k in sizes]
    edges = []
    for axis, count in enumerate(shape):
        e = np.linspace(low[axis], high[axis], int(count) + 1)
        inside = [b for b in (breakpoints[axis] if len(breakpoints) else ())
                  if low[axis] < b < high[axis]]  # fmt: skip
        fixed: set[int] = set()
        for b in np.unique(np.asarray(inside, np.float64)):
            nearest = int(np.argmin(np.abs(e - b)))
            if nearest in fixed or nearest in (0, len(e) - 1):
                fixed = {i + (i >= np.searchsorted(e, b)) for i in fixed}
                nearest = int(np.searchsorted(e, b))
                e = np.insert(e, nearest, b)
            e[nearest] = b
            fixed.add(nearest)
        edges.append(np.unique(e))
    return Grid(tuple(edges))


def cumulative(sets: Booleans | Integers) -> Integers:
    """Summed-area table of ``[..., *shape]``, with a leading 0 along each axis of the grid."""
    table = np.asarray(sets, np.int32)
    for axis in range(table.ndim):
        table = np.cumsum(table, axis, dtype=np.int32)
    return np.pad(table, [(1, 0)] * table.ndim)


def count_in(table: Integers, start: Integers, stop: Integers) -> Integers:
    """Number of members of a set in boxes of cells: sums over corners of its summed-area table."""
    total = np.zeros(len(start), np.int64)
    n = start.shape[1]
    strides = np.array([s // table.itemsize for s in table.strides])
    flat = table.reshape(-1)
    for begin in range(0, len(start), _BOXES):
        part = slice(begin, begin + _BOXES)
        first, last = start[part] * strides, stop[part] * strides  # int64
        for corner in itertools.product((0, 1), repeat=n):
            index = sum(last[:, i] if c else first[:, i] for i, c in enumerate(corner))
            sign = 1 if (n - sum(corner)) % 2 == 0 else -1
            total[part] += sign * flat[index]
    return total


def volume(start: Integers, stop: Integers) -> Integers:
    """Number of cells in boxes of cells."""
    count: Integers = np.prod(np.maximum(stop - start, 0), -1, dtype=np.int64)
    return count


def covered(start: Integers, stop: Integers, shape: tuple[int, ...]) -> Booleans:
    """The union of boxes of cells, as ``bool[*shape]``."""
    steps = np.zeros(tuple(k + 1 for k in shape), np.int32)
    keep = volume(start, stop) > 0
    start, stop = start[keep], stop[keep]
    for corner in itertools.product((0, 1), repeat=len(shape)):
        index = tuple(stop[:, i] if c else start[:, i] for i, c in enumerate(corner))
        np.add.at(steps, index, 1 if sum(corner) % 2 == 0 else -1)
    mask: Booleans = cumulative(steps)[tuple(slice(1, k + 1) for k in shape)] > 0
    return mask
