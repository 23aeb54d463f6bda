"""How far nature may move from a center in all, beside the ends of each probability.

Of ``sum_t |p_t - c_t| <= radius`` half is what some successors gain and half what others lose, so a
ball is a limit on what is gained: ``sum_t max(p_t - c_t, 0) <= most``. That says the same of a row
some of whose successors are left out because they get nothing.

For a given order of the successors the best ones gain first and the worst ones lose first, up to
the limit. Between the ends that these have then, the greedy distribution of the intervals is the
extreme one (Strehl and Littman 2008, section 3.2, with ends): the limit holds for all of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers


class Ball(NamedTuple):
    """What the distributions of each row may gain over a center.

    Attributes:
      center: ``float64[T]``, each between its ends.
      most: ``float64[R]``, how much may be gained in a row; half of the radius where the center is
        a distribution.
    """

    center: Floats
    most: Floats

    def of(self, entry: Integers, row: Integers) -> Ball:
        """The same of some entries and rows."""
        return Ball(self.center[entry], self.most[row])


class Sorted(NamedTuple):
    """Some rows whose successors stand in the order in which nature likes them.

    Attributes:
      lower, upper, center: ``float64[N, W]``.
      used: ``bool[N, W]``, which of them are successors; None: all.
      most, lack, rounding: ``float64[N]``, what may be gained, what the centers miss of one, and
        by how much a sum may miss.
    """

    lower: Floats
    upper: Floats
    center: Floats
    used: Booleans | None
    most: Floats
    lack: Floats
    rounding: Floats


def narrowed(of: Sorted) -> tuple[Floats, Floats]:
    """The ends between which the best distribution of the ball is the best of the intervals.

    A limit that is missed by no more than rounding is met, and what rounding leaves is nothing.
    """
    room, free = of.upper - of.center, of.center - of.lower
    if of.used is not None:
        room, free = (np.where(of.used, x, 0) for x in (room, free))
    rounding = of.rounding[:, None]
    left = of.most[:, None] - _before(room)
    gain = np.clip(np.where(left > rounding, left, 0), 0, room)
    upper = np.where(gain == room, of.upper, of.center + gain)
    left = (of.most - of.lack)[:, None] - _before(free[:, ::-1])[:, ::-1]
    loss = np.clip(np.where(left > rounding, left, 0), 0, free)
    lower = np.where(free <= left + rounding, of.lower, of.center - loss)
    return lower, upper


def _before(room: Floats) -> Floats:
    """What those before each one can take."""
    found = np.zeros_like(room)
    np.cumsum(room[:, :-1], axis=1, out=found[:, 1:])
    return found


def share_of(part: Floats, whole: Floats) -> Floats:
    """Which part of the whole, at most all; none of nothing."""
    return np.clip(np.divide(part, whole, out=np.zeros_like(whole), where=whole > 0), 0, 1)
