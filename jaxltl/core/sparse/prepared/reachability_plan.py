"""Plan of a prepared solve: preprocessing, schedule, and the maps of numbers and policies.

Numbers are the probabilities of the T entries, the rewards of the R rows, one and zero, in this
order: T + R is one, and T + R + 1 zero.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.contraction import Contraction, contract_chains, identity
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
    groups: int  # their number


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
    terms: int  # number of roundings behind a weight


def plan_optimum(reduced: ReducedProblem, cost: Floats | None) -> Plan:
    """Plan of an optimum, or of a Markov chain."""
    mdp, small, part = reduced.mdp, reduced.contraction, reduced.quotient
    known = reduced.known_value
    if part is not None:
        small = replace(small, mdp=part.mdp, node=part.node[small.node], row=small.row[part.row])
    if cost is None:
        code = np.where(known == 0, LOST, ONE)
    else:
        code = np.where(np.isfinite(known), GOAL, LOST)
    rows = np.zeros(0, np.int64)
    if reduced.problem is not None:
        interior, allowed = reduced.problem.interior, reduced.problem.allowed
        code[interior] = np.arange(np.count_nonzero(interior))
        kept = interior[small.mdp.state] & ~small.mdp.is_self_loop
        rows = np.flatnonzero(kept if allowed is None else kept & allowed)
    order, place, loops = _scheduled(mdp, small, code, rows, cost, mixed=False)
    own, row = _own(reduced, place)
    states = place[small.node].astype(np.int32)
    return Plan(order, states, own, row, loops, _cycles(reduced), _terms(loops))


def _scheduled(
    mdp: HostMDP,
    small: Contraction,
    code: Integers,
    rows: Integers,
    cost: Floats | None,
    *,
    mixed: bool,
) -> tuple[Schedule, Integers, Loops | None]:
    """Schedule of the open nodes, the places of all nodes, and the self-loops.

    `code` has the number of each open node, and ONE, GOAL or LOST of the others. If rows are mixed
    by a policy, all rows of a node are one.
    """
    state, origin = small.mdp.state[rows], small.row[rows]
    width = np.diff(small.mdp.entry_start)[rows]
    row: Integers = np.repeat(np.arange(rows.size), width)
    successor = small.mdp.successor[concatenated_ranges(small.mdp.entry_start[rows], width)]
    source = concatenated_ranges(mdp.entry_start[origin], width)
    loop, loops = successor == state[row], None
    if loop.any():
        group = code[state] if mixed else np.arange(rows.size)
        looping = np.unique(group[row[loop]])
        inside, rank = np.isin(group, looping), np.searchsorted(looping, group)
        rest = ~loop & inside[row]
        loops = Loops(source[rest], rank[row[rest]], origin[inside], rank[inside], looping.size)
    target = code[successor]
    kept = ~loop & (mixed | (target >= 0) | (target == ONE))
    # Rewards are entries of the constant one.
    paid = np.zeros(0, np.int64) if cost is None else np.flatnonzero(cost[origin] > 0)
    row = np.append(paid, row[kept])
    target = np.append(np.full(paid.size, ONE), target[kept])
    source = np.append(mdp.num_transitions + origin[paid], source[kept])
    entries = np.argsort(row, kind="stable")
    row, target, source = row[entries], target[entries], source[entries]
    count = int(np.count_nonzero(code >= 0))
    owner, name = code[state], origin.astype(np.int64)
    if mixed:
        owner, name, row = np.arange(count), np.zeros(count, np.int64), owner[row]
    one = mdp.num_transitions + mdp.num_rows
    order = schedule(Nodes(count, owner, name, row, target, source), one, one + 1)
    place = order.size - 1 - code
    place[code >= 0] = order.place
    return order, place, loops


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


def _cycles(reduced: ReducedProblem) -> Cycles | None:
    """States and rows of the collapsed end components with unknown value."""
    components, whole, part = reduced.components, reduced.contraction, reduced.quotient
    if components is None or part is None or reduced.problem is None:
        return None
    mdp = whole.mdp
    open_ = reduced.problem.interior[part.node]
    inside = components.inside & open_[mdp.state]
    region = mdp.states_of(inside)
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
    whole = contract_chains(mdp, fixed, None) or identity(mdp)
    small, goal, dead = whole.mdp, whole.region(target), whole.region(blocked)
    if cost is None:
        before = ~(goal | dead)[small.state]
        lost = ~backward_reachable(small, goal, before)
        some = dead | ~positive_under_all_policies(small, goal, among=~dead)
        reached = goal | ~backward_reachable(small, some, before)
        code = np.where(reached, ONE, LOST)
    else:
        lost = ~almost_sure_reachability(small, goal, np.ones(small.num_rows, bool))[0]
        reached, code = goal, np.where(goal, GOAL, LOST)
    open_ = ~(lost | reached)
    code[open_] = np.arange(np.count_nonzero(open_))
    rows = np.flatnonzero(open_[small.state])
    order, place, loops = _scheduled(mdp, whole, code, rows, cost, mixed=True)
    max_choices = int(np.diff(mdp.row_start).max())
    row: Integers = mdp.row_start[:-1].astype(np.int32)
    states = place[whole.node].astype(np.int32)
    nowhere = np.full(mdp.num_states, -1, np.int32)
    return Plan(order, states, nowhere, row, loops, None, _terms(loops) + 2 * max_choices + 4)


def _terms(loops: Loops | None) -> int:
    if loops is None:
        return 6
    return 10 + int(np.bincount(loops.group, minlength=loops.groups).max(initial=0))
