"""Encodes a second player or a randomized policy as choices of nature in an uncertain MDP.

A player that optimises in nature's direction is part of nature: its choice among rows is a
distribution with ends 0 and 1 over auxiliary states that have one of the rows each. The rows of a
mixed policy are such a distribution with equal ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.interval.l1_ball import Ball
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import concatenated_ranges, offsets_from_counts, row_entries


@dataclass(frozen=True)
class EncodedChoices:
    """A model in which nature chooses the rows of some states."""

    model: UncertainMDP  # original states first; each auxiliary state has one row
    source: Integers  # int[S'], original state of each state
    row: Integers  # int[R'], original row, -1 for rows by which nature chooses
    entry: Integers  # int[T'], original entry, -1 in those rows
    chosen: Integers  # int[T'], original row that an entry of those rows stands for; -1 elsewhere

    def policy(self, row: Integers, probability: Floats) -> Integers:
        """Original rows of a policy; nature's most likely one where it chooses."""
        size = int(self.source.size - np.count_nonzero(np.arange(self.source.size) != self.source))
        policy = self.row[row[:size]].copy()
        places = np.flatnonzero(policy < 0)
        entry, count = row_entries(self.model.mdp.entry_start, row[places])
        if places.size:
            weight, first = probability[entry], offsets_from_counts(count)[:-1]
            likely = weight == np.repeat(np.maximum.reduceat(weight, first), count)
            place, at = np.unique(np.repeat(places, count)[likely], return_index=True)
            policy[place] = self.chosen[entry[likely][at]]
        return policy

    def nature(self, probability: Floats, otherwise: Floats) -> Floats:
        """Nature's distributions in the original entries, `otherwise` elsewhere."""
        nature, original = otherwise.copy(), self.entry >= 0
        nature[self.entry[original]] = probability[original]
        return nature


def choices_as_nature(
    model: UncertainMDP, states: Booleans, lower: Floats, upper: Floats
) -> EncodedChoices:
    """The model in which nature chooses the rows of some states between ends ``float64[R]``."""
    mdp = model.mdp
    moved = np.flatnonzero(states[mdp.state] & (upper > 0))
    own = np.flatnonzero(~states[mdp.state])
    many = np.bincount(mdp.state[moved], minlength=mdp.num_states)
    count = np.where(states, 1, np.diff(mdp.row_start))
    rows = np.concatenate([count, np.ones(moved.size, np.int64)])
    row_start = offsets_from_counts(rows)
    row = np.full(int(row_start[-1]), -1)
    row[~np.repeat(np.append(states, np.zeros(moved.size, bool)), rows)] = np.append(own, moved)
    width = np.where(row < 0, 0, np.diff(mdp.entry_start)[row])
    width[row < 0] = many[states]
    starts = offsets_from_counts(width)
    original = np.repeat(row >= 0, width)
    entry = np.full(original.size, -1)
    entry[original] = concatenated_ranges(mdp.entry_start[row[row >= 0]], width[row >= 0])
    chosen = np.full(original.size, -1)
    chosen[~original] = moved
    successor = np.empty(original.size, np.int32)
    successor[original] = mdp.successor[entry[original]]
    successor[~original] = mdp.num_states + np.arange(moved.size)

    def of_entries(inner: Floats, outer: Floats) -> Floats:
        x = np.empty(original.size)
        x[original], x[~original] = inner[entry[original]], outer[moved]
        return x

    low, high = of_entries(model.lower, lower), of_entries(model.upper, upper)
    ball = None
    if model.ball is not None:  # no limit where nature chooses
        center, gain = low.copy(), np.ones(row.size)
        center[original] = model.ball.center[entry[original]]
        gain[row >= 0] = model.ball.gain[row[row >= 0]]
        ball = Ball(center, gain)
    sets = UncertainMDP(HostMDP(row_start, starts, successor, high), low, high, ball)
    nominal = sets.interior_distributions(np.ones(original.size, bool))
    sets = UncertainMDP(HostMDP(row_start, starts, successor, nominal), low, high, ball)
    source = np.concatenate([np.arange(mdp.num_states), mdp.state[moved]])
    return EncodedChoices(sets, source, row, entry, chosen)
