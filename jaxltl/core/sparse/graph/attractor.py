"""Attractors on the host: sweeps over open states, then a worklist, linear in the transitions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.sparse.rows import (
    group_starts,
    decrement,
    sorted_unique,
    first_action,
    some_action,
    concatenated_ranges,
)

SWEEPS = 12  # times the size of the graph that sweeps may cost, before a worklist takes over
ALL: Any = slice(None)
FEW = 24  # transitions into a frontier up to which Python's own loop beats NumPy's overhead


@dataclass
class Search:
    """An attractor that grows in place; states ``[S, Q]``, pairs ``[S, Q, A]``.

    Attributes:
      graph: the :class:`~jaxltl.core.sparse.graph.product_graph.HostGraph`.
      chance: ``"some"`` successor in the region makes an action lead there, or ``"all"``.
      region: what has joined, at first the goal.
      action, rank: as of an attractor.
      allowed: the actions that count.
      rule: True where one allowed action suffices, False where all must lead there.
      open: the states that may still join.
      round: how many rounds were made.
    """

    graph: Any
    chance: str
    region: Booleans
    action: Integers
    rank: Integers
    allowed: Booleans
    rule: Booleans
    open: Booleans
    round: int = 0


def attract(search: Search) -> None:
    """Grows the region until nothing joins."""
    goal = search.region.copy()
    if not _sweep(search):
        _work(search)
    # Where every action leads nearer none is better than the first.
    forced = search.region & ~goal & ~search.rule
    search.action[forced] = first_action(search.allowed[forced])[1]


def _sweep(search: Search) -> bool:
    """Rounds over the states that are open; whether nothing joins any more."""
    graph, num_memory = search.graph, search.graph.num_memory
    forced = not search.rule.all()
    rows, part = graph.rows, ALL
    size, left = graph.rows.num_states, SWEEPS * (rows.successor.size + search.open.size)
    while True:
        world = np.flatnonzero(search.open.any(-1) if num_memory > 1 else search.open)
        if not world.size:
            return True
        if 4 * world.size < size:  # look at the open states alone
            pairs = world[:, None] * graph.num_actions + np.arange(graph.num_actions)
            rows, part, size = graph.rows.take(pairs.ravel()), world, world.size
        left -= rows.successor.size * num_memory + search.open.size
        hit = search.allowed[part] & _leads(search, rows, part)
        some, first = first_action(hit)
        new = some & search.rule[part] & search.open[part]
        if forced:
            rest = some_action(search.allowed[part] & ~hit)
            new |= ~rest & ~search.rule[part] & search.open[part]
        if not new.any():
            return True
        _join(search, part, new, first)
        if left <= 0:
            return False


def _leads(search: Search, rows: Any, part: Any) -> Booleans:
    """The pairs of some world states that lead to the region: ``bool[N, Q, A]``."""
    graph = search.graph
    if search.chance == "some":
        return graph.through(search.region, rows.some_successor_in, part)
    return ~graph.through(~search.region, rows.some_successor_in, part)


def _join(search: Search, part: Any, new: Booleans, first: Integers) -> None:
    search.round += 1
    found = np.flatnonzero(new)
    state = found
    if not isinstance(part, slice):
        row, q = np.divmod(found, search.graph.num_memory)
        state = part[row] * search.graph.num_memory + q
    search.region.reshape(-1)[state] = True
    search.open.reshape(-1)[state] = False
    search.rank.reshape(-1)[state] = search.round
    search.action.reshape(-1)[state] = first.reshape(-1)[found]


def _work(search: Search) -> None:
    """Finishes by a worklist: each transition is touched once more."""
    worklist = _worklist(search)
    frontier: Integers = np.flatnonzero(search.region & (search.rank == search.round))
    while frontier.size:
        frontier = _join_few(worklist, frontier)
        search.round += 1
        frontier = _join_pairs(worklist, _into(worklist, frontier))


class _Worklist(NamedTuple):
    """What each pair ``(s * Q + q) * A + a`` still lacks before it leads to the region.

    Attributes:
      search: what is grown.
      missing: ``int[S * Q * A]``, the successors of a pair that must still join.
      waiting: ``bool[S * Q * A]``, pairs that count and do not lead to the region yet.
      remaining: ``int[S * Q]``, how many pairs of a state are waiting.
      view: the same and parts of the search as memory views, which plain loops read faster.
    """

    search: Search
    missing: Integers
    waiting: Booleans
    remaining: Integers
    view: dict[str, memoryview]


def _worklist(search: Search) -> _Worklist:
    graph = search.graph
    before = search.region & (search.rank < search.round)  # the last round is the frontier
    if search.chance == "some":
        lacking = ~graph.through(before, graph.rows.some_successor_in)
        missing = np.ones(lacking.size, np.int32)
    else:
        missing = graph.through(~before, graph.rows.number_in).reshape(-1)
        lacking = missing.reshape(search.allowed.shape) > 0
    waiting = (search.allowed & lacking).reshape(-1)
    remaining = waiting.reshape(-1, graph.num_actions).sum(-1)
    start, pair = graph.rows.predecessors
    arrays = {
        "missing": missing,
        "waiting": waiting,
        "remaining": remaining,
        "start": start,
        "pair": pair,
        "memory": graph.next_memory,
        "open": search.open,
        "rule": search.rule,
        "region": search.region,
        "rank": search.rank,
        "action": search.action,
    }
    view = {name: memoryview(x.reshape(-1)) for name, x in arrays.items()}
    return _Worklist(search, missing, waiting, remaining, view)


def _into(worklist: _Worklist, frontier: Integers) -> Integers:
    """The pairs with a successor in the frontier, one a transition."""
    graph = worklist.search.graph
    start, row = graph.rows.predecessors
    target, memory = np.divmod(frontier, graph.num_memory)
    count = start[target + 1] - start[target]
    row = row[concatenated_ranges(start[target], count)]
    if graph.num_memory == 1:
        return row
    s, a = np.divmod(row, graph.num_actions)
    read = np.repeat(target, count) if graph.on_entry else s
    start, before = graph.memory_before
    code = graph.letter[read].astype(np.int64) * graph.num_memory + np.repeat(memory, count)
    count = start[code + 1] - start[code]
    q = before[concatenated_ranges(start[code], count)]
    return (
        np.repeat(s.astype(np.int64) * (graph.num_memory * graph.num_actions) + a, count)
        + q * graph.num_actions
    )


def _join_pairs(worklist: _Worklist, pairs: Integers) -> Integers:
    """The states that join by pairs of which some more successors are in the region."""
    search, missing, waiting, remaining, _ = worklist
    decrement(missing, pairs)
    pair = sorted_unique(pairs[waiting[pairs] & (missing[pairs] <= 0)], waiting.size)
    waiting[pair] = False
    state, a = np.divmod(pair, search.graph.num_actions)
    decrement(remaining, state)
    flat = [
        x.reshape(-1) for x in (search.rule, search.open, search.action, search.region, search.rank)
    ]
    rule, open_, action, region, rank = flat
    joins = (rule[state] | (remaining[state] == 0)) & open_[state]
    state, a = state[joins], a[joins]
    first = group_starts(state)  # pairs are in order, so one state's stand together
    frontier = state[first]
    action[frontier] = a[first]
    open_[frontier], region[frontier], rank[frontier] = False, True, search.round
    return frontier


def _join_few(worklist: _Worklist, frontier: Integers) -> Integers:
    """Rounds by plain loops while frontiers are small; the first one that is not.

    Along a chain every frontier is small, and there are very many.
    """
    search, view = worklist.search, worklist.view
    graph, few = search.graph, frontier.tolist() if frontier.size <= FEW else []
    num_actions, num_memory, on_entry = graph.num_actions, graph.num_memory, graph.on_entry
    start, row, memory = view["start"], view["pair"], view["memory"]
    missing, waiting, remaining = view["missing"], view["waiting"], view["remaining"]
    rule, open_, region = view["rule"], view["open"], view["region"]
    while few:
        pairs: list[int] = []
        for state in few:
            target, after = divmod(state, num_memory)
            first, last = start[target], start[target + 1]
            if len(pairs) + (last - first) * num_memory > FEW:
                return np.array(few)
            if num_memory == 1:
                pairs += row[first:last]
                continue
            for pair in row[first:last]:
                s, a = divmod(pair, num_actions)
                read = (target if on_entry else s) * num_memory
                pairs += [
                    (s * num_memory + q) * num_actions + a
                    for q in range(num_memory)
                    if memory[read + q] == after
                ]
        search.round += 1
        few = []
        for pair in sorted(pairs):
            missing[pair] -= 1
            if missing[pair] > 0 or not waiting[pair]:
                continue
            waiting[pair] = False
            state, a = divmod(pair, num_actions)
            remaining[state] -= 1
            if (rule[state] or not remaining[state]) and open_[state]:
                open_[state], region[state] = False, True
                view["action"][state], view["rank"][state] = a, search.round
                few.append(state)
    return frontier if frontier.size > FEW else np.array([], int)
