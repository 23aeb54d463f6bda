"""Merging of states with the same language, refuted by counterexamples and proven by products."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.sparse.graph.components import forward_reachable, strong_components

MAX_PAIRS = 3_000_000  # pair transitions up to which languages of states are compared
FEW_PAIRS = 400_000  # up to which all pairs are compared at once
MAX_CANDIDATES = 200_000  # pairs of states that may be merged
MAX_ROUNDS = 12  # of comparisons with one state of each class
MERGE_WORK = 1_200_000  # pair transitions of the products that prove or refute merges: about .6 s
WINDOW = 1000  # merges that a counterexample is tried on
KNOWN = 20_000  # pairs of a merge and a counterexample to others that are tried first
UNREAD = 1 << 30  # above all priorities
TURNS = 4  # of a cycle before its priorities are read, and while they are


Word = tuple[Integers, Integers]  # the letters of a prefix and of a cycle


class Table(NamedTuple):
    """A parity automaton as bare arrays: `delta [Q, L]`, `priority [Q, L]`, an initial state."""

    delta: Integers
    priority: Integers
    initial: int


def distinct_columns(table: Table) -> tuple[Integers, Integers]:
    """Letters with different columns, and the place of each letter among them."""
    both = np.concatenate([table.delta, table.priority]).T
    _, first, inverse = np.unique(both, axis=0, return_index=True, return_inverse=True)
    return first, inverse.ravel()


def language_classes(table: Table) -> Integers | None:
    """The states grouped by language, int `[Q]`; None where that is too much work.

    Two states differ iff some word leads to cycles of even least priority p from one and of odd
    least priority r from the other: to a component of the pairs without priorities below these.
    """
    columns, _ = distinct_columns(table)
    few = Table(table.delta[:, columns], table.priority[:, columns], table.initial)
    count, width = few.delta.shape
    classes = np.zeros(count, np.int64)
    for _ in range(MAX_ROUNDS):
        apart = _differing(few, np.arange(count), classes)
        if apart is None or not apart.any():
            return None if apart is None else classes
        if count * count * width <= FEW_PAIRS:
            every = np.arange(count * count)
            apart = _differing(few, every // count, every % count)
            return None if apart is None else np.argmin(apart.reshape(count, count), axis=1)
        for old in np.unique(classes[apart]):
            members = np.flatnonzero(apart & (classes == old))
            classes[members] = members[0]
    return None


def _differing(table: Table, left: Integers, right: Integers) -> NDArray[np.bool_] | None:
    """The pairs of states with different languages; None where that is too much work."""
    pairs = left * len(table.delta) + right
    product = _product(table, table, np.unique(pairs))
    if product is None:
        return None
    number, edges, size = product
    differ = np.zeros(size, bool)
    for inside, _ in _different_loops(edges, size):
        differ[inside.source] = True
    differ = forward_reachable(edges.target, edges.source, differ)
    return np.asarray(differ[number[pairs]])


def _product(one: Table, two: Table, frontier: Integers) -> tuple[Integers, _Edges, int] | None:
    """The numbers of the pairs that are reachable from some, their transitions and their count."""
    count, width = two.delta.shape
    if len(one.delta) * count > MAX_PAIRS:
        return None
    number = np.full(len(one.delta) * count, -1)
    found, size = [], 0
    while frontier.size:
        number[frontier] = np.arange(size, size + frontier.size)
        found.append(frontier)
        size += frontier.size
        if size * width > MAX_PAIRS:
            return None
        ends = one.delta[frontier // count] * count + two.delta[frontier % count]
        frontier = np.unique(ends[number[ends] < 0])
    left, right = np.divmod(np.concatenate(found), count)
    follow = number[one.delta[left] * count + two.delta[right]]
    return number, _joint_edges(follow, one.priority[left], two.priority[right]), size


def merged(table: Table, order: int, work: int, words: list[Word]) -> tuple[Table, int]:
    """The table with states of one language merged, one after another, where the whole allows it.

    The `words` that refute merges of a table with the same language are tried first, and new ones
    are appended.
    """
    same = language_classes(table)
    if same is None or (np.bincount(same) ** 2).sum() > MAX_CANDIDATES:
        return table, work
    columns, place_of = distinct_columns(table)
    few = Table(table.delta[:, columns], table.priority[:, columns], int(table.initial))
    target = np.arange(len(same))
    kept, gone = _candidates(few, same, order)
    if words and len(kept):
        fine, count = np.ones(len(kept), bool), KNOWN // min(len(kept), WINDOW)
        known = [(place_of[prefix], place_of[cycle]) for prefix, cycle in words[-count:]]
        fine[:WINDOW] = _agreeing(few, kept[:WINDOW], gone[:WINDOW], known)
        kept, gone = kept[fine], gone[fine]
    together = 1  # merges that are tried at once
    while len(kept) and work > 0:
        trial = target.copy()
        for one, two in _independent(kept, gone, together):
            trial[target == two] = one
        small = Table(trial[few.delta], few.priority, int(trial[few.initial]))
        product = _product(few, small, np.array([few.initial * len(same) + small.initial]))
        if product is None:
            break
        _, edges, size = product
        work -= size * (few.delta.shape[1] // 4 + 4) + 1000
        loop = next(_different_loops(edges, size), None)
        if loop is None:
            few, target, together = small, trial, 2 * together
            fine = (target[kept] == kept) & (target[gone] == gone)
        elif together > 1:
            together = 1
            continue
        else:
            fine = np.ones(len(kept), bool)
            word = _lasso(edges, *loop)
            fine[:WINDOW] = _agreeing(few, kept[:WINDOW], gone[:WINDOW], [word])
            fine[0] = False
            words.append((columns[word[0]], columns[word[1]]))
        kept, gone = kept[fine], gone[fine]
    return Table(target[table.delta], table.priority, int(target[table.initial])), work


def _independent(kept: Integers, gone: Integers, count: int) -> list[tuple[int, int]]:
    """The first of some merges, none of which touches a state that another removes."""
    chosen: list[tuple[int, int]] = []
    stay: set[int] = set()
    leave: set[int] = set()
    for one, two in zip(kept[: 50 * count].tolist(), gone[: 50 * count].tolist(), strict=True):
        if one not in leave and two not in leave and two not in stay:
            chosen.append((one, two))
            stay.add(one)
            leave.add(two)
            if len(chosen) == count:
                break
    return chosen


def _candidates(table: Table, same: Integers, order: int) -> tuple[Integers, Integers]:
    """The pairs of states of one language, those with similar transitions first if order is 1."""
    kept, gone = np.nonzero((same[:, None] == same[None]) & ~np.eye(len(same), dtype=bool))
    alike = np.zeros(len(kept), int)
    for table_of in (table.delta, table.priority):
        for column in table_of.T:
            alike += column[kept] == column[gone]
    ranks = np.argsort(-order * alike, kind="stable")
    return kept[ranks], gone[ranks]


class _Edges(NamedTuple):
    """Transitions of a product of two automata, those with equal ends and priorities once."""

    source: Integers
    target: Integers
    left: Integers
    right: Integers
    letter: Integers

    def chosen(self, mask: NDArray[np.bool_]) -> _Edges:
        return _Edges(*(column[mask] for column in self))


def _joint_edges(delta: Integers, left: Integers, right: Integers) -> _Edges:
    width = delta.shape[1]
    levels = int(max(left.max(), right.max())) + 1
    code = (delta.astype(np.int64) * levels + left) * levels + right
    code = np.sort(code * width + np.arange(width), axis=1)
    first = np.ones(code.shape, bool)
    first[:, 1:] = code[:, 1:] // width != code[:, :-1] // width
    source, _ = np.nonzero(first)
    rest, letter = np.divmod(code[first], width)
    rest, right = np.divmod(rest, levels)
    target, left = np.divmod(rest, levels)
    return _Edges(source, target, left, right, letter)


def _different_loops(every: _Edges, count: int) -> Iterator[tuple[_Edges, list[NDArray[np.bool_]]]]:
    """The components with cycles of different verdicts, and where each least priority is.

    If the least priorities of a component agree in parity, a cycle that shows a difference lacks
    those of the one or those of the other automaton.
    """
    waiting = [every]
    while waiting:
        edges = waiting.pop()
        if (edges.left == edges.right).all():
            continue
        component = strong_components(edges.source, edges.target, count)
        edges = edges.chosen(component[edges.source] == component[edges.target])
        # Where both read the same priorities, all cycles agree.
        unequal = np.zeros(count, bool)
        unequal[component[edges.source[edges.left != edges.right]]] = True
        edges = edges.chosen(unequal[component[edges.source]])
        if not len(edges.source):
            continue
        of = component[edges.source]
        least = np.full((2, count), 1 << 30)
        np.minimum.at(least[0], of, edges.left)
        np.minimum.at(least[1], of, edges.right)
        bad = least[0] % 2 != least[1] % 2
        lowest = edges.left == least[0][of], edges.right == least[1][of]
        for each in np.flatnonzero(bad):
            inside = of == each
            yield edges.chosen(inside), [marks[inside] for marks in lowest]
        unlike = np.zeros(count, bool)
        unlike[of[lowest[0] != lowest[1]]] = True
        waiting.append(edges.chosen(~bad[of] & ~lowest[0]))
        waiting.append(edges.chosen(~bad[of] & unlike[of] & ~lowest[1]))


def _lasso(every: _Edges, inside: _Edges, marks: list[NDArray[np.bool_]]) -> Word:
    """The letters of a cycle inside a component through each of two marks, and those to it."""
    one, two = (int(np.argmax(mark)) for mark in marks)
    start = int(inside.source[one])
    prefix = _walk(every, 0, start)
    if marks[1][one]:
        two = one
    cycle, end = [int(inside.letter[one])], int(inside.target[one])
    if two != one:
        cycle += [*_walk(inside, end, int(inside.source[two])), int(inside.letter[two])]
        end = int(inside.target[two])
    return np.array(prefix, int), np.array(cycle + _walk(inside, end, start))


def _walk(edges: _Edges, start: int, goal: int) -> list[int]:
    """The letters of a shortest path from a node to another."""
    last = np.full(int(edges.target.max()) + 1, -1)  # edge to each node on a shortest path
    reached = np.zeros(max(len(last), start + 1, int(edges.source.max()) + 1), bool)
    reached[start] = True
    while not reached[goal]:
        fresh = np.flatnonzero(reached[edges.source] & ~reached[edges.target])
        last[edges.target[fresh]] = fresh
        reached[edges.target[fresh]] = True
    letters = []
    while goal != start:
        letters.append(int(edges.letter[last[goal]]))
        goal = int(edges.source[last[goal]])
    return letters[::-1]


def _agreeing(table: Table, kept: Integers, gone: Integers, words: list[Word]) -> NDArray[np.bool_]:
    """The merges, each alone, with which words seem to have the verdicts that they have without."""
    reads = max(len(prefix) + len(cycle) * 2 * TURNS for prefix, cycle in words)
    letters = np.array([np.append(p, np.resize(c, reads - len(p))) for p, c in words])
    begin = np.array([len(p) + len(c) * TURNS for p, c in words])
    kept, gone = np.append(table.initial, kept), np.append(table.initial, gone)  # first: none
    state = np.where(gone == table.initial, kept, table.initial)[None].repeat(len(words), axis=0)
    least = np.full(state.shape, UNREAD)
    delta, priority, width = table.delta.ravel(), table.priority.ravel(), table.delta.shape[1]
    for step, letter in enumerate(letters.T[:, :, None]):
        place = state * width + letter
        if step >= begin.min():
            late = np.where(begin <= step, 0, UNREAD)[:, None]
            np.minimum(least, priority[place] + late, out=least)
        state = delta[place]
        np.copyto(state, kept, where=state == gone)
    return np.asarray((least % 2 == least[:, :1] % 2)[:, 1:].all(axis=0))
