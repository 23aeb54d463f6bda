"""What an automaton still asks for: whoever follows a sequence satisfies the task."""

import random

import numpy as np
import pytest

from jaxltl.core.automata.runs import live_states, universal_states
from jaxltl.core.automata.sequences import reach_avoid_sequences
from jaxltl.core.automata.translate import to_automaton
from tests.reference_logic import random_formula

NAMES = ("a", "b", "c")
EVENTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]], bool)
LETTERS = [[n for n, h in zip(NAMES, row, strict=True) if h] for row in EVENTS]


def column(automaton, event):
    seen = [EVENTS[event][NAMES.index(p)] for p in automaton.propositions]
    return int(np.flatnonzero((automaton.letters == seen).all(1))[0])


def follow(automaton, state, reach, rng):
    """The states and priorities of reading one wanted event after the other."""
    states, priorities = [state], []
    for row in reach:
        letter = column(automaton, rng.choice(np.flatnonzero(row)))
        priorities.append(int(automaton.priority[states[-1], letter]))
        states.append(int(automaton.delta[states[-1], letter]))
    return states, priorities


@pytest.mark.parametrize("seed", range(40))
def test_who_follows_a_sequence_is_accepted(seed):
    rng = np.random.default_rng(seed)
    formula = random_formula(random.Random(seed), 6, NAMES)
    automaton = to_automaton(formula, letters=LETTERS)
    depth = 40
    found = reach_avoid_sequences(automaton, EVENTS, NAMES, depth=depth, max_sequences=4)
    live, done = live_states(automaton), universal_states(automaton)
    assert ((found.length > 0).any(1) == (live & ~done)).all()
    assert not (found.reach & found.avoid).any()
    for q, m in np.argwhere(found.length > 0):
        size = found.length[q, m]
        rows = found.reach[q, m]
        asked = int(rows.any(1).sum())
        states, priorities = follow(automaton, q, rows[:asked], rng)
        if asked < depth:  # it ends where every word is accepted, and no sooner
            assert asked == size
            assert done[states[-1]]
            assert not done[states[:-1]].any()
        else:  # it goes round a cycle whose least priority is even
            assert min(priorities[len(priorities) // 2 :]) % 2 == 0
        for state, avoided in zip(states, found.avoid[q, m], strict=False):
            after = [automaton.delta[state, column(automaton, e)] for e in np.flatnonzero(~avoided)]
            assert live[after].all()  # what is not avoided loses nothing for good


def test_a_set_back_is_avoided_and_other_progress_is_not():
    task = to_automaton("F(a & (!b U c)) & F b", letters=LETTERS)
    found = reach_avoid_sequences(task, EVENTS, NAMES, depth=3, max_sequences=8)
    rows = np.flatnonzero(found.length[task.initial])
    orders = {tuple(tuple(np.flatnonzero(r)) for r in found.reach[task.initial, m]) for m in rows}
    assert ((1,), (3,), (2, 4)) in orders  # a, then c, then any b
    first = next(m for m in rows if found.reach[task.initial, m, 1, 3])
    assert found.avoid[task.initial, first, 1, 2]  # b between a and c sets back


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"events": [[0, 0]]}, "a column for each"),
        ({"propositions": ("a", "b", "x")}, "mentions the proposition 'c'"),
        ({"events": [[1, 1, 1]]}, r"does not read the event \{a, b, c\}"),
        ({"depth": 0}, "depth=0"),
        ({"max_sequences": 0}, "max_sequences=0"),
    ],
)
def test_bad_input_is_named(given, said):
    task = to_automaton("F (a & F (b & F c))", letters=LETTERS)
    with pytest.raises(ValueError, match=said):
        reach_avoid_sequences(
            **{"automaton": task, "events": EVENTS, "propositions": NAMES, **given}
        )
