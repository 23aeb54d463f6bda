"""All distributions of a row that nature likes best, where successors stand in classes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.interval.l1_distance import Ball, share_of
from jaxltl.core.sparse.interval.uncertainty_set import HostInterval


def face_of(model: HostInterval, rank: Integers) -> HostInterval:
    """The distributions of each row that make ``sum_t p_t rank_t`` least.

    Between ends alone, mass goes to lesser ranks first; of the last one that gets any, how is free.
    Where a ball is in the way, so much mass is moved as it allows: some rank is the last one that
    gains, a greater one the first that loses, and how is free in each of the two.

    Args:
      model: the model.
      rank: ``int[T]``, from 0.
    """
    start, row = model.mdp.entry_start[:-1], model.mdp.row
    p = model.nature(rank.astype(np.float64), maximize=False)
    loose = model.lower < model.upper
    last = np.maximum.reduceat(np.where(loose & (p > model.lower), rank, -1), start)
    free = loose & (rank == last[row])
    lower, upper = np.where(free, model.lower, p), np.where(free, model.upper, p)
    if model.ball is None:
        return HostInterval(model.mdp, lower, upper, nearly=True)
    center, most = model.ball
    off = p - center
    gainer = np.maximum.reduceat(np.where(off > 0, rank, -1), start)
    loser = np.minimum.reduceat(np.where(off < 0, rank, rank.max(initial=0) + 1), start)
    gained = model.total(np.maximum(off, 0))
    full = ((gained >= most - model.rounding) & (gainer < loser))[row]
    # Else the ball is in nobody's way between ranks, but it still is within the one that is free.
    spare = most - model.total(np.where(free, 0, np.maximum(off, 0)))
    upper = np.where(free & (spare <= model.rounding)[row], center, upper)
    gains, loses = (full & (rank == x[row]) for x in (gainer, loser))
    lower = np.where(gains, center, np.where(loses, model.lower, np.where(full, p, lower)))
    upper = np.where(gains, model.upper, np.where(loses, center, np.where(full, p, upper)))
    left = model.total(np.where(loses, p - lower, 0))
    upper = np.where(loses & (left <= model.rounding)[row], lower, upper)
    inner = np.where(full, lower, np.where(free, center, p))
    most = np.where(np.logical_or.reduceat(full, start), 1, spare)
    mass = model.total(np.where(gains, p, 0))
    return _Parted(model.mdp, lower, upper, Ball(inner, most), nearly=True, gains=gains, mass=mass)


@dataclass(frozen=True, kw_only=True)
class _Parted(HostInterval):
    """Distributions that give so much mass to some entries, and all else to the others.

    Attributes:
      gains: ``bool[T]``, those entries; rows without any are as they are.
      mass: ``float64[R]``.
    """

    gains: Booleans
    mass: Floats

    @property
    def _parts(self) -> tuple[tuple[Booleans, Floats], tuple[Booleans, Floats]]:
        return (self.gains, self.mass), (~self.gains, 1 - self.mass)

    def may_keep(self, entries: Booleans) -> Booleans:
        found = HostInterval.may_keep(self, entries)
        for part, mass in self._parts:
            room = self.total(np.where(entries & part, self.upper, 0))
            found &= room >= mass - self.rounding
        return found

    def within(self, entries: Booleans) -> Floats:
        row = self.mdp.row
        entries = entries | ~self.may_keep(entries)[row]
        found = HostInterval.within(self, entries)
        parted = np.logical_or.reduceat(self.gains, self.mdp.entry_start[:-1])[row]
        for part, mass in self._parts:
            free = np.where(entries & part, self.upper - self.lower, 0)
            rest = mass - self.total(np.where(part, self.lower, 0))
            share = share_of(rest, self.total(free))[row]
            given = np.where(entries, self.lower + free * share, 0)
            found = np.where(part & parted, given, found)
        return found
