"""State reduction of deterministic parity automata, to (co-)safety or Buchi where possible.

States with the same language need not stand side by side: of all that have it, those lowest in
the order of strongly connected components suffice, because a run can move down only finitely
often. Where no component has cycles of both verdicts, the automaton is weak and its minimal form
is unique (Loeding 2001, "Efficient minimization of deterministic weak omega-automata").
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.emerson_lei import parity_condition, to_parity
from jaxltl.core.automata.merging import (
    MERGE_WORK,
    Table,
    Word,
    distinct_columns,
    language_classes,
    merged,
)
from jaxltl.core.sparse.graph.components import strong_components

ORDERS = (1, -1)  # similar states first, different ones first


def simplify(automaton: Automaton) -> Automaton:
    """A small automaton with the same language and the simplest acceptance that it allows.

    Co-safe or safety (then minimal), else Buchi where the language has a deterministic Buchi
    automaton, else parity. If every cycle's verdict is that of its component, it is minimal too.
    """
    table = Table(automaton.delta, automaton.priority, int(automaton.initial))
    small, kind, base = reduce_table(table)
    names = automaton.state_names
    return replace(
        automaton,
        delta=small.delta.astype(np.int32),
        priority=small.priority.astype(np.int32),
        initial=np.asarray(small.initial, np.int32),
        acceptance=kind,
        state_names=tuple(names[q] for q in base) if names else (),
    )


def reduce_table(table: Table, thorough: bool = True) -> tuple[Table, str, Integers]:
    """The small table, its acceptance, and an old state of each new one; `thorough` is slow."""
    columns, inverse = distinct_columns(table)
    few = Table(table.delta[:, columns], table.priority[:, columns], table.initial)
    every, work = np.arange(len(table.delta)), MERGE_WORK
    words: list[Word] = []
    best: tuple[Table, Integers] | None = None
    for order in ORDERS if thorough else (None,):  # another order may merge more, if one merges any
        small, base, work = _reduced(few, every, order, work, words)
        if best is None or len(small.delta) < len(best[0].delta):
            best = small, base
        if work <= 0 or len(small.delta) == len(few.delta) or is_weak(small):
            break
    assert best is not None
    few, base = best
    return (
        Table(few.delta[:, inverse], few.priority[:, inverse], few.initial),
        _acceptance(few),
        base,
    )


def _reduced(
    few: Table, base: Integers, order: int | None, work: int, words: list[Word]
) -> tuple[Table, Integers, int]:
    """The table after the steps that make it smaller, merging states in an order if one is given."""
    while True:
        few, base = _composed(quotient_table(few), base)
        few, base = _composed(_fewest_priorities(few), base)
        few, base = _composed(quotient_table(few), base)
        if is_weak(few):
            few, base = _composed(_weak_minimal(few), base)
            return _early(few), base, work
        size = len(few.delta)
        few, base = _composed(_move_down(few), base)
        if len(few.delta) < size:
            continue
        if order is not None:
            table, work = merged(few, order, work, words)
            few, base = _composed(quotient_table(table), base)
        if len(few.delta) == size:
            return few, base, work


def _composed(step: tuple[Table, Integers], base: Integers) -> tuple[Table, Integers]:
    return step[0], base[step[1]]


def _acceptance(table: Table) -> str:
    """The kind of a reduced table."""
    delta, priority = table.delta, table.priority
    if (priority == priority[:, :1]).all() and priority.max() <= 1:
        final = priority[:, 0] == 0
        if final[delta[final]].all():
            return "cosafe"
        if not final[delta[~final]].any():
            return "safety"
    return "buchi" if priority.max() <= 1 else "parity"


# ---------------------------------------------------------------------------------------------
# Steps that keep the language
# ---------------------------------------------------------------------------------------------


def quotient_table(table: Table) -> tuple[Table, Integers]:
    """Reachable states, merged where every word reads the same priorities (Moore 1956)."""
    (delta, priority, _), old = reachable(table)
    _, block = np.unique(priority, axis=0, return_inverse=True)
    block = block.ravel()
    count = block.max() + 1
    while count < len(delta):
        signature = np.concatenate([block[:, None], block[delta]], axis=1)
        _, block = np.unique(signature, axis=0, return_inverse=True)
        block = block.ravel()
        if block.max() + 1 == count:
            break
        count = block.max() + 1
    _, first = np.unique(block, return_index=True)
    small = Table(block[delta[first]], priority[first], int(block[0]))
    ordered, order = reachable(small)
    return ordered, old[first[order]]


def _order(table: Table) -> Integers:
    """The reachable states, breadth first."""
    seen = {table.initial: None}
    rows = table.delta.tolist()
    for state in (queue := [table.initial]):
        for successor in dict.fromkeys(rows[state]):
            if successor not in seen:
                seen[successor] = None
                queue.append(successor)
    return np.array(queue)


def reachable(table: Table) -> tuple[Table, Integers]:
    """The reachable part, renumbered breadth first, and the old numbers."""
    order = _order(table)
    position = np.full(len(table.delta), -1)
    position[order] = np.arange(len(order))
    return Table(position[table.delta[order]], table.priority[order], 0), order


def _fewest_priorities(table: Table) -> tuple[Table, Integers]:
    """The same automaton with the fewest priorities, transient transitions at 1."""
    condition = parity_condition(int(table.priority.max()) + 1)
    marks = np.left_shift(1, table.priority.astype(np.int64))
    delta, priority, initial, base = to_parity(table.delta, marks, table.initial, condition)
    return Table(delta, priority, initial), base


def components(table: Table) -> Integers:
    """The strongly connected component of each state."""
    count, width = table.delta.shape
    source = np.repeat(np.arange(count), width)
    return strong_components(source, table.delta.ravel(), count)


def is_weak(table: Table) -> bool:
    """True if no component has cycles of both verdicts; priorities must be the fewest."""
    component = components(table)
    inside = component[table.delta] == component[:, None]
    low = np.full(component.max() + 1, table.priority.max() + 1)
    high = np.full(component.max() + 1, -1)
    states = np.broadcast_to(component[:, None], inside.shape)[inside]
    np.minimum.at(low, states, table.priority[inside])
    np.maximum.at(high, states, table.priority[inside])
    return bool((low >= high).all())


def _reach(delta: Integers) -> NDArray[np.bool_]:
    """bool `[Q, Q]`: which states are reachable from which, themselves included."""
    count = len(delta)
    reach = np.eye(count, dtype=bool)
    reach[np.arange(count)[:, None], delta] = True
    while True:
        wider = (reach.astype(np.float32) @ reach.astype(np.float32)) > 0
        if (wider == reach).all():
            return reach
        reach = wider


def _weak_minimal(table: Table) -> tuple[Table, Integers]:
    """The minimal form of a weak automaton, priorities 0 and 1 on states."""
    component = components(table)
    level = np.zeros(component.max() + 1, int)
    inside = component[table.delta] == component[:, None]
    verdict = np.full(component.max() + 1, -1)  # -1: transient
    states = np.broadcast_to(component[:, None], inside.shape)[inside]
    verdict[states] = table.priority[inside] % 2
    # The level of a component is the greatest below it, raised where its verdict asks so.
    source = np.repeat(component, table.delta.shape[1])
    target = component[table.delta].ravel()
    while True:
        higher = np.zeros_like(level)
        np.maximum.at(higher, source, np.where(source == target, 0, level[target]))
        higher += (verdict >= 0) & (higher % 2 != verdict)
        if (higher == level).all():
            break
        level = higher
    priority = np.repeat((level % 2)[component][:, None], table.delta.shape[1], axis=1)
    return quotient_table(Table(table.delta, priority, table.initial))


def _early(table: Table) -> Table:
    """A weak automaton with the earliest verdicts, if its language is co-safe or safe."""
    component = components(table)
    inside = component[table.delta] == component[:, None]
    good, bad = ((inside & (table.priority % 2 == parity)).any(axis=1) for parity in (0, 1))
    reach = _reach(table.delta)
    universal, live = ~(reach & bad).any(axis=1), (reach & good).any(axis=1)
    if (good <= universal).all():
        final = universal
    elif (bad <= ~live).all():
        final = live
    else:
        return table
    priority = np.repeat(np.where(final, 0, 1)[:, None], table.delta.shape[1], axis=1)
    return table._replace(priority=priority)


def _move_down(table: Table) -> tuple[Table, Integers]:
    """Replaces states by others of their language in the lowest component that has one."""
    same = language_classes(table)
    count = len(table.delta)
    if same is None or len(np.unique(same)) == count:
        return table, np.arange(count)
    component = components(table)
    rank = _reach(table.delta).sum(axis=1) * count + component  # lower below
    target = np.arange(count)
    for state in np.unique(same):
        members = np.flatnonzero(same == state)
        lowest = members[rank[members] == rank[members].min()]
        target[np.setdiff1d(members, lowest)] = lowest[0]
    moved = Table(target[table.delta], table.priority, int(target[table.initial]))
    return quotient_table(moved)
