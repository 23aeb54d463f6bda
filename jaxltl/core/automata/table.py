"""Parity automata as integer tables: breadth-first search, equal letters and equal states."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable
from typing import NamedTuple, TypeVar

import numpy as np

from jaxltl.core.array_types import Integers
from jaxltl.core.sparse.graph.components import strong_components

State = TypeVar("State", bound=Hashable)


class ParityTable(NamedTuple):
    """A parity automaton as bare arrays: `delta [Q, L]`, `priority [Q, L]`, an initial state."""

    delta: Integers
    priority: Integers
    initial: int


def too_many_states(max_states: int, place: str = "to_automaton") -> ValueError:
    """The error of a construction that exceeds the limit of states."""
    return ValueError(
        f"{place}: more than {max_states} states. Pass fewer letters=, split the formula into "
        "parts that are tracked side by side, or raise max_states."
    )


def explore(
    start: State,
    step: Callable[[State], Iterable[tuple[State, int]]],
    max_states: int = 2**31,
    place: str = "to_automaton",
) -> tuple[list[State], list[Integers], list[Integers]]:
    """The states that are reachable by steps to (successor, mark), breadth first.

    For each state also the numbers of its successors, and their marks.
    """
    number, order = {start: 0}, [start]
    rows: list[Integers] = []
    marks: list[Integers] = []
    for state in order:
        successors, marked = zip(*step(state), strict=True)
        for successor in successors:
            if successor not in number:
                number[successor] = len(order)
                order.append(successor)
        rows.append(np.array([number[successor] for successor in successors], np.int32))
        marks.append(np.array(marked, np.int64))
        if len(order) > max_states:
            raise too_many_states(max_states, place)
    return order, rows, marks


def distinct_columns(*tables: Integers) -> tuple[Integers, Integers]:
    """Letters with different columns in tables `[Q, L]`, and each letter's place among them."""
    _, first, place = np.unique(
        np.concatenate(tables), axis=1, return_index=True, return_inverse=True
    )
    return first, place.ravel()


def reachable(table: ParityTable) -> tuple[ParityTable, Integers]:
    """The reachable part, renumbered breadth first, and the old numbers."""
    rows = table.delta.tolist()
    order = np.array(explore(table.initial, lambda q: ((end, 0) for end in rows[q]))[0])
    position = np.full(len(table.delta), -1)
    position[order] = np.arange(len(order))
    return ParityTable(position[table.delta[order]], table.priority[order], 0), order


def quotient(table: ParityTable) -> tuple[ParityTable, Integers]:
    """Reachable states, merged where every word reads the same priorities.

    The minimal table, numbered breadth first, and a state of each class.
    """
    (delta, priority, _), old = reachable(table)
    columns, _ = distinct_columns(delta)
    _, output = np.unique(priority, axis=0, return_inverse=True)
    block = coarsest_partition(delta[:, columns], output.ravel())
    _, first = np.unique(block, return_index=True)
    small, order = reachable(ParityTable(block[delta[first]], priority[first], int(block[0])))
    return small, old[first[order]]


def coarsest_partition(delta: Integers, output: Integers) -> Integers:
    """Blocks of states with equal outputs on every word, ``int[Q]``.

    Refinement by the smaller half of a split block, which takes O(L Q log Q) (Hopcroft 1971).
    """
    before: list[list[list[int]]] = [[[] for _ in delta] for _ in delta.T]
    for state, row in enumerate(delta.tolist()):
        for letter, successor in enumerate(row):
            before[letter][successor].append(state)
    block_of = output.tolist()
    members: list[set[int]] = [set() for _ in range(max(block_of) + 1)]
    for state, block in enumerate(block_of):
        members[block].add(state)
    waiting = list(range(len(members)))
    while waiting:
        splitter = list(members[waiting.pop()])
        for sources in before:
            hit: defaultdict[int, set[int]] = defaultdict(set)
            for state in splitter:
                for source in sources[state]:
                    hit[block_of[source]].add(source)
            for block, inside in hit.items():
                whole = members[block]
                if len(inside) == len(whole):
                    continue
                # The smaller half gets the new number, so that a state is renumbered O(log Q)
                # times; the larger half stays in `waiting` if the block was there.
                smaller = inside if 2 * len(inside) <= len(whole) else whole - inside
                whole -= smaller
                for state in smaller:
                    block_of[state] = len(members)
                waiting.append(len(members))
                members.append(smaller)
    return np.array(block_of)


def components(table: ParityTable) -> Integers:
    """The strongly connected component of each state."""
    count, width = table.delta.shape
    return strong_components(np.repeat(np.arange(count), width), table.delta.ravel(), count)
