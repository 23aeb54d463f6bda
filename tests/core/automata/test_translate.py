"""Automata of formulas, against truth on lassos and brute force."""

import random
import re

import numpy as np
import pytest

from jaxltl.core.automata.automaton import accepts_lasso, complement, make_automaton
from jaxltl.core.automata.language import find_difference, is_equivalent
from jaxltl.core.automata.runs import live_states, universal_states
from jaxltl.core.automata.text import to_dict
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.logic.ltl import (
    holds_on_lasso,
    is_syntactically_cosafe,
    is_syntactically_safe,
    parse_ltl,
)
from jaxltl.core.logic.simplify import simplify
from tests.reference_logic import (
    holds_by_definition,
    minimize,
    random_formula,
    random_lasso,
    residual_count,
    subsets,
    unmergeable,
)
from tests.support import counts

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


@pytest.mark.parametrize(
    "seed",
    [pytest.param(seed, marks=[] if seed < 3 else pytest.mark.exhaustive) for seed in range(16)],
)
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


@counts(120, 400)
def test_automaton_is_well_formed_minimal_and_canonical(count):
    rng = random.Random(25)
    sizes = []
    for _ in range(count):
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
    for _ in range(50):
        names = NAMES[: rng.randint(1, 2)]
        fragment = rng.choice(["cosafe", "safety"])
        letters = random_letters(rng, names)
        automaton = to_automaton(random_formula(rng, rng.randint(1, 10), names, fragment), letters)
        undecided = automaton.final == (automaton.acceptance == "safety")
        for q in np.flatnonzero(undecided):
            # With an undecided successor everywhere, some word is never forced.
            assert undecided[automaton.delta[q]].any()


@counts(75, 500)
def test_negation_is_complement(count):
    rng = random.Random(22)
    both = 0
    for _ in range(count):
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
    assert count / 25 < both < count / 2


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("letters", "stem", "tail", "largest"), [(["", "a"], 4, 3, 5), (["", "a", "b"], 3, 2, 4)]
)
@counts(8, 60)
def test_states_are_the_residuals_of_the_language(letters, stem, tail, largest, count):
    """Brute-force Myhill-Nerode, from the definition of truth alone."""
    rng = random.Random(23)
    letters = [frozenset(letter) for letter in letters]
    seen = []
    while len(seen) < count:
        formula = random_formula(rng, rng.randint(4, 9), "ab", rng.choice(["cosafe", "safety"]))
        states = len(to_automaton(formula, letters).delta)
        if 3 <= states <= largest:
            assert residual_count(formula, letters, stem, tail, 2) == states, str(formula)
            seen.append(states)
    assert set(seen) == set(range(3, largest + 1))


@counts(25, 150)
def test_states_are_named_by_what_is_left(count):
    rng = random.Random(24)
    for _ in range(count):
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
    automaton = to_automaton(formula, letters)
    assert automaton.delta.shape == (2, 300) and automaton.state_names == ("...", "false")
    bad = [any({f"a{i}", f"b{i}"} <= letter for i in range(100)) for letter in letters]
    assert 0 < sum(bad) < 300 and sum(automaton.delta[0]) == sum(bad)


def test_deep_formula():
    automaton = to_automaton("X" * 1500 + "a")
    assert automaton.delta.shape == (1503, 2)
    assert automaton.state_names[1497:1500] == ("X X X a", "X X a", "X a")


@pytest.mark.parametrize(
    ("text", "acceptance", "parts"),
    [
        (
            "G F a",
            "dfa",
            [
                "G F a has no finite acceptance",
                "It fails on ({})^w",
                "It holds on ({a})^w",
                'Ask for acceptance="auto"',
            ],
        ),
        ("F a & G b", "dfa", ["It fails on ({b})^w", "It holds on {a, b} ({b})^w"]),
        ("(a W b) U c", "dfa", ["It fails on ", "It holds on "]),
        ("F G a", "dfa", ["It fails on ({})^w", "It holds on ({a})^w"]),
        (
            "F G a",
            "buchi",
            [
                "F G a has no deterministic Buchi automaton",
                'Ask for acceptance="parity"',
            ],
        ),
        ("F G a | G F b", "buchi", ["F G a | G F b has no deterministic Buchi"]),
        ("F a", "finite", ["acceptance='finite'", "auto, dfa, buchi, parity"]),
        ("F a", None, ["acceptance=None"]),
    ],
)
def test_acceptance_that_the_language_has_not(text, acceptance, parts):
    with pytest.raises(ValueError) as caught:
        to_automaton(text, acceptance=acceptance)
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


# --- all of the logic ------------------------------------------------------------------------


def agree(automaton, formula, rng, letters, count=20):
    verdicts = []
    for _ in range(count):
        lasso = random_lasso(rng, letters)
        verdicts.append(holds_on_lasso(formula, *lasso))
        assert accepts_lasso(automaton, *lasso) == verdicts[-1], (str(formula), lasso)
    return verdicts


def check_random_formulas(seed, count, largest=15):
    rng = random.Random(seed)
    kinds, verdicts = {}, []
    for _ in range(count):
        names = NAMES[: rng.randint(1, 4)]
        formula = random_formula(rng, rng.randint(1, largest), names)
        letters = random_letters(rng, names)
        automaton, negated = to_automaton(formula, letters), to_automaton(~formula, letters)
        verdicts += agree(automaton, formula, rng, letters)
        assert same_tables_up_to_kind(make_automaton(**to_dict(automaton)), automaton)
        assert is_equivalent(negated, complement(automaton)), str(formula)
        both = [automaton.acceptance, negated.acceptance]
        finite = [kind in ("cosafe", "safety") for kind in both]
        assert finite[0] == finite[1], (str(formula), both)
        if all(finite):
            assert len(automaton.delta) == len(negated.delta), str(formula)
        kinds[both[0]] = kinds.get(both[0], 0) + 1
    return kinds, np.mean(verdicts)


def same_tables_up_to_kind(left, right):
    names = ("delta", "initial", "priority", "letters", "propositions", "acceptance")
    return all(np.array_equal(getattr(left, n), getattr(right, n)) for n in names)


@pytest.mark.parametrize(
    "seed", [100, *(pytest.param(seed, marks=pytest.mark.exhaustive) for seed in range(101, 104))]
)
def test_random_formulas_of_all_of_the_logic(seed):
    kinds, mean = check_random_formulas(seed, 60)
    assert set(kinds) == {"cosafe", "safety", "buchi", "parity"} and 0.2 < mean < 0.8


# Dwyer, Avrunin & Corbett 1999, with q the start and r the end of the scope: what is to hold,
# the acceptance, and the number of states.
PATTERNS = [
    ("G !p", "safety", 2),
    ("F r -> (!p U r)", "safety", 4),  # before r: none yet, p waits for r, r came, p then r
    ("G (q -> G !p)", "safety", 3),
    ("G ((q & !r & F r) -> (!p U r))", "safety", 4),
    ("G (q & !r -> (!p W r))", "safety", 3),
    ("F p", "cosafe", 2),
    ("!r W (p & !r)", "safety", 3),
    ("G !q | F (q & F p)", "buchi", 3),
    ("G (q & !r -> (!r W (p & !r)))", "safety", 3),
    ("G (q & !r -> (!r U (p & !r)))", "buchi", 3),
    ("G p", "safety", 2),
    ("F r -> (p U r)", "safety", 4),
    ("G (q -> G p)", "safety", 3),
    ("G ((q & !r & F r) -> (p U r))", "safety", 4),
    ("G (q & !r -> (p W r))", "safety", 3),
    ("!p W s", "safety", 3),
    ("F r -> (!p U (s | r))", "safety", 4),
    ("G !q | F (q & (!p W s))", None, None),
    ("G ((q & !r & F r) -> (!p U (s | r)))", "safety", None),
    ("G (q & !r -> (!p W (s | r)))", "safety", 3),
    ("G (p -> F s)", "buchi", 2),
    ("F r -> (p -> (!r U (s & !r))) U r", "safety", None),
    ("G (q -> G (p -> F s))", "buchi", 3),
    ("G ((q & !r & F r) -> ((p -> (!r U (s & !r))) U r))", "safety", None),
    ("G (q & !r -> ((p -> (!r U (s & !r))) W r))", "buchi", None),
]


@pytest.mark.parametrize(("text", "acceptance", "states"), PATTERNS)
def test_specification_patterns(text, acceptance, states):
    rng = random.Random(text)
    automaton = to_automaton(text)
    verdicts = agree(automaton, parse_ltl(text), rng, subsets(automaton.propositions), 150)
    assert len(set(verdicts)) == 2
    assert acceptance is None or automaton.acceptance == acceptance
    assert states is None or len(automaton.delta) == states
    assert is_equivalent(automaton, complement(to_automaton(f"!({text})")))


def joined(template, count, operator):
    return f" {operator} ".join(template.format(i=i) for i in range(count))


FAMILIES = [
    # One state for each goal to wait for; one goal needs no memory.
    *((joined("G F a{i}", n, "&"), "buchi", n) for n in range(1, 6)),
    *((joined("F G a{i}", n, "|"), "parity", n) for n in range(1, 6)),
    # G F is an F G less: limits of one shape are one limit.
    (joined("G F a{i}", 4, "|"), "buchi", 1),
    (joined("F G a{i}", 4, "&"), "parity", 1),
    # The assumption is followed in turn below the goals: 2 * 2 leaves of the Zielonka tree.
    ("G F a & G F b -> G F c & G F d", "parity", 4),
    ("G F a -> G F b", "parity", 1),
    ("G F a & F G b", "parity", 1),
    # Co-safe and safety: what n letters back were, as long as it matters.
    *((f"F (a & {'X ' * n}b)", "cosafe", 2**n + 1) for n in range(6)),
    *((f"G (a -> {'X ' * n}b)", "safety", 2**n + 1) for n in range(6)),
    ("G F (a & X b)", "buchi", 2),  # whether a held is all there is to remember
    ("F G (a | X b)", "parity", 2),
    ("G F (a & X b) & G F (b & X !b & X a)", "buchi", None),  # limits followed in turn
    ("F G (a | X b) | F G (!b | X a)", "parity", None),
    ("a U (b U (c U d))", "cosafe", 5),  # the stages a, b, c, and the two verdicts
    # Open requests, 2^n sets of them, of which some can stand for others: at most n + 1 to wait.
    ("G (r -> F g)", "buchi", 2),
    ("G (r0 -> F g0) & G (r1 -> F g1) & G !(g0 & g1)", "buchi", None),
    ("G F p1 & G F p2 & G !(p1 & p2)", "buchi", 3),  # two goals and the sink
    ("F a -> F b", "buchi", 3),  # nothing yet, a owes b, done
    ("F a & G b", "buchi", 3),
    ("(a W b) U c", "buchi", None),
    ("((a U b) U c) U d", "cosafe", None),
    ("G (a U (b U c))", "buchi", None),
    ("G (a -> (b U (c U d)))", "buchi", None),
]


@pytest.mark.parametrize(("text", "acceptance", "states"), FAMILIES)
def test_families(text, acceptance, states):
    rng = random.Random(text)
    automaton = to_automaton(text)
    agree(automaton, parse_ltl(text), rng, subsets(automaton.propositions), 100)
    assert automaton.acceptance == acceptance
    assert states is None or len(automaton.delta) == states


def test_delays_need_all_residuals():
    """Brute force on residuals: continuations of 2 letters tell the words of 2 letters apart."""
    letters = subsets("ab")
    for text in ("F (a & X b)", "G (a -> X b)", "F (a & X X b)"):
        n = text.count("X")
        count = residual_count(parse_ltl(text), letters, n + 1, n, 1)
        assert count == len(to_automaton(text).delta) == 2**n + 1


@pytest.mark.parametrize(
    ("text", "acceptance", "plain"),
    [
        ("F a | G F a", "cosafe", "F a"),
        ("G (a & F a)", "safety", "G a"),
        ("(F G a) & (G a | false)", "safety", "G a"),
        ("F (a & G F true)", "cosafe", "F a"),
        ("!(X X b U (a R a))", "safety", "!(X X b U a)"),
        ("!a W (a & X a & (F c | G !c))", "safety", "!a W (a & X a)"),
        ("(X b W b) & F a & (F a | G F c)", None, "(X b W b) & F a"),
        ("X a xor (G a & F G a)", None, "X a xor G a"),
        ("G F a | F G !a", "cosafe", "true"),
        ("G F a & F G !a", "cosafe", "false"),
        ("G F a & X F a", "buchi", "G F a"),
        ("F G a & G F a", "parity", "F G a"),
        ("F (a & X G F b)", "buchi", "F a & G F b"),
        ("G (a | G F b)", "buchi", "G a | G F b"),
        ("(a U b) & G F b", "buchi", "(a U b) & (G F (b & (a | !a)))"),
    ],
)
def test_acceptance_is_of_the_language_not_of_the_text(text, acceptance, plain):
    automaton, expected = to_automaton(text), to_automaton(plain)
    assert is_equivalent(automaton, expected)
    assert acceptance is None or automaton.acceptance == acceptance
    assert len(automaton.delta) == len(expected.delta)
    if {automaton.acceptance, expected.acceptance} != {"cosafe", "safety"}:  # it may be both
        assert automaton.acceptance == expected.acceptance


@pytest.mark.parametrize(
    "text",
    [
        "F G a",
        "F G a | G F b",
        "F G a & G F b",
        "a U G b",
        "G F a -> G F b",
        "F (a & G b)",
        "F G (a | X b)",
        "(F a & G b) | F G c",
    ],
)
def test_no_deterministic_buchi_automaton(text):
    """Landweber: parity only where a rejecting loop can hold an accepting one."""
    automaton = to_automaton(text)
    assert automaton.acceptance == "parity" and automaton.priority.max() >= 2


@counts(60, 400)
def test_finite_verdicts_are_early(count):
    """Final is decided: co-safe iff universal from there, safety iff something is left."""
    rng = random.Random(30)
    seen = {"cosafe": 0, "safety": 0}
    for _ in range(count):
        formula = random_formula(rng, rng.randint(3, 12), "ab")
        automaton = to_automaton(formula)
        if automaton.acceptance in seen:
            states = universal_states if automaton.acceptance == "cosafe" else live_states
            assert np.array_equal(automaton.final, states(automaton)), str(formula)
            if not (is_syntactically_cosafe(formula) or is_syntactically_safe(formula)):
                seen[automaton.acceptance] += 1
                assert same_tables(minimize(automaton), automaton) and unmergeable(automaton)
    assert min(seen.values()) > count / 27


@pytest.mark.parametrize("text", ["F a", "G a", "a U b", "G F a & G F b", "X a | G b"])
def test_acceptance_asked_for(text):
    automaton = to_automaton(text)
    for acceptance in ("buchi", "parity", "dfa"):
        if acceptance == "dfa" and automaton.acceptance == "buchi":
            continue
        asked = to_automaton(text, acceptance=acceptance)
        assert is_equivalent(asked, automaton)
        assert asked.acceptance in (("cosafe", "safety") if acceptance == "dfa" else (acceptance,))
    assert to_automaton("F G a", acceptance="parity").acceptance == "parity"


def test_two_goals_in_turn():
    """Each state waits for a goal of its own, and until it comes nothing happens."""
    automaton = to_automaton("G F a & G F b")
    holds = {"a": np.array([0, 1, 0, 1], bool), "b": np.array([0, 0, 1, 1], bool)}
    awaited = []
    for state in range(2):
        stays = (automaton.delta[state] == state) & ~automaton.accepting[state]
        (goal,) = [name for name in "ab" if np.array_equal(stays, ~holds[name])]
        awaited.append(goal)
        assert automaton.accepting[state, 3]  # both goals at once
    assert sorted(awaited) == ["a", "b"] and len(automaton.delta) == 2


def test_request_and_response():
    automaton = to_automaton("G (r -> F g)")
    # Letters {}, {g}, {r}, {g, r}: state 1 owes a response.
    assert automaton.delta.tolist()[0] == [0, 0, 1, 0]
    assert automaton.accepting.tolist()[0][:2] == [True, True]
    owed = automaton.delta[1].tolist()
    assert owed[0] == owed[2] == 1 and not automaton.accepting[1, [0, 2]].any()
    assert owed[1] == owed[3] == 0


def robots(size):
    cells = [(i, j) for i in range(size) for j in range(size)]
    safe = " & ".join(f"G !(x{i}_{j} & y{i}_{j})" for i, j in cells)
    letters = [{f"x{i}_{j}", f"y{k}_{m}"} for i, j in cells for k, m in cells]
    return safe, letters


def test_two_robots_apart():
    safe, letters = robots(10)
    automaton = to_automaton(safe, letters)
    assert automaton.delta.shape == (2, 10_000) and len(automaton.propositions) == 200
    held = automaton.letters
    meets = np.zeros(10_000, bool)
    for p, name in enumerate(automaton.propositions[:100]):
        meets |= held[:, p] & held[:, automaton.propositions.index("y" + name[1:])]
    assert meets.sum() == 100
    assert np.array_equal(automaton.delta, [meets, np.ones(10_000)])
    assert automaton.final.tolist() == [True, False]


@pytest.mark.parametrize("size", [3, 6, 8])
def test_two_robots_apart_with_goals(size):
    """More conjuncts than an integer has bits."""
    safe, letters = robots(size)
    last = size - 1
    text = f"{safe} & G F x0_0 & G F x{last}_{last}"
    automaton = to_automaton(text, letters)
    assert automaton.acceptance == "buchi" and len(automaton.delta) == 3
    goals = [{"x0_0", "y0_1"}, {f"x{last}_{last}", "y0_1"}]
    assert accepts_lasso(automaton, [], goals)
    assert not accepts_lasso(automaton, [{"x0_1", "y0_1"}], goals)
    assert not accepts_lasso(automaton, [], goals[:1])


@pytest.mark.parametrize("count", [10, 61, 62, 63, 64, 70])
def test_many_safety_conjuncts_and_two_goals(count):
    text = joined("G !x{i}", count, "&") + " & G F a & G F b"
    automaton = to_automaton(text, [set(), {"a"}, {"b"}, {"x0"}, {f"x{count - 1}"}])
    assert automaton.acceptance == "buchi" and len(automaton.delta) == 3
    assert accepts_lasso(automaton, [], [{"a"}, {"b"}])
    for bad in ({"x0"}, {f"x{count - 1}"}):
        assert not accepts_lasso(automaton, [bad], [{"a"}, {"b"}])
    assert not accepts_lasso(automaton, [], [{"a"}])


@pytest.mark.parametrize(
    ("text", "limit"),
    [
        (f"F (a & {'X ' * 12}b)", 1000),
        (f"G F (a & {'X ' * 9}b)", 100),
        (joined("(F a{i} | G b{i})", 4, "&"), 20),
        ("G F a <-> G F b <-> G F c <-> G F d", 5),
    ],
)
def test_limits_on_states(text, limit):
    with pytest.raises(ValueError, match=f"more than {limit} states"):
        to_automaton(text, max_states=limit)


def test_thirteen_propositions_in_all_of_the_logic():
    text = joined("G F p{i}", 13, "&")
    with pytest.raises(ValueError, match=r"13 propositions.*2\^13 letters.*Pass letters="):
        to_automaton(text)
    one_by_one = [{f"p{i}"} for i in range(13)]
    assert to_automaton(text, one_by_one).delta.shape == (13, 13)
    with pytest.raises(ValueError, match="letters is empty"):
        to_automaton(text, [])


@pytest.mark.few(5)
@pytest.mark.parametrize("seed", [1000, 1001, 1003, 1006, 1008, 1011, 1014, 1017, 1020, 1025])
def test_large_formulas(seed):
    rng = random.Random(seed)
    names = "abc"[: 2 + seed % 2]
    formula = random_formula(rng, seed - 970, names)
    agree(to_automaton(formula), formula, rng, subsets(names), 40)


# Formulas whose normal form is far larger than their automaton.
HOSTILE = [
    "G (((X a <-> G (a | F a)) U X a) M !a)",
    "G !((F b <-> !b) | (((G (!((a R a) M a) & X b) W (G b -> a)) | X (X a & (a | G F X b))) "
    "W X G G (G b <-> F (a M (b U !X b))) M X a))",
    "X ((c M (((G b xor b) & (X (G ((a U G c) M !(c M a)) U (((b <-> F c) U c) W a)) R "
    "(F G !b U (b & a)))) | (X (c W F (b R (b -> a))) & ((true <-> !a) M b)))) xor !b)",
    "(((X (a -> (a R F b)) <-> F (!(b -> X a) <-> (!(a & G true) W !b))) M ((!G F (b W X X a) "
    "R (!a W (b | ((a W b) xor a)))) M (!F a M X b))) U (X a & G true)) W a",
]


@pytest.mark.exhaustive
@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_formulas_end(text):
    """An automaton or a refusal, after work that is bounded."""
    try:
        automaton = to_automaton(text)
    except ValueError as error:
        assert "to_automaton" in str(error) or "to_parity" in str(error)
    else:
        agree(automaton, parse_ltl(text), random.Random(0), subsets(automaton.propositions), 60)


@counts(20, 60)
def test_formulas_are_compared_by_their_words(count):
    rng = random.Random(77)
    different = 0
    for _ in range(count):
        formula, other = (random_formula(rng, rng.randint(2, 8), "ab") for _ in range(2))
        assert is_equivalent(formula, simplify(formula)) and is_equivalent(formula, str(formula))
        word = find_difference(formula, other)
        assert is_equivalent(formula, other) == (word is None)
        if word is not None:
            different += 1
            assert holds_on_lasso(formula, *word) != holds_on_lasso(other, *word)
    assert different > 2 * count / 3


@counts(25, 150)
def test_a_refused_dfa_shows_words_that_no_prefix_decides(count):
    rng = random.Random(78)
    refused = 0
    for _ in range(count):
        formula = random_formula(rng, rng.randint(3, 10), "ab")
        if to_automaton(formula).acceptance in ("buchi", "parity"):
            refused += 1
            with pytest.raises(ValueError, match="has no finite acceptance") as error:
                to_automaton(formula, acceptance="dfa")
            lines = str(error.value).splitlines()
            for line, holds in ((lines[1], False), (lines[2], True)):
                prefix, cycle = re.search(r" on (.*?)\((.*)\)\^w", line).groups()
                word = [
                    [set(filter(None, letter.split(", "))) for letter in re.findall(r"{(.*?)}", x)]
                    for x in (prefix, cycle)
                ]
                assert holds_on_lasso(formula, *word) == holds
    assert refused > count / 8
