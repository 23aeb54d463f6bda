"""Zielonka trees, and sizes of the automata of recurrence formulas with memory."""

import random
from itertools import product

import pytest

from jaxltl.core.automata.automaton import accepts_lasso, complement
from jaxltl.core.automata.emerson_lei import ZielonkaTree, holds, polarities, residual
from jaxltl.core.automata.language import is_equivalent
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.logic.ltl import holds_on_lasso, parse_ltl
from tests.core.automata.test_emerson_lei import random_condition
from tests.reference_logic import random_lasso, subsets


def both(n, m):
    """All of n colors recur iff all of m others do."""
    one, two = range(n), range(n, n + m)
    yes = [("and", *(("inf", c) for c in part)) for part in (one, two)]
    no = [("or", *(("fin", c) for c in part)) for part in (one, two)]
    return ("or", ("and", *yes), ("and", *no))


@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 1), (3, 3), (6, 6)])
def test_an_equivalence_of_conjunctions_has_a_leaf_for_each_pair_and_order(n, m):
    tree = ZielonkaTree(both(n, m), 1000)
    assert tree.children.count([]) == 2 * n * m
    with pytest.raises(ValueError, match="more than 1 states"):
        ZielonkaTree(both(n, m), 1)


def test_the_least_recurring_priority_of_a_zielonka_tree_decides():
    rng = random.Random(0)
    sizes = set()
    for _ in range(150):
        condition = random_condition(rng, 4, rng.randint(1, 7))
        tree = ZielonkaTree(condition, 1000)
        for _ in range(8):
            cycle = [rng.randrange(16) for _ in range(rng.randint(1, 4))]
            leaf, priorities = tree.leaf_below(0), []
            for colors in cycle * 60:
                leaf, priority = tree.step(leaf, colors & tree.colors)
                priorities.append(priority)
            recurring = 0
            for colors in cycle:
                recurring |= colors
            least = min(priorities[len(cycle) * 30 :])
            assert (least % 2 == 0) == holds(condition, recurring), (condition, cycle)
        sizes.add(tree.children.count([]))
    assert max(sizes) >= 4


def test_residual_conditions_by_definition():
    rng = random.Random(1)
    for _ in range(200):
        condition = random_condition(rng, 4, rng.randint(1, 7))
        absent, present = rng.randrange(16), rng.randrange(16)
        present &= ~absent
        small = residual(condition, absent, present)
        inf, fin = polarities(small)
        assert not (inf | fin) & (absent | present)
        for mask in range(16):
            assert holds(small, mask) == holds(condition, mask & ~absent | present)


# The number of leaves of the tree times the memory of the two limits that a leaf waits for,
# unless a comment gives another reason.
FAMILIES = [
    ("(G F a & G F b) <-> G F c", 4),
    ("(G F a & G F b) <-> (G F c & G F d)", 8),
    ("(G F a & G F b & G F c) <-> (G F d & G F e & G F f)", 18),
    ("G F a <-> G F b <-> G F c", 6),
    ("(G F (a & X b) & G F c) <-> G F d", 6),
    ("(G F (a & X b) & G F (b & X a)) <-> G F c", 8),
    ("(G F (a & X b) & G F (c & X d)) <-> G F (e & X f)", 16),
    ("(G F (a & X b) & G F (c & X d)) <-> (G F e & G F f)", 16),
    ("G F (a & X X b) <-> G F (c & X X d)", 32),
    ("(G F a & G F (b & X c)) <-> (G F d & G F (e & X f))", 18),
    # One of two limits with X X and one without it can be missing.
    ("(G F (a & X X b) & G F c) <-> G F d", 10),
    ("G F (a R X X b)", 4),
    ("F G (a U X X b)", 4),
    ("F G (a R X X b)", 1),
    ("G F (a R X X b) & G F (c R X X d)", 14),
    ("G F (a R X X b) | F G (c U X X d)", 17),
    ("G F (a R X X b) & F G (a U X X b)", 4),
    ("G F (a & X X b) & G F (b & X X c) & G F (c & X X a)", 12),
    ("G F (a <-> X X b)", 4),
    ("F x & (G F (a & X b) <-> G F (c & X d))", 9),
    # Two orders of merging: only the second finds all.
    ("F (a & (G a | G b | (c & G d)))", 8),
    ("G (a | (F a & F b & (c | F d)))", 8),
]


@pytest.mark.few(8)
@pytest.mark.parametrize(("text", "states"), FAMILIES)
def test_sizes_of_families(text, states):
    rng = random.Random(text)
    automaton, formula = to_automaton(text), parse_ltl(text)
    letters = subsets(automaton.propositions)
    verdicts = set()
    for _ in range(60):
        few = rng.sample(letters, min(len(letters), rng.randint(1, 6)))
        lasso = random_lasso(rng, few)
        verdicts.add(holds_on_lasso(formula, *lasso))
        assert accepts_lasso(automaton, *lasso) == holds_on_lasso(formula, *lasso), lasso
    assert len(verdicts) == 2
    assert len(automaton.delta) == states


@pytest.mark.slow
def test_an_equivalence_of_limits_with_shared_letters():
    ring = "(G F ({0} & X {1}) & G F ({1} & X {2}) & G F ({2} & X {0}))"
    automaton = to_automaton(f"{ring.format(*'abc')} <-> {ring.format(*'def')}")
    assert len(automaton.delta) == 2 * 3 * 3 * 2 * 2


def test_random_combinations_of_limits():
    """The negation has the complement, and lassos have the formula's verdict."""
    rng = random.Random(2)
    bodies = ["a & X b", "a U X b", "b R X X a", "a & X X !b", "!a | X b", "a", "b W X a"]
    limits = [f"{outer} ({body})" for outer, body in product(("G F", "F G"), bodies)]
    for _ in range(10):
        parts = rng.sample([*limits, "F a", "a U b", "G (a | X b)"], 3)
        one, two = rng.choices(["&", "|", "<->", "->"], k=2)
        text = f"(({parts[0]}) {one} ({parts[1]})) {two} ({parts[2]})"
        automaton = to_automaton(text)
        assert is_equivalent(complement(automaton), to_automaton(f"!({text})")), text
        for _ in range(20):
            lasso = random_lasso(rng, subsets(automaton.propositions))
            assert accepts_lasso(automaton, *lasso) == holds_on_lasso(parse_ltl(text), *lasso)
