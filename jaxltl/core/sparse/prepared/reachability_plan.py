"""Plan of a prepared solve: preprocessing, schedule, and the maps of numbers and policies.

Numbers are the probabilities of the T entries, the rewards of the R rows, one and zero, in this
order: T + R is one, and T + R + 1 zero.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.contraction import contract_chains
from jaxltl.core.sparse.graph.qualitative import (
    positive_under_all_policies,
    backward_reachable,
    almost_sure_reachability,
)
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.prepared.block_schedule import GOAL, LOST, ONE, Nodes, Schedule, schedule
from jaxltl.core.sparse.rows import concatenated_ranges
from jaxltl.core.sparse.solvers.reachability import ReducedProblem, quotient_policy


class Loops(NamedTuple):
    """Self-loops to eliminate: groups of rows; their other entries are normalised."""

    entry: Integers  # int[E], the entries that lead elsewhere
    group: Integers  # int[E], their groups, ascending
    row: Integers  # int[L], the rows
    row_group: Integers  # int[L]
    groups: int  # how many there are


class Cycles(NamedTuple):
    """Collapsed end components, in which the policy moves to the exit of the component."""

    state: Integers  # int[M], their states
    row: Integers  # int[K], the rows that stay inside, and their states by rank in `state`
    row_state: Integers
    entry_row: Integers  # int[E], what these rows lead to, by ranks in `row` and `state`
    entry_state: Integers


class Plan(NamedTuple):
    """Plan of a question for solves with other numbers."""

    schedule: Schedule  # the order of the nodes
    place: Integers  # int32[S], where the value of a state is, see `Schedule`
    own: Integers  # int32[S], the place of the node with the row of a state, or -1
    row: Integers  # int32[S], the row that it takes else
    loops: Loops | None  # rows that lead to where they are
    cycles: Cycles | None  # end components that are one node
    terms: int  # how many roundings stand behind a weight


class _Entries(NamedTuple):
    """The entries of some rows of a reduced model: rows by rank, nodes, sources."""

    row: Integers
    target: Integers
    source: Integers


def plan_optimum(reduced: ReducedProblem, cost: Floats | None) -> Plan:
    """Plan of an optimum, or of a Markov chain."""
    mdp, whole, part = reduced.mdp, reduced.contraction, reduced.quotient
    small = whole.mdp if part is None else part.mdp
    origin = whole.row if part is None else whole.row[part.row]
    node = whole.node if part is None else part.node[whole.node]
    finite = np.isfinite(reduced.known_value)
    codes = np.where(finite & ((reduced.known_value == 0) | (cost is not None)), GOAL, ONE)
    codes = np.where(finite, codes, LOST)
    if cost is None:
        codes[reduced.known_value == 0] = LOST
    open_, rows = np.zeros(small.num_states, bool), np.zeros(0, np.int64)
    if reduced.problem is not None:
        open_ = reduced.problem.interior
        kept = open_[small.state]
        if reduced.problem.allowed is not None:
            kept &= reduced.problem.allowed
        rows = np.flatnonzero(kept)
    found = _entries(mdp, small, origin, rows)
    state = small.state[rows]
    loop = found.target == state[found.row]
    ends = np.bincount(found.row[~loop], minlength=rows.size) > 0
    if not ends.all():  # rows that never get anywhere
        rows, state = rows[ends], state[ends]
        found = _entries(mdp, small, origin, rows)
        loop = found.target == state[found.row]
    loops = None
    if loop.any():
        looping = np.zeros(rows.size, bool)
        looping[found.row[loop]] = True
        loops = _loops(found, loop, looping, np.cumsum(looping) - 1, origin[rows])
    number = np.cumsum(open_) - 1
    target = np.where(open_[found.target], number[found.target], codes[found.target])
    kept = ~loop & ((target >= 0) | (target == ONE))
    entries = _Entries(found.row[kept], target[kept], found.source[kept])
    entries = _with_costs(entries, origin[rows], cost, mdp.num_transitions)
    nodes = Nodes(int(open_.sum()), number[state], origin[rows].astype(np.int64), *entries)
    order = schedule(
        nodes, mdp.num_transitions + mdp.num_rows, mdp.num_transitions + mdp.num_rows + 1
    )
    codes = order.size - 1 - codes
    codes[open_] = order.place
    own, row = _own(reduced, codes)
    cycles = _circles(reduced)
    return Plan(order, codes[node].astype(np.int32), own, row, loops, cycles, _terms(loops))


def _entries(mdp: HostMDP, small: HostMDP, origin: Integers, rows: Integers) -> _Entries:
    width = np.diff(small.entry_start)[rows]
    return _Entries(
        np.repeat(np.arange(rows.size), width),
        small.successor[concatenated_ranges(small.entry_start[rows], width)],
        concatenated_ranges(mdp.entry_start[origin[rows]], width),
    )


def _loops(
    found: _Entries, loop: Booleans, looping: Booleans, group: Integers, origin: Integers
) -> Loops:
    """Self-loops of the marked rows, by group."""
    rest = np.flatnonzero(~loop & looping[found.row])
    of = group[found.row[rest]]
    order = np.argsort(of, kind="stable")
    rows = np.flatnonzero(looping)
    return Loops(
        found.source[rest][order], of[order], origin[rows], group[rows], int(group[rows].max()) + 1
    )


def _with_costs(
    entries: _Entries, origin: Integers, cost: Floats | None, num_entries: int
) -> _Entries:
    """Adds rewards as entries of the constant one."""
    if cost is None:
        return entries
    paid = np.flatnonzero(cost[origin] > 0)
    row = np.concatenate([paid, entries.row])
    order = np.argsort(row, kind="stable")
    return _Entries(
        row[order],
        np.concatenate([np.full(paid.size, ONE), entries.target])[order],
        np.concatenate([num_entries + origin[paid], entries.source])[order],
    )


def _own(reduced: ReducedProblem, codes: Integers) -> tuple[Integers, Integers]:
    """Place of the node that decides for each state, and fixed rows elsewhere."""
    mdp, whole, part = reduced.mdp, reduced.contraction, reduced.quotient
    mine = mdp.state[whole.row[whole.mdp.row_start[:-1]]]  # the state that each node is
    chosen: Integers = reduced.known_row
    node: Integers = np.arange(mine.size)
    if part is not None and reduced.components is not None:
        chosen = quotient_policy(
            whole.mdp, reduced.components, part.row[reduced.known_row][part.node]
        )
        node = part.node
    if reduced.fixed is not None and reduced.fixed_row is not None:
        chosen = np.where(reduced.fixed, reduced.fixed_row, chosen)
    row: Integers = mdp.row_start[:-1].astype(np.int32)
    row[mine] = whole.row[chosen]
    own: Integers = np.full(mdp.num_states, -1, np.int32)
    if reduced.problem is not None:
        own[mine] = np.where(reduced.problem.interior, codes, -1)[node]
    return own, row


def _circles(reduced: ReducedProblem) -> Cycles | None:
    """States and rows of the collapsed end components with unknown value."""
    components, whole, part = reduced.components, reduced.contraction, reduced.quotient
    if components is None or part is None or reduced.problem is None:
        return None
    mdp = whole.mdp
    open_ = reduced.problem.interior[part.node]
    inside = components.inside & open_[mdp.state]
    region: Booleans = np.zeros(mdp.num_states, bool)
    region[mdp.state[inside]] = True
    if not region.any():
        return None
    number = np.cumsum(region) - 1
    rows = np.flatnonzero(inside)
    width = np.diff(mdp.entry_start)[rows]
    mine = reduced.mdp.state[whole.row[mdp.row_start[:-1]]]
    return Cycles(
        mine[region],
        whole.row[rows],
        number[mdp.state[rows]],
        np.repeat(np.arange(rows.size), width),
        number[mdp.successor[concatenated_ranges(mdp.entry_start[rows], width)]],
    )


def plan_policy(mdp: HostMDP, target: Booleans, stay: Booleans | None, cost: Floats | None) -> Plan:
    """Plan of policy evaluation, for policies given later."""
    blocked = np.zeros(mdp.num_states, bool) if stay is None else ~stay & ~target
    fixed = target | blocked
    if cost is not None:
        fixed |= mdp.over_choices(np.maximum, cost) > 0
    whole = contract_chains(mdp, fixed, None)
    small = mdp if whole is None else whole.mdp
    node = np.arange(mdp.num_states) if whole is None else whole.node
    origin = np.arange(mdp.num_rows) if whole is None else whole.row
    goal, dead = (np.zeros(small.num_states, bool) for _ in range(2))
    goal[node[target]], dead[node[blocked]] = True, True
    if cost is None:
        before = ~(goal | dead)[small.state]
        lost = ~backward_reachable(small, goal, before)
        some = dead | ~positive_under_all_policies(small, goal, among=~dead)
        reached = goal | ~backward_reachable(small, some, before)
        codes = np.where(reached, ONE, LOST)
    else:
        lost = ~almost_sure_reachability(small, goal, np.ones(small.num_rows, bool))[0]
        reached, codes = goal, np.where(goal, GOAL, LOST)
    open_ = ~(lost | reached)
    found = _entries(mdp, small, origin, np.flatnonzero(open_[small.state]))
    rows = np.flatnonzero(open_[small.state])
    state = small.state[rows]
    number = np.cumsum(open_) - 1
    loop = found.target == state[found.row]
    loops = None
    if loop.any():
        of = np.zeros(small.num_states, bool)
        of[found.target[loop]] = True
        loops = _loops(found, loop, of[state], (np.cumsum(of) - 1)[state], origin[rows])
    to = np.where(open_[found.target], number[found.target], codes[found.target])
    entries = _Entries(found.row[~loop], to[~loop], found.source[~loop])
    entries = _with_costs(entries, origin[rows], cost, mdp.num_transitions)
    count = int(open_.sum())
    nodes = Nodes(
        count,
        np.arange(count),
        np.zeros(count, np.int64),
        number[state][entries.row],
        entries.target,
        entries.source,
    )
    order = schedule(
        nodes, mdp.num_transitions + mdp.num_rows, mdp.num_transitions + mdp.num_rows + 1
    )
    place = order.size - 1 - codes
    place[open_] = order.place
    most = int(np.diff(mdp.row_start).max())
    row: Integers = mdp.row_start[:-1].astype(np.int32)
    return Plan(
        order,
        place[node].astype(np.int32),
        np.full(mdp.num_states, -1, np.int32),
        row,
        loops,
        None,
        _terms(loops) + 2 * most + 4,
    )


def _terms(loops: Loops | None) -> int:
    if loops is None:
        return 6
    return 10 + int(np.bincount(loops.group, minlength=loops.groups).max(initial=0))
