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
from jaxltl.core.automata.products import (
    EVEN,
    ODD,
    Word,
    loops,
    may,
    product,
    states_that_may,
    word_through,
)
from jaxltl.core.automata.table import ParityTable, components, distinct_columns, quotient


MAX_PAIRS = 3_000_000  # pair transitions up to which languages of states are compared
FEW_PAIRS = 400_000  # up to which all pairs are compared at once
MAX_CANDIDATES = 200_000  # pairs of states that may be merged
MAX_ROUNDS = 12  # of comparisons with one state of each class
MERGE_WORK = 1_200_000  # pair transitions of the products that prove or refute merges: about .6 s
WINDOW = 1000  # merges that a counterexample is tried on
TURNS = 4  # of a cycle before its priorities are read, and while they are

DIFFERENT = ((EVEN, ODD), (ODD, EVEN))


def language_classes(table: ParityTable) -> Integers | None:
    """The states grouped by language, int `[Q]`; None where that is too much work."""
    columns, _ = distinct_columns(*table[:2])
    few = ParityTable(table.delta[:, columns], table.priority[:, columns], table.initial)
    count, width = few.delta.shape
    classes = np.zeros(count, np.int64)
    for _ in range(MAX_ROUNDS):
        apart = _differing(few, np.arange(count) * count + classes)
        if apart is None or not apart.any():
            return None if apart is None else classes
        if count * count * width <= FEW_PAIRS:
            apart = _differing(few, np.arange(count * count))
            return None if apart is None else np.argmin(apart.reshape(count, count), axis=1)
        for old in np.unique(classes[apart]):
            members = np.flatnonzero(apart & (classes == old))
            classes[members] = members[0]
    return None


def _differing(table: ParityTable, pairs: Integers) -> Booleans | None:
    """The pairs of states with different languages; None where that is too much work."""
    both = product([table, table], np.unique(pairs), MAX_PAIRS)
    if both is None:
        return None
    return may(both.edges, len(both.states), DIFFERENT)[both.number[pairs]]


def merged(table: ParityTable, order: int, work: int) -> tuple[ParityTable, int]:
    """The table with states of one language merged, one after another, where the whole allows it.

    `work` limits the pair transitions of the products that decide; what is left is returned.
    """
    same = language_classes(table)
    if same is None or (np.bincount(same) ** 2).sum() > MAX_CANDIDATES:
        return table, work
    columns, _ = distinct_columns(*table[:2])
    few = ParityTable(table.delta[:, columns], table.priority[:, columns], int(table.initial))
    target = np.arange(len(same))
    survivor, gone = _candidates(few, same, order)
    while len(survivor) and work > 0:
        trial = np.where(target == gone[0], survivor[0], target)
        small = ParityTable(trial[few.delta], few.priority, int(trial[few.initial]))
        both = product([few, small], max_size=MAX_PAIRS)
        if both is None:
            break
        size = len(both.states)
        work -= size * (few.delta.shape[1] // 4 + 4) + 1000
        difference = next(loops(both.edges, size, DIFFERENT), None)
        if difference is None:
            few, target = small, trial
            fine = (target[survivor] == survivor) & (target[gone] == gone)
        else:
            word = word_through(both.edges, size, *difference)
            fine = np.ones(len(survivor), bool)
            fine[:WINDOW] = _agreeing(few, survivor[:WINDOW], gone[:WINDOW], word)
            fine[0] = False
        survivor, gone = survivor[fine], gone[fine]
    return ParityTable(target[table.delta], table.priority, int(target[table.initial])), work


def _candidates(table: ParityTable, same: Integers, order: int) -> tuple[Integers, Integers]:
    """The pairs of states of one language, those with similar transitions first if order is 1."""
    survivor, gone = np.nonzero((same[:, None] == same[None]) & ~np.eye(len(same), dtype=bool))
    alike = np.zeros(len(survivor), int)
    for column in np.concatenate(table[:2], axis=1).T:
        alike += column[survivor] == column[gone]
    ranks = np.argsort(-order * alike, kind="stable")
    return survivor[ranks], gone[ranks]


def _agreeing(table: ParityTable, survivor: Integers, gone: Integers, word: Word) -> Booleans:
    """The merges, each alone, with which a word seems to have the verdict that it has without."""
    prefix, cycle = word
    letters = np.concatenate([prefix, np.tile(cycle, 2 * TURNS)])
    survivor, gone = (
        np.append(table.initial, survivor),
        np.append(table.initial, gone),
    )  # first: none
    state = np.where(gone == table.initial, survivor, table.initial)
    least = table.priority.max() + np.ones_like(state)
    for step, letter in enumerate(letters):
        if step >= len(prefix) + len(cycle) * TURNS:
            least = np.minimum(least, table.priority[state, letter])
        state = table.delta[state, letter]
        state = np.where(state == gone, survivor, state)
    return np.asarray((least % 2 == least[0] % 2)[1:])


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
