"""Automata of co-safe and safety formulas, against truth on lassos and brute force."""

import random
import time

import numpy as np
import pytest

from jaxltl.core.automaton import accepts_lasso, complement, make_automaton, minimize, to_dict
from jaxltl.core.ltl import (
    holds_on_lasso,
    is_syntactically_cosafe,
    is_syntactically_safe,
    parse_ltl,
)
from jaxltl.core.translate import to_automaton
from tests.reference_logic import (
    holds_by_definition,
    random_formula,
    random_lasso,
    residual_count,
    subsets,
    unmergeable,
)

NAMES = ("a", "b", "c", "d")
COLOURS = [frozenset(letter) for letter in ((), "b", "r", "y", ("g1",), ("g2",))]


def same_tables(left, right):
    return all(
        np.array_equal(getattr(left, name), getattr(right, name))
        for name in ("delta", "initial", "final", "letters", "propositions", "acceptance")
    )


def random_letters(rng, names):
    """All letters, or some of them, as a world in which not everything occurs would give."""
    everything = subsets(names)
    if rng.random() < 0.5:
        return everything
    return rng.sample(everything, rng.randint(1, len(everything)))


@pytest.mark.parametrize("seed", range(16))
def test_automaton_accepts_what_the_formula_says(seed):
    rng = random.Random(seed)
    accepted = []
    for _ in range(250):
        names = NAMES[: rng.randint(1, 4)]
        formula = random_formula(rng, rng.randint(1, 15), names, rng.choice(["cosafe", "safety"]))
        letters = random_letters(rng, names)
        automaton = to_automaton(formula, letters)
        for _ in range(12):
            lasso = random_lasso(rng, letters)
            accepted.append(accepts_lasso(automaton, *lasso))
            assert accepted[-1] == holds_on_lasso(formula, *lasso), (str(formula), lasso)
    assert len(accepted) == 3000 and 0.2 < np.mean(accepted) < 0.8


def test_automaton_is_well_formed_minimal_and_canonical():
    rng = random.Random(20)
    sizes = []
    for _ in range(400):
        names = NAMES[: rng.randint(1, 3)]
        formula = random_formula(rng, rng.randint(1, 14), names, rng.choice(["cosafe", "safety"]))
        letters = random_letters(rng, names)
        automaton = to_automaton(formula, letters)
        assert same_tables(make_automaton(**to_dict(automaton)), automaton)
        assert same_tables(minimize(automaton), automaton)
        assert unmergeable(automaton), str(formula)
        sizes.append(len(automaton.delta))
    assert max(sizes) > 10 and np.mean(np.array(sizes) > 2) > 0.4


def test_final_is_decided_as_early_as_possible():
    """For co-safe, final iff every word from there is accepted; dually for safety."""
    rng = random.Random(21)
    for _ in range(150):
        names = NAMES[: rng.randint(1, 2)]
        fragment = rng.choice(["cosafe", "safety"])
        letters = random_letters(rng, names)
        automaton = to_automaton(random_formula(rng, rng.randint(1, 10), names, fragment), letters)
        undecided = automaton.final == (automaton.acceptance == "safety")
        for q in np.flatnonzero(undecided):
            # With an undecided successor everywhere, some word is never forced.
            assert undecided[automaton.delta[q]].any()


def test_negation_is_complement():
    rng = random.Random(22)
    both = 0
    for _ in range(500):
        names = NAMES[: rng.randint(1, 3)]
        formula = random_formula(rng, rng.randint(1, 14), names, rng.choice(["cosafe", "safety"]))
        letters = random_letters(rng, names)
        automaton, negated = to_automaton(formula, letters), to_automaton(~formula, letters)
        if is_syntactically_cosafe(formula) and is_syntactically_safe(formula):
            # Both are read as co-safe, so only the states before the verdict differ.
            both += 1
            assert np.array_equal(automaton.delta, negated.delta)
            assert not (automaton.final & negated.final).any()
        else:
            assert same_tables(complement(automaton), negated), str(formula)
            assert same_tables(complement(negated), automaton)
    assert 20 < both < 250


@pytest.mark.parametrize(
    ("letters", "stem", "tail", "largest"), [(["", "a"], 4, 3, 5), (["", "a", "b"], 3, 2, 4)]
)
def test_states_are_the_residuals_of_the_language(letters, stem, tail, largest):
    """Brute-force Myhill-Nerode, from the definition of truth alone."""
    rng = random.Random(23)
    letters = [frozenset(letter) for letter in letters]
    seen = []
    while len(seen) < 60:
        formula = random_formula(rng, rng.randint(4, 9), "ab", rng.choice(["cosafe", "safety"]))
        states = len(to_automaton(formula, letters).delta)
        if 3 <= states <= largest:
            assert residual_count(formula, letters, stem, tail, 2) == states, str(formula)
            seen.append(states)
    assert set(seen) == set(range(3, largest + 1))


def test_states_are_named_by_what_is_left():
    rng = random.Random(24)
    for _ in range(150):
        names = NAMES[: rng.randint(1, 3)]
        formula = random_formula(rng, rng.randint(1, 9), names, rng.choice(["cosafe", "safety"]))
        letters = subsets(names)
        automaton = to_automaton(formula, letters)
        for q, name in enumerate(automaton.state_names):
            for _ in range(4):
                prefix, cycle = random_lasso(rng, letters)
                state = q
                for letter in prefix + cycle * len(automaton.delta):
                    held = [proposition in letter for proposition in automaton.propositions]
                    read = int(np.flatnonzero((automaton.letters == held).all(axis=1))[0])
                    state = automaton.delta[state, read]
                assert holds_by_definition(parse_ltl(name), prefix, cycle) == automaton.final[state]


def test_stop_and_go_example():
    text = "(!r & !y) -> ((!r U y) & ((!y U g1) & (!y U g2) & F y))"
    automaton = to_automaton(text, COLOURS)
    assert automaton.delta.shape == (7, 5)  # {} and {b} are one letter to the formula
    assert automaton.acceptance == "cosafe"
    assert automaton.state_names[1] == "(!r U y) & (!y U g1) & (!y U g2) & F y"


def test_weak_order_drops_out():
    first = to_automaton("(!y) U (F g1 & F g2)", COLOURS)
    second = to_automaton("F g1 & F g2", COLOURS)
    assert first.delta.shape == (4, 4) and second.delta.shape == (4, 3)
    by_letter = {tuple(row): i for i, row in enumerate(second.letters.tolist())}
    shared = [by_letter[tuple(row[:2])] for row in first.letters.tolist()]
    assert np.array_equal(first.delta, second.delta[:, shared])
    assert np.array_equal(first.final, second.final)


@pytest.mark.parametrize(
    ("text", "acceptance", "delta", "final"),
    [
        ("true", "cosafe", [[0]], [True]),
        ("false", "cosafe", [[0]], [False]),
        ("a", "cosafe", [[1, 2], [1, 1], [2, 2]], [False, False, True]),
        ("F a", "cosafe", [[0, 1], [1, 1]], [False, True]),
        ("G a", "safety", [[1, 0], [1, 1]], [True, False]),
        ("X a", "cosafe", [[1, 1], [2, 3], [2, 2], [3, 3]], [False, False, False, True]),
        ("F a | F !a", "cosafe", [[0, 0]], [True]),
        ("G a & G !a", "safety", [[0, 0]], [False]),
        ("a W false", "safety", [[1, 0], [1, 1]], [True, False]),
    ],
)
def test_by_hand(text, acceptance, delta, final):
    automaton = to_automaton(text)
    assert automaton.acceptance == acceptance
    assert automaton.delta.tolist() == delta and automaton.final.tolist() == final


def test_only_the_given_letters_count():
    assert to_automaton("F a", [{"a"}]).final.tolist() == [True]
    assert to_automaton("F a", [set(), {"b"}]).final.tolist() == [False]
    assert to_automaton("F (a & b)", [{"a"}, {"b"}]).delta.tolist() == [[0, 0]]
    mutual = to_automaton("G !(a & b)", [{"a"}, {"b"}, set()])
    assert mutual.delta.tolist() == [[0, 0, 0]] and mutual.final.tolist() == [True]


def test_letters_are_canonical():
    automaton = to_automaton("F (a & b)", [{"b"}, ["a", "b"], {"z"}, ("b", "z"), set()])
    assert automaton.letters.tolist() == [[False, False], [False, True], [True, True]]
    everything = to_automaton("F (a & b)")
    assert (everything.letters @ [1, 2]).tolist() == [0, 1, 2, 3]
    assert automaton.propositions == ("a", "b")


def test_many_propositions_are_fast():
    rng = random.Random(25)
    formula = " & ".join(f"G !(a{i} & b{i})" for i in range(100))
    names = [f"{kind}{i}" for kind in "ab" for i in range(100)]
    letters = [frozenset(rng.sample(names, 20)) for _ in range(300)]
    start = time.perf_counter()
    automaton = to_automaton(formula, letters)
    assert time.perf_counter() - start < 2
    assert automaton.delta.shape == (2, 300) and automaton.state_names == ("...", "false")
    bad = [any({f"a{i}", f"b{i}"} <= letter for i in range(100)) for letter in letters]
    assert 0 < sum(bad) < 300 and sum(automaton.delta[0]) == sum(bad)


def test_deep_formula():
    automaton = to_automaton("X" * 1500 + "a")
    assert automaton.delta.shape == (1503, 2)
    assert automaton.state_names[1497:1500] == ("X X X a", "X X a", "X a")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("G F a & X b", ["G F a & X b is neither", "because of G F a: G", "because of F a: F"]),
        ("F a & G b", ["because of G b", "because of F a", "one by one"]),
        ("!(F a -> F b)", ["pushed inwards: F a & G !b", "because of G !b"]),
        ("(a W b) U c", ["because of a W b: W", "because of (a W b) U c: U"]),
    ],
)
def test_outside_the_fragments(text, parts):
    with pytest.raises(ValueError) as caught:
        to_automaton(text)
    assert all(part in str(caught.value) for part in parts), str(caught.value)


def test_too_many_propositions():
    formula = " & ".join(f"F p{i}" for i in range(13))
    with pytest.raises(ValueError, match=r"13 propositions.*Pass letters="):
        to_automaton(formula)
    assert to_automaton(formula, [{f"p{i}"} for i in range(2)]).final.tolist() == [False]


def test_too_many_states():
    formula = " & ".join(f"F p{i}" for i in range(8))
    letters = [{f"p{i}"} for i in range(8)]
    assert len(to_automaton(formula, letters, max_states=256).delta) == 256
    with pytest.raises(ValueError, match=r"more than 255 states.*raise max_states"):
        to_automaton(formula, letters, max_states=255)


def test_too_many_conjuncts():
    formula = " & ".join(f"G !p{i}" for i in range(3000))
    with pytest.raises(ValueError, match="too many subformulas"):
        to_automaton(formula, [set()])


@pytest.mark.parametrize(
    ("letters", "message"),
    [
        ([], "letters is empty"),
        (["a"], "letter 0 is 'a'"),
        ([{"a"}, {1}], "letter 1 is {1}"),
    ],
)
def test_bad_letters(letters, message):
    with pytest.raises(ValueError, match=message):
        to_automaton("F a", letters)
