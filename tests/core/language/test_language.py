"""The PRISM language: precedence, types, constants, formulas, renaming, and errors with a place."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.language.expressions import compile_expressions, substitute
from jaxltl.core.language.parser import parse_expression, parse_program
from jaxltl.core.language.resolve import read_program


@pytest.mark.parametrize(
    ("text", "tree"),
    [
        ("a | b & c", "(a | (b & c))"),
        ("!a = b", "!(a = b)"),
        ("!a & b", "(!a & b)"),
        ("a = !b & c", "((a = !b) & c)"),
        ("a => b => c", "((a => b) => c)"),
        ("a <=> b => c", "((a <=> b) => c)"),
        ("a & b <=> c | d", "((a & b) <=> (c | d))"),
        ("a = b < c", "(a = (b < c))"),
        ("a < b + c * d", "(a < (b + (c * d)))"),
        ("a - b - c + d", "(((a - b) - c) + d)"),
        ("a / b * c / d", "(((a / b) * c) / d)"),
        ("-a * b", "(-a * b)"),
        ("a - -b", "(a - -b)"),
        ("a ? b : c ? d : e", "(a ? b : (c ? d : e))"),
        ("a => b ? c : d", "((a => b) ? c : d)"),
        ("x > 0 & y < 1 | z", "(((x > 0) & (y < 1)) | z)"),
        ("min(a, b + 1, c)", "min(a, (b + 1), c)"),
        ("func(mod, a, 2)", "mod(a, 2)"),
        ("(a + b) + c", "(a + b + c)"),
        ("a + (b + c)", "(a + (b + c))"),
    ],
)
def test_operators_bind_as_in_the_manual(text, tree):
    assert str(parse_expression(text)) == tree


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1 / 4", 0.25),
        ("7 / 7", 1.0),
        ("floor(7 / 2)", 3),
        ("ceil(-7 / 2)", -3),
        ("floor(-7 / 2)", -4),
        ("round(2.5)", 3),
        ("round(-2.5)", -2),
        ("mod(7, 3)", 1),
        ("mod(-1, 3)", 2),
        ("pow(2, 10)", 1024),
        ("pow(2, 0.5)", 2**0.5),
        ("pow(2.0, -1)", 0.5),
        ("log(8, 2)", 3.0),
        ("min(3, 2, 4)", 2),
        ("max(1, 2.5)", 2.5),
        ("2 + 3 * 4 - 1", 13),
        ("true ? 1 : 2", 1),
        ("true ? 1 : 2.5", 1.0),
        ("1 < 2 & 2 <= 2 & 3 != 4", True),
        ("true <=> false", False),
        ("false => false", True),
        ("1 = 1.0", True),
        ("1.5e2 + .5", 150.5),
    ],
)
def test_constants_fold_as_the_operators_are_defined(text, value):
    found = substitute(parse_expression(text), {}).value
    assert found == value
    assert isinstance(found, bool) == isinstance(value, bool)
    assert isinstance(found, int) == isinstance(value, int)


EXPRESSIONS = (
    "x + y * 2 - 1",
    "mod(x, 3) + mod(-x, 3)",
    "x / 2 > y",
    "floor(x / 2) + ceil(y / 2) + round(x / 4)",
    "b ? x : y",
    "!b | x < y & y >= 2",
    "b <=> x = y",
    "b => x != y",
    "min(x, y, 2) + max(x, y)",
    "pow(x, 2)",
    "log(x + 1, 2) < y",
    "-x + 0.5 * y",
)


@pytest.mark.parametrize("xp", [np, jnp])
def test_arrays_have_the_values_of_folded_literals(xp):
    values = {"x": np.arange(6), "y": np.array([3, 1, 4, 1, 5, 0]), "b": np.arange(6) % 2 == 0}
    trees = [parse_expression(text) for text in EXPRESSIONS]
    found = compile_expressions(trees)({k: xp.asarray(v) for k, v in values.items()}, xp)
    for tree, column in zip(trees, found, strict=True):
        for i in range(6):
            known = {k: parse_expression(str(v[i]).lower()) for k, v in values.items()}
            exact = substitute(tree, known).value
            assert float(column[i]) == pytest.approx(float(exact), rel=1e-6), str(tree)


HEAD = "mdp const int K; const double p; formula next = x + K; "
BODY = "module m x : [0..9] init K; [a] next < 9 -> p : (x'=next) + 1-p : true; endmodule"


def test_formulas_are_substituted_before_renaming():
    copy = " module n = m [x = y, a = b] endmodule"
    found = read_program(HEAD + BODY + copy, {"K": 2, "p": 0.5})
    first, second = (m.commands[0] for m in found.modules)
    assert (str(first.guard), str(second.guard)) == ("((x + 2) < 9)", "((y + 2) < 9)")
    assert second.action == "b"
    assert second.outcomes[0].assignments[0].variable == "y"
    assert [(v.name, v.low, v.high, v.initial) for v in found.variables] == [
        ("x", 0, 9, 2),
        ("y", 0, 9, 2),
    ]


def test_a_copy_renames_constants_and_swaps_names():
    text = """dtmc const int A = 1; const int B = 3;
    module m x : [0..3] init A; y : [0..3]; [] x < A & z > 0 -> (x'=A) & (y'=z); endmodule
    module n = m [x = z, z = x, y = w, A = B] endmodule"""
    found = read_program(text)
    assert str(found.modules[1].commands[0].guard) == "((z < 3) & (x > 0))"
    assert {v.name: v.initial for v in found.variables}["z"] == 3


def test_constants_without_values_are_parameters():
    found = read_program(HEAD + BODY, {"K": 1})
    assert found.parameters == ("p",)
    assert str(found.modules[0].commands[0].outcomes[1].probability) == "(1 - p)"


def test_constants_depend_on_each_other_in_any_order():
    text = "mdp const int a = 2*b; const double c = a/4; const int b = 3; module m endmodule"
    assert read_program(text).constants == {"a": 6, "b": 3, "c": 1.5}


@pytest.mark.parametrize("value", [3, 3.0, "3", "1 + 2", np.int64(3)])
def test_values_of_constants_are_numbers_or_texts(value):
    assert read_program(HEAD + BODY, {"K": value, "p": "1/2"}).constants == {"K": 3, "p": 0.5}


M = "module m x : [0..1]; [] true -> true; endmodule"


@pytest.mark.parametrize(
    ("text", "place", "says"),
    [
        ("ctmc " + M, (1, 1), "continuous-time Markov chains"),
        ("pta\n" + M, (1, 1), "timed automata"),
        ("popta " + M, (1, 1), "partially observable timed"),
        ("csg " + M, (1, 1), "concurrent games"),
        (M + "\n system k endsystem", (2, 9), "exactly once"),
        ("mdp module m x : int; endmodule", (1, 18), "unbounded"),
        ("mdp module m x : clock; endmodule", (1, 18), "clock"),
        ("mdp module m invariant true endinvariant endmodule", (1, 14), "invariant"),
        ("mdp\n" + M.replace("true ->", "1 ->"), (2, 25), "no Boolean"),
        ("mdp\n" + M.replace("true ->", "y=1 ->"), (2, 25), "y is not declared"),
        ("mdp\n" + M.replace("> true", "> (x'=0.5)"), (2, 34), "type double"),
        ("mdp\n" + M.replace("> true", "> (x'=0)&(x'=1)"), (2, 41), "assigned twice"),
        ("mdp\n" + M.replace("> true", "> (z'=0)"), (2, 34), "no variable"),
        ("mdp " + M + " module n [] true -> (x'=0); endmodule", (1, 74), "belongs to the module m"),
        ("mdp const int N; module m x : [0..N]; endmodule", (1, 35), "has no value"),
        ("mdp const int a = b; const int b = a;" + M, (1, 15), "depends on itself"),
        ("mdp formula f = f + 1;" + M, (1, 17), "depends on itself"),
        ("mdp const int a = 2.5;" + M, (1, 15), "its type int"),
        ("mdp const int a = pow(10, 100);" + M, (1, 19), "larger than 2^53"),
        ("mdp const int a = mod(1, 0);" + M, (1, 19), "not defined"),
        ("mdp const bool x = true;" + M, (1, 34), "declared twice"),
        ("mdp module m x : [3..1]; endmodule", (1, 14), "is empty"),
        ("mdp module m x : [0..1] init 2; endmodule", (1, 14), "outside of its range"),
        ("mdp module m x : [0..1]; [] x=0 -> (x'=1) endmodule", (1, 43), "expected ';'"),
        ("mdp module m x : [0..1]; [] x=0 > (x'=1); endmodule", (1, 37), "expected"),
        ("mdp module m x : [0..1]; [] x=@ -> true; endmodule", (1, 31), "'@'"),
        ("mdp " + M + " module n = m [] endmodule", (1, 67), "a name to be replaced"),
        ("mdp " + M + " module n = k [x=y] endmodule", (1, 60), "there is no module k"),
        ("mdp " + M + " module n = m [z=y] endmodule", (1, 60), "does not rename x"),
        ('mdp label "init" = true; ' + M, (1, 11), "built in"),
        ("mdp mdp " + M, (1, 5), "given twice"),
        ("smg " + M, (1, 1), "no player"),
        ("mdp " + M + " rewards x=0 -> x=1 : 2; endrewards", (1, 65), "single successors"),
        ("mdp formula a = " + "(" * 100 + "1" + ")" * 100 + ";" + M, (1, 77), "nested deeper"),
        ("mdp", (1, 4), "no module"),
    ],
)
def test_errors_name_line_and_column(text, place, says):
    with pytest.raises(ValueError, match=f"'model', line {place[0]}, column {place[1]}: ") as error:
        read_program(text)
    assert says in str(error.value)
    assert "\n" not in str(error.value)


def test_globals_are_not_assigned_by_synchronised_commands():
    text = "mdp global g : [0..1]; module m [a] true -> (g'=1); endmodule module n {} endmodule"
    assert read_program(text.format("[b] true -> true;")).variables[0].module is None
    with pytest.raises(ValueError, match="synchronises modules"):
        read_program(text.format("[a] true -> true;"))


def test_shared_formulas_do_not_explode():
    doubled = "".join(f"formula f{i} = f{i + 1} + f{i + 1} * 2;" for i in range(40))
    with pytest.raises(ValueError, match="with its formulas; simplify"):
        read_program(f"mdp {doubled} formula f40 = x; {M}")


def test_an_unknown_constant_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match="no constant Q; it has K, p"):
        read_program(HEAD + BODY, {"Q": 1})
    with pytest.raises(ValueError, match="has a value already"):
        read_program("mdp const int N = 1;" + M, {"N": 2})


def test_old_keywords():
    found = parse_program("probabilistic rate r = 0.5; const rate s; prob q = 1; " + M)
    assert found.kind == "dtmc"
    assert [(c.name, c.type) for c in found.constants] == [
        ("r", "double"),
        ("s", "double"),
        ("q", "double"),
    ]
    assert parse_program(M).kind == "mdp"


def test_renamed_formulas_must_mean_their_renamed_variables():
    text = """mdp formula f = x > 0; formula g = {}; formula h = f;
    module m x : [0..1]; [] h -> true; endmodule module n = m [x = y, f = g] endmodule"""
    assert str(read_program(text.format("y > 0")).modules[1].commands[0].guard) == "(y > 0)"
    with pytest.raises(ValueError, match="line 2, column 57: the formula f with renamed variables"):
        read_program(text.format("y = 0"))


@pytest.mark.parametrize(
    "constant, message",
    [
        ("const bool b = 1 = true;", "line 1, column 21: .* compares a Boolean with a number"),
        ("const int k = min(true, 1);", "column 24: true is a Boolean; min takes a number"),
        ("const bool b = true | 1;", "column 28: 1 is an integer; | takes a Boolean"),
        ("const int k = mod(5, 2.0);", "column 27: 2.0 is a double; mod takes an integer"),
        ("formula f = !1; const bool b = f;", "column 19: 1 is an integer; ! takes a Boolean"),
        ("const int k = true ? 1 : false;", "is a Boolean in one case and a number in the other"),
    ],
)
def test_operators_of_literals_are_checked_before_they_are_folded(constant, message):
    text = f"dtmc {constant} module m x : [0..1]; [] x=0 -> (x'=1); endmodule"
    with pytest.raises(ValueError, match=message.replace("|", r"\|")):
        read_program(text)
