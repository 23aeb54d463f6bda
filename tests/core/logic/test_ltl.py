"""Syntax, normal form, fragments and truth of linear temporal logic."""

import random
import tracemalloc

import pytest

from jaxltl.core.logic.ltl import (
    FALSE,
    TRUE,
    Formula,
    holds_on_lasso,
    is_syntactically_cosafe,
    is_syntactically_safe,
    negation_normal_form,
    offending_subformula,
    parse_ltl,
    subformulas,
)
from tests.reference_logic import holds_by_definition, random_formula, random_lasso, subsets
from tests.support import counts

NAMES = ("a", "b", "c", "d")


def tree(formula):
    """A formula as nested tuples, which no parsing or printing rule can distort."""
    if formula.operator == "ap":
        return formula.proposition
    return (formula.operator, *map(tree, formula.operands))


# Expanded by hand from the precedences and the scanner of Spot.
EXPANSIONS = {
    "a -> b -> c": ("->", "a", ("->", "b", "c")),
    "a <-> b -> c": ("<->", "a", ("->", "b", "c")),
    "a -> b <-> c": ("->", "a", ("<->", "b", "c")),
    "a -> b | c": ("->", "a", ("|", "b", "c")),
    "a | b -> c": ("->", ("|", "a", "b"), "c"),
    "a | b xor c": ("|", "a", ("xor", "b", "c")),
    "a xor b | c": ("|", ("xor", "a", "b"), "c"),
    "a xor b xor c": ("xor", ("xor", "a", "b"), "c"),
    "a xor b & c": ("xor", "a", ("&", "b", "c")),
    "a & b ^ c": ("xor", ("&", "a", "b"), "c"),
    "a | b & c | d": ("|", "a", ("&", "b", "c"), "d"),
    "a & b & c": ("&", "a", "b", "c"),
    "a & (b & c)": ("&", "a", "b", "c"),
    "a | (b | c) | d": ("|", "a", "b", "c", "d"),
    "a & b U c": ("&", "a", ("U", "b", "c")),
    "a U b & c": ("&", ("U", "a", "b"), "c"),
    "a U b U c": ("U", "a", ("U", "b", "c")),
    "a U b R c": ("U", "a", ("R", "b", "c")),
    "a W b M c": ("W", "a", ("M", "b", "c")),
    "a V b": ("R", "a", "b"),
    "(a U b) U c": ("U", ("U", "a", "b"), "c"),
    "F a U b": ("U", ("F", "a"), "b"),
    "!a U b": ("U", ("!", "a"), "b"),
    "!F a & b": ("&", ("!", ("F", "a")), "b"),
    "X a U G b": ("U", ("X", "a"), ("G", "b")),
    "GFa": ("G", ("F", "a")),
    "XXb": ("X", ("X", "b")),
    "G!a": ("G", ("!", "a")),
    "FGb": ("F", ("G", "b")),
    "GXd": ("G", ("X", "d")),
    "!!~a": ("!", ("!", ("!", "a"))),
    "[]<>a": ("G", ("F", "a")),
    "X[]a": ("X", ("G", "a")),
    "a && b || c": ("|", ("&", "a", "b"), "c"),
    "a /\\ b \\/ c": ("|", ("&", "a", "b"), "c"),
    "a => b <=> c": ("->", "a", ("<->", "b", "c")),
    "true & 1": ("&", ("true",), ("true",)),
    "False | 0": ("|", ("false",), ("false",)),
    "FTRUE": ("F", ("true",)),
    "trueish": "trueish",
    "goal": "goal",
    "red_cell.x": "red_cell.x",
    "_g1": "_g1",
    "y": "y",
    "aUb": "aUb",
    "a Ub": ("U", "a", "b"),
    "(a)U(b)": ("U", "a", "b"),
    "(a)UFXb": ("U", "a", ("F", ("X", "b"))),
    "Ub": "Ub",
    "xor_gate": "xor_gate",
    "Foo": ("F", "oo"),
    "GFX": None,
    "X0 & F1a & G2": ("&", "X0", "F1a", "G2"),
    "XX0": ("X", "X0"),
    'F"Goal 1"': ("F", "Goal 1"),
    r'"say \"hi\" \\ é"': 'say "hi" \\ é',
    '"one\\\ntwo"': "one\ntwo",
    '"true" & "U" & "0"': ("&", "true", "U", "0"),
}


@pytest.mark.parametrize("text", EXPANSIONS)
def test_parse_by_hand(text):
    if EXPANSIONS[text] is None:
        with pytest.raises(ValueError, match="end of the formula"):
            parse_ltl(text)
    else:
        assert tree(parse_ltl(text)) == EXPANSIONS[text]


@counts(400, 3000)
def test_printer_round_trip(count):
    rng = random.Random(1)
    odd = ["a", "U", "Foo", "F1", 'q"\\', "two words", "true", "é", "1st", ".x", "line\nbreak"]
    for _ in range(count):
        formula = random_formula(rng, rng.randint(1, 25), rng.choice([NAMES, odd]))
        again = parse_ltl(str(formula))
        assert again == formula and tree(again) == tree(formula), str(formula)
        assert hash(again) == hash(formula)


def test_printer_is_readable():
    assert str(parse_ltl("GFa->((b U c)&&!(X d))")) == "G F a -> ((b U c) & !X d)"
    assert repr(parse_ltl("!(a|b)")) == "parse_ltl('!(a | b)')"


def test_equality_is_structural():
    rng = random.Random(2)
    formulas = [random_formula(rng, rng.randint(1, 5), NAMES[:2]) for _ in range(300)]
    for f in formulas:
        for g in formulas:
            assert (f == g) == (tree(f) == tree(g))
    assert TRUE != "true" and Formula("ap", proposition="true") != TRUE


def test_python_operators():
    a, b = parse_ltl("a"), parse_ltl("b")
    assert (~a & b | a ^ b) >> b == parse_ltl("(!a & b | (a xor b)) -> b")
    assert parse_ltl("b U a").propositions == ("a", "b")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("S", (TRUE, TRUE)), "unknown operator 'S'"),
        (("U", (TRUE,)), "got 1 operands. Pass 2"),
        (("&", (TRUE,)), "Pass at least 2"),
        (("ap",), "non-empty name"),
        (("X", (TRUE,), "a"), "to no other operator"),
    ],
)
def test_bad_formula(arguments, message):
    with pytest.raises(ValueError, match=message):
        Formula(*arguments)


OPERAND = "a proposition, a constant, '(' or a prefix operator"


@pytest.mark.parametrize(
    ("text", "column", "parts"),
    [
        ("a &", 4, ["the end of the formula, expected", OPERAND]),
        ("a b", 3, ["found 'b'", "binary operator", "or the end of the formula"]),
        ("(a", 3, ["the end of the formula, expected", "binary operator", "or ')'"]),
        ("a)", 2, ["found ')'", "binary operator"]),
        ("a & & b", 5, ["found '&'", OPERAND]),
        ("a U U b", 5, ["found 'U'", OPERAND]),
        ("a $ b", 3, ["found '$'", "double quotes"]),
        ('F "abc', 3, ["never closed"]),
        ("a\n & )", 4, ["line 2", "found ')'"]),
        ("a & " * 50 + "!", 202, ["the end of the formula"]),
    ],
)
def test_syntax_error(text, column, parts):
    with pytest.raises(ValueError) as caught:
        parse_ltl(text)
    message, line, caret = str(caught.value).split("\n")
    assert f"column {column}:" in message
    assert all(part in message for part in parts), message
    # The caret stands under the character that is named.
    shown = line[caret.index("^") :]
    assert (text.split("\n")[-1][column - 1 :]).startswith(shown[:1])
    assert len(line) <= 80


@pytest.mark.parametrize("text", [None, 3, b"a", "", "  \n", TRUE])
def test_not_a_text(text):
    with pytest.raises(ValueError, match="expected the text of a formula"):
        parse_ltl(text)


def test_empty_name():
    with pytest.raises(ValueError, match="non-empty name"):
        parse_ltl('F ""')


@pytest.mark.parametrize(
    "text", ["(" * 3000 + "a" + ")" * 3000, "X" * 3000 + "a", "!" * 3000 + "a", "a U " * 3000 + "a"]
)
def test_deep_nesting(text):
    formula = parse_ltl(text)
    assert parse_ltl(str(formula)) == formula
    assert is_syntactically_cosafe(formula)
    assert holds_on_lasso(formula, [], [{"a"}])


def test_subformulas_come_after_their_operands():
    rng = random.Random(3)
    for _ in range(200):
        nodes = subformulas(random_formula(rng, 15, NAMES[:2]))
        place = {node: i for i, node in enumerate(nodes)}
        assert len(place) == len(nodes)
        assert all(place[operand] < place[node] for node in nodes for operand in node.operands)


def test_normal_form_is_normal_and_equivalent():
    rng = random.Random(4)
    letters = subsets(NAMES[:3])
    for _ in range(600):
        formula = random_formula(rng, rng.randint(1, 12), NAMES[:3])
        normal = negation_normal_form(formula)
        for node in subformulas(normal):
            assert node.operator not in ("->", "<->", "xor")
            assert node.operator != "!" or node.operands[0].operator == "ap"
        for _ in range(5):
            lasso = random_lasso(rng, letters)
            assert holds_by_definition(normal, *lasso) == holds_by_definition(formula, *lasso)


def test_normal_form_of_nested_xor_is_shared():
    normal = negation_normal_form(parse_ltl(" xor ".join(f"G a{i}" for i in range(60))))
    assert len(subformulas(normal)) < 1000


def test_lasso_truth_against_the_definition():
    rng = random.Random(5)
    letters = subsets(NAMES[:3])
    outcomes = []
    for _ in range(4000):
        formula = random_formula(rng, rng.randint(1, 12), NAMES[:3])
        lasso = random_lasso(rng, letters)
        outcomes.append(holds_on_lasso(formula, *lasso))
        assert outcomes[-1] == holds_by_definition(formula, *lasso), (str(formula), lasso)
    assert 0.2 < sum(outcomes) / len(outcomes) < 0.8


@pytest.mark.parametrize("operator", ["U", "R", "W", "M", "F", "G", "X"])
def test_lasso_truth_of_each_operator_exhaustively(operator):
    letters = subsets(("a", "b"))
    text = f"a {operator} b" if operator in "URWM" else f"{operator} a"
    formula = parse_ltl(text)
    for i in range(4**4):
        word = [letters[i // 4**k % 4] for k in range(4)]
        for cut in range(4):
            lasso = word[:cut], word[cut:]
            assert holds_on_lasso(text, *lasso) == holds_by_definition(formula, *lasso)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("a", [{"a"}], []), "cycle is empty"),
        (("a", ["a"], [{"a"}]), "prefix: letter 0 is 'a'"),
        (("a", [], [{"a"}, "goal"]), "cycle: letter 1 is 'goal'"),
        (("a", [], [{1}]), "collection of proposition names"),
    ],
)
def test_bad_lasso(arguments, message):
    with pytest.raises(ValueError, match=message):
        holds_on_lasso(*arguments)


@pytest.mark.parametrize(
    ("text", "uncosafe", "unsafe"),
    [
        ("a & !b", None, None),
        ("X (a xor X b)", None, None),
        ("F a", None, "F a"),
        ("G a", "G a", None),
        ("a U b", None, "a U b"),
        ("a M b", None, "a M b"),
        ("a W b", "a W b", None),
        ("a R b", "a R b", None),
        ("!(a R b)", None, "!a U !b"),
        ("F a -> X b", "G !a", None),
        ("G F a & X b", "G F a", "F a"),
        ("F a <-> b", "G !a", "F a"),
    ],
)
def test_fragments(text, uncosafe, unsafe):
    formula = parse_ltl(text)
    assert is_syntactically_cosafe(formula) == (uncosafe is None)
    assert is_syntactically_safe(formula) == (unsafe is None)
    for fragment, offender in (("cosafe", uncosafe), ("safety", unsafe)):
        found = offending_subformula(formula, fragment)
        assert (None if found is None else str(found)) == offender


def test_fragments_are_dual():
    rng = random.Random(6)
    inside = 0
    for _ in range(2000):
        formula = random_formula(rng, rng.randint(1, 8), NAMES[:2])
        assert is_syntactically_cosafe(formula) == is_syntactically_safe(~formula)
        inside += is_syntactically_cosafe(formula)
    assert 200 < inside < 1800
    for fragment, test in (("cosafe", is_syntactically_cosafe), ("safety", is_syntactically_safe)):
        assert all(test(random_formula(rng, 15, NAMES, fragment)) for _ in range(500))


def test_constants():
    assert parse_ltl("1") == TRUE and parse_ltl("fAlSe") == FALSE


@pytest.mark.parametrize("operator", ["X", "U", "->"])
def test_the_text_of_a_deep_formula_takes_linear_memory(operator):
    a, depth = Formula("ap", proposition="a"), 20_000
    formula = a
    for _ in range(depth):
        formula = Formula(operator, (formula,) if operator == "X" else (a, formula))
    tracemalloc.start()
    try:
        text = str(formula)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert text.count(operator) == depth and text.count("a") == depth * (operator != "X") + 1
    assert peak < 20e6


@pytest.mark.parametrize(
    "text, plain",
    [
        ("□(request → ◇ grant)", "G (request -> F grant)"),
        ("always (request implies eventually grant)", "G (request -> F grant)"),
        ("not a until (b and next c)", "!a U (b & X c)"),
        ("¬a ∧ ○b ∨ c ⊕ ⊤ ↔ ⊥", "((!a & X b) | (c xor true)) <-> false"),
        ("a release b or c iff a weakuntil b xor c", "(a R b | c) <-> (a W b xor c)"),
        ("◻◇a ∧ ◊◯b ⇒ ⋄c ⇔ d", "G F a & F X b -> (F c <-> d)"),
        ("not(a)and(b)", "!a & b"),
        # Where no operator can be, they are names.
        ("F next", 'F "next"'),
        ("next U until", '"next" U "until"'),
        ("always -> not & or", '"always" -> ("not" & "or")'),
        ("(eventually)", '"eventually"'),
        ("nota & always_on & android", '"nota" & "always_on" & "android"'),
        ("and and and", '"and" & "and"'),
    ],
)
def test_words_and_signs_are_operators(text, plain):
    found = parse_ltl(text)
    assert found == parse_ltl(plain)
    assert parse_ltl(str(found)) == found
