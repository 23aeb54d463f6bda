"""Games and mixed policies as interval models: whose choice it is, is told by intervals.

A player that wants what nature wants is nature: its choice among rows is a distribution with ends 0
and 1 over states that have one of the rows each. A policy that mixes rows does so with equal ends.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.interval.l1_distance import Ball
from jaxltl.core.sparse.interval.uncertainty_set import HostInterval
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import concatenated_ranges, offsets_from_counts


class Spread(NamedTuple):
    """A model in which some states' rows are chosen by nature.

    Attributes:
      model: the first states are those that there were; the others have one row each.
      source: ``int[S']``, which state each one stands for.
      row: ``int[R']``, which row each one was; -1 of the rows by which nature chooses.
      entry: ``int[T']``, which entry each one was; -1 of the entries of those rows.
      chosen: ``int[T']``, the row that an entry of those rows leads to; -1 elsewhere.
    """

    model: HostInterval
    source: Integers
    row: Integers
    entry: Integers
    chosen: Integers

    def policy(self, row: Integers, probability: Floats) -> Integers:
        """The rows of the model that there was: nature's most likely where it chooses."""
        size = int(self.source.size - np.count_nonzero(np.arange(self.source.size) != self.source))
        found = self.row[row[:size]].copy()
        mdp = self.model.mdp
        waits = np.flatnonzero(found < 0)
        for s in waits:
            first, last = mdp.entry_start[row[s]], mdp.entry_start[row[s] + 1]
            found[s] = self.chosen[first + int(probability[first:last].argmax())]
        return found

    def nature(self, probability: Floats, otherwise: Floats) -> Floats:
        """Nature's distributions in the model that there was."""
        found, given = otherwise.copy(), self.entry >= 0
        found[self.entry[given]] = probability[given]
        return found


def spread(model: HostInterval, states: Booleans, lower: Floats, upper: Floats) -> Spread:
    """The model in which nature chooses the rows of some states, within ends.

    Args:
      model: the model.
      states: ``bool[S]``.
      lower, upper: ``float64[R]``, how likely nature may take a row, in these states; rows with an
        upper end of 0 are left out there.
    """
    mdp = model.mdp
    moved = np.flatnonzero(states[mdp.state] & (upper > 0))
    own = np.flatnonzero(~states[mdp.state])
    many = np.bincount(mdp.state[moved], minlength=mdp.num_states)
    count = np.where(states, 1, np.diff(mdp.row_start))
    rows = np.concatenate([count, np.ones(moved.size, np.int64)])
    row_start = offsets_from_counts(rows)
    row = np.full(int(row_start[-1]), -1)
    row[~np.repeat(np.append(states, np.zeros(moved.size, bool)), rows)] = np.append(own, moved)
    choosing = np.flatnonzero(row < 0)
    width = np.where(row < 0, 0, np.diff(mdp.entry_start)[row])
    width[choosing] = many[states]
    starts = offsets_from_counts(width)
    given = np.repeat(row >= 0, width)
    entry = np.full(given.size, -1)
    entry[given] = concatenated_ranges(mdp.entry_start[row[row >= 0]], width[row >= 0])
    chosen = np.full(given.size, -1)
    chosen[~given] = moved
    successor = np.empty(given.size, np.int32)
    successor[given] = mdp.successor[entry[given]]
    successor[~given] = mdp.num_states + np.arange(moved.size)
    ends: list[Any] = []
    for of, at in ((model.lower, lower), (model.upper, upper)):
        x = np.empty(given.size)
        x[given], x[~given] = of[entry[given]], at[moved]
        ends.append(x)
    lower, upper = ends
    host = HostMDP(row_start, starts, successor, upper)
    ball = None
    if model.ball is not None:  # where nature chooses it may gain all that the ends leave
        center, most = lower.copy(), np.ones(row.size)
        center[given] = model.ball.center[entry[given]]
        most[row >= 0] = model.ball.most[row[row >= 0]]
        ball = Ball(center, most)
    found = HostInterval(host, lower, upper, ball)
    chance = found.within(np.ones(given.size, bool))
    host = HostMDP(row_start, starts, successor, chance)
    source = np.concatenate([np.arange(mdp.num_states), mdp.state[moved]])
    return Spread(HostInterval(host, lower, upper, ball), source, row, entry, chosen)
