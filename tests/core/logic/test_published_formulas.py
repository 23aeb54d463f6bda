"""The formulas of the dissertation, and its automata written down by hand."""

import numpy as np
import pytest

from jaxltl.core.automata.automaton import make_automaton
from jaxltl.core.automata.language import is_equivalent
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.logic.ltl import holds_on_lasso


def by_hand(propositions, step, accepting):
    """A Buchi automaton on states, from a function of state and letter."""
    letters = [
        [bool(n >> p & 1) for p in range(len(propositions))] for n in range(2 ** len(propositions))
    ]
    held = [{p for p, holds in zip(propositions, row, strict=True) if holds} for row in letters]
    delta = [[step(q, letter) for letter in held] for q in range(len(accepting))]
    return make_automaton(delta, 0, letters, propositions, accepting=accepting)


def answering(q, letter):
    """Figure 15: waiting (1) from a request until a response, one moment serving both."""
    if "response" in letter:
        return 0
    return 1 if q == 1 or "request" in letter else 0


def charging(q, letter):
    """Figure 15: 0 after a low battery, 1 while it is not low yet, 2 once charged before that."""
    if q == 2 or "battery_low" in letter:
        return q if q == 2 else 0
    return 2 if "charge" in letter else 1


def posting(q, letter):
    """Figure 17: q_1 to q_4 are 0 to 3; q_4 is entered when the second office is visited."""
    p1, p2 = "p1" in letter, "p2" in letter
    if q in (0, 3):
        return 3 if p1 and p2 else 1 if p1 else 2 if p2 else 0
    if q == 1:
        return 3 if p2 else 1
    return 3 if p1 else 2


@pytest.mark.parametrize(
    ("text", "drawn", "acceptance", "states"),
    [
        (
            "G safe_region",
            by_hand(["safe_region"], lambda q, x: q or int("safe_region" not in x), [True, False]),
            "safety",
            2,
        ),
        (
            "F goal",
            by_hand(["goal"], lambda q, x: q or int("goal" in x), [False, True]),
            "cosafe",
            2,
        ),
        (
            "G (request -> F response)",
            by_hand(["request", "response"], answering, [True, False]),
            "buchi",
            2,
        ),
        (
            "G (!charge U battery_low)",
            by_hand(["battery_low", "charge"], charging, [True, False, False]),
            "buchi",
            2,
        ),
        (
            "G F p1 & G F p2",
            by_hand(["p1", "p2"], posting, [False, False, False, True]),
            "buchi",
            2,
        ),
    ],
)
def test_the_drawn_automata(text, drawn, acceptance, states):
    ours = to_automaton(text)
    assert is_equivalent(ours, drawn)
    # Acceptance on transitions may need fewer states than the figure, never more.
    assert ours.acceptance == acceptance and len(ours.delta) == states <= len(drawn.delta)


def robots(side):
    """The letters of two robots on a grid, and the safety formula of chapter 5's Example 1."""
    cells = range(side * side)
    letters = [{f"x{i}", f"y{j}"} for i in cells for j in cells]
    apart = " & ".join(f"(x{i} -> !y{i})" for i in cells)
    return letters, f"{apart} & G ({apart})"


def test_two_robots_apart():
    letters, safe = robots(10)  # 200 propositions, 10,000 letters
    automaton = to_automaton(safe, letters)
    assert automaton.acceptance == "safety" and automaton.delta.shape == (2, 10_000)
    assert automaton.final.tolist() == [True, False]
    held = [
        {p for p, holds in zip(automaton.propositions, row, strict=True) if holds}
        for row in automaton.letters
    ]
    clash = np.array(
        [{x[1:] for x in row if x[0] == "x"} == {x[1:] for x in row if x[0] == "y"} for row in held]
    )
    assert np.array_equal(automaton.delta[0], clash.astype(int))


def test_two_robots_who_take_turns_at_the_corners():
    side = 2
    letters, safe = robots(side)
    last, corners = side * side - 1, f"G F y{side - 1} & G F y{side * side - side}"
    assumed = to_automaton(f"{safe} & ((G F x0 & G F x{last}) -> ({corners}))", letters)
    assert assumed.acceptance == "parity" and set(np.unique(assumed.priority)) == {0, 1, 2}
    often = to_automaton(f"{safe} & G F (y{side * side - side} | y{side - 1})", letters)
    assert often.acceptance == "buchi" and len(often.delta) == 2


def test_the_task_of_the_two_goals():
    text = "(!r & !y) -> ((!r U y) & (!y U g1) & (!y U g2) & F y)"
    letters = [set(), {"r"}, {"y"}, {"g1"}, {"g2"}]
    task = to_automaton(text, letters)
    assert task.acceptance == "cosafe"
    for word, holds in [
        ([{"g1"}, {"g2"}, set(), {"y"}], True),
        ([{"g2"}, {"g1"}, {"y"}], True),
        ([{"g1"}, {"y"}], False),
        ([set(), {"g1"}, {"r"}, {"g2"}, {"y"}], False),
    ]:
        assert holds_on_lasso(text, word, [set()]) == holds
        state = 0
        for letter in word:
            names = [set(np.array(task.propositions)[row]) for row in task.letters]
            state = task.delta[state, names.index(letter)]
        assert task.final[state] == holds
