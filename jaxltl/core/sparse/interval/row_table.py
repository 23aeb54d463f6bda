"""Rows of interval models in tables of one width, and what nature makes of them.

A linear function is extreme where mass goes first to the best successors. Where there are few these
are compared pair by pair, else sorted. Tables are short, so that work on them stays near.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.interval.exact_sums import SHARE, exact_sum
from jaxltl.core.sparse.interval.l1_distance import Sorted, narrowed
from jaxltl.core.sparse.rows import concatenated_ranges, offsets_from_counts

_EPS = float(np.finfo(np.float64).eps)
_NEAR = 2.0**-16  # of zero, sums that are done again
_FINE = 2.0**-20  # mass below which it counts how a distribution is rounded
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
    fine: Integers = np.zeros(0, np.int64)

    def best(self, key: Floats) -> Floats:
        """The distributions that make the mean of a key, ``float64[W, N]``, least: the same."""
        if key.shape[0] == 1:
            return self.upper.copy()
        if key.shape[0] <= _PAIRS and self.center is None and self.used is None:
            return self._by_pairs(key)
        return self._by_order(key)

    @classmethod
    def of(cls, *ends: Any, **ball: Any) -> Table:
        """A table whose fine rows are found."""
        table = cls(*ends, **ball)
        lower, upper = table.lower, table.upper
        if lower.shape[0] == 1 or (lower.min() >= _FINE and upper.max() <= 1 - _FINE):
            return table
        fine = np.zeros(table.row.size, bool)
        for x in (lower, upper, 1 - upper):
            fine |= ((x > 0) & (x < _FINE)).any(0)
        return table._replace(fine=np.flatnonzero(fine & (lower < upper).any(0)))

    def _by_pairs(self, key: Floats) -> Floats:
        free = self.upper - self.lower
        left = np.repeat(self.rest[None], key.shape[0], 0)
        for j in range(1, key.shape[0]):
            for i in range(j):
                first = key[i] <= key[j]
                left[j] -= first * free[i]
                left[i] -= ~first * free[j]
        given = self._given(left, self.lower, self.upper, self.rounding)
        if self.fine.size:
            order = np.argsort(key[:, self.fine].T, axis=1, kind="stable")
            ends = (
                np.take_along_axis(x[:, self.fine].T, order, 1) for x in (self.lower, self.upper)
            )
            mass = np.empty(order.shape)
            np.put_along_axis(mass, order, exactly_given(*ends), 1)
            given[:, self.fine] = mass.T
        return given

    def _by_order(self, key: Floats) -> Floats:
        if self.used is not None:
            key = np.where(self.used, key, np.inf)
        order = np.argsort(key.T, axis=1, kind="stable")
        lower, upper = (np.take_along_axis(x.T, order, 1) for x in (self.lower, self.upper))
        rest, rounding = self.rest[:, None], self.rounding[:, None]
        if self.center is not None and self.most is not None and self.lack is not None:
            center = np.take_along_axis(self.center.T, order, 1)
            used = None if self.used is None else np.take_along_axis(self.used.T, order, 1)
            lower, upper = narrowed(
                Sorted(lower, upper, center, used, self.most, self.lack, self.rounding)
            )
            rest = np.maximum(1 - lower.sum(1, keepdims=True), 0)
        before = np.zeros_like(lower)
        np.cumsum((upper - lower)[:, :-1], axis=1, out=before[:, 1:])
        mass, given = np.empty_like(lower), self._given(rest - before, lower, upper, rounding)
        if self.fine.size:
            given[self.fine] = exactly_given(lower[self.fine], upper[self.fine])
        np.put_along_axis(mass, order, given, 1)
        return np.ascontiguousarray(mass.T)

    # --- what distributions are worth, exactly ------------------------------------------------

    def more(self, p: Floats, gain: Floats, *, every: bool) -> Floats:
        """How much more than some distributions others gain, at most: ``float64[N]``.

        Args:
          p: ``float64[W, N]``, distributions up to rounding: the best ones where `every`.
          gain: ``float64[W, N]``.
          every: whether all others count, else one next to p that is a distribution exactly.
        """
        if self.center is not None:
            return self._most(p, gain) if every else self._near(p, gain)
        room = np.minimum(p - self.lower, self.upper - p)
        partly = room > 0
        found = np.einsum("wn,wn->n", partly, np.abs(gain)) * self.rounding
        # Where one entry has a part that rounding leaves one, only that may be off. Else:
        told = (partly.sum(0) == 1) & (room.max(0) > self.rounding)
        told[self.fine] = False
        if not told.all():
            rows = np.flatnonzero(~told)
            part = self._replace(
                row=self.row[rows], lower=self.lower[:, rows], upper=self.upper[:, rows]
            )
            p, gain = p[:, rows], gain[:, rows]
            found[rows] = part._most(p, gain) if every else part._near(p, gain)
        return found

    def missing(self, p: Floats, share: float = SHARE) -> Floats:
        """What distributions miss of one, ``float64[N]``; nothing where there is one alone.

        Rows without choice are in proportion to their numbers, however these add up.
        """
        found = exact_sum(np.concatenate([np.ones((1, p.shape[1])), -p]), share)
        return np.where((self.lower == self.upper).all(0), 0, found)

    def spare(self, p: Floats) -> Floats:
        """What more may be gained over the center, ``float64[N]``, of a ball."""
        assert self.center is not None and self.most is not None
        over = p > self.center
        gained = np.where(over, p, 0), np.where(over, self.center, 0)
        found = exact_sum(np.concatenate([self.most[None], -gained[0], gained[1]]))
        return np.where((self.lower == self.upper).all(0), 0, found)

    def _most(self, p: Floats, gain: Floats) -> Floats:
        """How much more than p any distribution may gain, at most: ``float64[N]``.

        By duality, for any price of mass: what misses of one at that price, and what entries that
        are worth more, or less, than it could still take, or give. Of a ball what may be gained
        over the center has a price too. Prices are those of the entry that is given a part.
        """
        missing = self.missing(p)
        price = self._price(p < self.upper, p > self.lower, gain, missing)
        found = self._dual(p, gain, missing, price, np.zeros_like(price))
        if self.center is None:
            return found
        low = self._price(p < self.center, (p > self.lower) & (p <= self.center), gain, missing)
        rise = np.where((p < self.upper) & (p >= self.center), gain, -np.inf).max(0)
        rise = np.where(np.isfinite(rise), np.maximum(rise - low, 0), 0)
        return np.minimum(found, self._dual(p, gain, missing, low, rise))

    @staticmethod
    def _price(more: Booleans, less: Booleans, gain: Floats, missing: Floats) -> Floats:
        """What the next mass is worth, or what the last was."""
        high = np.where(more, gain, -np.inf).max(0)
        low = np.where(less, gain, np.inf).min(0)
        found = np.where(missing < 0, low, high)
        return np.where(np.isfinite(found), found, gain.min(0))

    def _dual(
        self, p: Floats, gain: Floats, missing: Floats, price: Floats, rise: Floats
    ) -> Floats:
        """The bound of some prices."""
        over = gain - price
        off = np.where(over > 0, self.upper, self.lower) - p
        if self.center is None:
            return _upward(price * missing) + _upward(np.einsum("wn,wn->n", off, over))
        above = over > rise
        at = np.where(above, self.upper, np.where(over > 0, self.center, self.lower))
        part = (at - p) * over
        paid = rise * (np.maximum(at - self.center, 0) - np.maximum(p - self.center, 0))
        size = np.where(at == p, 0, np.abs(at - self.center) + np.abs(p - self.center))
        slack = 8 * _EPS * (np.abs(part) + rise * size).sum(0)
        return (
            _upward(price * missing) + (part - paid).sum(0) + slack + _upward(rise * self.spare(p))
        )

    def _near(self, p: Floats, gain: Floats) -> Floats:
        """How much more than p a distribution of the row gains, at most: ``float64[N]``.

        The same one for all gains: what p misses goes to the entry with most room, where that is
        certain to be enough; else it may be any.
        """
        missing = self.missing(p)
        k, fits, over = self._taker(p, missing)
        mine = _upward(gain[k, np.arange(k.size)] * missing)
        loose = np.where(self.lower < self.upper, np.abs(gain), 0).max(0)
        return np.where(fits, mine, (np.abs(missing) + 4 * over) * loose * (1 + SHARE))

    def _taker(self, p: Floats, missing: Floats) -> tuple[Integers, Booleans, Floats]:
        """An entry that can take what is missing, whether it can, and what is gained too much."""
        over, top = np.zeros(missing.size), self.upper
        if self.center is not None:
            spare = self.spare(p)
            over = np.maximum(-spare, 0)
            enough = spare >= 2 * np.abs(missing)
            top = np.where(enough, top, np.where(p < self.center, self.center, p))
        room = np.where(missing > 0, top - p, p - self.lower)
        kept = np.where(p > 0, room, 0)
        enough = kept.max(0) * (1 - 8 * _EPS) >= np.abs(missing) * (1 + SHARE)
        room = np.where(enough, kept, room)
        k = room.argmax(0)
        fits = room.max(0) * (1 - 8 * _EPS) >= np.abs(missing) * (1 + SHARE)
        return k, (fits | (missing == 0)) & (over == 0), over

    def settled(self, p: Floats) -> tuple[Floats, Booleans]:
        """Distributions next to p, each mass right to its last digits, where ``bool[N]``."""
        p = np.clip(p, self.lower, self.upper)
        if self.center is not None:
            over = np.maximum(-self.spare(p), 0)
            gained = p - self.center
            k, every = gained.argmax(0), np.arange(over.size)
            less = np.where(over > 0, 2 * over + 4 * _EPS * p[k, every], 0)
            p[k, every] -= np.where(less < gained[k, every] / 2, less, 0)
        missing = self.missing(p, _EPS)
        k, fits, _ = self._taker(p, missing)
        p[k, np.arange(k.size)] += np.where(fits, missing, 0)
        return p, fits

    @staticmethod
    def _given(left: Floats, lower: Floats, upper: Floats, rounding: Floats) -> Floats:
        """What entries get of what better ones leave; what is given whole is the upper end."""
        room = upper - lower
        given = np.minimum(left, room)
        given *= left > rounding
        found = lower + given
        np.copyto(found, upper, where=given == room)
        return found


def _upward(x: Floats) -> Floats:
    """No less than what this is a rounding of."""
    return x + 2 * SHARE * np.abs(x)


def exactly_given(lower: Floats, upper: Floats) -> Floats:
    """What entries get in turn, the first ones first: ``float64[N, W]``, each to its last digits.

    What is left for an entry is one without the upper ends before it and the lower ends after it.
    """
    high, low = np.ones(len(lower)), np.zeros(len(lower))

    def less(x: Floats) -> None:
        nonlocal high, low
        total = high - x
        part = total - high
        low = low + ((high - (total - part)) - (x + part))
        high = total

    for j in range(1, lower.shape[1]):
        less(lower[:, j])
    found = np.empty_like(lower)
    for j in range(lower.shape[1]):
        found[:, j] = np.clip(high + low, lower[:, j], upper[:, j])
        if j + 1 < lower.shape[1]:
            less(upper[:, j])
            less(-lower[:, j + 1])
    return found


def row_sums(quantity: Floats, start: Integers, *more: Floats) -> Floats:
    """Sums over each row's entries and of more, ``float64[R]``; of the right sign, as `exact_sum`.

    Args:
      quantity: ``float64[T]``.
      start: ``int[R + 1]``, where rows begin.
      more: ``float64[R]`` each.
    """
    found = np.add.reduceat(quantity, start[:-1])
    for x in more:
        found = found + x
    near = np.flatnonzero(np.abs(found) <= _NEAR)
    near = near[np.diff(start)[near] + len(more) > 2]  # one addition has the right sign
    if near.size:
        width = np.diff(start)[near]
        entry = concatenated_ranges(start[near], width)
        for row, at, used in tables(offsets_from_counts(width)):
            terms = quantity[entry[at]]
            terms = terms if used is None else np.where(used, terms, 0)
            found[near[row]] = exact_sum(np.concatenate([[x[near[row]] for x in more], terms]))
    return found


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
