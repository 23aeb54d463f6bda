"""Trackers that follow a formula only where the Zielonka tree of their condition needs its marks.

A leaf of the tree waits for colors outside of its label, so that marks inside of it need not be
seen. A guess may be made anew at any time, hence a tracker can sleep in these leaves. For limits
with memory this takes a sum over the leaves, in place of the product of all trackers.
"""

from __future__ import annotations

import numpy as np

from jaxltl.core.array_types import Integers
from jaxltl.core.automata.emerson_lei import Condition, ZielonkaTree
from jaxltl.core.automata.trackers import IDLE, States, Trackers, too_many_states


def track_on_demand(run: Trackers, max_states: int) -> tuple[Integers, Integers]:
    """A parity automaton of trackers: its transitions and priorities `[Q, L]`."""
    trees: dict[Condition, ZielonkaTree] = {}

    def settled(states: States, condition: Condition, live: int, leaf: int) -> _State:
        needed = trees[condition].missing[leaf]
        kept = (
            tracker.awake(q, bool(needed >> i & 1)) if live >> i & 1 else IDLE
            for i, (tracker, q) in enumerate(zip(run.trackers, states, strict=True))
        )
        return tuple(kept), condition, leaf

    def entered(states: States, condition: Condition, live: int) -> _State:
        if condition not in trees:
            trees[condition] = ZielonkaTree(condition, max_states)
        return settled(states, condition, live, trees[condition].leaf_below(0))

    start = entered(run.start, *run.remaining(run.start, run.condition))
    index = {start: 0}
    order = [start]
    rows, priorities = [], []
    for states, condition, leaf in order:
        tree = trees[condition]
        awake = tree.missing[leaf]
        heard = sum(
            1 << i
            for i, (t, q) in enumerate(zip(run.trackers, states, strict=True))
            if q >= 0 and (awake >> i & 1 or t.whole is not None)
        )
        row, marks = [], []
        for target, colors in run.successors(states, heard):
            remaining, live = run.remaining(target, condition)
            if remaining == condition:
                next_leaf, priority = tree.step(leaf, colors & awake)
                state = settled(target, condition, live, next_leaf)
            else:
                state, priority = entered(target, remaining, live), 1
            if state not in index:
                index[state] = len(order)
                order.append(state)
            row.append(index[state])
            marks.append(priority)
        place = run.heard(heard)[1]
        rows.append(np.array(row, np.int32)[place])
        priorities.append(np.array(marks, np.int32)[place])
        if len(order) > max_states:
            raise too_many_states(max_states)
    return np.stack(rows), np.stack(priorities)


_State = tuple[States, Condition, int]  # of the trackers, the condition that remains, the leaf
