"""Simplified formulas and combinations, against truth on lassos."""

import random

import pytest

from jaxltl.core.logic.ltl import holds_on_lasso, negation_normal_form, parse_ltl
from jaxltl.core.logic.normal_form import (
    LimitPart,
    combination,
    is_pi2,
    is_pure,
    is_sigma2,
    limit_parts,
)
from jaxltl.core.logic.simplify import (
    GREATEST,
    LEAST,
    implies,
    is_invariant,
    is_limit,
    negated,
    simplify,
)
from tests.reference_logic import random_formula, random_lasso, subsets

WAYS = [(True, False), (True, True), (False, False), (False, True)]


def truth(parts, lasso):
    if isinstance(parts, LimitPart):
        return holds_on_lasso(parts.formula, *lasso)
    join = all if parts[0] == "&" else any
    return join(truth(part, lasso) for part in parts[1:])


def leaves(parts):
    if isinstance(parts, LimitPart):
        return [parts]
    assert parts[0] in ("&", "|") and len(parts) > 2
    return [leaf for part in parts[1:] for leaf in leaves(part)]


def random_cases(seed, count, largest=14):
    rng = random.Random(seed)
    for _ in range(count):
        names = "abc"[: rng.randint(1, 3)]
        yield (
            random_formula(rng, rng.randint(1, largest), names),
            [random_lasso(rng, subsets(names)) for _ in range(12)],
        )


def test_simplify_keeps_truth():
    shorter = 0
    for formula, lassos in random_cases(0, 700):
        simple = simplify(formula)
        assert negation_normal_form(simple) == simple
        for lasso in lassos:
            assert holds_on_lasso(simple, *lasso) == holds_on_lasso(formula, *lasso), str(formula)
        shorter += len(str(simple)) < len(str(negation_normal_form(formula)))
    assert shorter > 150


def test_simplify_again_changes_little():
    """Laws are applied bottom up, so that most formulas are done; again keeps truth."""
    same = []
    for formula, lassos in random_cases(1, 500):
        simple = simplify(formula)
        again = simplify(simple)
        same.append(again == simple)
        if not same[-1]:
            assert all(holds_on_lasso(again, *x) == holds_on_lasso(simple, *x) for x in lassos)
    assert sum(same) > 0.9 * len(same)


@pytest.mark.parametrize(
    ("text", "simple"),
    [
        ("G F G F a", "G F a"),
        ("F G F a", "G F a"),
        ("G F (a | b)", "G F a | G F b"),
        ("F G (a & b)", "F G a & F G b"),
        ("X G F a", "G F a"),
        ("G F X X a", "G F a"),
        ("F (a & G F b)", "F a & G F b"),
        ("G (a | G F b)", "G a | G F b"),
        ("a U G F b", "G F b"),
        ("a U F b", "F b"),
        ("F (a U b)", "F b"),
        ("a & !a", "false"),
        ("a U true", "true"),
        ("!(a U b)", "!a R !b"),
        ("G F true", "true"),
    ],
)
def test_laws(text, simple):
    found = simplify(parse_ltl(text))
    assert str(found) == simple and simplify(found) == found


@pytest.mark.parametrize(("grouped", "dual"), WAYS)
def test_combination_keeps_truth_and_its_parts_have_their_classes(grouped, dual):
    kinds = {"sigma2": 0, "pi2": 0, "limit": 0}
    verdicts = []
    for formula, lassos in random_cases(2, 300):
        parts = combination(simplify(formula), grouped, dual)
        for lasso in lassos:
            verdicts.append(holds_on_lasso(formula, *lasso))
            assert truth(parts, lasso) == verdicts[-1], str(formula)
        for part in leaves(parts):
            kinds[part.kind] += 1
            if part.kind == "sigma2":
                assert is_sigma2(part.formula), str(part.formula)
            elif part.kind == "pi2":
                assert is_pi2(part.formula), str(part.formula)
            else:
                limits = limit_parts(part.formula)
                assert all(map(is_limit, limits))
                assert len({limit.operator for limit in limits}) == 1
                for limit in limits:
                    absent = GREATEST if limit.operator == "G" else LEAST
                    assert is_pure(limit.operands[0].operands[0], absent), str(limit)
                if len(limits) > 1:  # conjunctions of G F, disjunctions of F G
                    outer = {"&": "G", "|": "F"}[part.formula.operator]
                    assert limits[0].operator == outer
    assert min(kinds.values()) > 20 and 0.2 < sum(verdicts) / len(verdicts) < 0.8


def test_deeply_mixed_formulas():
    """Alternations beyond the second level, which are what the rewriting is for."""
    rng = random.Random(3)
    texts = [
        "G (a -> F (b & G (c | F a)))",
        "F (a & G (b | F (c & G a)))",
        "(a U (G b)) W (c U a)",
        "((a W b) U c) W (b U (a W c))",
        "G (a U (b W (c U a)))",
        "F (a W (b U (c W a)))",
        "(G a) U (F b W G c)",
        "((a R b) M c) R (b M a)",
        "G F (a & X G F (b | G c))",
        "G ((a W b) U c)",
        "F ((a U b) W c)",
        "X G (a | X F G b)",
    ]
    for text in texts:
        formula = parse_ltl(text)
        for way in WAYS:
            parts = combination(simplify(formula), *way)
            for _ in range(60):
                lasso = random_lasso(rng, subsets("abc"))
                assert truth(parts, lasso) == holds_on_lasso(formula, *lasso), (text, way, lasso)


def test_ways_of_one_class():
    together = combination(simplify(parse_ltl("F a & X b & F G c")), True)
    assert {part.kind for part in leaves(together)} == {"sigma2", "limit"}
    turns = combination(simplify(parse_ltl("G F (a & X b) & G F (b & X c)")), True)
    assert isinstance(turns, LimitPart) and len(limit_parts(turns.formula)) == 2
    apart = combination(simplify(parse_ltl("G F (a & X b) & G F (b & X c)")), False)
    assert len(leaves(apart)) == 2


def test_invariants_are_true_now_iff_later():
    rng = random.Random(4)
    seen = 0
    for formula, _ in random_cases(5, 800, largest=9):
        simple = simplify(formula)
        if not is_invariant(simple) or simple.operator in ("true", "false"):
            continue
        seen += 1
        for _ in range(8):
            prefix, cycle = random_lasso(rng, subsets("abc"))
            now = holds_on_lasso(simple, prefix, cycle)
            assert now == holds_on_lasso(simple, [], cycle)
    assert seen > 10


def test_negated_is_the_complement():
    for formula, lassos in random_cases(6, 200):
        simple = simplify(formula)
        assert negated(negated(simple)) == simple
        for lasso in lassos:
            assert holds_on_lasso(negated(simple), *lasso) != holds_on_lasso(simple, *lasso)


def test_limits_raise():
    nested = simplify(parse_ltl("G (a U (b W (c U (d W (a U (b W c))))))"))
    with pytest.raises(ValueError, match="normal form of the formula is too large"):
        combination(nested, steps=30)
    many = " & ".join(f"(F a{i} | G b{i})" for i in range(401))
    with pytest.raises(ValueError, match="more than 400 parts"):
        combination(simplify(parse_ltl(many)), grouped=False)


def test_what_the_rules_say_is_implied_is_implied():
    rng = random.Random(9)
    claimed = 0
    for _ in range(3000):
        one, two = (simplify(random_formula(rng, rng.randint(1, 5), "ab")) for _ in range(2))
        if one == two or not implies(one, two):
            continue
        claimed += 1
        for _ in range(12):
            lasso = random_lasso(rng, [frozenset(), {"a"}, {"b"}, {"a", "b"}])
            assert not holds_on_lasso(one, *lasso) or holds_on_lasso(two, *lasso), (one, two)
    assert claimed > 200
