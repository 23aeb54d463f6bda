"""Automata in the Hanoi format: what is read, what is refused, and what is written."""

import random
import re
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from jaxltl.core.automata.automaton import accepts_lasso, complement, make_automaton
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.logic.ltl import holds_on_lasso
from jaxltl.io.hoa.hoa import read_hoa, read_hoa_stream, write_hoa
from tests.reference_logic import subsets, words


def lassos(names, longest_prefix=1, longest_cycle=3):
    letters = subsets(names)
    prefixes = words(letters, 0, longest_prefix)
    yield from product(prefixes, list(words(letters, 1, longest_cycle)))


def assert_language(automaton, formula, names):
    """The automaton agrees with the formula on all short lassos over the names."""
    for prefix, cycle in lassos(names, longest_cycle=3 if len(names) < 3 else 2):
        expected = holds_on_lasso(formula, prefix, cycle)
        assert accepts_lasso(automaton, prefix, cycle) == expected, (prefix, cycle)


def assert_same(left, right):
    """Equal in every field."""
    assert left.delta.tolist() == right.delta.tolist()
    assert left.priority.tolist() == right.priority.tolist()
    assert left.letters.tolist() == right.letters.tolist()
    assert int(left.initial) == int(right.initial)
    assert left.propositions == right.propositions
    assert left.acceptance == right.acceptance
    assert left.state_names == right.state_names
    for table in ("delta", "priority", "letters"):
        assert getattr(left, table).dtype == getattr(right, table).dtype
        assert getattr(left, table).shape == getattr(right, table).shape


# ---------------------------------------------------------------------------------------------
# What is read: a text, and the formula that says what it means
# ---------------------------------------------------------------------------------------------

SPOT_BUCHI = """HOA: v1
name: "GFa"
States: 1
Start: 0
AP: 1 "a"
acc-name: Buchi
Acceptance: 1 Inf(0)
properties: trans-labels explicit-labels trans-acc complete
properties: deterministic stutter-invariant
--BODY--
State: 0
[0] 0 {0}
[!0] 0
--END--
"""
SPOT_STATE_BUCHI = """HOA: v1
name: "GFa"
States: 2
Start: 1
AP: 1 "a"
acc-name: Buchi
Acceptance: 1 Inf(0)
properties: trans-labels explicit-labels state-acc complete
properties: deterministic stutter-invariant
--BODY--
State: 0 "{0}" {0}
[!0] 1
[0] 0
State: 1 "1"
[0] 0
[!0] 1
--END--
"""
SPOT_TGBA = """HOA: v1.1
name: "GFa & GFb"
States: 1
Start: 0
AP: 2 "b" "a"
acc-name: generalized-Buchi 2
Acceptance: 2 Inf(0)&Inf(1)
properties: trans-labels explicit-labels trans-acc complete !weak
properties: deterministic stutter-invariant
--BODY--
State: 0
[!0&!1] 0
[0&!1] 0 {0}
[!0&1] 0 {1}
[0&1] 0 {0 1}
--END--
"""
SPOT_CO_BUCHI = """HOA: v1
name: "FGa"
States: 1
Start: 0
AP: 1 "a"
acc-name: co-Buchi
Acceptance: 1 Fin(0)
properties: trans-labels explicit-labels trans-acc complete
properties: deterministic weak
--BODY--
State: 0
[!0] 0 {0}
[0] 0
--END--
"""
SPOT_RABIN = """HOA: v1
name: "FGa | GFb"
States: 1
Start: 0
AP: 2 "a" "b"
acc-name: Rabin 2
Acceptance: 4 (Fin(0) & Inf(1)) | (Fin(2) & Inf(3))
properties: trans-labels explicit-labels trans-acc complete deterministic
--BODY--
State: 0
[!0&!1] 0 {0}
[0&!1] 0 {1}
[!0&1] 0 {0 3}
[0&1] 0 {1 3}
--END--
"""
OWL_PARITY = """HOA: v1
tool: "ltl2dpa" "21.0"
name: "Automaton for ((G(F(a))) | (F(G(b))))"
owlArgs: "ltl2dpa" "-f" "GFa | FGb"
Start: 0
acc-name: parity min even 3
Acceptance: 3 Inf(0) | (Fin(1) & Inf(2))
properties: trans-labels explicit-labels trans-acc no-univ-branch
properties: deterministic unambiguous complete
AP: 2 "a" "b"
--BODY--
State: 0 "[GF(a), FG(b)]"
[0] 0 {0}
[!0 & !1] 0 {1}
[!0 & 1] 0 {2}
--END--
"""
OWL_PARITY_ODD = """HOA: v1
tool: "owl" "21.0"
Start: 0
acc-name: parity min odd 3
Acceptance: 3 Fin(0) & (Inf(1) | Fin(2))
AP: 2 "a" "b"
--BODY--
State: 0 "x" [0] 0 {0} [!0 & 1] 0 {1} [!0 & !1] 0 {2}
--END--
"""


def one_state(acceptance, body, header=""):
    return (
        f'HOA: v1 States: 1 Start: 0 AP: 2 "a" "b" {header} Acceptance: {acceptance}\n'
        f"--BODY--\nState: 0 {body}\n--END--"
    )


READ = {
    "Spot, transition-based Buchi": (SPOT_BUCHI, "G F a"),
    "Spot, state-based Buchi": (SPOT_STATE_BUCHI, "G F a"),
    "Spot, generalised Buchi, version 1.1": (SPOT_TGBA, "G F a & G F b"),
    "Spot, co-Buchi": (SPOT_CO_BUCHI, "F G a"),
    "Spot, Rabin": (SPOT_RABIN, "F G a | G F b"),
    "Owl, parity min even": (OWL_PARITY, "G F a | F G b"),
    "Owl, parity min odd": (OWL_PARITY_ODD, "F G !a & G F (!a & b) | F G (!a & b)"),
    "all": (one_state("0 t", "[t] 0"), "true"),
    "none": (one_state("0 f", "[t] 0"), "false"),
    "incomplete, all": (one_state("0 t", "[0] 0"), "G a"),
    "incomplete, co-Buchi": (one_state("1 Fin(0)", "[0 & 1] 0 [0&!1] 0 {0}"), "G a & F G b"),
    "a state without edges": (one_state("0 t", ""), "false"),
    "incomplete, generalised Buchi":
        (one_state("2 Inf(0)&Inf(1)", "[0&1] 0 {0} [0&!1] 0 {1}"), "G a & G F b & G F !b"),
    "implicit labels": (one_state("1 Inf(0)", "0 0 {0} 0 0"), "G F (a & !b)"),
    "implicit labels, other order": (
        'HOA: v1 Start: 0 AP: 2 "b" "a" Acceptance: 1 Inf(0) --BODY-- State: 0 0 0 {0} 0 0 --END--',
        "G F (b & !a)",
    ),
    "implicit labels without propositions":
        ("HOA: v1 Start: 0 Acceptance: 1 Inf(0) --BODY-- State: 0 0 {0} --END--", "true"),
    "state labels": (
        'HOA: v1 Start: 0 AP: 1 "a" Acceptance: 0 t properties: state-labels --BODY--\n'
        "State: [0] 0 1 State: [!0] 1 0 --END--",
        "a & G (a -> X !a) & G (!a -> X a)",
    ),
    "aliases": (
        one_state("1 Inf(0)", "[@ab] 0 {0} [!@ab] 0", "Alias: @a 0 Alias: @ab @a & !(1 | f)"),
        "G F (a & !b)",
    ),
    "an alias before AP:": (
        'HOA: v1 Alias: @x-1 !0 AP: 1 "a" Start: 0 Acceptance: 0 t --BODY-- State: 0 [@x-1] 0 '
        "--END--",
        "G !a",
    ),
    "precedence in labels": (one_state("0 t", "[!0 & 1 | 0 & !1] 0"), "G (a xor b)"),
    "precedence in the condition":
        (one_state("3 Inf(0)|Inf(1)&Inf(2)", "[0&1] 0 {0} [0&!1] 0 {1} [!0&1] 0 {2} [!0&!1] 0"),
         "G F (a & b) | (G F (a & !b) & G F (!a & b))"),
    "complemented sets": (one_state("1 Fin(!0)", "[0] 0 {0} [!0] 0"), "F G a"),
    "complemented sets and Inf": (one_state("1 Inf(!0)", "[0] 0 {0} [!0] 0"), "G F !a"),
    "a set and its complement":
        (one_state("1 Inf(0) & Inf(!0)", "[0] 0 {0} [!0] 0"), "G F a & G F !a"),
    "unused sets": (one_state("4 Inf(2)", "[0] 0 {0 2 3} [!0] 0 {1}"), "G F a"),
    "a misleading acc-name":
        (one_state("1 Fin(0)", "[0] 0 {0} [!0] 0", "acc-name: parity max odd 7"), "F G !a"),
    "nested comments": (
        '/* HOA: v0 /* " */ --END-- */ HOA: v1 /* \n\n */ Start: 0 AP: 1 "/*a*/" Acceptance: 0 t '
        "--BODY--/**/State:/*1*/0[0/*|!0*/]0--END--",
        'G "/*a*/"',
    ),
    "one line": (" ".join(SPOT_BUCHI.split()), "G F a"),
    "many lines": ("\r\n".join(SPOT_BUCHI.split(" ")), "G F a"),
    "quoted names": (
        r'HOA: v1 Start: 0 AP: 1 "a \"\\x\" b" Acceptance: 0 t --BODY-- State: 0 [0] 0 --END--',
        r'G "a \"\\x\" b"',
    ),
    "unknown lower-case headers":
        (one_state("0 t", "[0] 0", 'controllable-AP: 0 1 note: t "x" y'), "G a"),
    "the words t and f are headers before a colon": (one_state("0 t", "[0] 0", "t: 1 f: 2"), "G a"),
    "generalised co-Buchi": (
        one_state("2 Fin(0) | Fin(1)", "[0&1] 0 [0&!1] 0 {1} [!0&1] 0 {0} [!0&!1] 0 {0 1}"),
        "F G a | F G b",
    ),
    "Streett": (
        one_state("2 Fin(0) | Inf(1)", "[0&1] 0 {0 1} [0&!1] 0 {0} [!0&1] 0 {1} [!0&!1] 0"),
        "G F a -> G F b",
    ),
    "two Streett pairs": (
        one_state("4 (Fin(0) | Inf(1)) & (Fin(2) | Inf(3))",
                  "[0&1] 0 {0 1 2 3} [0&!1] 0 {0 3} [!0&1] 0 {1 2} [!0&!1] 0"),
        "G F a <-> G F b",
    ),
    "generalised Rabin": (
        one_state("3 Fin(0) & Inf(1) & Inf(2)",
                  "[0&1] 0 {0} [0&!1] 0 {1} [!0&1] 0 {2} [!0&!1] 0"),
        "F G !(a & b) & G F a & G F b",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", READ)
def test_a_text_means_its_formula(case):
    text, formula = READ[case]
    automaton = read_hoa(text)
    assert_language(automaton, formula, automaton.propositions)


def test_marks_of_a_state_are_on_all_its_edges_beside_their_own():
    automaton = read_hoa(
        'HOA: v1 States: 2 Start: 0 AP: 1 "a" Acceptance: 2 Inf(0) & Inf(1) --BODY-- '
        "State: 1 {0} [0] 0 [!0] 1 State: 0 [0] 1 {1} [!0] 1 --END--"
    )
    for prefix, cycle in lassos(["a"], 2, 4):
        # Both marks recur iff the run returns to state 0 for ever and leaves it reading a.
        state, steps = 0, []
        for letter in [*prefix, *list(cycle) * 6]:
            steps.append((state, "a" in letter))
            state = 1 if state == 0 else 0 if "a" in letter else 1
        late = steps[len(prefix) + 2 * len(cycle) :]
        expected = (0, True) in late and any(q == 1 for q, _ in late)
        assert accepts_lasso(automaton, prefix, cycle) == expected


def test_states_keep_their_numbers_and_names():
    automaton = read_hoa(SPOT_STATE_BUCHI)
    assert (int(automaton.initial), automaton.state_names) == (1, ("{0}", "1"))
    assert automaton.delta.tolist() == [[1, 0], [1, 0]]
    assert automaton.priority.tolist() == [[0, 0], [1, 1]]
    assert automaton.acceptance == "buchi"


def test_an_added_state_comes_last_and_rejects():
    automaton = read_hoa(one_state("1 Fin(0)", '"x" [0] 0'))
    assert automaton.state_names == ("x", "false")
    assert automaton.delta.tolist() == [[1, 0, 1, 0], [1, 1, 1, 1]]
    assert (automaton.priority[1] == 1).all()


def test_co_buchi_has_priorities_one_and_two():
    automaton = read_hoa(SPOT_CO_BUCHI)
    assert (automaton.acceptance, automaton.priority.tolist()) == ("parity", [[1, 2]])


def test_a_stream_is_read_in_order_without_aborted_automata():
    text = SPOT_BUCHI + "HOA: v1 States: --ABORT--" + SPOT_CO_BUCHI + one_state("0 t", "[t] 0")
    cut = SPOT_BUCHI.replace("--END--", "--ABORT--")
    found = read_hoa_stream(cut + text + cut)
    assert [a.acceptance for a in found] == ["buchi", "parity", "buchi"]
    assert read_hoa_stream(" /* nothing */ ") == []
    assert_same(read_hoa(cut + SPOT_TGBA), read_hoa(SPOT_TGBA))


def test_end_inside_a_word_is_no_end():
    text = SPOT_BUCHI.replace("stutter-invariant", "foo--ABORT--")
    assert_same(read_hoa(text), read_hoa(SPOT_BUCHI))


def test_letters_restrict_the_alphabet():
    automaton = read_hoa(SPOT_TGBA, letters=iter([{"b"}, set(), {"b", "unrelated"}]))
    assert automaton.propositions == ("a", "b")
    assert automaton.letters.tolist() == [[False, False], [False, True]]
    assert not accepts_lasso(automaton, [], [{"b"}])
    both = read_hoa_stream(SPOT_BUCHI + SPOT_TGBA, letters=iter([{"a", "b"}]))
    assert [len(a.letters) for a in both] == [1, 1]


def test_many_propositions_need_letters():
    names = " ".join(f'"p{i}"' for i in range(70))
    body = "--BODY-- State: 0 [69] 0 {0} [!69] 0 --END--"
    text = f"HOA: v1 Start: 0 AP: 70 {names} Acceptance: 1 Inf(0) {body}"
    with pytest.raises(ValueError, match=r"line 1: .*70 propositions.*Pass letters="):
        read_hoa(text)
    automaton = read_hoa(text, letters=[set(), {"p69"}, {"p0"}])
    assert len(automaton.letters) == 3
    assert accepts_lasso(automaton, [], [{"p0"}, {"p69"}])
    assert not accepts_lasso(automaton, [{"p69"}], [{"p0"}])


def test_letters_hide_what_they_leave_out():
    text = one_state("0 t", "[0] 0 [1] 0")  # two edges for {a, b}
    automaton = read_hoa(text, letters=[{"a"}, {"b"}])
    assert automaton.delta.tolist() == [[0, 0]]
    with pytest.raises(ValueError, match="letters is empty"):
        read_hoa(text, letters=[])
    with pytest.raises(ValueError, match="read_hoa: letters: letter 0 is 'a'"):
        read_hoa(text, letters="ab")


# ---------------------------------------------------------------------------------------------
# Conditions
# ---------------------------------------------------------------------------------------------


def parity_formula(style, parity, count):
    """The canonical formula of the format, from the least important set on."""
    order = range(count) if style == "min" else range(count)[::-1]
    accepts = [i % 2 == (parity == "odd") for i in order]
    # Without any set, the next number in the order decides.
    text = None
    for i, good in reversed(list(zip(order, accepts, strict=True))):
        atom = f"Inf({i})" if good else f"Fin({i})"
        text = f"{atom} {'|' if good else '&'} ({text})" if text else atom
    if text is None:
        return "t" if (style, parity) in {("min", "even"), ("max", "odd")} else "f"
    return text


def distributed(style, parity, count):
    """The same as a disjunction of conjunctions, as older tools write it, or None if empty."""
    order = list(range(count) if style == "min" else range(count)[::-1])
    parts = [
        " & ".join([*(f"Fin({j})" for j in order[:k]), f"Inf({i})"])
        for k, i in enumerate(order)
        if i % 2 == (parity == "odd")
    ]
    return " | ".join(f"({part})" for part in parts) or None


@pytest.mark.parametrize("style", ["min", "max"])
@pytest.mark.parametrize("parity", ["even", "odd"])
@pytest.mark.parametrize("count", range(6))
def test_parity_of_every_style_is_direct(style, parity, count):
    names = ["a", "b", "c"]
    # Letter number l carries mark l, where there is one, and those above count none.
    body = "".join(f" 0 {{{letter}}}" if letter < count else " 0" for letter in range(8))
    head = 'HOA: v1 States: 1 Start: 0 AP: 3 "a" "b" "c"'
    empty = count % 2 == (parity == "odd") if style == "min" else parity == "odd"
    canonical, older = parity_formula(style, parity, count), distributed(style, parity, count)
    for formula in filter(None, (canonical, older)):
        text = f"{head} Acceptance: {count} {formula} --BODY-- State: 0 {body} --END--"
        automaton = read_hoa(text)
        assert len(automaton.delta) == 1
        if formula == canonical and (style, parity) == ("min", "even"):
            assert automaton.priority[0, :count].tolist() == list(range(count))
        numbers = {i: {n for p, n in enumerate(names) if i >> p & 1} for i in range(8)}
        for cycle in words(range(8), 1, 2):
            seen = [letter for letter in cycle if letter < count]
            best = (min if style == "min" else max)(seen, default=None)
            expected = empty if best is None else best % 2 == (parity == "odd")
            if best is None and formula == older:
                expected = False  # every conjunction has an Inf
            assert accepts_lasso(automaton, [], [numbers[i] for i in cycle]) == expected


def random_condition(rng, sets, depth):
    """A formula as text and the function that evaluates it on (marks seen, marks missed)."""
    if depth == 0 or rng.random() < 0.25:
        x, positive, inf = rng.randrange(sets), rng.random() < 0.75, rng.random() < 0.5
        text = f"{'Inf' if inf else 'Fin'}({'' if positive else '!'}{x})"
        return text, lambda seen, missed: (x in (seen if positive else missed)) == inf
    parts = [random_condition(rng, sets, depth - 1) for _ in range(rng.choice([2, 2, 3]))]
    sign, combine = rng.choice([("&", all), ("|", any)])
    text = f" {sign} ".join(f"({text})" for text, _ in parts)
    return text, lambda seen, missed: combine(value(seen, missed) for _, value in parts)


def random_text(rng, states, sets, condition):
    """A text over a and b with its tables: successor, or None, and marks by state and letter."""
    tables, lines = {}, []
    for q in rng.sample(range(states), states):
        on_state = {s for s in range(sets) if rng.random() < 0.15}
        implicit = rng.random() < 0.4
        lines.append(f"State: {q} " + (f"{{{' '.join(map(str, on_state))}}}" if on_state else ""))
        for i, label in enumerate(("!0 & !1", "0 & !1", "!0 & 1", "0 & 1")):
            marks = {s for s in range(sets) if rng.random() < 0.3}
            target = rng.randrange(states)
            if not implicit and rng.random() < 0.1:
                tables[q, i] = None
                continue
            tables[q, i] = (target, marks | on_state)
            lines.append(("" if implicit else f"[{label}] ") + f"{target} "
                         + (f"{{{' '.join(map(str, marks))}}}" if marks else ""))  # fmt: skip
    start = rng.randrange(states)
    head = f'HOA: v1 AP: 2 "a" "b" Start: {start} Acceptance: {sets} {condition}'
    return "\n".join([head, "--BODY--", *lines, "--END--"]), tables, start


def test_any_condition_agrees_with_its_definition():
    rng = random.Random(5)
    letters = [frozenset(n for p, n in enumerate("ab") if i >> p & 1) for i in range(4)]
    for _ in range(60):
        states, sets = rng.choice([1, 2, 3, 4]), rng.choice([1, 2, 3, 4])
        condition, value = random_condition(rng, sets, rng.choice([0, 1, 2, 3]))
        text, tables, start = random_text(rng, states, sets, condition)
        automaton = read_hoa(text)
        for _ in range(40):
            prefix = rng.choices(range(4), k=rng.randrange(3))
            cycle = rng.choices(range(4), k=rng.randint(1, 4))
            marks, state = [], start
            for letter in [*prefix, *cycle * (2 * states + 2)]:
                step = None if state is None else tables[state, letter]
                marks.append(None if step is None else step[1])
                state = None if step is None else step[0]
            # After `states` laps the states repeat lap by lap, at most every `states` laps.
            late = marks[len(prefix) + (states + 1) * len(cycle) :]
            expected = None not in late and value(
                set().union(*late), {s for s in range(sets) if any(s not in m for m in late)}
            )
            got = accepts_lasso(
                automaton, [letters[i] for i in prefix], [letters[i] for i in cycle]
            )
            assert got == expected, (text, prefix, cycle)


# ---------------------------------------------------------------------------------------------
# What is refused
# ---------------------------------------------------------------------------------------------


def lines(header="", acceptance="Acceptance: 1 Inf(0)", body="State: 0\n[t] 0\nState: 1\n[t] 1"):
    """A text with the header in line 4, the acceptance in line 5 and the body from line 7 on."""
    head = f'HOA: v1\nStates: 2\nAP: 2 "a" "b"\n{header or "Start: 0"}\n{acceptance}\n'
    return f"{head}--BODY--\n{body}\n--END--\n"


def body(state):
    return lines(body=f"State: 1 [t] 1\n{state}")


REFUSED = {
    "overlapping labels":
        (body("State: 0\n[0] 0\n[1] 1"), "line 10: state 0 has two edges for the letter {a, b}"),
    "overlap although said to be deterministic":
        (lines("Start: 0 properties: deterministic", body="State: 0 [t] 0 [1] 1 State: 1"),
         "line 7: state 0 has two edges for the letter {b}"),
    "two edges of a labelled state":
        (body("State: [0] 0 0 1"), "line 8: state 0 has two edges for the letter {a}"),
    "several initial states": (lines("Start: 0 Start: 1"), "line 4: there are several initial"),
    "a conjunction of initial states":
        (lines("Start: 0&1"), "line 4: Start: 0 & 1 branches universally"),
    "universal branching":
        (body("State: 0\n[0] 0&1"), "line 9: the edge of state 0 to 0 & 1 branches universally"),
    "universal branching without labels": (body("State: 0\n0&1"), "line 9: .*universally"),
    "a set in the formula": (lines(acceptance="Acceptance: 1 Inf(1)"),
                             "line 5: acceptance set 1 is out of range.*counts 1"),
    "a set on an edge": (body("State: 0 [t]\n0 {0 1}"), "line 9: acceptance set 1 is out of range"),
    "a set on a state": (body("State: 0 {2} [t] 0"), "line 8: acceptance set 2 is out of range"),
    "an unknown atom": (lines(acceptance="Acceptance: 1 Often(0)"), "line 5: .*Often\\(0\\)"),
    "a proposition": (body("State: 0\n[0 | !2] 0"), "line 9: proposition 2 is out of range"),
    "a proposition in an alias":
        (lines("Start: 0 Alias: @a 7"), "line 4: proposition 7 is out of range"),
    "an undefined alias": (body("State: 0\n[@a] 0"), "line 9: the alias @a is not defined"),
    "an alias used too early":
        (lines("Start: 0 Alias: @b @a Alias: @a 0"), "line 4: the alias @a is not defined"),
    "an alias of itself": (lines("Start: 0 Alias: @a !@a"), "line 4: the alias @a is not defined"),
    "an alias twice":
        (lines("Start: 0 Alias: @a 0\nAlias: @a 0"), "line 5: the alias @a is defined twice"),
    "a state number": (body("State: 2"), "line 8: state 2 is out of range.*counts 2"),
    "a state twice": (body("State: 0\nState: 1"), "line 9: state 1 is defined twice.*line 7"),
    "a target that is not defined": (body("State: 0\n[t] 3"), "line 9: state 3 is not defined"),
    "a start that is not defined": (lines("Start: 2"), "line 4: state 2 is not defined"),
    "a state that is missing": (lines(body="State: 0"), "line 1: state 1 of 2 is not defined"),
    "a gap without States:":
        ("HOA: v1 Start: 2 Acceptance: 0 t --BODY-- State: 2 State: 0 --END--",
         "line 1: state 1 of 3 is not defined"),
    "no HOA:": ("\n" + lines()[8:], "line 2: column 1: found 'States:', expected 'HOA:'"),
    "no Acceptance:": (lines(acceptance=""), "line 1: the header Acceptance: is missing"),
    "no Start:": (lines("note: 0"), "line 1: the header Start: is missing"),
    "no AP:": ("HOA: v1 Start: 0 Acceptance: 0 t --BODY--\nState: 0 [0] 0 --END--",
               "line 2: proposition 0 is out of range, since AP: counts 0"),
    "no --END--": (lines().replace("--END--", ""),
                   "line 10: column 5: found the end of the text.*ends with --END--"),
    "no --END-- before the next": (lines().replace("--END--", "") + lines(),
                                   "line 12: column 1: found 'HOA:'.*ends with --END--"),
    "no --BODY--": (lines().replace("--BODY--", ""), "line 7: column 1: found 'State:'"),
    "too few implicit edges": (body("State: 0 0 0 0"), "line 8: .*of state 0 is 3, expected 2.2"),
    "too many implicit edges": (body("State: 0 0 0 0 0 0"), "line 8: .*is 5, expected 2.2"),
    "labels on some edges":
        (body("State: 0\n[0] 0\n1"), "line 10: state 0 has edges with a label and edges without"),
    "labels on a state and its edges":
        (body("State: [0] 0\n[0] 0"), "line 8: state 0 has a label and so have its edges"),
    "a version": (lines().replace("v1", "v2"), "line 1: version v2 is unknown"),
    "an unknown header": (lines("Start: 0 Fairness: 1"), "line 4: the header Fairness: is unknown"),
    "States: twice": (lines("Start: 0 States: 2"), "line 4: the header States: is given twice"),
    "AP: twice": (lines('Start: 0 AP: 1 "a"'), "line 4: the header AP: is given twice"),
    "Acceptance: twice":
        (lines("Start: 0 Acceptance: 0 t"), "line 5: the header Acceptance: is given twice"),
    "name: twice": (lines('Start: 0 name: "" name: ""'), "line 4: the header name: is given twice"),
    "propositions miscounted":
        (lines().replace("AP: 2", "AP: 3"), "line 3: AP: counts 3 propositions and names 2"),
    "equal propositions": (lines().replace('"b"', '"a"'), "line 3: AP: names 'a' twice"),
    "a label that does not end":
        (body("State: 0\n  [0 & ] 0"), r"line 9: column 8: found '\]', expected .*a number"),
    "two propositions side by side": (body("State: 0 [0 1] 0"), "line 8: column 13: found '1'"),
    "a strange character": (body("State: 0 [0 ^ 1] 0"), r"line 8: column 13: found '\^'"),
    "an open quote": (body('State: 0 "x'), "line 8: column 10: .*never closed"),
    "an open comment": (body("State: 0 /* /* */"), "line 8: the comment.*never closed"),
    "a number with zeros": (body("State: 00"), "line 8: 00 is not a number"),
    "a number too large": (body("State: 2147483648"), "line 8: 2147483648 is not a number"),
    "a number far too large": (body("State: " + "9" * 9999), "line 8: 9{20} is not a number"),
    "a huge States:": (lines().replace("States: 2", "States: 2147483647"),
                       "line 1: state 2 of 2147483647 is not defined"),
    "a deep label": (body(f"State: 0 [{'!' * 50_000}0] 0"), "line 1: .*nests hundreds of levels"),
    "a deep formula": (
        lines(acceptance="Acceptance: 1 " + "(Inf(0) | t & " * 3000 + "f" + ")" * 3000),
        "line 1: .*nests hundreds of levels",
    ),
    "too many sets": (
        lines(acceptance="Acceptance: 70 " + " & ".join(f"Inf({i})" for i in range(70))),
        "line 1: the acceptance formula has 70 sets",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_a_fault_is_named_with_its_line(case):
    text, message = REFUSED[case]
    with pytest.raises(ValueError, match="(?s)^read_hoa: " + message) as raised:
        read_hoa(text)
    assert str(raised.value).endswith("."), "the fix is a sentence"
    if "no --END-- before" not in case:
        with pytest.raises(ValueError, match="(?s)^read_hoa: " + message):
            read_hoa_stream(text)


def test_lines_are_counted_through_the_stream():
    text = SPOT_BUCHI + "/*\n\n*/" + SPOT_BUCHI.replace("[!0]", "[t]")
    number = text[: text.index("[t]")].count("\n") + 1
    with pytest.raises(ValueError, match=f"read_hoa: line {number}: state 0 has two edges"):
        read_hoa_stream(text)


@pytest.mark.parametrize(("text", "count"), [("", 0), (SPOT_BUCHI * 2, 2), ("--ABORT--", 0)])
def test_exactly_one_automaton_is_expected(text, count):
    with pytest.raises(ValueError, match=f"holds {count} automata"):
        read_hoa(text)


def test_only_text_is_read():
    with pytest.raises(ValueError, match="expected text in the Hanoi format, got bytes"):
        read_hoa(b"HOA: v1")


# ---------------------------------------------------------------------------------------------
# What is written
# ---------------------------------------------------------------------------------------------

FORMULAS = [
    "true", "false", "F a", "G a", "a U b", "!a W (b & c)", "X X a", "F a & F b & F c",
    "G (a -> X b)", "F (a & X (b | X c))", "(a U b) & (!c U d)", "a xor b", "a R b", "a M b",
    'F "Goal 1" & g_1 U "\\"x\\\\"',
]  # fmt: skip


@pytest.mark.parametrize("formula", FORMULAS)
def test_automata_of_formulas_come_back_as_they_were(formula):
    automaton = to_automaton(formula)
    for each in (automaton, complement(automaton)):
        assert_same(read_hoa(write_hoa(each, name=formula)), each)


@pytest.mark.parametrize("formula", ["!r U g", "G !r", "F (g & X r)", "r | !r", "F (r & !r)"])
def test_automata_over_some_letters_come_back_over_these_letters(formula):
    letters = [set(), {"r"}, {"g"}]
    automaton = to_automaton(formula, letters=letters)
    for each in (automaton, complement(automaton)):
        text = write_hoa(each)
        assert_same(read_hoa(text, letters=letters), each)
        if len(each.letters) < 2 ** len(each.propositions):
            assert not re.search(r"\b(complete|terminal)\b", text)
            open_world = read_hoa(text)  # other letters are rejected for ever
            assert not accepts_lasso(open_world, [{"r", "g"}], [set()])


def random_automaton(rng, acceptance):
    states, names = int(rng.integers(1, 7)), list("abcd"[: rng.integers(0, 5)])
    letters = np.arange(2 ** len(names))[:, None] >> np.arange(len(names)) & 1 == 1
    delta = rng.integers(states, size=(states, len(letters)))
    given = {}
    if acceptance in ("cosafe", "safety"):
        final = rng.random(states) < 0.4
        absorbing = np.flatnonzero(final if acceptance == "cosafe" else ~final)
        for q in absorbing:
            delta[q] = rng.choice(absorbing, size=len(letters))
        given = {"final": final, "acceptance": acceptance}
    elif acceptance == "buchi":
        given = {"accepting": rng.random(delta.shape) < 0.4}
    else:
        given = {"priority": rng.integers(rng.integers(1, 7), size=delta.shape)}
    pool = ['s "x"', "a\\b\n", "", "ü"]
    state_names = rng.choice(pool, size=states).tolist() if rng.random() < 0.5 else []
    return make_automaton(
        delta, int(rng.integers(states)), letters, names, state_names=state_names, **given
    )


@pytest.mark.parametrize("acceptance", ["cosafe", "safety", "buchi", "parity"])
def test_random_automata_come_back_as_they_were(acceptance):
    rng = np.random.default_rng(11)
    for _ in range(25):
        automaton = random_automaton(rng, acceptance)
        text = write_hoa(automaton)
        assert_same(read_hoa(text), automaton)
        assert write_hoa(read_hoa(text)) == text


@pytest.mark.parametrize("acceptance", ["cosafe", "safety", "buchi", "parity"])
def test_other_orders_come_back_sorted_with_the_same_language(acceptance):
    rng = np.random.default_rng(13)
    automaton = random_automaton(rng, acceptance)
    while len(automaton.propositions) != 3:
        automaton = random_automaton(rng, acceptance)
    order = rng.permutation(8)
    shuffled = replace(
        automaton,
        delta=automaton.delta[:, order],
        priority=automaton.priority[:, order],
        letters=automaton.letters[order][:, [2, 0, 1]],
        propositions=("c", "a", "b"),
    )
    assert_same(read_hoa(write_hoa(shuffled)), automaton)


def test_without_our_marker_final_states_are_a_buchi_condition():
    automaton = to_automaton("F a")
    text = write_hoa(automaton)
    for changed in (text.replace('tool: "jaxltl"', 'tool: "other"'),
                    text.replace(" weak terminal", "")):  # fmt: skip
        again = read_hoa(changed)
        assert again.acceptance == "buchi"
        assert again.priority.tolist() == automaton.priority.tolist()
    # A marker that the structure belies is not believed.
    assert read_hoa(text.replace("[t] 1", "[0] 1 [!0] 0")).acceptance == "buchi"
    safe = write_hoa(to_automaton("G a"))
    assert read_hoa(safe.replace("[t] 1", "[0] 1 [!0] 0")).acceptance == "buchi"


def test_a_written_parity_automaton_is_readable():
    automaton = make_automaton(
        [[0, 1, 1, 1], [1, 0, 0, 0]],
        0,
        [[False, False], [True, False], [False, True], [True, True]],
        ["a", "b"],
        priority=[[3, 2, 2, 2], [0, 1, 1, 3]],
        state_names=["x", 'say "y"'],
    )
    assert write_hoa(automaton, name='a\\"b"').splitlines() == [
        "HOA: v1",
        'tool: "jaxltl"',
        r'name: "a\\\"b\""',
        "States: 2",
        "Start: 0",
        'AP: 2 "a" "b"',
        "acc-name: parity min even 4",
        "Acceptance: 4 Inf(0) | (Fin(1) & (Inf(2) | Fin(3)))",
        "properties: trans-labels explicit-labels trans-acc complete deterministic colored",
        "--BODY--",
        'State: 0 "x"',
        "[!0&!1] 0 {3}",
        "[0 | 1] 1 {2}",
        r'State: 1 "say \"y\""',
        "[!0&!1] 1 {0}",
        "[!0&1 | 0&!1] 0 {1}",
        "[0&1] 0 {3}",
        "--END--",
    ]


def test_priorities_out_of_proportion_are_refused():
    make = [[[0]], 0, np.zeros((1, 0), bool), []]
    with pytest.raises(ValueError, match=r"write_hoa: priority 1000 .*Renumber the priorities"):
        write_hoa(make_automaton(*make, priority=[[1000]]))
    largest = make_automaton(*make, priority=[[255]])
    assert_same(read_hoa(write_hoa(largest)), largest)


# ---------------------------------------------------------------------------------------------
# Damage
# ---------------------------------------------------------------------------------------------


def test_damaged_texts_are_read_or_refused():
    rng = random.Random(3)
    texts = [text for text, _ in READ.values()] + [write_hoa(to_automaton("F (a & X b)"))]
    pieces = [*'0123456789[](){}&|!@"\\/* \ntfé:-', "HOA:", "Start:", "--END--", "--ABORT--", "/*"]
    refused = 0
    for _ in range(600):
        text = rng.choice(texts)
        for _ in range(rng.choice([1, 1, 2, 3])):
            place = rng.randrange(len(text) + 1)
            if rng.random() < 0.5:
                text = text[:place] + text[place + 1 :]
            else:
                text = text[:place] + rng.choice(pieces) + text[place:]
        try:
            read_hoa_stream(text)
        except ValueError as error:
            refused += 1
            assert str(error).startswith(("read_hoa: line ", "to_parity: "))
    assert refused > 100
