"""Automata as integer tables: breadth-first search, equal letters and equal states."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from typing import NamedTuple, TypeVar

import numpy as np

from jaxltl.core.array_types import Integers
from jaxltl.core.sparse.graph.components import strong_components

State = TypeVar("State", bound=Hashable)


class Table(NamedTuple):
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


def reachable(table: Table) -> tuple[Table, Integers]:
    """The reachable part, renumbered breadth first, and the old numbers."""
    rows = table.delta.tolist()
    order = np.array(explore(table.initial, lambda q: ((end, 0) for end in rows[q]))[0])
    position = np.full(len(table.delta), -1)
    position[order] = np.arange(len(order))
    return Table(position[table.delta[order]], table.priority[order], 0), order


def quotient(table: Table) -> tuple[Table, Integers]:
    """Reachable states, merged where every word reads the same priorities (Moore 1956).

    The minimal table, numbered breadth first, and a state of each class.
    """
    (delta, priority, _), old = reachable(table)
    columns, _ = distinct_columns(delta)
    _, block = np.unique(priority, axis=0, return_inverse=True)
    count = 0
    while count < block.max() + 1 < len(delta):
        count = block.max() + 1
        signature = np.column_stack([block.ravel(), block.ravel()[delta[:, columns]]])
        _, block = np.unique(signature, axis=0, return_inverse=True)
    block = block.ravel()
    _, first = np.unique(block, return_index=True)
    small, order = reachable(Table(block[delta[first]], priority[first], int(block[0])))
    return small, old[first[order]]


def components(table: Table) -> Integers:
    """The strongly connected component of each state."""
    count, width = table.delta.shape
    return strong_components(np.repeat(np.arange(count), width), table.delta.ravel(), count)
