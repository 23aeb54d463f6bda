"""What a prepared solve of an interval model knows: what is decided, and on which answers it rests.

Which states are worth 0, 1 or infinity depends on where the ends are positive, and on which
successors nature may drop: on whether some upper ends add up to one. These questions are kept with
their answers. Where other ends give the same answers, the same is decided.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.graph.qualitative import backward_reachable, shortest_path_rows
from jaxltl.core.sparse.interval.qualitative import (
    Decided,
    attracting,
    decided,
    held,
    joint_components,
    surely,
)
from jaxltl.core.sparse.interval.row_table import row_sums
from jaxltl.core.sparse.interval.uncertainty_set import HostInterval
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import offsets_from_counts


class Answers(NamedTuple):
    """Whether the upper ends of some entries of a row have room for all mass.

    Attributes:
      entry, group: ``int[E]``, the entries, and which question they belong to, ascending.
      row: ``int[G]``, the row that a question is about.
      room: ``bool[G]``, the answers.
    """

    entry: Integers
    group: Integers
    row: Integers
    room: Booleans


class IntervalPlan(NamedTuple):
    """What is left of a question once the graph has decided.

    Attributes:
      known: ``float64[S]``, 0, 1 or infinity, NaN where a state is open.
      row: ``int[S]``: of a known state, a row that the policy takes; of an open one, a row by
        which the policy gets out, if it is who must.
      within: ``bool[T]``, the entries to which nature keeps in the rows of known states.
      rows: ``int[R']``, the rows of open states that may be taken.
      used: ``bool[T]``, their entries that nature may use.
      circling: whether who must get out may also stay for ever, at no cost.
      answers: what this rests on, besides where ends and rewards are positive.
    """

    known: Floats
    row: Integers
    within: Booleans
    rows: Integers
    used: Booleans
    circling: bool
    answers: Answers


def plan_reachability(
    model: HostInterval, target: Booleans, stay: Booleans | None, *, maximize: bool, helpful: bool
) -> IntervalPlan:
    """The plan of a probability; arguments as of
    :func:`~jaxltl.core.sparse.interval.reachability.reachability`.
    """
    blocked = np.zeros(target.size, bool) if stay is None else ~stay & ~target
    halted, origin = model.halted(target | blocked)
    mdp, log = halted.mdp, list[_Question]()
    zero, one = decided(_asking(halted, log), target, maximize=maximize, helpful=helpful)
    if maximize == helpful:  # policy and nature see to the same
        mine = one if maximize else zero
        rows = halted.may_stay(mine) & mine[mdp.state]
        within = mine[mdp.successor] | ~rows[mdp.row]
        way = halted.fixed(np.where(rows[mdp.row], halted.within(within), mdp.probability))
        row = shortest_path_rows(way, target, rows) if maximize else mdp.first_choice(rows)[1]
    else:
        row, within = held(halted, target, Decided(zero, one), maximize=maximize)
    open_ = ~(zero | one)
    if maximize:
        every = np.ones(mdp.num_rows, bool)
        out = shortest_path_rows(mdp, one, every) if helpful else attracting(halted, one, every)
        row = np.where(open_, out, row)
    left = _Left(
        halted,
        origin,
        np.where(open_, np.nan, one),
        row,
        within,
        open_[mdp.state],
        np.ones(mdp.num_transitions, bool),
    )
    return _plan(model, target | blocked, left, log, np.ones(mdp.num_rows, bool))


def plan_total_reward(
    model: HostInterval, reward: Floats, target: Booleans, *, maximize: bool, large: bool
) -> IntervalPlan:
    """The plan of a reward; arguments as of
    :func:`~jaxltl.core.sparse.interval.reachability.total_reward`.
    """
    halted, origin = model.halted(target)
    mdp, log = halted.mdp, list[_Question]()
    asked = _asking(halted, log)
    free = target[mdp.state] | (reward[origin] == 0)
    paying = np.zeros(target.size, bool)
    paying[mdp.state[~free]] = True
    if maximize and large:
        finite = decided(asked, target, maximize=False, helpful=False).one
        kept = finite[mdp.state]
        nothing = finite & ~backward_reachable(mdp, paying)
    else:
        finite, kept = surely(
            asked, target, np.ones(target.size, bool), maximize=not maximize, helpful=not large
        )
        if maximize:
            nothing, _ = surely(asked, target, finite & ~paying, maximize=False, helpful=True)
        else:
            nothing = _for_nothing(halted, target, finite, free & kept, large, log)
    row = mdp.row_start[:-1].astype(np.int64)
    used = finite[mdp.successor]
    within = np.ones(mdp.num_transitions, bool)
    if not large:
        within = np.where(nothing[mdp.state], halted.may_stay(nothing), False)[mdp.row]
        within = nothing[mdp.successor] | ~within
    if not maximize:
        inside = nothing[mdp.state] & free & kept
        if large:
            row = np.where(nothing, attracting(halted, target, inside), row)
            out = attracting(halted, target, kept)
        else:
            inside &= halted.may_stay(nothing)
            row = np.where(
                nothing, shortest_path_rows(_keeping(halted, within, inside), target, inside), row
            )
            out = shortest_path_rows(_keeping(halted, used, kept), target, kept)
        row = np.where(nothing, row, out)
    known = np.where(nothing, 0, np.where(finite, np.nan, np.inf))
    open_ = np.isnan(known)
    left = _Left(halted, origin, known, row, within, kept & open_[mdp.state], used)
    return _plan(model, target, left, log, free)


def _keeping(model: HostInterval, entries: Booleans, rows: Booleans) -> HostMDP:
    """The model in which nature keeps to some entries in some rows."""
    kept = model.within(entries)
    return model.fixed(np.where(rows[model.mdp.row], kept, model.mdp.probability))


def _for_nothing(
    model: HostInterval,
    target: Booleans,
    finite: Booleans,
    rows: Booleans,
    large: bool,
    log: list[_Question],
) -> Booleans:
    """The states from which a policy surely reaches the target by some rows."""
    mdp = model.mdp
    some, first = mdp.first_choice(rows)
    taken = rows.copy()
    taken[first[~some]] = True
    row = np.flatnonzero(taken)
    part, entry = model.of_rows(
        offsets_from_counts(np.bincount(mdp.state[row], minlength=some.size)), row
    )
    asked = _Asking(part.mdp, part.lower, part.upper, log=log, origin=entry)
    return surely(asked, target, finite & some, maximize=True, helpful=not large)[0]


# --- the questions ------------------------------------------------------------------------------


class _Question(NamedTuple):
    """Entries of rows, each row's a question.

    Attributes:
      entry: ``int[E]``, of the model whose entries are counted.
      group: ``int[E]``, by row; `room`, ``bool[G]``.
    """

    entry: Integers
    group: Integers
    room: Booleans


@dataclass(frozen=True, kw_only=True)
class _Asking(HostInterval):
    """A model that writes down what it is asked, where positive ends alone do not answer it.

    Attributes:
      log: what was asked.
      origin: ``int[T]``, which entries these are of the model whose entries are counted.
    """

    log: list[_Question]
    origin: Integers

    def may_keep(self, entries: Booleans) -> Booleans:
        found = HostInterval.may_keep(self, entries)
        self._note(np.arange(self.mdp.num_rows), entries)
        return found

    def must_enter(self, row: Integers, region: Booleans) -> Booleans:
        self._note(row, ~region[self.mdp.successor])
        return HostInterval.must_enter(self, row, region)

    def _note(self, row: Integers, entries: Booleans) -> None:
        """What is asked of some rows: whether they have room in some entries."""
        start, lower = self.mdp.entry_start, self.lower
        asked = np.zeros(self.mdp.num_rows, bool)
        asked[row] = True
        needed = np.logical_or.reduceat(~entries & (lower > 0), start[:-1])
        some = np.logical_or.reduceat(entries, start[:-1])
        every = np.logical_and.reduceat(entries, start[:-1])
        asked &= some & ~needed & ~every
        if not asked.any():
            return
        room = row_sums(np.where(entries, self.upper, 0), start, -self._ones) >= 0
        entry = np.flatnonzero(entries & asked[self.mdp.row])
        group = (np.cumsum(asked) - 1)[self.mdp.row[entry]]
        self.log.append(_Question(self.origin[entry], group, room[asked]))


def _asking(model: HostInterval, log: list[_Question]) -> _Asking:
    every: Integers = np.arange(model.mdp.num_transitions)
    return _Asking(model.mdp, model.lower, model.upper, log=log, origin=every)


def _answers(model: HostInterval, log: list[_Question], entries: Integers) -> Answers:
    """All questions, each once."""
    none = np.zeros(0, np.int64)
    if not log:
        return Answers(none, none, none, np.zeros(0, bool))
    before = np.cumsum([0, *(q.room.size for q in log[:-1])])
    entry = entries[np.concatenate([q.entry for q in log])]
    group = np.concatenate([q.group + n for q, n in zip(log, before, strict=True)])
    room = np.concatenate([q.room for q in log])
    # Sums of random numbers tell sets of entries apart.
    mark = np.random.default_rng(0).integers(1, 2**62, model.mdp.num_transitions, np.int64)
    start = np.flatnonzero(np.diff(group, prepend=-1))
    key = np.add.reduceat(mark[entry], start)
    _, first = np.unique(key, return_index=True)
    kept = np.zeros(room.size, bool)
    kept[first] = True
    chosen = kept[group]
    return Answers(
        entry[chosen],
        (np.cumsum(kept) - 1)[group[chosen]],
        model.mdp.row[entry[start[kept]]],
        room[kept],
    )


# --- what is left -------------------------------------------------------------------------------


class _Left(NamedTuple):
    """The plan of a model in which some states stand still, in its numbers.

    Attributes:
      model: that model; `origin`, ``int[R]``, which row each of its rows was.
      known, row, within, used: as of the plan; `rows`, ``bool[R]``, likewise.
    """

    model: HostInterval
    origin: Integers
    known: Floats
    row: Integers
    within: Booleans
    rows: Booleans
    used: Booleans


def _plan(
    model: HostInterval, halts: Booleans, left: _Left, log: list[_Question], free: Booleans
) -> IntervalPlan:
    """The plan, in the numbers of the model.

    Args:
      model: the model.
      halts: ``bool[S]``, the states that stand still.
      left: what is left.
      log: what was asked.
      free: ``bool[R]``, the rows that cost nothing.
    """
    mdp, small = model.mdp, left.model.mdp
    open_ = np.isnan(left.known)
    used = left.used & (free & left.rows)[small.row]
    inner = joint_components(left.model, open_, used)[1] if open_.any() else used & False
    circling = inner & (small.successor != small.state[small.row])
    # Entries of states that move are the same, in the same order.
    moves, moved = (~halts[x.state[x.row]] for x in (mdp, small))
    entries = np.zeros(small.num_transitions, np.int64)
    entries[moved] = np.flatnonzero(moves)
    within, used = (np.ones(mdp.num_transitions, bool) for _ in range(2))
    within[moves], used[moves] = left.within[moved], left.used[moved]
    return IntervalPlan(
        left.known,
        left.origin[left.row],
        within,
        left.origin[left.rows],
        used,
        bool(circling.any()),
        _answers(model, log, entries),
    )
