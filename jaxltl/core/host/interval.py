"""Decision processes whose probabilities lie in intervals, and what nature makes of a row.

A row is the set of all distributions p with ``lower <= p <= upper``. Each time that it is taken,
nature picks one of them. A linear function is extreme where mass goes first to the best successors
(Nilim and El Ghaoui 2005; Givan, Leach and Dean 2000). Sums that miss one by no more than the
rounding of their terms count as one. Where there is a ball too, p lies in both.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.host.ball import Ball, Sorted, narrowed, share_of
from jaxltl.core.host.rows import Booleans, Integers, spans, starts_of
from jaxltl.core.host.sparse import Floats, HostMDP

_EPS = float(np.finfo(np.float64).eps)
_PAIRS = 5  # entries of a row up to which each pair is compared
_WIDTHS = 12  # different numbers of successors up to which rows of each are sorted together


@dataclass(frozen=True)
class HostInterval:
    """A decision process with intervals, as NumPy arrays.

    Attributes:
      mdp: its rows; probabilities are one distribution of each, positive where upper is.
      lower, upper: ``float64[T]``; each end is met by some distribution of the row.
      ball: how far from its center each row may be besides; None: as far as the ends allow.
    """

    mdp: HostMDP
    lower: Floats
    upper: Floats
    ball: Ball | None = None

    @cached_property
    def rounding(self) -> Floats:
        """``float64[R]``, by how much a sum over a row may miss, of numbers that add up to one."""
        return 4 * _EPS * (np.diff(self.mdp.entry_start) + 1)

    @cached_property
    def rest(self) -> Floats:
        """``float64[R]``, the mass that the lower ends leave to nature."""
        return np.maximum(1 - self.total(self.lower), 0)

    @cached_property
    def _groups(self) -> list[_Group]:
        """The rows by their number of entries; by its logarithm if these are many."""
        start, width = self.mdp.entry_start[:-1], np.diff(self.mdp.entry_start)
        kind = width
        if np.unique(width).size > _WIDTHS:
            kind = np.where(width > 1, np.ceil(np.log2(width)).astype(int) + 1, 1)
        each = (np.flatnonzero(kind == k) for k in np.unique(kind))
        return [_group(row, start[row], width[row]) for row in each]

    def total(self, quantity: NDArray[Any]) -> NDArray[Any]:
        """The sum over each row's entries, ``[R]`` from ``[T]``."""
        return np.add.reduceat(quantity, self.mdp.entry_start[:-1])

    def nature(self, quantity: Floats, *, maximize: bool) -> Floats:
        """The distributions that make ``sum_t p_t quantity_t`` extreme, ``float64[T]``.

        Args:
          quantity: ``float64[T]``, finite, of each entry.
          maximize: whether nature makes the sum large.
        """
        key = -quantity if maximize else quantity
        box = self._ends_for(key)
        found = box.lower.copy()
        free = box.upper - box.lower
        for row, entry, used in self._groups:
            if entry.shape[1] == 1:
                found[entry] = box.upper[entry]
                continue
            if used is None and entry.shape[1] <= _PAIRS:
                found[entry] = box._by_pairs(key, free, row, entry)
                continue
            rank = key[entry] if used is None else np.where(used, key[entry], np.inf)
            order = np.argsort(rank, axis=1, kind="stable")
            entry = np.take_along_axis(entry, order, 1)
            room = free[entry]
            if used is not None:
                used = np.take_along_axis(used, order, 1)
                room = np.where(used, room, 0)
            before = np.zeros_like(room)
            np.cumsum(room[:, :-1], axis=1, out=before[:, 1:])
            left = box.rest[row, None] - before
            given = np.clip(np.where(left > self.rounding[row, None], left, 0), 0, room)
            # What is given whole is the upper end itself, without rounding.
            mass = np.where(given == room, box.upper[entry], box.lower[entry] + given)
            if used is None:
                found[entry] = mass
            else:
                found[entry[used]] = mass[used]
        return found

    def _ends_for(self, key: Floats) -> HostInterval:
        """The intervals in whose stead a ball's best distribution, least keys first, is theirs."""
        if self.ball is None:
            return self
        lower, upper = self.lower.copy(), self.upper.copy()
        for row, entry, used in self._groups:
            if entry.shape[1] == 1:
                continue
            rank = key[entry] if used is None else np.where(used, key[entry], np.inf)
            order = np.argsort(rank, axis=1, kind="stable")
            entry = np.take_along_axis(entry, order, 1)
            used = None if used is None else np.take_along_axis(used, order, 1)
            ends = narrowed(Sorted(
                self.lower[entry], self.upper[entry], self.ball.center[entry], used,
                self.ball.most[row], self._lack[row], self.rounding[row]))
            for end, found in zip((lower, upper), ends, strict=True):
                end[entry if used is None else entry[used]] = found if used is None else found[used]
        return HostInterval(self.mdp, lower, upper)

    @cached_property
    def _lack(self) -> Floats:
        """``float64[R]``, what the centers of a ball miss of one."""
        assert self.ball is not None
        found = 1 - self.total(self.ball.center)
        return np.where(np.abs(found) > self.rounding, found, 0)

    def _by_pairs(
        self, key: Floats, free: Floats, row: Integers, entry: Integers
    ) -> Floats:
        """The distributions of some rows, ``[N, W]``: few entries are compared, not sorted."""
        rank, room = (np.ascontiguousarray(x[entry].T) for x in (key, free))
        rest, rounding = self.rest[row], self.rounding[row]
        mass = np.empty(entry.shape)
        for i in range(entry.shape[1]):
            left = rest.copy()
            for j in range(entry.shape[1]):
                if j != i:
                    first = rank[j] <= rank[i] if j < i else rank[j] < rank[i]
                    left -= first * room[j]
            given = np.clip(np.where(left > rounding, left, 0), 0, room[i])
            mine = entry[:, i]
            # What is given whole is the upper end itself, without rounding.
            mass[:, i] = np.where(given == room[i], self.upper[mine], self.lower[mine] + given)
        return mass

    def may_keep(self, entries: Booleans) -> Booleans:
        """Whether nature may put all mass on some entries: ``bool[R]`` from ``bool[T]``."""
        room = self.total(np.where(entries, self.upper, 0))
        needed = np.logical_or.reduceat(
            ~entries & (self.lower > 0), self.mdp.entry_start[:-1])
        return (room >= 1 - self.rounding) & ~needed & self._near(entries)

    def _near(self, entries: Booleans) -> Booleans:
        """Whether a ball holds something that keeps to some entries: ``bool[R]``."""
        if self.ball is None:
            return np.ones(self.mdp.num_rows, bool)
        gained = 1 - self.total(np.where(entries, self.ball.center, 0))
        return gained <= self.ball.most + self.rounding

    def may_stay(self, region: Booleans) -> Booleans:
        """Whether nature may keep to a region: ``bool[R]`` from ``bool[S]``."""
        return self.may_keep(region[self.mdp.successor])

    def must_enter(self, row: Integers, region: Booleans) -> Booleans:
        """Whether every distribution of some rows enters a region: ``bool[N]``."""
        if not row.size:
            return np.zeros(0, bool)
        mdp = self.mdp
        count = mdp.entry_start[row + 1] - mdp.entry_start[row]
        entry = spans(mdp.entry_start[row], count)
        start = count.cumsum() - count
        inside = region[mdp.successor[entry]]
        room = np.add.reduceat(np.where(inside, 0, self.upper[entry]), start)
        sure = np.logical_or.reduceat(inside & (self.lower[entry] > 0), start)
        if self.ball is not None:
            gained = 1 - np.add.reduceat(np.where(inside, 0, self.ball.center[entry]), start)
            sure |= gained > self.ball.most[row] + self.rounding[row]
        return sure | (room < 1 - self.rounding[row])

    def within(self, entries: Booleans) -> Floats:
        """Distributions with all of some entries as their support, where nature may keep to them.

        Args:
          entries: ``bool[T]``.

        Returns:
          ``float64[T]``; of other rows, what they are anyway.
        """
        entries = entries | ~self.may_keep(entries)[self.mdp.row]
        free = np.where(entries, self.upper - self.lower, 0)
        room = self.total(free)
        found = np.where(entries, self.lower + free * share_of(self.rest, room)[self.mdp.row], 0)
        return found if self.ball is None else self._drawn_in(found, entries, self.ball)

    def _drawn_in(self, found: Floats, entries: Booleans, ball: Ball) -> Floats:
        """The same distributions, nearer to the center where they are too far from it."""
        center = np.where(entries, ball.center, 0)
        lack = 1 - self.total(center)
        room, free = (np.where(entries, x, 0) for x in (
            self.upper - ball.center, ball.center - self.lower))
        more, less = share_of(lack, self.total(room)), share_of(-lack, self.total(free))
        # What gains least keeps to the entries; half of the rest is spent on all of them.
        near = center + room * more[self.mdp.row] - free * less[self.mdp.row]
        gained = self.total(np.maximum(found - center, 0))
        least = np.maximum(lack, 0)
        share = share_of((ball.most - least) / 2, gained - least)
        far = (gained > ball.most)[self.mdp.row]
        return np.where(far, near + (found - near) * share[self.mdp.row], found)

    def fixed(self, probability: Floats) -> HostMDP:
        """The decision process that is left when nature's choices are known.

        Args:
          probability: ``float64[T]``; entries of zero are left out.
        """
        mdp, kept = self.mdp, probability > 0
        if kept.all():
            return HostMDP(mdp.row_start, mdp.entry_start, mdp.successor, probability)
        count = np.add.reduceat(kept.astype(np.int64), mdp.entry_start[:-1])
        return HostMDP(mdp.row_start, starts_of(count), mdp.successor[kept], probability[kept])

    def chain(self, row: Integers) -> tuple[HostInterval, Integers]:
        """The intervals under a policy ``int[S]``, and which entries these are."""
        states: Any = np.arange(self.mdp.num_states + 1, dtype=np.int32)
        return self.of_rows(states, row)

    def of_rows(self, row_start: Integers, row: Integers) -> tuple[HostInterval, Integers]:
        """Some rows in a new order, and which entries these are."""
        mdp = self.mdp
        width = np.diff(mdp.entry_start)[row]
        entry = spans(mdp.entry_start[row], width)
        part = HostMDP(row_start, starts_of(width), mdp.successor[entry], mdp.probability[entry])
        ball = None if self.ball is None else self.ball.of(entry, row)
        return HostInterval(part, self.lower[entry], self.upper[entry], ball), entry

    def halted(self, states: Booleans) -> tuple[HostInterval, Integers]:
        """The model in which some states stand still, and the row that each row was."""
        mdp = self.mdp
        if not states.any():
            return self, np.arange(mdp.num_rows)
        count = np.where(states, 1, np.diff(mdp.row_start))
        row = spans(mdp.row_start[:-1], count)
        part, _ = self.of_rows(starts_of(count), row)
        loop = states[part.mdp.state]
        first = part.mdp.entry_start[:-1][loop]
        kept = ~loop[part.mdp.row]
        kept[first] = True
        successor = part.mdp.successor.copy()
        lower, upper, chance = (x.copy() for x in (part.lower, part.upper, part.mdp.probability))
        successor[first] = part.mdp.state[loop]
        lower[first] = upper[first] = chance[first] = 1
        width = np.add.reduceat(kept.astype(np.int64), part.mdp.entry_start[:-1])
        small = HostMDP(part.mdp.row_start, starts_of(width), successor[kept], chance[kept])
        ball = part.ball
        if ball is not None:
            center = ball.center.copy()
            center[first] = 1
            ball = ball._replace(center=center[kept])
        return HostInterval(small, lower[kept], upper[kept], ball), row


class _Group(NamedTuple):
    """Rows of about one width, as a table.

    Attributes:
      row: ``int[N]``.
      entry: ``int[N, W]``, their entries; the first one again where a row has fewer.
      used: ``bool[N, W]``, or None where every row has W.
    """

    row: Integers
    entry: Integers
    used: Booleans | None


def _group(row: Integers, start: Integers, width: Integers) -> _Group:
    rank = np.arange(width.max())
    used = rank < width[:, None]
    entry = start[:, None] + np.where(used, rank, 0)
    return _Group(row, entry, None if used.all() else used)
