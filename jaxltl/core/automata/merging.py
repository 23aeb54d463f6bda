"""Merging of states with the same language, refuted by counterexamples and proven by products."""

from __future__ import annotations

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.automata.products import EVEN, ODD, Word, loops, may, product, word_through
from jaxltl.core.automata.table import ParityTable, distinct_columns

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
