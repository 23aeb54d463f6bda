"""Attractors on sparse rows: a worklist, linear in the transitions."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.sparse.mdp import HostGraph
from jaxltl.core.sparse.rows import decrement, group_starts, mask_of, row_entries, sorted_unique

FEW = 24  # states of a frontier up to which Python's own loop beats NumPy's overhead
_MANY = 64  # transitions into one of them from which it does not


class Attraction(NamedTuple):
    """An attractor."""

    region: Booleans  # bool[S]
    row: Integers  # int32[S], the first row nearer if one suffices, else the first row
    rank: Integers  # int32[S], the round in which a state joined; 0 in the goal


def attracted(
    graph: HostGraph,
    goal: Booleans,
    rows: Booleans | None = None,
    *,
    exists: bool | Booleans = True,
    chance: str = "some",
    among: Booleans | None = None,
) -> Attraction:
    """States that a goal attracts by some row (`exists`) or by all of `rows`, the rows that count."""
    waiting = np.ones(graph.num_rows, bool) if rows is None else rows.copy()
    remaining = (
        np.diff(graph.row_start)
        if rows is None
        else np.bincount(graph.state[rows], minlength=graph.num_states)
    ).astype(np.int32)
    open_ = ~goal if among is None else among & ~goal
    rule = np.broadcast_to(exists, goal.shape)
    lacking = None if chance == "some" else np.diff(graph.entry_start).astype(np.int32)
    first = graph.row_start[:-1].astype(np.int32)
    search = _AttractorSearch(
        graph,
        waiting,
        lacking,
        remaining,
        open_,
        rule,
        goal.copy(),
        first,
        np.zeros(goal.size, np.int32),
        bool(rule.any()),
        not rule.all(),
    )
    # In the first round also states without a row join that need all, and empty rows lead anywhere.
    alone: Integers = np.flatnonzero(~rule & (remaining == 0) & open_)
    empty = np.flatnonzero(waiting & (lacking == 0)) if lacking is not None else None
    frontier, count = search.many(np.flatnonzero(goal), 1, empty), 1
    if alone.size:
        alone = alone[open_[alone]]
        open_[alone], search.region[alone], search.rank[alone] = False, True, 1
        frontier = np.concatenate([frontier, alone])
    start = graph.predecessors[0]
    while frontier.size:
        if frontier.size <= FEW and (start[frontier + 1] - start[frontier]).max() <= _MANY:
            frontier, count = search.few(frontier, count)
        else:
            count += 1
            frontier = search.many(frontier, count)
    return Attraction(search.region, search.row, search.rank)


class _AttractorSearch(NamedTuple):
    """A growing region; region, row and rank as of :class:`Attraction`."""

    graph: HostGraph
    waiting: Booleans  # bool[R], rows that count and do not lead to the region yet
    lacking: Integers | None  # int32[R], entries outside if all must be inside, else None
    remaining: Integers  # int32[S], waiting rows of a state
    joinable: Booleans  # bool[S], states that may still join
    rule: Booleans  # bool[S], True where one row suffices
    region: Booleans
    row: Integers
    rank: Integers
    needs_one: bool  # whether one row suffices in some states
    needs_all: bool  # whether some states need all rows

    def many(self, frontier: Integers, rank: int, empty: Integers | None = None) -> Integers:
        """The states that join after a frontier."""
        start, pred = self.graph.predecessors
        row = pred[row_entries(start, frontier)[0]]
        if self.lacking is not None:
            decrement(self.lacking, row)
            row = row[self.lacking[row] <= 0]
            if empty is not None and empty.size:
                row = np.concatenate([row, empty])
        if row.size < self.graph.num_rows // 16:
            row = sorted_unique(row[self.waiting[row]], self.graph.num_rows)
        else:
            row = np.flatnonzero(mask_of(row, self.graph.num_rows) & self.waiting)
        self.waiting[row] = False
        row = row[self.joinable[self.graph.state[row]]]
        state: Integers = self.graph.state[row]
        if self.needs_all:
            every = state[~self.rule[state]] if self.needs_one else state
            decrement(self.remaining, every)
            joins = self.remaining[state] == 0
            if self.needs_one:
                joins |= self.rule[state]
            state, row = state[joins], row[joins]
        first = group_starts(state)  # rows are in order, so those of one state are contiguous
        state = state[first]
        self.joinable[state], self.region[state], self.rank[state] = False, True, rank
        if self.needs_one:
            one = self.rule[state]
            self.row[state[one]] = row[first][one]
        return state

    def few(self, frontier: Integers, rank: int) -> tuple[Integers, int]:
        """Rounds by plain loops while few states join, as along a chain; the next frontier."""
        arrays: tuple[Any, ...] = (*self.graph.predecessors, self.graph.state, *self[1:9])
        views: list[Any] = [None if x is None else memoryview(x) for x in arrays]
        start, pred, owner, waiting, lacking, remaining, open_, rule, region, first, joined = views
        todo = frontier.tolist()
        while todo and len(todo) <= FEW:
            rows: list[int] = []
            for target in todo:
                rows += pred[start[target] : start[target + 1]]
                if len(rows) > FEW * _MANY:
                    return np.array(todo), rank
            rank += 1
            todo = []
            for row in sorted(rows):
                if lacking is not None:
                    lacking[row] -= 1
                    if lacking[row] > 0:
                        continue
                if waiting[row]:
                    waiting[row] = False
                    state = owner[row]
                    remaining[state] -= 1
                    if (rule[state] or not remaining[state]) and open_[state]:
                        open_[state], region[state], joined[state] = False, True, rank
                        if rule[state]:
                            first[state] = row
                        todo.append(state)
        return np.array(todo, np.int64), rank
