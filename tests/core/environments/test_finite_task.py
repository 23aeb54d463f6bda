"""Formulas on rows of labels: cases by hand, and random ones against slow readings."""

import random

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.automata.automaton import make_automaton
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.environments.monitor import (
    Verdict,
    finite_verdict_frequencies,
    finite_verdicts,
    make_finite_task,
    verdict,
    verdict_frequencies,
)
from tests.reference_logic import holds_by_definition, random_formula, subsets, words
from tests.support import counted_traces

MAX_PROGRAMS = 350  # that the default tests compile at most

COLUMNS = ("noise", "goal", "obstacle")
YES, NO, OPEN = Verdict.SATISFIED, Verdict.VIOLATED, Verdict.UNDECIDED

# Words of "." for nothing, "g" for the goal, "o" for the obstacle and "b" for both.
BY_HAND = [
    ("F goal", {"..g": YES, "...": OPEN, "g..": YES, "": OPEN}),
    ("G !obstacle", {"...": OPEN, "..o": NO, "o..": NO, "gg": OPEN}),
    ("!obstacle U goal", {"..g": YES, "o.g": NO, "...": OPEN, ".b": YES, ".go": YES}),
    ("F goal & G !obstacle", {"..g": OPEN, ".og": NO, "gg": OPEN}),
    ("F (goal & X goal)", {".gg": YES, "g.g": OPEN, "g": OPEN}),
    ("X goal", {".g": YES, "g.": NO, "g": OPEN}),
    ("G F goal", {"ggg": OPEN, "...": OPEN}),
    ("goal | !goal", {"": YES, ".": YES}),
    ("goal & !goal", {"": NO, "g": NO}),
    ("obstacle", {"o": YES, ".": NO}),
]


def rows(word):
    return np.array([[len(word) % 2, c in "gb", c in "ob"] for c in word], bool).reshape(-1, 3)


@pytest.mark.parametrize(("formula", "cases"), BY_HAND, ids=[f for f, _ in BY_HAND])
def test_cases_by_hand(formula, cases):
    task = make_finite_task(formula, COLUMNS)
    for word, expected in cases.items():
        padded = rows(word.ljust(3, "b"))  # of one shape, so that one compilation serves all
        assert finite_verdicts(task, padded, len(word)) == expected, word
        assert len(word) < 3 or finite_verdicts(task, padded) == expected, word


def test_random_formulas_against_the_automatons_reading():
    """Columns in another order and more than the formula has; letters by their names."""
    rng, seen = random.Random(0), set()
    names = ("p", "q", "r")
    for _ in range(25):
        formula = random_formula(rng, rng.randint(2, 6), names)
        automaton = to_automaton(formula)
        columns = rng.sample([*names, "other"], 4)
        task = make_finite_task(rng.choice([formula, str(formula), automaton]), columns)
        label = np.array(
            [[[rng.random() < 0.5 for _ in columns] for _ in range(3)] for _ in range(6)], bool
        )
        expected = [
            verdict(
                automaton,
                [
                    {p for p, holds in zip(columns, row, strict=True) if holds}
                    & set(automaton.propositions)
                    for row in word
                ],
            )
            for word in label
        ]
        found = finite_verdicts(task, jnp.asarray(label))
        assert found.tolist() == expected
        shares = finite_verdict_frequencies(task, jnp.asarray(label))
        parts = [expected.count(v) / 6 for v in (YES, NO, OPEN)]
        np.testing.assert_allclose(shares, parts, rtol=1e-12)
        seen |= set(expected)
    assert seen == set(Verdict)


def test_verdicts_are_what_all_continuations_agree_on():
    """By the definition of truth on words, without any automaton."""
    rng, seen = random.Random(1), set()
    letters = subsets(("p",))
    ways = [(prefix, cycle) for prefix in words(letters, 0, 2) for cycle in words(letters, 1, 3)]
    for _ in range(40):
        formula = random_formula(rng, rng.randint(1, 5), ("p",))
        word = [rng.choice(letters) for _ in range(rng.randint(0, 3))]
        label = np.array([[p in letter for p in ("p",)] for letter in word], bool).reshape(-1, 1)
        told = Verdict(int(finite_verdicts(make_finite_task(formula, ["p"]), label)))
        results = {holds_by_definition(formula, (*word, *prefix), cycle) for prefix, cycle in ways}
        assert results == {YES: {True}, NO: {False}}.get(told, {True, False}), str(formula)
        seen.add(told)
    assert seen == set(Verdict)


def test_lengths_cut_trajectories_off():
    task = make_finite_task("F goal", COLUMNS)
    label = jnp.asarray(np.stack([rows("..g"), rows(".g.")]))
    assert finite_verdicts(task, label, jnp.array([2, 2])).tolist() == [OPEN, YES]
    assert finite_verdicts(task, label, 1).tolist() == [OPEN, OPEN]
    assert finite_verdict_frequencies(task, label, jnp.array([2, 2])).satisfied == 0.5


def test_shares_under_jit_and_vmap_of_a_population():
    task = make_finite_task("!obstacle U goal", COLUMNS)
    label = jnp.asarray(np.random.default_rng(0).random((5, 7, 4, 3)) < 0.3)
    shares = jax.jit(finite_verdict_frequencies)
    mapped = jax.vmap(shares, (None, 0))(task, label)
    whole = shares(task, label)
    for i in range(5):
        alone = finite_verdict_frequencies(task, label[i])
        assert [x[i] for x in mapped] == [x[i] for x in whole] == list(alone)
    np.testing.assert_allclose(sum(whole), 1, rtol=1e-12)
    assert all(len(np.unique(x)) > 1 for x in whole)
    other = make_finite_task("!goal U obstacle", COLUMNS)
    swap = label[..., jnp.array([0, 2, 1])]
    with counted_traces() as traced:
        swapped = shares(other, swap)
    assert not traced, "another formula of as many letters and states"
    np.testing.assert_array_equal(swapped, whole)


def test_axes_of_shares():
    told = jnp.array([[1, 1, 2], [0, 1, 2]])
    assert verdict_frequencies(told, axis=0).satisfied.tolist() == [0.5, 1, 0]
    assert [float(x) for x in verdict_frequencies(told, axis=None)] == [0.5, 2 / 6, 1 / 6]


def test_unknown_propositions_are_refused():
    with pytest.raises(ValueError, match=r"'F gaol' mentions .* Did you mean 'goal'\?"):
        make_finite_task("F gaol", COLUMNS)
    with pytest.raises(ValueError, match="the automaton mentions the proposition 'wall'"):
        make_finite_task(to_automaton("G !wall"), COLUMNS)
    with pytest.raises(ValueError, match=r"'goal' .*occurs twice"):
        make_finite_task("F goal", ("goal", "goal"))


def test_automata_must_read_every_letter():
    both_orders = make_automaton(
        [[1, 0], [1, 1]], 0, [[True], [False]], ["goal"], final=[False, True], acceptance="cosafe"
    )
    task = make_finite_task(both_orders, COLUMNS)
    assert finite_verdicts(task, rows("..g")) == YES
    assert finite_verdicts(task, rows("...")) == OPEN
    partial = to_automaton("F (goal & obstacle)", letters=[set(), {"goal", "obstacle"}])
    with pytest.raises(ValueError, match=r"does not read the letter \{goal\}"):
        make_finite_task(partial, COLUMNS)


def test_labels_that_do_not_fit_are_refused():
    task = make_finite_task("F goal", COLUMNS)
    for label in (np.zeros((4, 2), bool), np.zeros(3, bool), np.zeros((4, 3))):
        with pytest.raises(ValueError, match=r"give booleans \[\.\.\., T, 3\]"):
            finite_verdicts(task, label)
    with pytest.raises(ValueError, match="an axis of trajectories"):
        finite_verdict_frequencies(task, np.zeros((4, 3), bool))
