"""State reduction of deterministic parity automata, to (co-)safety or Buchi where possible.

States with the same language need not stand side by side: of all that have it, those lowest in
the order of strongly connected components suffice, because a run can move down only finitely
often. Where no component has cycles of both verdicts, the automaton is weak and its minimal form
is unique (Loeding 2001, "Efficient minimization of deterministic weak omega-automata").
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.automata.automaton import Automaton, condition_of
from jaxltl.core.automata.emerson_lei import parity_condition, to_parity
from jaxltl.core.automata.merging import MERGE_WORK, language_classes, merged
from jaxltl.core.automata.products import EVEN, ODD, states_that_may
from jaxltl.core.automata.table import ParityTable, components, distinct_columns, quotient

ORDERS = (1, -1)  # similar states first, different ones first


def simplify(automaton: Automaton) -> Automaton:
    """A small automaton with the same language and the simplest acceptance that it allows.

    Co-safe or safety (then minimal), else Buchi where the language has a deterministic Buchi
    automaton, else parity. If every cycle's verdict is that of its component, it is minimal too.
    """
    table = ParityTable(automaton.delta, automaton.priority, int(automaton.initial))
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


def reduce_table(table: ParityTable, thorough: bool = True) -> tuple[ParityTable, str, Integers]:
    """The small table, its acceptance, and an old state of each new one; `thorough` is slow."""
    columns, inverse = distinct_columns(*table[:2])
    few = ParityTable(table.delta[:, columns], table.priority[:, columns], table.initial)
    every, work = np.arange(len(table.delta)), MERGE_WORK
    best: tuple[ParityTable, Integers] | None = None
    for order in ORDERS if thorough else (None,):  # another order may merge more, if one merges any
        small, base, work = _reduced(few, every, order, work)
        if best is None or len(small.delta) < len(best[0].delta):
            best = small, base
        if work <= 0 or len(small.delta) == len(few.delta) or is_weak(small):
            break
    assert best is not None
    few, base = best
    wide = ParityTable(few.delta[:, inverse], few.priority[:, inverse], few.initial)
    return wide, _acceptance(few), base


def _reduced(
    few: ParityTable, base: Integers, order: int | None, work: int
) -> tuple[ParityTable, Integers, int]:
    """The table after the steps that make it smaller, merging states in an order if one is given."""
    while True:
        for step in (quotient, _fewest_priorities, quotient):
            few, old = step(few)
            base = base[old]
        size = len(few.delta)
        if is_weak(few):
            few, old = _weak_minimal(few)
            return _early(few), base[old], work
        few, old = _move_down(few)
        base = base[old]
        if len(few.delta) < size:
            continue
        if order is not None:
            table, work = merged(few, order, work)
            few, old = quotient(table)
            base = base[old]
        if len(few.delta) == size:
            return few, base, work


def _acceptance(table: ParityTable) -> str:
    """The kind of a reduced table."""
    delta, priority = table.delta, table.priority
    if (priority == priority[:, :1]).all() and priority.max() <= 1:
        final = priority[:, 0] == 0
        if final[delta[final]].all():
            return "cosafe"
        if not final[delta[~final]].any():
            return "safety"
    return condition_of(priority)


# --- Steps that keep the language: the new table, and an old state of each new one -----------


def _fewest_priorities(table: ParityTable) -> tuple[ParityTable, Integers]:
    """The same automaton with the fewest priorities, transient transitions at 1."""
    condition = parity_condition(int(table.priority.max()) + 1)
    marks = np.left_shift(1, table.priority.astype(np.int64))
    delta, priority, initial, base = to_parity(table.delta, marks, table.initial, condition)
    return ParityTable(delta, priority, initial), base


def _cycles(table: ParityTable) -> tuple[Integers, Booleans, Integers]:
    """Components, the transitions `[Q, L]` that stay in theirs, and the components of these."""
    component = components(table)
    inside = component[table.delta] == component[:, None]
    return component, inside, component[np.nonzero(inside)[0]]


def is_weak(table: ParityTable) -> bool:
    """True if no component has cycles of both verdicts; priorities must be the fewest."""
    component, inside, of = _cycles(table)
    low, high = np.full(len(component), table.priority.max() + 1), np.full(len(component), -1)
    np.minimum.at(low, of, table.priority[inside])
    np.maximum.at(high, of, table.priority[inside])
    return bool((low >= high).all())


def _reach(delta: Integers) -> Booleans:
    """bool `[Q, Q]`: which states are reachable from which, themselves included."""
    count = len(delta)
    reach = np.eye(count, dtype=bool)
    reach[np.arange(count)[:, None], delta] = True
    while True:
        wider = (reach.astype(np.float32) @ reach.astype(np.float32)) > 0
        if (wider == reach).all():
            return reach
        reach = wider


def _on_states(table: ParityTable, priority: Integers) -> ParityTable:
    """The table with a priority for each state."""
    return table._replace(priority=np.repeat(priority[:, None], table.delta.shape[1], axis=1))


def _weak_minimal(table: ParityTable) -> tuple[ParityTable, Integers]:
    """The minimal form of a weak automaton, priorities 0 and 1 on states."""
    component, inside, of = _cycles(table)
    level = np.zeros(len(component), int)
    verdict = np.full(len(component), -1)  # -1: transient
    verdict[of] = table.priority[inside] % 2
    # The level of a component is the greatest below it, raised where its verdict asks so.
    source = np.repeat(component, table.delta.shape[1])
    target = component[table.delta].ravel()
    while True:
        higher = np.zeros_like(level)
        np.maximum.at(higher, source, np.where(source == target, 0, level[target]))
        higher += (verdict >= 0) & (higher % 2 != verdict)
        if (higher == level).all():
            return quotient(_on_states(table, level[component] % 2))
        level = higher


def _early(table: ParityTable) -> ParityTable:
    """A weak automaton with the earliest verdicts, if its language is co-safe or safe."""
    _, inside, _ = _cycles(table)
    good, bad = ((inside & (table.priority % 2 == parity)).any(axis=1) for parity in (0, 1))
    universal, live = ~states_that_may(table, ODD), states_that_may(table, EVEN)
    for final in (universal, live):
        if (good <= final).all() and (bad <= ~final).all():
            return _on_states(table, 1 - final)
    return table


def _move_down(table: ParityTable) -> tuple[ParityTable, Integers]:
    """Replaces states by others of their language in the lowest component that has one."""
    same = language_classes(table)
    count = len(table.delta)
    if same is None or len(np.unique(same)) == count:
        return table, np.arange(count)
    rank = _reach(table.delta).sum(axis=1) * count + components(table)  # lower below
    target = np.arange(count)
    for state in np.unique(same):
        members = np.flatnonzero(same == state)
        lowest = members[rank[members] == rank[members].min()]
        target[np.setdiff1d(members, lowest)] = lowest[0]
    return quotient(ParityTable(target[table.delta], table.priority, int(target[table.initial])))
