"""Rows of interval models in tables of one width, and what nature makes of them.

A linear function is extreme where mass goes first to the best successors. Where there are few these
are compared pair by pair, else sorted. Tables are short, so that work on them stays near.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxltl.core.host.ball import Sorted, narrowed
from jaxltl.core.host.rows import Booleans, Integers
from jaxltl.core.host.sparse import Floats

_PAIRS = 5  # entries of a row up to which each pair is compared
_WIDTHS = 12  # different numbers of successors up to which rows of each are in tables of their own
_LENGTH = 2**13  # rows of a table at most


class Table(NamedTuple):
    """Some rows of about one width.

    Attributes:
      row: ``int[N]``.
      entry: ``int[W, N]``, their entries; the first one again where a row has fewer.
      used: ``bool[W, N]``, or None where every row has W.
      lower, upper: ``float64[W, N]``; 0 where there is no entry.
      rest: ``float64[N]``, the mass that the lower ends leave.
      rounding: ``float64[N]``, by how much a sum may miss.
      center: ``float64[W, N]``, of a ball, or None; of that `most` and `lack`, ``float64[N]``, are
        what may be gained, and what the centers miss of one.
    """

    row: Integers
    entry: Integers
    used: Booleans | None
    lower: Floats
    upper: Floats
    rest: Floats
    rounding: Floats
    center: Floats | None = None
    most: Floats | None = None
    lack: Floats | None = None

    def best(self, key: Floats) -> Floats:
        """The distributions that make the mean of a key, ``float64[W, N]``, least: the same."""
        if key.shape[0] == 1:
            return self.upper.copy()
        if key.shape[0] <= _PAIRS and self.center is None and self.used is None:
            return self._by_pairs(key)
        return self._by_order(key)

    def _by_pairs(self, key: Floats) -> Floats:
        free = self.upper - self.lower
        left = np.repeat(self.rest[None], key.shape[0], 0)
        for j in range(1, key.shape[0]):
            for i in range(j):
                first = key[i] <= key[j]
                left[j] -= first * free[i]
                left[i] -= ~first * free[j]
        return self._given(left, self.lower, self.upper, self.rounding)

    def _by_order(self, key: Floats) -> Floats:
        if self.used is not None:
            key = np.where(self.used, key, np.inf)
        order = np.argsort(key.T, axis=1, kind="stable")
        lower, upper = (np.take_along_axis(x.T, order, 1) for x in (self.lower, self.upper))
        rest, rounding = self.rest[:, None], self.rounding[:, None]
        if self.center is not None and self.most is not None and self.lack is not None:
            center = np.take_along_axis(self.center.T, order, 1)
            used = None if self.used is None else np.take_along_axis(self.used.T, order, 1)
            lower, upper = narrowed(Sorted(
                lower, upper, center, used, self.most, self.lack, self.rounding))
            rest = np.maximum(1 - lower.sum(1, keepdims=True), 0)
        before = np.zeros_like(lower)
        np.cumsum((upper - lower)[:, :-1], axis=1, out=before[:, 1:])
        mass = np.empty_like(lower)
        np.put_along_axis(mass, order, self._given(rest - before, lower, upper, rounding), 1)
        return np.ascontiguousarray(mass.T)

    @staticmethod
    def _given(left: Floats, lower: Floats, upper: Floats, rounding: Floats) -> Floats:
        """What entries get of what better ones leave; what is given whole is the upper end."""
        room = upper - lower
        given = np.clip(np.where(left > rounding, left, 0), 0, room)
        return np.where(given == room, upper, lower + given)


def tables(start: Integers) -> list[tuple[Integers, Integers, Booleans | None]]:
    """The rows in tables by their width, or by its logarithm if there are many widths.

    Args:
      start: ``int[R + 1]``, where the entries of rows begin.

    Returns:
      For each table its rows, their entries, and which of them are used, as in a :class:`Table`.
    """
    width = np.diff(start)
    kind = width
    if np.unique(width).size > _WIDTHS:
        kind = np.where(width > 1, np.ceil(np.log2(width)).astype(int) + 1, 1)
    found: list[tuple[Integers, Integers, Booleans | None]] = []
    for k in np.unique(kind):
        every = np.flatnonzero(kind == k)
        rank = np.arange(width[every].max())[:, None]
        for i in range(0, every.size, _LENGTH):
            row = every[i : i + _LENGTH]
            used = rank < width[row]
            entry = start[row] + np.where(used, rank, 0)
            found.append((row, entry, None if used.all() else used))
    return found
