"""Sparse rows: the successors of every choice without padding, and reductions over them.

SciPy takes a tenth of a second to import, so below some size NumPy alone does the work.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from jaxltl.core.array_types import Booleans, Integers, SparseMatrix

SCIPY_SIZE = 100_000  # entries from which importing SciPy pays
_READY = 20_000  # entries from which it is faster, once it is imported
_FEW = 16  # columns up to which reducing them one by one beats a reduction over a short axis


@dataclass(frozen=True)
class Rows:
    """Support of a transition function: row r has successors ``successor[entry_start[r] : ...]``."""

    entry_start: Integers  # int[R + 1]
    successor: Integers  # int32[T], by row
    num_states: int  # S, above every successor

    @property
    def num_rows(self) -> int:
        return self.entry_start.size - 1

    @cached_property
    def count(self) -> Integers:
        """The number of entries of each row, ``int[R]``."""
        return np.diff(self.entry_start)

    @cached_property
    def matrix(self) -> SparseMatrix:
        """The sparse matrix of ones, ``[R, S]``."""
        from scipy import sparse  # slow to import; only large models need it

        # Bytes are the fastest, but a row of 256 of them can add up to zero.
        data = np.ones(self.successor.size, np.uint8 if self.count.max() < 256 else bool)
        shape = (self.num_rows, self.num_states)
        return sparse.csr_array((data, self.successor, self.entry_start), shape=shape)

    def some_successor_in(self, region: Booleans) -> Booleans:
        """Marks rows with a successor in a region: ``bool[R]``."""
        if not region.any():
            return np.zeros(self.num_rows, bool)
        if region.all():
            return self.count > 0
        if self.successor.size > SCIPY_SIZE:
            result: Booleans = self.matrix @ region.astype(self.matrix.dtype) > 0
            return result
        return self.reduce(np.logical_or, region[self.successor], False)

    def least(self, value: np.ndarray, default: float) -> np.ndarray:
        """The smallest value among the successors, ``[R]``; the default for empty rows."""
        return self.reduce(np.minimum, value[self.successor], default)

    def reduce(self, operation: np.ufunc, entries: np.ndarray, default: float) -> np.ndarray:
        """A reduction over the entries of each row, ``[R]``; the default for empty rows."""
        reduced = np.full(self.num_rows, default, entries.dtype)
        full = self.count > 0
        if full.any():
            reduced[full] = operation.reduceat(entries, self.entry_start[:-1][full])
        return reduced

    @cached_property
    def predecessors(self) -> tuple[Integers, Integers]:
        """The rows with successor t, one per entry and in order: ``row[start[t] : start[t + 1]]``."""
        size = self.successor.size
        if size > SCIPY_SIZE or (size > _READY and "scipy.sparse" in sys.modules):
            columns = self.matrix.tocsc()
            return columns.indptr, columns.indices
        order = np.argsort(self.successor, kind="stable")
        count = np.bincount(self.successor, minlength=self.num_states)
        row = np.repeat(np.arange(self.num_rows, dtype=np.int32), self.count)
        return np.concatenate([[0], count.cumsum()]), row[order]


def concatenated_ranges(start: Integers, count: Integers) -> Integers:
    """The numbers ``start[i], ..., start[i] + count[i] - 1`` of all ranges, concatenated."""
    end = count.cumsum()
    numbers: Integers = (start - end + count).repeat(count)
    numbers += np.arange(numbers.size)
    return numbers


def row_entries(start: Integers, row: Integers) -> tuple[Integers, Integers]:
    """The entries of some rows, concatenated, and the number of entries of each of these rows."""
    count = start[row + 1] - start[row]
    return concatenated_ranges(start[row], count), count


def mask_of(index: Integers, size: int) -> Booleans:
    """The mask ``bool[size]`` of some indices.

    >>> mask_of(np.array([2, 0]), 3).tolist()
    [True, False, True]
    """
    mask = np.zeros(size, bool)
    mask[index] = True
    return mask


def positions(number: Integers, size: int) -> Integers:
    """The position of each number in a list, ``int32[size]``; -1 where it is not listed.

    >>> positions(np.array([2, 0]), 3).tolist()
    [1, -1, 0]
    """
    position: Integers = np.full(size, -1, np.int32)
    position[number] = np.arange(number.size)
    return position


def offsets_from_counts(count: Integers) -> Integers:
    """The start of each group of the given sizes, and the end: ``int32[N + 1]``, if that fits.

    >>> offsets_from_counts(np.array([2, 0, 1])).tolist()
    [0, 2, 2, 3]
    """
    offsets: Integers = np.zeros(count.size + 1, np.int64)
    np.cumsum(count, out=offsets[1:])
    return offsets.astype(np.int32) if offsets[-1] < 2**31 else offsets


def sorted_unique(number: Integers, size: int) -> Integers:
    """Numbers below a size in ascending order, without repetition.

    >>> sorted_unique(np.array([3, 1, 3]), 5).tolist()
    [1, 3]
    """
    if number.size < size // 16:
        number = np.sort(number)
        return number[group_starts(number)]
    mark = mask_of(number, size)
    return np.flatnonzero(mark)


def group_starts(number: Integers) -> Booleans:
    """Marks the numbers that differ from the number before them: ``bool[N]``.

    >>> group_starts(np.array([1, 1, 3])).tolist()
    [True, False, True]
    """
    starts = np.ones(number.size, bool)
    np.not_equal(number[1:], number[:-1], out=starts[1:])
    return starts


def first_hits(hit: Booleans, owner: Integers, otherwise: Integers) -> Integers:
    """The first marked element of each owner, or another number where none is marked.

    >>> first_hits(np.array([False, True, True]), np.array([0, 1, 1]), np.array([7, 7])).tolist()
    [7, 1]
    """
    place, first = np.flatnonzero(hit)[::-1], otherwise.copy()
    first[owner[place]] = place  # the first one is written last
    return first


def decrement(counter: Integers, number: Integers) -> None:
    """Decrements a counter once for each occurrence of its number, in place."""
    if number.size < counter.size:
        np.subtract.at(counter, number, counter.dtype.type(1))  # another type is far slower
    else:
        counter -= np.bincount(number, minlength=counter.size).astype(counter.dtype)


def rows_from_padded(successor: Integers, used: Booleans, num_states: int) -> Rows:
    """Rows from padded lists ``int[..., K]``, of which the entries in `used` ``bool[..., K]`` count.

    >>> rows = rows_from_padded(np.array([[1, 7], [0, 1]]), np.array([[True, False], [True, True]]), 2)
    >>> rows.entry_start.tolist(), rows.successor.tolist()
    ([0, 1, 3], [1, 0, 1])
    """
    width = used.shape[-1]
    index: type[np.signedinteger] = np.int32 if used.size < 2**31 else np.int64
    if used.all():
        every: Integers = np.arange(0, used.size + 1, width, dtype=index)
        return Rows(every, successor.reshape(-1), num_states)
    start: Integers = np.zeros(used.size // width + 1, index)
    start[1:] = np.cumsum(used.ravel(), dtype=index)[width - 1 :: width]
    return Rows(start, successor[used], num_states)


def rows_from_dense(used: Booleans) -> Rows:
    """Rows from a dense support, ``bool[..., S]``."""
    flat = used.reshape(-1, used.shape[-1])
    start: Integers = np.concatenate([[0], flat.sum(-1).cumsum()])
    return Rows(start, np.nonzero(flat)[1].astype(np.int32), used.shape[-1])


# --- masks of actions -------------------------------------------------------------------------


def some_action(mask: Booleans) -> Booleans:
    """Marks where a mask ``bool[..., A]`` holds for some action."""
    if mask.shape[-1] > _FEW:
        result: Booleans = np.any(mask, -1, keepdims=True)[..., 0]
        return result
    some: Booleans = mask[..., 0].copy()
    for a in range(1, mask.shape[-1]):
        some |= mask[..., a]
    return some


def first_action(mask: Booleans) -> tuple[Booleans, Integers]:
    """Marks where a mask ``bool[..., A]`` holds for some action, and gives the first one (or 0)."""
    if mask.shape[-1] > _FEW:
        return np.any(mask, -1, keepdims=True)[..., 0], mask.argmax(-1).astype(np.int32)
    # Counting the actions before the first one is ten times faster than writing where it is.
    some: Booleans = mask[..., 0].copy()
    action = np.zeros(mask.shape[:-1], np.int8)
    for a in range(1, mask.shape[-1]):
        action += ~some
        some |= mask[..., a]
    action *= some
    return some, action.astype(np.int32)
