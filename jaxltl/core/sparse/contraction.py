"""Smaller models with the same answers: chains of single successors, and end components, as one."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import concatenated_ranges, offsets_from_counts

_WORTH = 8  # a model is contracted if more than one in so many of its states goes


class Contraction(NamedTuple):
    """A model in which some states stand for several.

    Attributes:
      mdp: the smaller model; its rows need be neither sorted nor without repetition.
      node: ``int[S]``, the state of the smaller model that stands for a state.
      row: ``int[R']``, the row of the model that each row of the smaller one is.
      earned: ``float64[S]``, what a state earns on the way to its node.
      cost: ``float64[R']``, what a row earns until the next node.
      depth: how many sums may stand behind one number of these.
    """

    mdp: HostMDP
    node: Integers
    row: Integers
    earned: Floats
    cost: Floats
    depth: int


def contract_chains(mdp: HostMDP, fixed: Booleans, cost: Floats | None) -> Contraction | None:
    """States that have one row with one successor become what they lead to.

    Args:
      mdp: the model.
      fixed: ``bool[S]``, states to keep.
      cost: ``float64[R]``, what rows earn, or None for nothing.

    Returns:
      The contraction, whose nodes are in the order of their states; None where it would not pay.
    """
    size = mdp.num_states
    width = mdp.entry_start[mdp.row_start[1:]] - mdp.entry_start[mdp.row_start[:-1]]
    alias = (width == 1) & ~fixed
    if np.count_nonzero(alias) * _WORTH < size:
        return None
    after = np.arange(size)
    from_ = np.flatnonzero(alias)
    to = mdp.successor[mdp.entry_start[mdp.row_start[from_]]]
    alias[from_[to == from_]] = False  # where it stands still
    after[from_] = to
    end, rounds = _ends(after)
    if (trapped := alias[end]).any():
        # A circle of single successors: what lies on it is kept, as nobody leaves it.
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
    number = np.zeros(size, np.int32)
    number[kept] = np.arange(kept.size)
    node = number[end]
    count = np.diff(mdp.row_start)[kept]
    row = concatenated_ranges(mdp.row_start[kept], count)
    smaller, entry = _taken(mdp, row, count, node)
    spent = np.zeros(row.size)
    if cost is not None:
        spent = cost[row] + np.add.reduceat(
            mdp.probability[entry] * earned[mdp.successor[entry]], smaller.entry_start[:-1]
        )
    return Contraction(smaller, node, row, earned, spent, rounds + 1)


def _ends(after: Integers) -> tuple[Integers, int]:
    """Where pointers end, by doubling, and how many doublings that took."""
    end, rounds = after, 0
    while True:
        further = end[end]
        if (further == end).all() or 2**rounds > after.size:
            return end, rounds
        end, rounds = further, rounds + 1


def _taken(
    mdp: HostMDP, row: Integers, count: Integers, node: Integers
) -> tuple[HostMDP, Integers]:
    """The model of some rows whose successors are renamed, and the entries that it has."""
    width = np.diff(mdp.entry_start)[row]
    entry = concatenated_ranges(mdp.entry_start[row], width)
    smaller = HostMDP(
        offsets_from_counts(count),
        offsets_from_counts(width),
        node[mdp.successor[entry]],
        mdp.probability[entry],
    )
    return smaller, entry


def quotient(mdp: HostMDP, component: Integers, inside: Booleans, cost: Floats) -> Contraction:
    """Each end component becomes one state, with the rows that leave it.

    Args:
      mdp: the model.
      component: ``int[S]``, the least state of each state's component.
      inside: ``bool[R]``, the rows to leave out. A state all of whose rows are left out must not
        be asked for: it keeps one of them.
      cost: ``float64[R]``.
    """
    size = mdp.num_states
    leader = component[mdp.state]
    kept = ~inside
    some = np.zeros(size, bool)
    some[leader[kept]] = True
    stuck = (component == np.arange(size)) & ~some
    kept[mdp.row_start[:-1][stuck]] = True
    row = np.flatnonzero(kept)
    row = row[np.argsort(leader[row], kind="stable")]
    leaders = np.flatnonzero(component == np.arange(size))
    number: Any = np.zeros(size, np.int32)
    number[leaders] = np.arange(leaders.size)
    node = number[component]
    count = np.bincount(node[mdp.state[row]], minlength=leaders.size)
    smaller, _ = _taken(mdp, row, count, node)
    return Contraction(smaller, node, row, np.zeros(size), cost[row], 0)
