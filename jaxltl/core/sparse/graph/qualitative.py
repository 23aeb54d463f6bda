"""Qualitative analysis of sparse MDPs: reachability in the graph, and end components."""

from __future__ import annotations

import sys
from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.sparse.graph.components import strong_components
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import (
    SCIPY_SIZE,
    group_starts,
    decrement,
    sorted_unique,
    concatenated_ranges,
)

_FEW = 24  # states of a frontier up to which Python's own loop beats NumPy's overhead
_READY = 500  # edges from which SciPy's search is faster, once it is imported
_MANY = 64  # transitions into one of them from which it does not


def backward_reachable(mdp: HostMDP, goal: Booleans, rows: Booleans | None = None) -> Booleans:
    """States from which some path leads to a goal: the largest probability is positive."""
    start, row = mdp.predecessors
    source = mdp.state[row]
    if rows is not None:
        kept = rows[row]
        source = source[kept]
        start = np.concatenate([[0], kept.cumsum()])[start]
    return forward_search(start, source, goal)


def forward_search(start: Integers, after: Integers, first: Booleans) -> Booleans:
    """Nodes that are reachable from some nodes; node i has successors ``after[start[i] : ...]``."""
    seen = first.copy()
    frontier = np.flatnonzero(first)
    ready = after.size > _READY and "scipy.sparse.csgraph" in sys.modules
    if ready or after.size > SCIPY_SIZE // 4:
        from scipy import sparse
        from scipy.sparse import csgraph

        # One search from an additional node that leads to all starts.
        size = first.size + 1
        starts = np.append(start, start[-1] + frontier.size)
        targets = np.concatenate([after, frontier.astype(after.dtype)])
        graph = sparse.csr_array((np.ones(targets.size), targets, starts), shape=(size, size))
        order = csgraph.breadth_first_order(graph, first.size, return_predecessors=False)
        seen[order[1:]] = True
        return seen
    while frontier.size:
        new = after[concatenated_ranges(start[frontier], start[frontier + 1] - start[frontier])]
        seen_new = np.zeros(first.size, bool)
        seen_new[new] = True
        seen_new &= ~seen
        seen |= seen_new
        frontier = np.flatnonzero(seen_new)
    return seen


def positive_under_all_policies(
    mdp: HostMDP, goal: Booleans, rows: Booleans | None = None, among: Booleans | None = None
) -> Booleans:
    """States from which every policy reaches a goal with positive probability.

    The least set with the goal and all states each of whose rows has a successor in it (the
    complement of Prob0E). From all other states some policy avoids the goal.
    """
    if mdp.is_chain and rows is None and among is None:
        return backward_reachable(mdp, goal)
    counts = np.diff(mdp.row_start)
    waiting = np.ones(mdp.num_rows, bool)
    left = counts.astype(np.int32)
    if rows is not None:
        waiting = rows.copy()
        left = np.bincount(mdp.state[rows], minlength=mdp.num_states).astype(np.int32)
    open_ = ~goal if among is None else among & ~goal
    region = goal | (open_ & (left == 0))
    open_ = open_ & ~region
    search = _PositiveSearch(mdp, waiting, left, open_, region)
    frontier: Integers = np.flatnonzero(region)
    start = mdp.predecessors[0]
    while frontier.size:
        few = frontier.size <= _FEW and (start[frontier + 1] - start[frontier]).max() <= _MANY
        frontier = search.few(frontier) if few else search.many(frontier)
    return region


class _PositiveSearch(NamedTuple):
    """A growing region; `left` counts the rows of a state without a successor in it yet."""

    mdp: HostMDP
    waiting: Booleans
    left: Integers
    open: Booleans
    region: Booleans

    def many(self, frontier: Integers) -> Integers:
        """The states that join after a frontier."""
        start, pred = self.mdp.predecessors
        row = pred[concatenated_ranges(start[frontier], start[frontier + 1] - start[frontier])]
        row = row[self.waiting[row]]
        if not row.size:
            return row
        row = sorted_unique(row, self.mdp.num_rows)
        self.waiting[row] = False
        state = self.mdp.state[row]
        decrement(self.left, state)
        state = state[(self.left[state] == 0) & self.open[state]]
        self.open[state], self.region[state] = False, True
        # Rows are in order, so one state's stand together.
        return state[group_starts(state)]

    def few(self, frontier: Integers) -> Integers:
        """The same by plain loops, while few states join at a time, as along a chain."""
        arrays: tuple[Any, ...] = (
            *self.mdp.predecessors,
            self.mdp.state,
            self.waiting,
            self.left,
            self.open,
            self.region,
        )
        start, pred, owner, waiting, left, open_, region = (memoryview(x) for x in arrays)
        todo = frontier.tolist()
        while todo and len(todo) <= _FEW:
            new: list[int] = []
            for target in todo:
                first, last = start[target], start[target + 1]
                if last - first > _MANY:
                    return np.array(new + todo)  # rows that were counted do not wait any more
                for row in pred[first:last]:
                    if waiting[row]:
                        waiting[row] = False
                        state = owner[row]
                        left[state] -= 1
                        if not left[state] and open_[state]:
                            open_[state], region[state] = False, True
                            new.append(state)
            todo = new
        return np.array(todo, np.int64)


def almost_sure_reachability(
    mdp: HostMDP, goal: Booleans, rows: Booleans | None = None
) -> tuple[Booleans, Booleans]:
    """States from which some policy reaches a goal almost surely (Prob1E), ``bool[S]``.

    Also the rows ``bool[R]`` of these states that never leave them; `rows` are those that may be
    taken.
    """
    kept = np.ones(mdp.num_rows, bool) if rows is None else rows.copy()
    inside = backward_reachable(mdp, goal, rows)
    while True:
        outside = ~inside
        leaving = mdp.support.some_successor_in(outside)
        kept &= ~leaving & inside[mdp.state]
        found = backward_reachable(mdp, goal & inside, kept)
        if (found == inside).all():
            return inside, kept
        inside = found


def shortest_path_rows(mdp: HostMDP, goal: Booleans, rows: Booleans) -> Integers:
    """The first row of each state on a shortest path to a goal among some rows: ``int32[S]``.

    The first row of all for states in the goal, and for those that cannot reach it.
    """
    first = mdp.row_start[:-1].astype(np.int32)
    if not (rows & ~goal[mdp.state]).any():
        return first
    nearer = _next_on_the_way(mdp, goal, rows)
    entry = np.flatnonzero(rows[mdp.row] & (nearer[mdp.state[mdp.row]] == mdp.successor))
    row = mdp.row[entry][::-1]
    first[mdp.state[row]] = row  # the first one is written last
    return first


def _next_on_the_way(mdp: HostMDP, goal: Booleans, rows: Booleans) -> Integers:
    """The next state on a shortest path to a goal, ``int[S]``; -1 in the goal and without a path."""
    from scipy.sparse import csgraph, csr_array

    start, row = mdp.predecessors
    kept = rows[row]
    last = np.flatnonzero(goal)
    # One search backwards from an additional node that leads to every goal.
    index = np.concatenate([[0], kept.cumsum()])[start]
    edges = np.concatenate([mdp.state[row[kept]], last])
    size = mdp.num_states + 1
    graph: Any = csr_array(
        (np.ones(edges.size), edges, np.append(index, edges.size)), shape=(size, size)
    )
    _, before = csgraph.breadth_first_order(graph, size - 1, return_predecessors=True)
    before = before[:-1]
    return np.where((before < 0) | (before == size - 1), -1, before)


class EndComponents(NamedTuple):
    """Maximal end components.

    Attributes:
      component: ``int64[S]``, the least state of a state's end component; its own number elsewhere.
      inside: ``bool[R]``, the rows of end components that stay inside.
    """

    component: Integers
    inside: Booleans

    def region(self, mdp: HostMDP) -> Booleans:
        """The states of end components, ``bool[S]``."""
        found = np.zeros(mdp.num_states, bool)
        found[mdp.state[self.inside]] = True
        return found


def end_components(
    mdp: HostMDP, states: Booleans | None = None, rows: Booleans | None = None
) -> EndComponents:
    """Maximal end components within some states and rows (Baier and Katoen 2008, section 10.6.3).

    States that cannot stay are removed first, so that strongly connected components are computed
    on few. Self-loops connect nothing and are added at the end; otherwise each state at the rim of
    a transient region would be removed in a round by itself.

    Args:
      mdp: the model.
      states: ``bool[S]``; default all.
      rows: ``bool[R]``; default all.
    """
    kept = np.ones(mdp.num_rows, bool) if rows is None else rows.copy()
    if states is not None:
        kept &= states[mdp.state]
    still = kept & mdp.is_self_loop
    found = _moving_components(mdp, kept & ~still)
    return found._replace(inside=found.inside | still)


def _moving_components(mdp: HostMDP, kept: Booleans) -> EndComponents:
    """End components of rows without self-loops."""
    component = np.arange(mdp.num_states)
    inside = np.zeros(mdp.num_rows, bool)
    while True:
        candidates = np.zeros(mdp.num_states, bool)
        candidates[mdp.state[kept]] = True
        candidates &= ~positive_under_all_policies(mdp, ~candidates, kept)
        row = np.flatnonzero(kept & candidates[mdp.state])
        if not row.size:
            return EndComponents(component, inside)
        count = mdp.entry_start[row + 1] - mdp.entry_start[row]
        entry = concatenated_ranges(mdp.entry_start[row], count)
        of, target = np.repeat(np.arange(row.size), count), mdp.successor[entry]
        leaves = np.bincount(of[~candidates[target]], minlength=row.size) > 0
        label = _labels(mdp.state[row], of, target, leaves, candidates)
        crossing = leaves.copy()
        crossing[of[label[target] != label[mdp.state[row]][of]]] = True
        final = _untouched(mdp.state[row], crossing, leaves, label)
        inside[row[final]] = True
        component[mdp.state[row[final]]] = label[mdp.state[row[final]]]
        kept = np.zeros(mdp.num_rows, bool)
        kept[row[~crossing & ~final]] = True


def _labels(
    state: Integers, of: Integers, target: Integers, leaves: Booleans, candidates: Booleans
) -> Integers:
    """The least state of each candidate's strongly connected component; -1 elsewhere."""
    node = np.flatnonzero(candidates)
    number = np.full(candidates.size, -1)
    number[node] = np.arange(node.size)
    stays = ~leaves[of]
    found = strong_components(number[state[of[stays]]], number[target[stays]], node.size)
    label: Any = np.full(candidates.size, -1)
    label[node] = node[found]
    return label


def _untouched(state: Integers, crossing: Booleans, leaves: Booleans, label: Integers) -> Booleans:
    """The rows of components that lost no row, which are end components."""
    touched = np.zeros(label.size, bool)
    touched[label[state[crossing & ~leaves]]] = True
    return ~crossing & ~touched[label[state]]
