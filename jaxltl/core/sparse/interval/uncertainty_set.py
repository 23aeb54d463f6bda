"""Sparse MDPs with uncertainty sets as rows: intervals, intersected with L1 balls.

A row is the set of all distributions p with ``lower <= p <= upper``, and with
``sum_t |p_t - center_t| <= radius`` where there is a ball. Nature picks one each time that the row
is taken. A linear function is extreme where mass goes greedily to the best successors (Nilim and
El Ghaoui 2005; Givan, Leach and Dean 2000).

Ends are exact numbers: nature may drop a successor if the upper ends of the others sum to one or
more exactly, and must give it the last 1e-17 otherwise. A row with equal lower and upper ends is
their normalised distribution.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.interval.l1_ball import Ball, share_of
from jaxltl.core.sparse.interval.row_table import RowTable, row_parts, row_sums
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import concatenated_ranges, offsets_from_counts, row_entries

_EPS = float(np.finfo(np.float64).eps)
_DECIMALS = 2 * _EPS  # by how much a sum of decimals may miss one through rounding


@brief
@dataclass(frozen=True)
class UncertainMDP:
    """An MDP with an uncertainty set in each row, as NumPy arrays."""

    # its rows; the probabilities are one distribution of each set, positive where upper is
    mdp: HostMDP
    lower: Floats  # float64[T]; each end is attained by some distribution of the row (lower, upper)
    upper: Floats
    ball: Ball | None = None  # L1 balls, or None
    tolerant: bool = False  # whether sums that miss one by rounding count as one, for computed ends

    @cached_property
    def rounding(self) -> Floats:
        """``float64[R]``, bound on the rounding error of a sum of masses over a row."""
        return 4 * _EPS * (np.diff(self.mdp.entry_start) + 1)

    @cached_property
    def free_mass(self) -> Floats:
        """``float64[R]``, one minus the sum of the lower ends."""
        return np.maximum(-row_sums(self.lower, self.mdp.entry_start, -self._ones), 0)

    @property
    def _ones(self) -> Floats:
        return np.ones(self.mdp.num_rows)

    @cached_property
    def has_fixed_support(self) -> bool:
        """True if nature must give every successor some mass."""
        return bool((self.lower > 0).all())

    @cached_property
    def enlarged(self) -> UncertainMDP | None:
        """The model with ends and balls enlarged by `_DECIMALS`; None if that changes nothing."""
        if self.has_fixed_support:
            return None
        start = self.mdp.entry_start
        droppable = (self.lower == 0) & (self.upper > 0)
        count = np.add.reduceat(droppable.astype(np.int64), start[:-1])
        kept = self.sum_rows(np.where(droppable, 0, self.upper)) - 1 - self.rounding
        # With one droppable successor the sum of the others decides; with several, subsets do,
        # unless each can have the whole mass, as the choices of a player in a game.
        partial = np.add.reduceat((droppable & (self.upper < 1)).astype(np.int64), start[:-1])
        subsets = (count > 1) & (partial > 0)
        unclear = (count > 0) & (kept <= 0) & (subsets | (np.abs(kept) <= 3 * self.rounding))
        if self.ball is None and not unclear.any():
            return None
        upper = np.where(self.upper > 0, np.minimum(self.upper + _DECIMALS, 1), 0)
        ball = None if self.ball is None else replace(self.ball, gain=self.ball.gain + _DECIMALS)
        return UncertainMDP(self.mdp, self.lower, upper, ball)

    @cached_property
    def tables(self) -> list[RowTable]:
        """The rows by width."""
        deficit = None
        if self.ball is not None:
            deficit = 1 - self.sum_rows(self.ball.center)
            deficit = np.where(np.abs(deficit) > self.rounding, deficit, 0)
        tables = []
        for row, entry, used in row_parts(self.mdp.entry_start):
            lower, upper = (
                x[entry] if used is None else np.where(used, x[entry], 0)
                for x in (self.lower, self.upper)
            )
            ball: dict[str, Floats] = {}
            if self.ball is not None and deficit is not None:
                center = self.ball.center[entry]
                center = center if used is None else np.where(used, center, 0)
                ball = {"center": center, "gain": self.ball.gain[row], "deficit": deficit[row]}
            tables.append(
                RowTable(
                    row, entry, used, lower, upper, self.free_mass[row], self.rounding[row], **ball
                )
            )
        return tables

    def sum_rows(self, quantity: Floats) -> Floats:
        """The sum over each row's entries, ``[R]`` from ``[T]``."""
        return np.add.reduceat(quantity, self.mdp.entry_start[:-1])

    # --- choices of nature --------------------------------------------------------------------

    def extreme_distributions(self, quantity: Floats, *, maximize: bool) -> Floats:
        """Distributions that make ``sum_t p_t quantity_t`` extreme in each row, ``float64[T]``."""
        key, probability = -quantity if maximize else quantity, np.empty(quantity.size)
        for table in self.tables:
            scatter(table, table.extreme(key[table.entry]), probability)
        return probability

    def can_stay_on(self, entries: Booleans) -> Booleans:
        """Tests if nature may put all mass on some entries: ``bool[R]`` from ``bool[T]``."""
        return self._can_stay(entries, self.mdp.entry_start, slice(None), slice(None))

    def can_stay_in(self, region: Booleans) -> Booleans:
        """Tests if nature may keep to a set of states: ``bool[R]`` from ``bool[S]``."""
        return self.can_stay_on(region[self.mdp.successor])

    def must_enter(self, row: Integers, region: Booleans) -> Booleans:
        """Tests if every distribution of some rows enters a region: ``bool[N]``."""
        entry, count = row_entries(self.mdp.entry_start, row)
        outside = ~region[self.mdp.successor[entry]]
        return ~self._can_stay(outside, offsets_from_counts(count), entry, row)

    def _can_stay(
        self, inside: Booleans, start: Integers, entry: Integers | slice, row: Integers | slice
    ) -> Booleans:
        """Tests if nature may put all mass of some rows on the marked ones of their entries."""
        if start.size == 1:
            return np.zeros(0, bool)
        if self.has_fixed_support:
            return np.logical_and.reduceat(inside, start[:-1])
        upper, one = self.upper[entry], self._ones[row]
        every = np.logical_and.reduceat(inside | (upper == 0), start[:-1])
        needed = np.logical_or.reduceat(~inside & (self.lower[entry] > 0), start[:-1])
        least = -self.rounding[row] if self.tolerant else 0
        able = row_sums(np.where(inside, upper, 0), start, -one) >= least
        if self.ball is not None:
            center = np.where(inside, self.ball.center[entry], 0)
            able &= row_sums(center, start, self.ball.gain[row], -one) >= least
        return every | (able & ~needed)

    def interior_distributions(self, entries: Booleans) -> Floats:
        """Distributions with support `entries` where nature may keep to these; full elsewhere."""
        entries = entries | ~self.can_stay_on(entries)[self.mdp.row]
        free = np.where(entries, self.upper - self.lower, 0)
        share = share_of(self.free_mass, self.sum_rows(free))
        probability = np.where(entries, self.lower + free * share[self.mdp.row], 0)
        return (
            probability if self.ball is None else self._into_ball(probability, entries, self.ball)
        )

    def _into_ball(self, p: Floats, entries: Booleans, ball: Ball) -> Floats:
        """Moves distributions towards the center until they lie in the ball."""
        row, center = self.mdp.row, np.where(entries, ball.center, 0)
        deficit = 1 - self.sum_rows(center)
        rise, fall = (
            np.where(entries, x, 0) for x in (self.upper - ball.center, ball.center - self.lower)
        )
        up = share_of(deficit, self.sum_rows(rise))
        down = share_of(-deficit, self.sum_rows(fall))
        # The nearest distribution on the entries; half of the remaining gain goes to all of them.
        nearest = center + rise * up[row] - fall * down[row]
        gained = self.sum_rows(np.maximum(p - center, 0))
        least = np.maximum(deficit, 0)
        share = share_of((ball.gain - least) / 2, gained - least)
        outside = (gained > ball.gain)[row]
        return np.where(outside, nearest + (p - nearest) * share[row], p)

    def nearest_distributions(self, probability: Floats) -> tuple[Floats, bool]:
        """Distributions near computed ones, right to their last digits; and if all rows have one."""
        nearest, able = probability.copy(), True
        for table in self.tables:
            p, fits = table.nearest(probability[table.entry])
            able &= bool(fits.all())
            scatter(table, p, nearest)
        return nearest, able

    # --- derived models -----------------------------------------------------------------------

    def resolve(self, probability: Floats) -> HostMDP:
        """The MDP under nature's distributions ``float64[T]``, without entries of mass 0."""
        mdp, kept = self.mdp, probability > 0
        if kept.all():
            return HostMDP(mdp.row_start, mdp.entry_start, mdp.successor, probability)
        count = np.add.reduceat(kept.astype(np.int64), mdp.entry_start[:-1])
        return HostMDP(
            mdp.row_start, offsets_from_counts(count), mdp.successor[kept], probability[kept]
        )

    def under_policy(self, row: Integers) -> tuple[UncertainMDP, Integers]:
        """The model under a policy ``int[S]``, and the original entries."""
        states = np.arange(self.mdp.num_states + 1, dtype=np.int32)
        return self.select_rows(states, row)

    def select_rows(self, row_start: Integers, row: Integers) -> tuple[UncertainMDP, Integers]:
        """The model with some rows in a new order, and the original entries."""
        part, entry = self.mdp.select(row_start, row)
        ball = None if self.ball is None else self.ball.select(entry, row)
        return UncertainMDP(part, self.lower[entry], self.upper[entry], ball), entry

    def with_absorbing(self, states: Booleans) -> tuple[UncertainMDP, Integers]:
        """The model with some states made absorbing, and the original rows."""
        mdp = self.mdp
        start, stop = (mdp.entry_start[x[states]] for x in (mdp.row_start[:-1], mdp.row_start[1:]))
        if (stop - start == 1).all() and (mdp.successor[start] == np.flatnonzero(states)).all():
            return self, np.arange(mdp.num_rows)
        count = np.where(states, 1, np.diff(mdp.row_start))
        row = concatenated_ranges(mdp.row_start[:-1], count)
        loop = np.repeat(states, count)
        width = np.where(loop, 1, np.diff(mdp.entry_start)[row])
        entry, start = concatenated_ranges(mdp.entry_start[row], width), offsets_from_counts(width)
        first = start[:-1][loop]
        successor = mdp.successor[entry]
        lower, upper, nominal = (x[entry] for x in (self.lower, self.upper, mdp.probability))
        successor[first] = np.flatnonzero(states)
        lower[first] = upper[first] = nominal[first] = 1
        ball = self.ball
        if ball is not None:
            ball = ball.select(entry, row)
            ball.center[first] = 1
        small = HostMDP(offsets_from_counts(count), start, successor, nominal)
        return UncertainMDP(small, lower, upper, ball), row


def scatter(table: RowTable, mass: Floats, probability: Floats) -> None:
    """Writes the masses ``float64[W, N]`` of a table into ``float64[T]``."""
    if table.used is None:
        probability[table.entry] = mass
    else:
        probability[table.entry[table.used]] = mass[table.used]


def uncertainty_sets(
    entry_start: Integers, lower: Floats, upper: Floats, ball: Ball | None = None
) -> UncertainMDP:
    """Uncertainty sets of rows alone, for row operations that read no states."""
    states = np.zeros(entry_start.size, np.int64)
    return UncertainMDP(HostMDP(states, entry_start, states[:0], lower), lower, upper, ball)
