"""Readable forms of automata whose acceptance is on transitions, and the cover behind guards."""

import random
from itertools import combinations

import numpy as np
import pytest

from jaxltl.core.automata.automaton import make_automaton
from jaxltl.core.automata.text import edge_guards, guards, prime_cover, to_dot, to_text
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.logic.ltl import holds_on_lasso


def inside(cube, number):
    return all(bool(number >> p & 1) == value for p, value in cube)


@pytest.mark.parametrize("density", [0.2, 0.5, 1.0])
def test_a_cover_is_exact_prime_and_irredundant(density):
    rng = random.Random(7)
    sizes = set()
    for _ in range(150):
        width = rng.randint(0, 5)
        known = [n for n in range(2**width) if rng.random() < density]
        chosen = {n for n in known if rng.random() < 0.5}
        others = set(known) - chosen
        cubes = prime_cover(chosen, others, width)
        sizes.add(len(cubes))
        assert {n for n in known if any(inside(c, n) for c in cubes)} == chosen
        for cube in cubes:
            rest = [other for other in cubes if other != cube]
            assert any(not any(inside(other, n) for other in rest) for n in chosen), cubes
            for shorter in combinations(cube, max(len(cube) - 1, 0)):
                assert not cube or any(inside(shorter, n) for n in others), cubes
    assert len(sizes) > 3


def test_a_cover_over_ten_propositions():
    majority = {n for n in range(2**10) if n.bit_count() > 5}
    cubes = prime_cover(majority, set(range(2**10)) - majority, 10)
    assert sorted(cubes) == [tuple((p, True) for p in six) for six in combinations(range(10), 6)]


def test_guards_over_many_propositions_and_few_letters():
    names = [f"p{i}" for i in range(200)]
    one_hot = np.eye(200, dtype=bool)
    automaton = make_automaton(
        [[0] * 199 + [1], [1] * 200], 0, one_hot, names, accepting=[False, True]
    )
    assert guards(automaton) == {(0, 0): "!p199", (0, 1): "p199", (1, 1): "true"}
    some = [1] * 3 + [0] * 197
    automaton = make_automaton([some, [1] * 200], 0, one_hot, names, accepting=[False, True])
    assert guards(automaton)[0, 1] == "p0 | p1 | p2"
    assert guards(automaton)[0, 0] == "!p0 & !p1 & !p2"


@pytest.mark.parametrize(
    "formula", ["G F a & G F b", "G F a -> G F b", "F a & G (b -> F c)", "a U b"]
)
@pytest.mark.parametrize("acceptance", ["auto", "parity"])
def test_each_letter_has_one_edge(formula, acceptance):
    automaton = to_automaton(formula, acceptance=acceptance)
    letters = [
        {name for name, holds in zip(automaton.propositions, row, strict=True) if holds}
        for row in automaton.letters
    ]
    count = 0
    for (q, successor, priority), text in edge_guards(automaton).items():
        for i, letter in enumerate(letters):
            made = (automaton.delta[q, i], automaton.priority[q, i]) == (successor, priority)
            assert holds_on_lasso(text, [], [letter]) == made
            count += made
    assert count == automaton.delta.size
    for (q, successor), text in guards(automaton).items():
        for i, letter in enumerate(letters):
            made = automaton.delta[q, i] == successor
            assert holds_on_lasso(text, [], [letter]) == made


def test_text_marks_transitions():
    assert to_text(to_automaton("F a & G F b")).splitlines() == [
        "buchi automaton: 2 states, 4 letters over a, b",
        ">  0: F a & G F b",
        "     !a -> 0",
        "     a -> 1",
        "   1: F b & G F b",
        "     b -> 1 *",
        "     !b -> 1",
    ]
    assert to_text(to_automaton("G F a -> G F b")).splitlines() == [
        "parity automaton: 1 state, 4 letters over a, b",
        ">  0: F G !a | G F b",
        "     b -> 0 {0}",
        "     a & !b -> 0 {1}",
        "     !a & !b -> 0 {2}",
    ]


def test_dot_marks_transitions():
    buchi = to_dot(to_automaton("G F a")).splitlines()
    assert '  0 [shape=circle, label="0: G F a"];' in buchi
    assert buchi[-3:-1] == [
        '  0 -> 0 [label="a ●", style=bold, color="#1f6f8b"];',
        '  0 -> 0 [label="!a"];',
    ]
    parity = to_dot(to_automaton("F G a")).splitlines()
    assert parity[-3:-1] == ['  0 -> 0 [label="!a {1}"];', '  0 -> 0 [label="a {2}"];']


def test_an_automaton_says_what_it_is():
    text = repr(to_automaton("G F a & G F b"))
    for part in ("'buchi'", "int32[2, 4]", "('a', 'b')", "'G F a & G F b'"):
        assert part in text
