"""Contraction of chains of single successors, and quotients by end components."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import (
    concatenated_ranges,
    mask_of,
    offsets_from_counts,
    positions,
    row_entries,
)

_WORTH = 8  # a model is contracted if more than one in that many of its states vanishes


@dataclass(frozen=True)
class Contraction:
    """A smaller model with one node for several states."""

    mdp: HostMDP  # of N nodes; its rows may be unsorted and repeat successors
    node: Integers  # int[S], the node of each state
    row: Integers  # int[R'], the model's row of each row of the smaller model
    earned: Floats  # float64[S], the reward between a state and its node
    cost: Floats  # float64[R'], the expected reward of a row up to the next node
    depth: int = 0  # the number of sums behind one of these numbers

    def region(self, states: Booleans) -> Booleans:
        """The nodes of some states, ``bool[N]``."""
        return mask_of(self.node[states], self.mdp.num_states)


def identity(mdp: HostMDP, cost: Floats | None = None) -> Contraction:
    """The model as its own contraction."""
    states, rows = np.arange(mdp.num_states), np.arange(mdp.num_rows)
    cost = np.zeros(mdp.num_rows) if cost is None else cost
    return Contraction(mdp, states, rows, np.zeros(mdp.num_states), cost)


def contract_chains(mdp: HostMDP, fixed: Booleans, cost: Floats | None) -> Contraction | None:
    """Identifies states that have one row with one successor with that successor."""
    size = mdp.num_states
    width = mdp.entry_start[mdp.row_start[1:]] - mdp.entry_start[mdp.row_start[:-1]]
    alias = (width == 1) & ~fixed
    if np.count_nonzero(alias) * _WORTH < size:
        return None
    after = np.arange(size)
    from_ = np.flatnonzero(alias)
    to = mdp.successor[mdp.entry_start[mdp.row_start[from_]]]
    alias[from_[to == from_]] = False  # self-loops
    after[from_] = to
    end, rounds = _ends(after)
    if (trapped := alias[end]).any():
        # A cycle of single successors is kept.
        alias[end[trapped]] = False
        after = np.where(alias, after, np.arange(size))
        end, rounds = _ends(after)
    earned = np.zeros(size)
    if cost is not None:
        earned[alias] = cost[mdp.row_start[:-1][alias]]
        step = after
        for _ in range(rounds):
            earned += earned[step]
            step = step[step]
    kept = np.flatnonzero(~alias)
    number = positions(kept, size)
    node = number[end]
    row, count = row_entries(mdp.row_start, kept)
    smaller, entry = mdp.select(offsets_from_counts(count), row, node)
    spent = np.zeros(row.size)
    if cost is not None:
        terms = mdp.probability[entry] * earned[mdp.successor[entry]]
        spent = cost[row] + np.add.reduceat(terms, smaller.entry_start[:-1])
    return Contraction(smaller, node, row, earned, spent, rounds + 1)


def _ends(after: Integers) -> tuple[Integers, int]:
    """The ends of pointers by doubling, and the number of doublings."""
    end, rounds = after, 0
    while True:
        further = end[end]
        if (further == end).all() or 2**rounds > after.size:
            return end, rounds
        end, rounds = further, rounds + 1


def quotient(mdp: HostMDP, component: Integers, inside: Booleans, cost: Floats) -> Contraction:
    """The quotient by end components: one state each, with the rows that leave it."""
    size = mdp.num_states
    leader = component[mdp.state]
    kept = ~inside
    some = mask_of(leader[kept], size)
    is_leader = component == np.arange(size)
    kept[mdp.row_start[:-1][is_leader & ~some]] = True
    row = np.flatnonzero(kept)
    row = row[np.argsort(leader[row], kind="stable")]
    leaders = np.flatnonzero(is_leader)
    number = positions(leaders, size)
    node = number[component]
    count = np.bincount(node[mdp.state[row]], minlength=leaders.size)
    smaller, _ = mdp.select(offsets_from_counts(count), row, node)
    return Contraction(smaller, node, row, np.zeros(size), cost[row])


def with_stops(
    mdp: HostMDP, row: Integers, node: Integers, stops: tuple[Integers, Integers], num_nodes: int
) -> tuple[HostMDP, Integers]:
    """Some rows on the nodes of their states, then rows between nodes; and the place of each row."""
    owner = np.concatenate([node[mdp.state[row]], stops[0]])
    width = np.concatenate([np.diff(mdp.entry_start)[row], np.ones(stops[0].size, np.int64)])
    entry = concatenated_ranges(mdp.entry_start[row], width[: row.size])
    successor = np.concatenate([node[mdp.successor[entry]], stops[1]]).astype(np.int32)
    probability = np.concatenate([mdp.probability[entry], np.ones(stops[0].size)])
    order = np.argsort(owner, kind="stable")
    entry = concatenated_ranges((width.cumsum() - width)[order], width[order])
    small = HostMDP(
        offsets_from_counts(np.bincount(owner, minlength=num_nodes)),
        offsets_from_counts(width[order]),
        successor[entry],
        probability[entry],
    )
    return small, order
