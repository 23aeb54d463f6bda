"""Automata with fewer states: quotients, and Hopcroft's partition of equivalent states."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.automata.automaton import Automaton


def minimize(automaton: Automaton) -> Automaton:
    """Minimal automaton with the same priorities along every run, by `equivalence_classes`.

    Co-safe and safety automata of one language, over the same letters, give identical tables.
    """
    return quotient(automaton, equivalence_classes(automaton))


def quotient(automaton: Automaton, classes: NDArray[np.int32]) -> Automaton:
    """Quotient automaton by an equivalence of states."""
    kept = np.flatnonzero(classes >= 0)
    _, first = np.unique(classes[kept], return_index=True)
    members = kept[first]  # one state of each class, in the order of the classes
    names: dict[int, str] = {}
    for q in kept if automaton.state_names else ():
        name = automaton.state_names[q]
        names[classes[q]] = min(names.get(classes[q], name), name, key=len)
    return replace(
        automaton,
        delta=classes[automaton.delta[members]],
        initial=np.asarray(classes[int(automaton.initial)], np.int32),
        priority=automaton.priority[members],
        state_names=tuple(names[c] for c in sorted(names)),
    )


def equivalence_classes(automaton: Automaton) -> NDArray[np.int32]:
    """The state of `minimize(automaton)` that each state becomes, -1 if it is unreachable.

    Partition refinement by the smaller half of a split block (Hopcroft 1971, "An n log n algorithm
    for minimizing states in a finite automaton"), numbered breadth first.
    """
    reached = _breadth_first(automaton.delta, int(automaton.initial))
    position = np.full(len(automaton.delta), -1)
    position[reached] = np.arange(len(reached))
    # Letters with equal columns are one letter to Hopcroft's algorithm.
    delta = np.unique(position[automaton.delta[reached]], axis=1)
    _, output = np.unique(automaton.priority[reached], axis=0, return_inverse=True)
    blocks = _coarsest_partition(delta, output.ravel())
    order = np.full(blocks.max() + 1, -1)
    found, first = np.unique(blocks, return_index=True)  # reached is in breadth-first order
    order[found[np.argsort(first)]] = np.arange(len(found))
    classes = np.full(len(automaton.delta), -1, np.int32)
    classes[reached] = order[blocks]
    return classes


def _breadth_first(delta: Integers, start: int) -> list[int]:
    order = {start: None}
    queue = [start]
    for state in queue:
        for successor in dict.fromkeys(delta[state].tolist()):
            if successor not in order:
                order[successor] = None
                queue.append(successor)
    return queue


def _coarsest_partition(delta: Integers, output: Integers) -> NDArray[np.int64]:
    count, width = delta.shape
    before: list[list[list[int]]] = [[[] for _ in range(count)] for _ in range(width)]
    for q, row in enumerate(delta.tolist()):
        for letter, successor in enumerate(row):
            before[letter][successor].append(q)
    block_of = output.tolist()
    members: list[set[int]] = [set() for _ in range(max(block_of) + 1)]
    for q, block in enumerate(block_of):
        members[block].add(q)
    largest = max(range(len(members)), key=lambda block: len(members[block]))
    waiting = [block for block in range(len(members)) if block != largest]
    while waiting:
        splitter = list(members[waiting.pop()])
        for sources in before:
            hit = defaultdict(set)
            for q in splitter:
                for source in sources[q]:
                    hit[block_of[source]].add(source)
            for block, inside in hit.items():
                whole = members[block]
                if len(inside) == len(whole):
                    continue
                # The smaller half gets the new number, so that a state is renumbered O(log Q)
                # times; the larger half stays in `waiting` if the block was there.
                smaller = inside if 2 * len(inside) <= len(whole) else whole - inside
                whole -= smaller
                members.append(smaller)
                for q in smaller:
                    block_of[q] = len(members) - 1
                waiting.append(len(members) - 1)
    return np.array(block_of)
