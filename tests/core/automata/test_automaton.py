"""Automata as tables: checks, runs, minimisation, complement and readable forms."""

import json
import random
import re

import numpy as np
import pytest

from jaxltl.core.automata.automaton import (
    accepts_lasso,
    complement,
    letter_index,
    make_automaton,
    run,
)
from jaxltl.core.automata.text import from_dict, guards, to_dict, to_dot, to_text
from jaxltl.core.automata.translate import to_automaton
from tests.reference_logic import minimize, random_formula, random_lasso, subsets, unmergeable
from tests.support import counts

GOOD = {
    "delta": [[0, 1], [1, 1]],
    "initial": 0,
    "final": [False, True],
    "letters": [[False], [True]],
    "propositions": ["a"],
    "acceptance": "cosafe",
}
COLOURS = [(), ("b",), ("r",), ("y",), ("g1",), ("g2",)]


def random_automaton(rng, states=8, letters=4):
    """Random tables with an absorbing half, so that both acceptances are well formed."""
    final = np.arange(states) >= rng.randint(1, states)
    delta = np.array([[rng.randrange(states) for _ in range(letters)] for _ in range(states)])
    delta[final] = np.flatnonzero(final)[delta[final] % final.sum()] if final.any() else 0
    order = rng.sample(range(states), states)
    shuffled, place = np.empty_like(delta), np.array(order)
    shuffled[place] = place[delta]
    kept = np.empty_like(final)
    kept[place] = final
    acceptance = rng.choice(["cosafe", "safety"])
    rows = [[bool(number >> p & 1) for p in range(2)] for number in range(letters)]
    is_final = kept if acceptance == "cosafe" else ~kept
    return make_automaton(
        shuffled, order[0], rows, ["a", "b"], final=is_final, acceptance=acceptance
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"delta": [[0, 2], [1, 1]]}, r"delta\[0, 1\] = 2 is no state"),
        ({"delta": [[0, 1], [-1, 1]]}, r"delta\[1, 0\] = -1 is no state"),
        ({"delta": [0, 1]}, r"delta has shape \(2,\)"),
        ({"delta": [[0.0, 1.0], [1.0, 1.0]]}, "type float64"),
        ({"delta": np.zeros((0, 2), int)}, "at least one of each"),
        ({"delta": [[0, 2**40], [1, 1]]}, "is no state"),
        ({"initial": 2}, r"initial = 2 is no state. Pass one of 0..1"),
        ({"initial": 0.5}, r"initial = 0.5 is no state"),
        ({"final": [True]}, r"final has shape \(1,\).*Pass booleans of shape \(2,\)"),
        ({"final": [0, 1]}, "final has shape .* and type int64"),
        ({"final": [True, False]}, r"delta\[0, 1\] = 1 leaves the final states"),
        ({"acceptance": "safety"}, r"delta\[0, 1\] = 1 leaves the non-final states"),
        ({"letters": [[False]]}, r"letters has shape \(1, 1\)"),
        ({"letters": [[True], [True]]}, r"letters 0 and 1 are both \{a\}"),
        ({"propositions": ["a", "b"]}, r"Pass booleans of shape \(2, 2\)"),
        ({"propositions": [1]}, "Pass distinct strings"),
        ({"propositions": ["a", "a"], "letters": [[False] * 2, [True] * 2]}, "distinct strings"),
        ({"acceptance": "buchi"}, "acceptance = 'buchi' with final. Pass one of cosafe, safety"),
        ({"state_names": ["one"]}, "1 state_names for 2 states"),
    ],
)
def test_bad_tables(change, message):
    with pytest.raises(ValueError, match=message):
        make_automaton(**{**GOOD, **change})


def test_tables_have_their_types():
    automaton = make_automaton(**GOOD)
    assert automaton.delta.dtype == np.int32 and automaton.initial.dtype == np.int32
    assert automaton.final.dtype == bool and automaton.letters.dtype == bool
    translated = to_automaton("F a")
    for name in ("delta", "initial", "final", "letters"):
        assert getattr(translated, name).dtype == getattr(automaton, name).dtype, name
        assert np.array_equal(getattr(translated, name), getattr(automaton, name))


def test_letters_and_runs():
    automaton = to_automaton("a U b", [set(), {"a"}, {"b"}])
    assert [letter_index(automaton, x) for x in (set(), ["a"], {"b", "z"})] == [0, 1, 2]
    states = run(automaton, [{"a"}, {"b"}, set()])
    assert states.dtype == np.int32 and states.shape == (4,)
    assert states[0] == automaton.initial and automaton.final[states].tolist() == [0, 0, 1, 1]
    assert run(automaton, []).tolist() == [0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda a: letter_index(a, {"a", "b"}), "not among the 3 letters.*letters="),
        (lambda a: letter_index(a, "a"), "collection of proposition names"),
        (lambda a: run(a, [set(), {"a", "b"}]), "run: letter 1 is"),
        (lambda a: accepts_lasso(a, [{"a", "b"}], [set()]), "prefix letter 0"),
        (lambda a: accepts_lasso(a, [], [{"a", "b"}]), "cycle letter 0"),
        (lambda a: accepts_lasso(a, [{"a"}], []), "cycle is empty"),
    ],
)
def test_bad_words(call, message):
    with pytest.raises(ValueError, match=message):
        call(to_automaton("a U b", [set(), {"a"}, {"b"}]))


def test_lasso_needs_several_laps():
    automaton = to_automaton("X X X X X F a", [set(), {"a"}])
    assert accepts_lasso(automaton, [{"a"}], [set(), {"a"}])
    assert not accepts_lasso(automaton, [{"a"}] * 5, [set()])


@counts(40, 300)
def test_minimize_keeps_the_language_and_is_minimal(count):
    rng = random.Random(30)
    shrunk = 0
    for _ in range(count):
        automaton = random_automaton(rng, states=rng.randint(1, 12))
        small = minimize(automaton)
        assert unmergeable(small)
        assert np.array_equal(minimize(small).delta, small.delta)
        shrunk += len(small.delta) < len(automaton.delta)
        for _ in range(10):
            lasso = random_lasso(rng, subsets("ab"))
            assert accepts_lasso(small, *lasso) == accepts_lasso(automaton, *lasso)
            states, small_states = run(automaton, lasso[0]), run(small, lasso[0])
            assert np.array_equal(automaton.final[states], small.final[small_states])
    assert shrunk > count / 6


def test_minimal_tables_do_not_depend_on_the_numbering():
    rng = random.Random(31)
    for _ in range(200):
        automaton = random_automaton(rng, states=10)
        place = np.array(rng.sample(range(10), 10))
        delta, final = np.empty_like(automaton.delta), np.empty_like(automaton.final)
        delta[place], final[place] = place[automaton.delta], automaton.final
        renamed = make_automaton(
            delta,
            place[automaton.initial],
            automaton.letters,
            automaton.propositions,
            final=final,
            acceptance=automaton.acceptance,
        )
        left, right = minimize(automaton), minimize(renamed)
        assert np.array_equal(left.delta, right.delta)
        assert np.array_equal(left.final, right.final)
        assert left.initial == right.initial == 0


def test_minimize_is_quick_on_a_long_chain():
    n = 20_000
    delta = np.minimum(np.arange(n) + 1, n - 1)[:, None].repeat(2, axis=1)
    final = np.arange(n) == n - 1
    automaton = make_automaton(delta, 0, [[False], [True]], ["a"], final=final, acceptance="cosafe")
    assert len(minimize(automaton).delta) == n


def test_complement_accepts_the_other_words():
    rng = random.Random(32)
    for _ in range(200):
        automaton = random_automaton(rng)
        other = complement(automaton)
        assert make_automaton(**to_dict(other)).acceptance != automaton.acceptance
        lasso = random_lasso(rng, subsets("ab"))
        assert accepts_lasso(other, *lasso) != accepts_lasso(automaton, *lasso)
        assert np.array_equal(complement(other).final, automaton.final)


def guard_holds(text, letter):
    """A guard read as Python, with propositions as names."""
    expression = text.replace("!", " not ").replace("&", " and ").replace("|", " or ")
    expression = re.sub(r"\btrue\b", "True", expression)
    names = set(re.findall(r"\w+", expression)) - {"not", "and", "or", "True"}
    return eval(expression, {name: name in letter for name in names})


def test_guards_hold_exactly_where_the_transition_is_made():
    rng = random.Random(33)
    names = ("p", "q", "r", "s")
    for _ in range(200):
        letters = rng.sample(subsets(names), rng.randint(1, 16))
        formula = random_formula(rng, 10, names, rng.choice(["cosafe", "safety"]))
        automaton = to_automaton(formula, letters)
        conditions = guards(automaton)
        assert len(conditions) == sum(len(set(row)) for row in automaton.delta.tolist())
        for (q, successor), text in conditions.items():
            for letter in letters:
                made = automaton.delta[q, letter_index(automaton, letter)] == successor
                assert guard_holds(text, letter) == made, (text, letter)
            made_by = [x for x in letters if guard_holds(text, x)]
            cubes = text.replace("(", "").replace(")", "").split(" | ")
            for cube in cubes:
                # No cube can be dropped, and no literal of a cube.
                others = [other for other in cubes if other != cube]
                covered = [any(guard_holds(other, x) for other in others) for x in made_by]
                assert not all(covered), text
                for literal in cube.split(" & ") if text != "true" else ():
                    rest = [other for other in cube.split(" & ") if other != literal]
                    wider = [x for x in letters if all(guard_holds(other, x) for other in rest)]
                    assert set(wider) - set(made_by), text


@pytest.mark.parametrize(
    ("formula", "expected"),
    [
        ("!r U y", {"!r & !y", "y", "r", "true"}),
        ("F (r | y) & F b", {"b", "r | y", "true", "!b", "!r & !y", "!b & !r & !y"}),
        ("F g1", {"!g1", "g1", "true"}),
        ("!r U ((g1 | g2 | y) & X b)", None),
    ],
)
def test_guards_on_a_coloured_grid_are_short(formula, expected):
    texts = set(guards(to_automaton(formula, COLOURS)).values())
    if expected is not None:
        assert texts == expected
    assert all(len(text) <= 25 for text in texts), texts


def test_guards_quote_odd_names():
    assert guards(to_automaton('F "Goal 1"'))[0, 1] == '"Goal 1"'


def test_text_shows_every_part():
    text = to_text(to_automaton("!r U y", COLOURS))
    assert text.splitlines() == [
        "cosafe automaton: 3 states, 3 letters over r, y",
        ">  0: !r U y",
        "     !r & !y -> 0",
        "     r -> 1",
        "     y -> 2",
        "   1: false",
        "     true -> 1",
        " * 2: true",
        "     true -> 2",
    ]


DOT_STRING = r'"(?:[^"\\\n]|\\.)*"'
DOT_LINE = re.compile(
    rf"  (rankdir=LR|start \[shape=point, label=\"\"\]|start -> \d+"
    rf"|\d+ \[shape=(?:double)?circle, label={DOT_STRING}\]|\d+ -> \d+ \[label={DOT_STRING}\]);"
)


def test_dot_is_well_formed():
    rng = random.Random(34)
    names = ("p", 'quo"te', "back\\slash", "line\nbreak")
    for _ in range(50):
        formula = random_formula(rng, 10, names, rng.choice(["cosafe", "safety"]))
        automaton = to_automaton(formula)
        head, *lines, tail = to_dot(automaton).split("\n")
        assert (head, tail) == ("digraph automaton {", "}")
        assert all(DOT_LINE.fullmatch(line) for line in lines), lines
        assert sum("doublecircle" in line for line in lines) == automaton.final.sum()
        assert len(lines) == 3 + len(automaton.delta) + len(guards(automaton))


def test_dict_round_trip_through_json():
    rng = random.Random(35)
    for _ in range(50):
        formula = random_formula(rng, 8, ("p", "q"), rng.choice(["cosafe", "safety"]))
        automaton = to_automaton(formula)
        again = from_dict(json.loads(json.dumps(to_dict(automaton))))
        for name in to_dict(automaton):
            mine, other = getattr(automaton, name), getattr(again, name)
            assert np.array_equal(mine, other) and type(mine) is type(other)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"extra": 1}, "unknown entries: extra"),
        ({"initial": 7}, "initial = 7 is no state"),
    ],
)
def test_bad_dict(change, message):
    with pytest.raises(ValueError, match=message):
        from_dict({**to_dict(to_automaton("F a")), **change})


def test_dict_with_a_missing_entry():
    tables = to_dict(to_automaton("F a"))
    del tables["final"]
    with pytest.raises(ValueError, match="missing or unknown entries: final"):
        from_dict(tables)
