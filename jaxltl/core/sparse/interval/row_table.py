"""Rows of an uncertainty set as dense tables: extreme distributions and certified row sums.

A linear function over ``{p : lower <= p <= upper, sum(p) = 1}`` is extreme at the distribution
that gives mass greedily to the best successors (Nilim and El Ghaoui 2005). Short rows compare all
pairs of successors, longer ones are sorted. Tables have at most `_LENGTH` rows to stay in cache.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.interval.l1_ball import BallLimits, narrow_intervals
from jaxltl.core.sparse.linear.extended_precision import two_sum
from jaxltl.core.sparse.rows import offsets_from_counts, row_entries

_EPS = float(np.finfo(np.float64).eps)
SUM_ERROR = 2.0**-30  # relative error of `exact_sum`
_RESUM = 2.0**-16  # row sums nearer to zero are summed again without error
_FINE = 2.0**-20  # mass below which the relative error of a distribution matters
_PAIRS = 5  # entries of a row up to which all pairs are compared
_WIDTHS = 12  # distinct row widths up to which each has its own table
_LENGTH = 2**13


@dataclass(frozen=True)
class RowTable:
    """Rows of about equal width, one column per row."""

    row: Integers  # int[N]
    entry: Integers  # int[W, N]; padding repeats the first entry of the row
    used: Booleans | None  # bool[W, N], False in padding; None without padding
    lower: Floats  # float64[W, N], 0 in padding
    upper: Floats
    free_mass: Floats  # float64[N], one minus the sum of the lower ends
    rounding: Floats  # float64[N], bound on the rounding error of a sum over the row
    center: Floats | None = None  # float64[W, N], center of the L1 ball, or None
    gain: Floats | None = None  # float64[N], mass that a distribution may gain over the center
    deficit: Floats | None = None  # float64[N], one minus the sum of the center

    @cached_property
    def fine(self) -> Integers:
        """Rows with a possible tiny mass; their distributions are computed exactly."""
        lower, upper = self.lower, self.upper
        loose = (lower < upper).any(0)
        if lower.shape[0] == 1 or (lower.min() >= _FINE and upper.max() <= 1 - _FINE):
            return np.zeros(0, np.int64)
        fine = np.zeros(self.row.size, bool)
        for x in (lower, upper, 1 - upper):
            fine |= ((x > 0) & (x < _FINE)).any(0)
        return np.flatnonzero(fine & loose)

    def select(self, rows: Integers) -> RowTable:
        """The intervals of some rows."""
        return replace(
            self,
            row=self.row[rows],
            lower=self.lower[:, rows],
            upper=self.upper[:, rows],
            rounding=self.rounding[rows],
        )

    # --- extreme distributions ----------------------------------------------------------------

    def extreme(self, key: Floats) -> Floats:
        """Distributions ``float64[W, N]`` that minimise the mean of a key of that shape."""
        if key.shape[0] == 1:
            return self.upper.copy()
        if key.shape[0] <= _PAIRS and self.center is None and self.used is None:
            return self._by_pairs(key)
        return self._by_order(key)

    def _by_pairs(self, key: Floats) -> Floats:
        free = self.upper - self.lower
        remaining = np.repeat(self.free_mass[None], key.shape[0], 0)
        for j in range(1, key.shape[0]):
            for i in range(j):
                first = key[i] <= key[j]
                remaining[j] -= first * free[i]
                remaining[i] -= ~first * free[j]
        mass = _greedy(remaining, self.lower, self.upper, self.rounding)
        if self.fine.size:
            order = np.argsort(key[:, self.fine].T, axis=1, kind="stable")
            ends = (
                np.take_along_axis(x[:, self.fine].T, order, 1) for x in (self.lower, self.upper)
            )
            exact = np.empty(order.shape)
            np.put_along_axis(exact, order, exact_greedy(*ends), 1)
            mass[:, self.fine] = exact.T
        return mass

    def _by_order(self, key: Floats) -> Floats:
        if self.used is not None:
            key = np.where(self.used, key, np.inf)
        order = np.argsort(key.T, axis=1, kind="stable")
        lower, upper = (np.take_along_axis(x.T, order, 1) for x in (self.lower, self.upper))
        free_mass, rounding = self.free_mass[:, None], self.rounding[:, None]
        if self.center is not None and self.gain is not None and self.deficit is not None:
            center = np.take_along_axis(self.center.T, order, 1)
            used = None if self.used is None else np.take_along_axis(self.used.T, order, 1)
            limits = BallLimits(self.gain[:, None], self.deficit[:, None], rounding)
            lower, upper = narrow_intervals(lower, upper, center, used, limits)
            free_mass = np.maximum(1 - lower.sum(1, keepdims=True), 0)
        before = np.zeros_like(lower)
        np.cumsum((upper - lower)[:, :-1], axis=1, out=before[:, 1:])
        ordered = _greedy(free_mass - before, lower, upper, rounding)
        if self.fine.size:
            ordered[self.fine] = exact_greedy(lower[self.fine], upper[self.fine])
        mass = np.empty_like(lower)
        np.put_along_axis(mass, order, ordered, 1)
        return np.ascontiguousarray(mass.T)

    # --- certified means ----------------------------------------------------------------------

    def mean_error(self, p: Floats, gain: Floats, *, over_all: bool) -> Floats:
        """Upper bound of ``sum (q - p) gain`` in each row: q is near p or, with `over_all`, any."""
        if self.center is not None:
            return self._dual_bound(p, gain) if over_all else self._nearest_bound(p, gain)
        room = np.minimum(p - self.lower, self.upper - p)
        partial = room > 0
        error: Floats = np.einsum("wn,wn->n", partial, np.abs(gain)) * self.rounding
        # With one entry strictly between its ends, by more than rounding, only that one may err.
        certain = (partial.sum(0) == 1) & (room.max(0) > self.rounding)
        certain[self.fine] = False
        if not certain.all():
            rows = np.flatnonzero(~certain)
            part, p, gain = self.select(rows), p[:, rows], gain[:, rows]
            bound = part._dual_bound if over_all else part._nearest_bound
            error[rows] = bound(p, gain)
        return error

    def missing(self, p: Floats, share: float = SUM_ERROR) -> Floats:
        """One minus the sum of each distribution; 0 in rows with a single distribution."""
        mass = exact_sum(np.concatenate([np.ones((1, p.shape[1])), -p]), share)
        return np.where((self.lower == self.upper).all(0), 0, mass)

    def _unused_gain(self, p: Floats) -> Floats:
        """Mass that p may still gain over the center of the ball."""
        assert self.center is not None and self.gain is not None
        over = p > self.center
        gained = np.where(over, p, 0), np.where(over, self.center, 0)
        unused = exact_sum(np.concatenate([self.gain[None], -gained[0], gained[1]]))
        return np.where((self.lower == self.upper).all(0), 0, unused)

    def _dual_bound(self, p: Floats, gain: Floats) -> Floats:
        """Bound of ``max_q sum (q - p) gain`` by linear programming duality.

        Every price of mass gives a bound: the missing mass at that price, plus the rise of
        entries that are worth more and the fall of those that are worth less. In a ball, gaining
        over the center has a price too. The prices tried are gains of the partial entry.
        """
        missing = self.missing(p)
        price = _marginal_gain(p < self.upper, p > self.lower, gain, missing)
        bound = self._dual_value(p, gain, missing, price, np.zeros_like(price))
        if self.center is None:
            return bound
        falls = (p > self.lower) & (p <= self.center)
        low = _marginal_gain(p < self.center, falls, gain, missing)
        rise = np.where((p < self.upper) & (p >= self.center), gain, -np.inf).max(0)
        rise = np.where(np.isfinite(rise), np.maximum(rise - low, 0), 0)
        return np.minimum(bound, self._dual_value(p, gain, missing, low, rise))

    def _dual_value(
        self, p: Floats, gain: Floats, missing: Floats, price: Floats, rise: Floats
    ) -> Floats:
        over = gain - price
        off = np.where(over > 0, self.upper, self.lower) - p
        if self.center is None:
            return _upward(price * missing) + _upward(np.einsum("wn,wn->n", off, over))
        at = np.where(over > rise, self.upper, np.where(over > 0, self.center, self.lower))
        part = (at - p) * over
        paid = rise * (np.maximum(at - self.center, 0) - np.maximum(p - self.center, 0))
        size = np.where(at == p, 0, np.abs(at - self.center) + np.abs(p - self.center))
        slack = 8 * _EPS * (np.abs(part) + rise * size).sum(0)
        unused = _upward(rise * self._unused_gain(p))
        total: Floats = _upward(price * missing) + (part - paid).sum(0) + slack + unused
        return total

    def _nearest_bound(self, p: Floats, gain: Floats) -> Floats:
        """Bound of ``sum (q - p) gain`` for the distribution q of `nearest`."""
        missing = self.missing(p)
        k, fits, over = self._correctable_entry(p, missing)
        mine = _upward(gain[k, np.arange(k.size)] * missing)
        loose = np.where(self.lower < self.upper, np.abs(gain), 0).max(0)
        return np.where(fits, mine, (np.abs(missing) + 4 * over) * loose * (1 + SUM_ERROR))

    def _correctable_entry(self, p: Floats, missing: Floats) -> tuple[Integers, Booleans, Floats]:
        """Entries that absorb the missing mass, whether they can, and gains beyond the ball."""
        over, top = np.zeros(missing.size), self.upper
        if self.center is not None:
            unused = self._unused_gain(p)
            over = np.maximum(-unused, 0)
            enough = unused >= 2 * np.abs(missing)
            top = np.where(enough, top, np.where(p < self.center, self.center, p))
        room = np.where(missing > 0, top - p, p - self.lower)
        kept = np.where(p > 0, room, 0)
        needed = np.abs(missing) * (1 + SUM_ERROR)
        room = np.where(kept.max(0) * (1 - 8 * _EPS) >= needed, kept, room)
        fits = room.max(0) * (1 - 8 * _EPS) >= needed
        return room.argmax(0), (fits | (missing == 0)) & (over == 0), over

    def nearest(self, p: Floats) -> tuple[Floats, Booleans]:
        """Distributions next to p, each mass right to its last digits, and whether they exist."""
        p = np.clip(p, self.lower, self.upper)
        if self.center is not None:
            over = np.maximum(-self._unused_gain(p), 0)
            gained = p - self.center
            k, rows = gained.argmax(0), np.arange(over.size)
            less = np.where(over > 0, 2 * over + 4 * _EPS * p[k, rows], 0)
            p[k, rows] -= np.where(less < gained[k, rows] / 2, less, 0)
        missing = self.missing(p, _EPS)
        k, fits, _ = self._correctable_entry(p, missing)
        p[k, np.arange(k.size)] += np.where(fits, missing, 0)
        return p, fits


def _greedy(remaining: Floats, lower: Floats, upper: Floats, rounding: Floats) -> Floats:
    """Mass of entries from what better ones leave; a full entry gets its upper end exactly."""
    room = upper - lower
    added = np.minimum(remaining, room)
    added *= remaining > rounding
    mass = lower + added
    np.copyto(mass, upper, where=added == room)
    return mass


def _marginal_gain(more: Booleans, less: Booleans, gain: Floats, missing: Floats) -> Floats:
    """Gain of the next unit of mass, or of the last one where mass is in excess."""
    high = np.where(more, gain, -np.inf).max(0)
    low = np.where(less, gain, np.inf).min(0)
    marginal: Floats = np.where(missing < 0, low, high)
    np.copyto(marginal, gain.min(0), where=~np.isfinite(marginal))
    return marginal


def _upward(x: Floats) -> Floats:
    return x + 2 * SUM_ERROR * np.abs(x)


def exact_greedy(lower: Floats, upper: Floats) -> Floats:
    """Greedy masses of sorted rows, ``float64[N, W]``, each right to its last digits."""
    high, low = np.ones(len(lower)), np.zeros(len(lower))

    def subtract(x: Floats) -> None:
        nonlocal high, low
        high, lost = two_sum(high, -x)
        low = low + lost

    for j in range(1, lower.shape[1]):
        subtract(lower[:, j])
    mass = np.empty_like(lower)
    for j in range(lower.shape[1]):
        mass[:, j] = np.clip(high + low, lower[:, j], upper[:, j])
        if j + 1 < lower.shape[1]:
            subtract(upper[:, j])
            subtract(-lower[:, j + 1])
    return mass


# --- sums with a certain sign -------------------------------------------------------------------


def exact_sum(terms: Floats, share: float = SUM_ERROR) -> Floats:
    """Sums over the first axis with relative error `share`, for finite terms of at most 1e100.

    Error-free additions (Knuth; Ogita, Rump and Oishi 2005); :func:`math.fsum` near zero.
    """
    high = terms[0].copy()
    low, size = np.zeros_like(high), np.zeros_like(high)
    for x in terms[1:]:
        high, lost = two_sum(high, x)
        low += lost
        size += np.abs(lost)
    total: Floats = high + low
    unsure = np.flatnonzero(share * np.abs(total) < len(terms) * _EPS * size)
    if unsure.size:
        total[unsure] = [math.fsum(x) for x in terms[:, unsure].T.tolist()]
    return total


def row_sums(quantity: Floats, start: Integers, *more: Floats) -> Floats:
    """Sums of ``float64[T]`` over each row, plus ``float64[R]`` terms, with the right sign."""
    sums = np.add.reduceat(quantity, start[:-1])
    for x in more:
        sums = sums + x
    small = np.flatnonzero(np.abs(sums) <= _RESUM)
    small = small[np.diff(start)[small] + len(more) > 2]  # a single addition has the right sign
    if small.size:
        entry, width = row_entries(start, small)
        for part in row_parts(offsets_from_counts(width)):
            terms = quantity[entry[part.entry]]
            terms = terms if part.used is None else np.where(part.used, terms, 0)
            rows = small[part.row]
            sums[rows] = exact_sum(np.concatenate([[x[rows] for x in more], terms]))
    return sums


class RowPart(NamedTuple):
    """Rows with their entries and the mask of padding, as in a :class:`RowTable`."""

    row: Integers
    entry: Integers
    used: Booleans | None


def row_parts(start: Integers) -> Iterator[RowPart]:
    """The rows grouped by width, or by its logarithm where there are many widths."""
    width = np.diff(start)
    kind = width
    if np.unique(width).size > _WIDTHS:
        kind = np.where(width > 1, np.ceil(np.log2(width)).astype(int) + 1, 1)
    for k in np.unique(kind):
        rows = np.flatnonzero(kind == k)
        rank = np.arange(width[rows].max())[:, None]
        for i in range(0, rows.size, _LENGTH):
            row = rows[i : i + _LENGTH]
            used = rank < width[row]
            entry = start[row] + np.where(used, rank, 0)
            yield RowPart(row, entry, None if used.all() else used)
