"""Interval transition probabilities between cells as factors of each coordinate.

Each coordinate of the next state has an interval probability for each interval of the grid, given the
state and the coordinates before it in an order (see :mod:`.images`). The least expectation over
all such products is at least that over the joint intervals, and is computed coordinate by coordinate
(orthogonally decoupled abstractions, Mathiesen et al. 2024, arXiv 2411.11803): no array has a row and
a column for each cell.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.continuous.grid import Grid
from jaxltl.core.continuous.images import Images, NoiseBox
from jaxltl.core.continuous.noise import Distribution
from jaxltl.core.pretty_print import brief

_CHUNK = 2**14  # probabilities handled at once by a thread
MAX_PROBABILITIES = 2**26  # of one coordinate, of which arrays have half a GiB
_UNIT = float(np.finfo(np.float64).eps)


class TooManyProbabilitiesError(ValueError):
    """Images times the intervals that each may meet exceed `MAX_PROBABILITIES`."""


@brief
@dataclass(frozen=True)
class CoordinateProbabilities:
    """Interval probabilities of one coordinate, for U different images."""

    start: Integers  # int[U], first interval of the window
    low: Floats  # float[U, K], lower probabilities in the window, and upper minus lower ones
    gap: Floats
    outside: Floats  # float[U, 2], lower probability and gap of leaving the grid
    rest: Floats  # float[U], at least the probability of intervals that are not in the window


@dataclass(frozen=True)
class _Stage:
    """Contraction of one coordinate: groups of rows that share all factors contracted so far."""

    axis: int
    factor: Integers  # int[G]
    parent: Integers  # int[G], group of the stage before
    parent_start: Integers  # int[G, axes], where the parent's array begins along each axis left
    start: Integers  # int[G, axes - 1]
    width: tuple[int, ...]


@brief
@dataclass(frozen=True)
class TransitionBounds:
    """Interval transition probabilities of rows, as factors."""

    factors: tuple[CoordinateProbabilities, ...]  # for each coordinate of the state, in their order
    ids: tuple[Integers, ...]  # for each coordinate, int[R], the factors of each row
    stages: tuple[_Stage, ...]  # order of the contraction
    shape: tuple[int, ...]  # of the grid, with its axes in that order
    order: tuple[int, ...]  # of the coordinates
    lost: float  # probability of noise for which nothing is known

    def least(self, value: Floats, outside: float) -> Floats:
        """Least expectation ``float[R]`` of ``value[*shape]`` over all transition probabilities.

        Values are in [0, 1]; that of leaving the grid is `outside`, 0 or 1. Rounded down.
        """
        source = np.ascontiguousarray(np.transpose(value, self.order))[None]
        for stage in self.stages:
            source = _contract(stage, self.factors[stage.axis], source, outside)
        return np.maximum(source - self.lost, 0)

    def certain_share(self) -> float:
        """Mean over the rows of the probability that their lower factors assign to cells."""
        shares = [x.low.sum(-1)[i] for x, i in zip(self.factors, self.ids, strict=True)]
        return float(np.prod(shares, 0).mean())

    def part(self, rows: Integers) -> TransitionBounds:
        """The transition probabilities of some rows."""
        ids = tuple(x[rows] for x in self.ids)
        return replace(self, ids=ids, stages=_stages(self.factors, ids, self.shape))

    def certain(self) -> tuple[Integers, Integers, Booleans]:
        """Boxes of cells ``int[R, n]`` of positive lower probabilities, start and stop; and ``bool[R]``,
        if leaving the grid has one.
        """
        start, stop, leaves = [], [], np.zeros(len(self.ids[0]), bool)
        for factors, index in zip(self.factors, self.ids, strict=True):
            # The product of the coordinates' probabilities must exceed the lost probability.
            positive: Booleans = factors.low > 1.01 * self.lost ** (1 / len(self.order))
            first = factors.start + np.argmax(positive, -1)
            last = factors.start + positive.shape[-1] - np.argmax(positive[:, ::-1], -1)
            start.append(first[index])
            stop.append(np.where(positive.any(-1), last, first)[index])
            leaves |= (factors.outside[:, 0] > 1.01 * self.lost)[index]
        axes = np.argsort(self.order)
        boxes = [np.stack(x, -1)[:, axes].astype(np.int32) for x in (start, stop)]
        return boxes[0], boxes[1], leaves


def transition_bounds(
    images: Images,
    grid: Grid,
    noise: Sequence[Distribution],
    box: NoiseBox,
    clipped: bool,
    only: Integers | None = None,
) -> TransitionBounds:
    """Interval transition probabilities of (some) rows of images, which hold for noise in a box."""
    factors, ids = [], []
    order = images.order or tuple(range(grid.num_axes))
    for axis in order:
        j = images.noise_of[axis]
        one, low_noise, high_noise = (
            (noise[j], box.low[j], box.high[j]) if j >= 0 else (None, 0.0, 0.0)
        )
        rows, number = _distinct(images.columns(axis, only))
        low, high, gain, _ = rows.T
        ends = low + gain * low_noise, high + gain * high_noise
        ids.append(number)
        factors.append(_factors(rows, ends, grid.edges[axis], one, clipped))
    shape = tuple(grid.shape[axis] for axis in order)
    stages = _stages(factors, ids, shape)
    return TransitionBounds(tuple(factors), tuple(ids), stages, shape, order, box.lost)


def _distinct(columns: Sequence[Floats]) -> tuple[Floats, Integers]:
    """Distinct rows ``[U, K]`` of K columns ``[R]``, in order, and the one of each row."""
    number = np.zeros(len(columns[0]), np.int32)
    for column in columns:  # keys of one number are sorted faster, and in less memory, than rows
        if (column == column[0]).all():
            continue
        values, inverse = np.unique(column, return_inverse=True)
        if number.any():
            key = number * np.int64(len(values)) + inverse
            inverse = np.unique(key, return_inverse=True)[1]
        number = inverse.astype(np.int32)
    first = np.empty(int(number.max()) + 1, np.int32)
    first[number[::-1]] = np.arange(len(number), dtype=np.int32)[::-1]
    return np.stack([column[first] for column in columns], -1), number


def _factors(
    rows: Floats,
    ends: tuple[Floats, Floats],
    edges: Floats,
    noise: Distribution | None,
    clipped: bool,
) -> CoordinateProbabilities:
    """Probabilities of intervals for images ``[U, 4]`` of low, high, gain and variation."""
    count = len(edges) - 1
    start = np.clip(np.searchsorted(edges, ends[0], "right") - 1, 0, count - 1)
    stop = np.clip(np.searchsorted(edges, ends[1], "right"), start + 1, count)
    width = int((stop - start).max())
    if len(rows) * width > MAX_PROBABILITIES:
        raise TooManyProbabilitiesError(
            f"{len(rows):,} images that may each meet {width:,} intervals of one coordinate have "
            f"{len(rows) * width:,} transition probabilities, of at most {MAX_PROBABILITIES:,}; give "
            "fewer cells."
        )
    start = np.minimum(start, count - width)
    bottom, top = edges[0], np.nextafter(edges[-1], np.inf)  # the last cell includes its upper edge
    if clipped:
        bottom, top = -np.inf, np.inf

    def side(at: Integers) -> Floats:
        return np.where(at == 0, bottom, np.where(at == count, top, edges[at]))

    def bounds(first: Integers, last: Integers, width: int = 1) -> tuple[Floats, Floats]:
        """``[U, width]``, of the intervals between the edges ``first + i`` and ``last + i``."""
        many, table = max(_CHUNK // width, 1), np.empty((2, len(rows), width))
        for i in range(0, len(rows), many):
            part = slice(i, i + many)
            a, b = (side(x[part, None] + np.arange(width)) for x in (first, last))
            table[:, part] = _bounds(noise, (a, b), rows[part])
        return table[0], table[1]

    lower, upper = bounds(start, start + 1, width)
    bottoms, tops = np.zeros_like(start), np.full_like(start, count)
    below, above = bounds(bottoms, start)[1], bounds(start + width, tops)[1]
    rest = np.where(start > 0, below[:, 0], 0) + np.where(start + width < count, above[:, 0], 0)
    outside = np.zeros((len(rows), 2))
    if not clipped:
        total_low, total_high = bounds(bottoms, tops)
        outside = np.concatenate([1 - total_high - _UNIT, total_high - total_low + 4 * _UNIT], -1)
        outside = np.where(
            np.concatenate([total_high, total_low], -1) == 1, 0, np.maximum(outside, 0)
        )
    gap = np.subtract(upper, lower, out=upper)
    np.add(gap, _UNIT, out=gap, where=gap > 0)
    return CoordinateProbabilities(start, lower, np.maximum(gap, 0, out=gap), outside, rest)


def _bounds(
    noise: Distribution | None, ends: tuple[Floats, Floats], rows: Floats
) -> tuple[Floats, Floats]:
    """Bounds of the probability of [a, b); without noise, 0 or 1 where the image decides it."""
    a, b = ends
    low, high, gain, varying = (x[:, None] for x in rows.T)
    certain = ((low >= a) & (high < b)).astype(np.float64)
    possible = ((high >= a) & (low < b)).astype(np.float64)
    if noise is None or not (gain > 0).any():
        return certain, possible
    scale = np.where(gain > 0, gain, 1.0)
    lower, upper = noise.probability_bounds(a, b, low, high, scale)
    if varying.any():  # the shift may depend on the noise: narrower and wider intervals
        first, last = a + varying, b - varying
        lower = noise.probability_bounds(first, np.maximum(first, last), low, high, scale)[0]
        lower = np.where(first < last, lower, 0.0)
        upper = noise.probability_bounds(a - varying, b + varying, low, high, scale)[1]
    random = gain > 0
    return np.where(random, lower, certain), np.where(random, upper, possible)


# --- contraction ----------------------------------------------------------------------------------


def _stages(
    factors: Sequence[CoordinateProbabilities], ids: Sequence[Integers], shape: tuple[int, ...]
) -> tuple[_Stage, ...]:
    """Groups of rows that share factors, from the last axis to the first."""
    num_rows = len(ids[0])
    stages = []
    group: Integers = np.zeros(num_rows, np.int32)  # of each row, in the stage before
    before, span = np.zeros((1, len(shape)), np.int32), shape
    starts = np.stack([f.start.astype(np.int32)[i] for f, i in zip(factors, ids, strict=True)], -1)
    widths = np.array([f.low.shape[1] for f in factors])
    for axis in reversed(range(len(shape))):
        if axis == 0:  # the last stage has one group for each row
            new = inverse = np.arange(num_rows, dtype=np.int32)
        else:
            # Rows far apart with equal factors are two groups: padded ranges stay short.
            pair = group * np.int64(ids[axis].max() + 1) + ids[axis]
            for other in range(axis):
                window = starts[:, other] // np.int32(2 * widths[other])
                _, pair = np.unique(pair, return_inverse=True)
                pair = pair.reshape(-1) * np.int64(window.max() + 1) + window
            _, new, inverse = np.unique(pair, return_index=True, return_inverse=True)
            inverse = inverse.reshape(-1).astype(np.int32)
        first = np.full((len(new), axis), np.iinfo(np.int32).max, np.int32)
        last = np.zeros((len(new), axis), np.int32)
        np.minimum.at(first, inverse, starts[:, :axis])
        np.maximum.at(last, inverse, starts[:, :axis] + widths[:axis])
        width = tuple(int(w) for w in (last - first).max(0)) if axis else ()
        # Padded ranges stay inside those of the stage before, which include the needed ones.
        parent = group[new]
        inside = before[parent]
        room = np.array(span[:axis], np.int32) - np.array(width, np.int32)
        first = np.minimum(first, inside[:, :axis] + room)
        stages.append(_Stage(axis, ids[axis][new], parent, inside, first, width))
        group, before, span = inverse, first, width
    return tuple(stages)


def _contract(
    stage: _Stage, factors: CoordinateProbabilities, source: Floats, outside: float
) -> Floats:
    """One stage: the least expectation along an axis, for each group and each cell of the others."""
    size = max(int(np.prod(stage.width)), 1)
    window = factors.low.shape[1]
    chunk = max(_CHUNK // (size * window), 1)
    values = np.empty((len(stage.factor), *stage.width))
    strides = np.array([s // source.itemsize for s in source.strides])
    flat = source.reshape(-1)

    def compute(begin: int) -> None:
        part = slice(begin, begin + chunk)
        factor = stage.factor[part]
        shift = stage.start[part] - stage.parent_start[part][:, : stage.axis]
        place = stage.parent[part] * strides[0] + (shift * strides[1:-1]).sum(-1)
        first = factors.start[factor] - stage.parent_start[part][:, stage.axis]
        index = (place + first * strides[-1]).reshape(-1, *(1,) * (len(stage.width) + 1))
        for axis, count in enumerate(stage.width):
            steps = np.arange(count) * strides[1 + axis]
            index = index + steps.reshape(-1, *(1,) * (len(stage.width) - axis))
        index = index + np.arange(window) * strides[-1]
        values[part] = _least(flat[index], factors, factor, outside)

    begins = range(0, len(stage.factor), chunk)
    if len(begins) < 3:
        list(map(compute, begins))
    else:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(compute, begins))
    return values


def _least(
    value: Floats, factors: CoordinateProbabilities, factor: Integers, outside: float
) -> Floats:
    """Least expectation along the last axis: the mass that is free goes to the least values first.

    ``sum low v + min sum x v`` over ``0 <= x <= gap`` with ``sum x = 1 - sum low``. Intervals that
    are not in the window count as 0. The sums of K products and of the masses err by at most
    ``(K + 4) eps``, since values and masses are at most 1.
    """
    middle = (1,) * (value.ndim - 2)
    low, gap = factors.low[factor], factors.gap[factor]
    out_low, out_gap = factors.outside[factor].T
    free = np.maximum(1 - low.sum(-1) - out_low, 0)
    free = np.maximum(free - factors.rest[factor] - (out_gap if outside == 0 else 0), 0)
    shape = (len(factor), *middle, value.shape[-1])
    low, gap = low.reshape(shape), gap.reshape(shape)
    order = np.argsort(value, -1)
    sorted_value = np.take_along_axis(value, order, -1)
    sorted_gap = np.take_along_axis(np.broadcast_to(gap, value.shape), order, -1)
    filled = np.cumsum(sorted_gap, -1)
    free = free.reshape(-1, *middle, 1)
    taken = np.clip(free - (filled - sorted_gap), 0, sorted_gap)
    total: Floats = (low * value).sum(-1) + (taken * sorted_value).sum(-1)
    if outside:
        rest = np.maximum(free[..., 0] - filled[..., -1], 0)
        total = total + out_low.reshape(-1, *middle) + rest
    result: Floats = np.clip(total - (value.shape[-1] + 8) * _UNIT, 0, 1)
    return result
