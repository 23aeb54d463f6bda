"""Qualitative analysis of sparse MDPs: reachability in the graph, and end components."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.sparse.graph.attractor import attracted
from jaxltl.core.sparse.graph.components import forward_search, strong_components
from jaxltl.core.sparse.mdp import HostGraph
from jaxltl.core.sparse.rows import mask_of, row_entries


def backward_reachable(mdp: HostGraph, goal: Booleans, rows: Booleans | None = None) -> Booleans:
    """States from which some path leads to a goal: the largest probability is positive."""
    start, row = mdp.predecessors
    source = mdp.state[row]
    if rows is not None:
        kept = rows[row]
        source = source[kept]
        start = np.concatenate([[0], kept.cumsum()])[start]
    return forward_search(start, source, goal)


def positive_under_all_policies(
    mdp: HostGraph, goal: Booleans, rows: Booleans | None = None, among: Booleans | None = None
) -> Booleans:
    """States from which every policy reaches a goal with positive probability (not Prob0E)."""
    if rows is None and mdp.is_chain:
        return backward_reachable(mdp, goal, None if among is None else among[mdp.state])
    return attracted(mdp, goal, rows, exists=False, among=among).region


def almost_sure_reachability(
    mdp: HostGraph, goal: Booleans, rows: Booleans | None = None
) -> tuple[Booleans, Booleans]:
    """Prob1E states ``bool[S]`` among `rows`, and their rows ``bool[R]`` that never leave them."""
    kept = np.ones(mdp.num_rows, bool) if rows is None else rows.copy()
    inside = backward_reachable(mdp, goal, rows)
    while True:
        outside = ~inside
        leaving = mdp.support.some_successor_in(outside)
        kept &= ~leaving & inside[mdp.state]
        reached = backward_reachable(mdp, goal & inside, kept)
        if (reached == inside).all():
            return inside, kept
        inside = reached


def shortest_path_rows(mdp: HostGraph, goal: Booleans, rows: Booleans) -> Integers:
    """Rows of shortest paths to a goal: ``int32[S]``; the first row where there is no path."""
    return attracted(mdp, goal, rows).row


class SparseEndComponents(NamedTuple):
    """Maximal end components."""

    component: Integers  # int64[S], least state of the component; own number elsewhere
    inside: Booleans  # bool[R], the rows of end components that stay inside

    def region(self, mdp: HostGraph) -> Booleans:
        """The states of end components, ``bool[S]``."""
        return mdp.states_of(self.inside)


def end_components(
    mdp: HostGraph, states: Booleans | None = None, rows: Booleans | None = None
) -> SparseEndComponents:
    """Maximal end components within some states and rows (Baier and Katoen 2008, section 10.6.3).

    Self-loops connect nothing and are added at the end; otherwise each state at the rim of a
    transient region would be removed in a round by itself.
    """
    kept = np.ones(mdp.num_rows, bool) if rows is None else rows.copy()
    if states is not None:
        kept &= states[mdp.state]
    still = kept & mdp.is_self_loop
    components = _moving_components(mdp, kept & ~still)
    return components._replace(inside=components.inside | still)


def _moving_components(mdp: HostGraph, kept: Booleans) -> SparseEndComponents:
    """End components of rows without self-loops."""
    component = np.arange(mdp.num_states)
    inside = np.zeros(mdp.num_rows, bool)
    while True:
        candidates = mdp.states_of(kept)
        candidates &= ~positive_under_all_policies(mdp, ~candidates, kept)
        row = np.flatnonzero(kept & candidates[mdp.state])
        if not row.size:
            return SparseEndComponents(component, inside)
        entry, count = row_entries(mdp.entry_start, row)
        of, target = np.repeat(np.arange(row.size), count), mdp.successor[entry]
        leaves = np.bincount(of[~candidates[target]], minlength=row.size) > 0
        label = _labels(mdp.state[row], of, target, leaves, candidates)
        crossing = leaves.copy()
        crossing[of[label[target] != label[mdp.state[row]][of]]] = True
        final = _untouched(mdp.state[row], crossing, leaves, label)
        inside[row[final]] = True
        component[mdp.state[row[final]]] = label[mdp.state[row[final]]]
        kept = mask_of(row[~crossing & ~final], mdp.num_rows)


def _labels(
    state: Integers, of: Integers, target: Integers, leaves: Booleans, candidates: Booleans
) -> Integers:
    """The least state of each candidate's strongly connected component; -1 elsewhere."""
    node = np.flatnonzero(candidates)
    number = np.full(candidates.size, -1)
    number[node] = np.arange(node.size)
    stays = ~leaves[of]
    leader = strong_components(number[state[of[stays]]], number[target[stays]], node.size)
    label: Integers = np.full(candidates.size, -1)
    label[node] = node[leader]
    return label


def _untouched(state: Integers, crossing: Booleans, leaves: Booleans, label: Integers) -> Booleans:
    """The rows of components that lost no row, which are end components."""
    return ~crossing & ~mask_of(label[state[crossing & ~leaves]], label.size)[label[state]]
