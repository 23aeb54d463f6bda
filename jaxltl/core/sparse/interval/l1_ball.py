"""L1 balls around the nominal distributions of an interval model.

Of ``sum_t |p_t - c_t| <= radius`` half is gained by some successors and half lost by others, so the
ball is the constraint ``sum_t max(p_t - c_t, 0) <= gain``, which also holds for rows without the
successors of mass 0.

For a given order of the successors the best ones gain first and the worst ones lose first, up to
the limit. Between the resulting ends the greedy distribution is extreme (Strehl and Littman 2008,
section 3.2, with ends): :func:`narrow_intervals`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers


@dataclass(frozen=True)
class Ball:
    """L1 balls of all rows."""

    center: Floats  # float64[T], between the ends
    gain: Floats  # float64[R], mass that may be gained over the center: half of the radius

    def select(self, entry: Integers, row: Integers) -> Ball:
        """The balls of some rows."""
        return Ball(self.center[entry], self.gain[row])


@dataclass(frozen=True)
class BallLimits:
    """Limits of some rows, ``float64[N, 1]``; what exceeds one by rounding alone meets it."""

    gain: Floats  # as of `Ball`
    deficit: Floats  # one minus the sum of the center
    rounding: Floats  # bound on the rounding error of a sum over the row


def narrow_intervals(
    lower: Floats, upper: Floats, center: Floats, used: Booleans | None, limits: BallLimits
) -> tuple[Floats, Floats]:
    """Ends ``float64[N, W]`` of extreme greedy distributions in the ball; best successor first."""
    rise, fall = upper - center, center - lower
    if used is not None:
        rise, fall = np.where(used, rise, 0), np.where(used, fall, 0)
    remaining = limits.gain - _sums_before(rise)
    added = np.clip(np.where(remaining > limits.rounding, remaining, 0), 0, rise)
    high = np.where(added == rise, upper, center + added)
    remaining = limits.gain - limits.deficit - _sums_before(fall[:, ::-1])[:, ::-1]
    removed = np.clip(np.where(remaining > limits.rounding, remaining, 0), 0, fall)
    low = np.where(fall <= remaining + limits.rounding, lower, center - removed)
    return low, high


def _sums_before(x: Floats) -> Floats:
    sums = np.zeros_like(x)
    np.cumsum(x[:, :-1], axis=1, out=sums[:, 1:])
    return sums


def share_of(part: Floats, whole: Floats) -> Floats:
    """``part / whole``, clipped to [0, 1]; 0 where the whole is 0."""
    return np.clip(np.divide(part, whole, out=np.zeros_like(whole), where=whole > 0), 0, 1)
