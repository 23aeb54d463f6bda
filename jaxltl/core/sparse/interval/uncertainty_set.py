"""Decision processes whose probabilities lie in intervals, and what nature makes of a row.

A row is the set of all distributions p with ``lower <= p <= upper``. Each time that it is taken,
nature picks one of them. A linear function is extreme where mass goes first to the best successors
(Nilim and El Ghaoui 2005; Givan, Leach and Dean 2000). Where there is a ball too, p lies in both.

Numbers are what they are to the last bit: nature may do without a successor if the upper ends of
the others sum to one or more exactly, and has to give it the last 1e-17 otherwise. A row whose ends
are all equal is in proportion to them, however they add up.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.interval.l1_distance import Ball, share_of
from jaxltl.core.sparse.interval.row_table import Table, row_sums, tables
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import concatenated_ranges, offsets_from_counts

_EPS = float(np.finfo(np.float64).eps)
_READ = 2 * _EPS  # by how much a sum of decimals, or of what was rounded once, may miss one


@brief
@dataclass(frozen=True)
class HostInterval:
    """A decision process with intervals, as NumPy arrays.

    Attributes:
      mdp: its rows; probabilities are one distribution of each, positive where upper is.
      lower, upper: ``float64[T]``; each end is met by some distribution of the row.
      ball: how far from its center each row may be besides; None: as far as the ends allow.
      nearly: whether sums that miss one by rounding count as one: of ends that are computed.
    """

    mdp: HostMDP
    lower: Floats
    upper: Floats
    ball: Ball | None = None
    nearly: bool = False

    @cached_property
    def rounding(self) -> Floats:
        """``float64[R]``, by how much a sum over a row may miss, of numbers that add up to one."""
        return 4 * _EPS * (np.diff(self.mdp.entry_start) + 1)

    @cached_property
    def rest(self) -> Floats:
        """``float64[R]``, the mass that the lower ends leave to nature."""
        return np.maximum(-row_sums(self.lower, self.mdp.entry_start, -self._ones), 0)

    @property
    def _ones(self) -> Floats:
        return np.ones(self.mdp.num_rows)

    def over(self, found: Floats) -> Booleans:
        """Whether sums less one are at least zero: ``bool[R]``, up to rounding if that counts."""
        return found >= (-self.rounding if self.nearly else 0)

    @cached_property
    def firm(self) -> bool:
        """Whether nature must give something to every successor."""
        return bool((self.lower > 0).all())

    @cached_property
    def widened(self) -> HostInterval | None:
        """The model with upper ends, and balls, that are larger by two roundings of one.

        Nature may drop in it all that it may drop where sums that miss one by these count as one.
        None where that is clearly no more than it may drop anyway.
        """
        if self.firm:
            return None
        start = self.mdp.entry_start
        free = (self.lower == 0) & (self.upper > 0)
        count = np.add.reduceat(free.astype(np.int64), start[:-1])
        kept = self.total(np.where(free, 0, self.upper)) - 1 - self.rounding
        # Where one may be dropped alone, the others' sum is clear; where several may be, none is.
        near = (count > 0) & (kept <= 0) & ((count > 1) | (np.abs(kept) <= 3 * self.rounding))
        if self.ball is None and not near.any():
            return None
        upper = np.where(self.upper > 0, np.minimum(self.upper + _READ, 1), 0)
        ball = self.ball
        ball = None if ball is None else ball._replace(most=ball.most + _READ)
        return HostInterval(self.mdp, self.lower, upper, ball)

    @cached_property
    def tables(self) -> list[Table]:
        """The rows by their number of entries, in parts."""
        lack = None
        if self.ball is not None:
            lack = 1 - self.total(self.ball.center)
            lack = np.where(np.abs(lack) > self.rounding, lack, 0)
        found = []
        for row, entry, used in tables(self.mdp.entry_start):
            lower, upper = (
                x[entry] if used is None else np.where(used, x[entry], 0)
                for x in (self.lower, self.upper)
            )
            ball: dict[str, Floats] = {}
            if self.ball is not None and lack is not None:
                center = self.ball.center[entry]
                center = center if used is None else np.where(used, center, 0)
                ball = {"center": center, "most": self.ball.most[row], "lack": lack[row]}
            found.append(
                Table.of(row, entry, used, lower, upper, self.rest[row], self.rounding[row], **ball)
            )
        return found

    def total(self, quantity: NDArray[Any]) -> NDArray[Any]:
        """The sum over each row's entries, ``[R]`` from ``[T]``."""
        return np.add.reduceat(quantity, self.mdp.entry_start[:-1])

    def nature(self, quantity: Floats, *, maximize: bool) -> Floats:
        """The distributions that make ``sum_t p_t quantity_t`` extreme, ``float64[T]``.

        Args:
          quantity: ``float64[T]``, finite, of each entry.
          maximize: whether nature makes the sum large.
        """
        key, found = -quantity if maximize else quantity, np.empty(quantity.size)
        for table in self.tables:
            mass = table.best(key[table.entry])
            if table.used is None:
                found[table.entry] = mass
            else:
                found[table.entry[table.used]] = mass[table.used]
        return found

    def may_keep(self, entries: Booleans) -> Booleans:
        """Whether nature may put all mass on some entries: ``bool[R]`` from ``bool[T]``."""
        start = self.mdp.entry_start
        if self.firm:
            return np.logical_and.reduceat(entries, start[:-1])
        every = np.logical_and.reduceat(entries | (self.upper == 0), start[:-1])
        needed = np.logical_or.reduceat(~entries & (self.lower > 0), start[:-1])
        room = self.over(row_sums(np.where(entries, self.upper, 0), start, -self._ones))
        if self.ball is not None:
            center, most = self.ball
            room &= self.over(row_sums(np.where(entries, center, 0), start, most, -self._ones))
        return every | (room & ~needed)

    def may_stay(self, region: Booleans) -> Booleans:
        """Whether nature may keep to a region: ``bool[R]`` from ``bool[S]``."""
        return self.may_keep(region[self.mdp.successor])

    def must_enter(self, row: Integers, region: Booleans) -> Booleans:
        """Whether every distribution of some rows enters a region: ``bool[N]``."""
        if not row.size:
            return np.zeros(0, bool)
        mdp = self.mdp
        count = mdp.entry_start[row + 1] - mdp.entry_start[row]
        entry = concatenated_ranges(mdp.entry_start[row], count)
        start = count.cumsum() - count
        inside = region[mdp.successor[entry]]
        start, one = np.append(start, entry.size), np.ones(row.size)
        least = -self.rounding[row] if self.nearly else np.zeros(row.size)
        room = row_sums(np.where(inside, 0, self.upper[entry]), start, -one) >= least
        sure = np.logical_or.reduceat(inside & (self.lower[entry] > 0), start[:-1])
        some = np.logical_or.reduceat(inside & (self.upper[entry] > 0), start[:-1])
        if self.ball is not None:
            center, most = self.ball.center[entry], self.ball.most[row]
            room &= row_sums(np.where(inside, 0, center), start, most, -one) >= least
        return some & (sure | ~room)

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
        room, free = (
            np.where(entries, x, 0) for x in (self.upper - ball.center, ball.center - self.lower)
        )
        more, less = share_of(lack, self.total(room)), share_of(-lack, self.total(free))
        # What gains least keeps to the entries; half of the rest is spent on all of them.
        near = center + room * more[self.mdp.row] - free * less[self.mdp.row]
        gained = self.total(np.maximum(found - center, 0))
        least = np.maximum(lack, 0)
        share = share_of((ball.most - least) / 2, gained - least)
        far = (gained > ball.most)[self.mdp.row]
        return np.where(far, near + (found - near) * share[self.mdp.row], found)

    def settled(self, probability: Floats) -> tuple[Floats, bool]:
        """Distributions next to those that were computed, each mass right to its last digits.

        Args:
          probability: ``float64[T]``, from which rows miss distributions by rounding.

        Returns:
          ``float64[T]``, and whether that could be done in all rows.
        """
        found, able = probability.copy(), True
        for table in self.tables:
            p, fits = table.settled(probability[table.entry])
            able &= bool(fits.all())
            kept = np.ones(p.shape, bool) if table.used is None else table.used
            found[table.entry[kept]] = p[kept]
        return found, able

    def fixed(self, probability: Floats) -> HostMDP:
        """The decision process that is left when nature's choices are known.

        Args:
          probability: ``float64[T]``; entries of zero are left out.
        """
        mdp, kept = self.mdp, probability > 0
        if kept.all():
            return HostMDP(mdp.row_start, mdp.entry_start, mdp.successor, probability)
        count = np.add.reduceat(kept.astype(np.int64), mdp.entry_start[:-1])
        return HostMDP(
            mdp.row_start, offsets_from_counts(count), mdp.successor[kept], probability[kept]
        )

    def chain(self, row: Integers) -> tuple[HostInterval, Integers]:
        """The intervals under a policy ``int[S]``, and which entries these are."""
        states: Any = np.arange(self.mdp.num_states + 1, dtype=np.int32)
        return self.of_rows(states, row)

    def of_rows(self, row_start: Integers, row: Integers) -> tuple[HostInterval, Integers]:
        """Some rows in a new order, and which entries these are."""
        mdp = self.mdp
        width = np.diff(mdp.entry_start)[row]
        entry = concatenated_ranges(mdp.entry_start[row], width)
        part = HostMDP(
            row_start, offsets_from_counts(width), mdp.successor[entry], mdp.probability[entry]
        )
        ball = None if self.ball is None else self.ball.of(entry, row)
        return HostInterval(part, self.lower[entry], self.upper[entry], ball), entry

    def halted(self, states: Booleans) -> tuple[HostInterval, Integers]:
        """The model in which some states stand still, and the row that each row was."""
        mdp = self.mdp
        start, stop = (mdp.entry_start[x[states]] for x in (mdp.row_start[:-1], mdp.row_start[1:]))
        if (stop - start == 1).all() and (mdp.successor[start] == np.flatnonzero(states)).all():
            return self, np.arange(mdp.num_rows)  # they do already
        count = np.where(states, 1, np.diff(mdp.row_start))
        row = concatenated_ranges(mdp.row_start[:-1], count)
        loop = np.repeat(states, count)
        width = np.where(loop, 1, np.diff(mdp.entry_start)[row])
        entry, start = concatenated_ranges(mdp.entry_start[row], width), offsets_from_counts(width)
        first = start[:-1][loop]
        successor = mdp.successor[entry]
        lower, upper, chance = (x[entry] for x in (self.lower, self.upper, mdp.probability))
        successor[first] = np.flatnonzero(states)
        lower[first] = upper[first] = chance[first] = 1
        ball = self.ball
        if ball is not None:
            ball = ball.of(entry, row)
            ball.center[first] = 1
        small = HostMDP(offsets_from_counts(count), start, successor, chance)
        return HostInterval(small, lower, upper, ball), row
