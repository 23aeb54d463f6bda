"""Qualitative preprocessing of an uncertain MDP that is reused for other intervals.

Which states have value 0, 1 or infinity depends on which ends are positive and on which successors
nature may drop, that is on whether the upper ends of some entries sum to at least one. These
queries are recorded with their answers; intervals with the same answers have the same states.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.graph.qualitative import backward_reachable, shortest_path_rows
from jaxltl.core.sparse.interval.qualitative import (
    almost_sure_states,
    attracting_rows,
    certain_choices,
    joint_end_components,
    zero_one_states,
)
from jaxltl.core.sparse.interval.robust_values import Query
from jaxltl.core.sparse.interval.row_table import row_sums
from jaxltl.core.sparse.interval.total_reward import finite_states
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import mask_of, offsets_from_counts


class RoomQueries(NamedTuple):
    """Queries if the upper ends of some entries of a row sum to at least one."""

    entry: Integers  # int[E], the entries and their query, ascending
    group: Integers
    row: Integers  # int[G], the row of each query
    room: Booleans  # bool[G], the answers


_NONE: Integers = np.zeros(0, np.int64)
_NO_QUERIES = RoomQueries(_NONE, _NONE, _NONE, np.zeros(0, bool))


@dataclass(frozen=True)
class IntervalPlan:
    """Residual problem after qualitative preprocessing."""

    known: Floats  # float64[S], 0, 1 or infinity; NaN in open states
    # int[S], the policy's row in known states; in open ones a row by which they are left, if the
    # policy must leave
    row: Integers
    within: Booleans  # bool[T], entries to which nature keeps in known states
    rows: Integers  # int[R'], available rows of open states
    used: Booleans  # bool[T], entries of these that nature may use
    # whether the side that must leave may also stay for ever at no cost
    has_free_cycles: bool = False
    # assumptions on the intervals, besides which ends and rewards are positive
    queries: RoomQueries = _NO_QUERIES


def plan_reachability(
    model: UncertainMDP, target: Booleans, stay: Booleans | None, query: Query
) -> IntervalPlan:
    """The plan of a reachability probability."""
    blocked = np.zeros(target.size, bool) if stay is None else ~stay & ~target
    absorbing, origin = model.with_absorbing(target | blocked)
    mdp, log = absorbing.mdp, list[RoomQueries]()
    known = zero_one_states(_recording(absorbing, log), target, query)
    zero, one = known
    if query.cooperative:
        mine = one if query.maximize else zero
        rows = absorbing.can_stay_in(mine) & mine[mdp.state]
        within = mine[mdp.successor] | ~rows[mdp.row]
        way = _restricted_nature(absorbing, within, rows)
        row = shortest_path_rows(way, target, rows) if query.maximize else mdp.first_choice(rows)[1]
    else:
        row, within = certain_choices(absorbing, target, known, maximize=query.maximize)
    open_ = ~(zero | one)
    if query.maximize:
        every = np.ones(mdp.num_rows, bool)
        helps = query.nature_maximizes
        out = (
            shortest_path_rows(mdp, one, every) if helps else attracting_rows(absorbing, one, every)
        )
        row = np.where(open_, out, row)
    plan = IntervalPlan(
        known=np.where(open_, np.nan, one),
        row=row,
        within=within,
        rows=np.flatnonzero(open_[mdp.state]),
        used=np.ones(mdp.num_transitions, bool),
    )
    every = np.ones(mdp.num_rows, bool)
    return _of_original(plan, (model, absorbing), origin, target | blocked, every, log)


def plan_total_reward(
    model: UncertainMDP, reward: Floats, target: Booleans, query: Query
) -> IntervalPlan:
    """The plan of an expected total reward; rewards ``float64[R]``."""
    absorbing, origin = model.with_absorbing(target)
    mdp, log, large = absorbing.mdp, list[RoomQueries](), query.nature_maximizes
    recording = _recording(absorbing, log)
    free = target[mdp.state] | (reward[origin] == 0)
    paying = mask_of(mdp.state[~free], target.size)
    finite, kept = finite_states(recording, target, query)
    if query.maximize and large:
        nothing = finite & ~backward_reachable(mdp, paying)
    elif query.maximize:
        against = Query(maximize=False, nature_maximizes=True)
        nothing, _ = almost_sure_states(recording, target, finite & ~paying, against)
    else:
        nothing = _free_states(absorbing, target, finite, free & kept, large, log)
    row = mdp.row_start[:-1].astype(np.int64)
    used = finite[mdp.successor]
    within = np.ones(mdp.num_transitions, bool)
    if not large:
        within = np.where(nothing[mdp.state], absorbing.can_stay_in(nothing), False)[mdp.row]
        within = nothing[mdp.successor] | ~within
    if not query.maximize:
        inside = nothing[mdp.state] & free & kept
        if large:
            row = np.where(nothing, attracting_rows(absorbing, target, inside), row)
            out = attracting_rows(absorbing, target, kept)
        else:
            inside &= absorbing.can_stay_in(nothing)
            way = _restricted_nature(absorbing, within, inside)
            row = np.where(nothing, shortest_path_rows(way, target, inside), row)
            out = shortest_path_rows(_restricted_nature(absorbing, used, kept), target, kept)
        row = np.where(nothing, row, out)
    known = np.where(nothing, 0, np.where(finite, np.nan, np.inf))
    plan = IntervalPlan(
        known=known,
        row=row,
        within=within,
        rows=np.flatnonzero(kept & np.isnan(known)[mdp.state]),
        used=used,
    )
    return _of_original(plan, (model, absorbing), origin, target, free, log)


def _of_original(
    plan: IntervalPlan,
    models: tuple[UncertainMDP, UncertainMDP],
    origin: Integers,
    absorbed: Booleans,
    free: Booleans,
    log: list[RoomQueries],
) -> IntervalPlan:
    """The plan in the rows and entries of the original model, from those of the absorbing one."""
    model, absorbing = models
    mdp, small = model.mdp, absorbing.mdp
    open_, rows = np.isnan(plan.known), np.zeros(small.num_rows, bool)
    rows[plan.rows] = True
    used = plan.used & (free & rows)[small.row]
    inner = joint_end_components(absorbing, open_, used)[1] if open_.any() else used & False
    cycles = inner & (small.successor != small.state[small.row])
    # Entries of states that are not absorbing are the same, in the same order.
    moves, moved = (~absorbed[x.state[x.row]] for x in (mdp, small))
    entries = np.zeros(small.num_transitions, np.int64)
    entries[moved] = np.flatnonzero(moves)
    within, used = (np.ones(mdp.num_transitions, bool) for _ in range(2))
    within[moves], used[moves] = plan.within[moved], plan.used[moved]
    return IntervalPlan(
        known=plan.known,
        row=origin[plan.row],
        within=within,
        rows=origin[plan.rows],
        used=used,
        has_free_cycles=bool(cycles.any()),
        queries=_unique_queries(model, log, entries),
    )


def _restricted_nature(model: UncertainMDP, entries: Booleans, rows: Booleans) -> HostMDP:
    """The MDP in which nature keeps to some entries in some rows."""
    kept = model.interior_distributions(entries)
    return model.resolve(np.where(rows[model.mdp.row], kept, model.mdp.probability))


def _free_states(
    model: UncertainMDP,
    target: Booleans,
    finite: Booleans,
    rows: Booleans,
    nature_maximizes: bool,
    log: list[RoomQueries],
) -> Booleans:
    """States from which a policy reaches the target almost surely by some rows."""
    mdp = model.mdp
    some, first = mdp.first_choice(rows)
    taken = rows.copy()
    taken[first[~some]] = True
    row = np.flatnonzero(taken)
    starts = offsets_from_counts(np.bincount(mdp.state[row], minlength=some.size))
    part, entry = model.select_rows(starts, row)
    recording = _RecordingMDP(part.mdp, part.lower, part.upper, log=log, origin=entry)
    query = Query(maximize=True, nature_maximizes=not nature_maximizes)
    return almost_sure_states(recording, target, finite & some, query)[0]


# --- recorded queries ---------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class _RecordingMDP(UncertainMDP):
    """An uncertain MDP that records queries which positive ends alone do not answer."""

    log: list[RoomQueries]  # the queries
    origin: Integers  # int[T], entries of the model that the queries refer to

    def can_stay_on(self, entries: Booleans) -> Booleans:
        self._record(np.arange(self.mdp.num_rows), entries)
        return UncertainMDP.can_stay_on(self, entries)

    def must_enter(self, row: Integers, region: Booleans) -> Booleans:
        self._record(row, ~region[self.mdp.successor])
        return UncertainMDP.must_enter(self, row, region)

    def _record(self, row: Integers, entries: Booleans) -> None:
        start, lower = self.mdp.entry_start, self.lower
        queried = mask_of(row, self.mdp.num_rows)
        needed = np.logical_or.reduceat(~entries & (lower > 0), start[:-1])
        some = np.logical_or.reduceat(entries, start[:-1])
        every = np.logical_and.reduceat(entries, start[:-1])
        queried &= some & ~needed & ~every
        if not queried.any():
            return
        room = row_sums(np.where(entries, self.upper, 0), start, -self._ones) >= 0
        entry = np.flatnonzero(entries & queried[self.mdp.row])
        group = (np.cumsum(queried) - 1)[self.mdp.row[entry]]
        rows = np.flatnonzero(queried)
        self.log.append(RoomQueries(self.origin[entry], group, rows, room[queried]))


def _recording(model: UncertainMDP, log: list[RoomQueries]) -> _RecordingMDP:
    every = np.arange(model.mdp.num_transitions)
    return _RecordingMDP(model.mdp, model.lower, model.upper, log=log, origin=every)


def _unique_queries(model: UncertainMDP, log: list[RoomQueries], entries: Integers) -> RoomQueries:
    """The distinct queries, by the entries and rows of the model."""
    if not log:
        return _NO_QUERIES
    before = np.cumsum([0, *(q.room.size for q in log[:-1])])
    entry = entries[np.concatenate([q.entry for q in log])]
    group = np.concatenate([q.group + n for q, n in zip(log, before, strict=True)])
    room = np.concatenate([q.room for q in log])
    # Sums of random numbers identify sets of entries.
    mark = np.random.default_rng(0).integers(1, 2**62, model.mdp.num_transitions, np.int64)
    start = np.flatnonzero(np.diff(group, prepend=-1))
    _, first = np.unique(np.add.reduceat(mark[entry], start), return_index=True)
    kept = mask_of(first, room.size)
    chosen = kept[group]
    return RoomQueries(
        entry[chosen],
        (np.cumsum(kept) - 1)[group[chosen]],
        model.mdp.row[entry[start[kept]]],
        room[kept],
    )
