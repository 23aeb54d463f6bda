"""Properties are read as PRISM and Storm read them, and mistakes are shown where they are."""

import re
import time
from fractions import Fraction

import numpy as np
import pytest

from jaxltl.core.language.resolve import read_program
from jaxltl.core.logic.bounded import Bounded, Earned, unfolded
from jaxltl.core.logic.comparisons import Definitions, program_definitions
from jaxltl.core.logic.ltl import FALSE, TRUE, Formula, holds_on_lasso, parse_ltl
from jaxltl.core.logic.properties import parse_properties, parse_property


def path(text):
    return parse_property(f"P=? [ {text} ]").path


# What Storm 1.11 shows of the left side, with all of its parentheses.
READ_AS = {
    'F "a" & "b"': "F (a & b)",
    'G F "a" & G !"b"': "G F (a & G !b)",
    '"a" & "b" U "c"': "(a & b) U c",
    '"a" | "b" U "c"': "(a | b) U c",
    '!"a" U "c" & "d"': "!a U (c & d)",
    '!("a" U "b")': "!(a U b)",
    '!F "b" & "c"': "!F (b & c)",
    '"a" | "b" & "c"': "a | (b & c)",
    '"a" & F "b" U "c"': "(a & F b) U c",
    'F "b" U "c"': "(F b) U c",
    'X "a" U "c"': "(X a) U c",
    'F "a" & G "b" & "c"': "F (a & G (b & c))",
    '("a" U "b") & "c"': "(a U b) & c",
    '(G F "a") & G !"b"': "(G F a) & (G !b)",
    '"a" | F "b" & "c"': "a | F (b & c)",
    '"a" U (X "b" & X "c")': "a U X (b & X c)",
    '"a" || "b"': "a | b",
    'F ("a" || "b")': "F (a | b)",
    '(F "a") | F "b"': "(F a) | (F b)",
    'F F "a"': "F F a",
    'GF"a"': "G F a",
    'F ("a" <=> "b" => "c")': "F ((a <-> b) -> c)",
    'G ("a" => F "b")': "G (a -> F b)",
    '"a" W "b" && true': "(a W b) & true",
    '"a" R !false': "a R !false",
}


@pytest.mark.parametrize("policy", ["max", "min"])
@pytest.mark.parametrize("nature", ["max", "min"])
def test_two_directions_are_of_the_policy_and_of_nature(policy, nature):
    for operator, rest in (
        ("P", 'F "a"'),
        ("R", 'F "a"'),
        ('R{"x"}', 'F "a"'),
        ('R {"x"} ', "C"),
        ("T", 'F "a"'),
        ("LRA", '"a"'),
        ("P ", 'G F "a"'),
    ):
        found = parse_property(f"{operator}{policy}{nature}=? [ {rest} ]")
        assert (found.objective, found.nature) == (policy, nature)
        assert found.operator == operator[: 3 if operator == "LRA" else 1]
    found = parse_property(f'P{policy}{nature}>=1/3 [ X "a" ]')
    assert (found.nature, found.relation, found.threshold) == (nature, ">=", Fraction(1, 3))
    assert parse_property(f'P{policy}=? [ X "a" ]').nature is None
    with pytest.raises(ValueError, match="one direction"):
        parse_property(f'multi(P{policy}{nature}=? [ X "a" ])')
    with pytest.raises(ValueError, match=f"found 'P{policy}{nature}max', expected a property"):
        parse_property(f'P{policy}{nature}max=? [ X "a" ]')


@pytest.mark.parametrize("text", READ_AS)
def test_temporal_operators_reach_as_far_as_they_can(text):
    assert path(text) == parse_ltl(READ_AS[text])


def test_it_is_how_storm_reads_them():
    stormpy = pytest.importorskip("stormpy")
    # Storm has no => between labels, no W, no R, no && and no GF.
    shared = [x for x in READ_AS if not re.search("=>|W|R|&&|GF", x)]
    for text in shared:
        (found,) = stormpy.parse_properties(f"P=? [ {text} ]")
        shown = str(found).split("P=? [")[1].rpartition("]")[0]
        assert parse_ltl(shown) == path(text), shown


BOUNDS = {
    'F<=10 "a"': Bounded("U", TRUE, parse_ltl("a"), 0, 10),
    'F<10 "a"': Bounded("U", TRUE, parse_ltl("a"), 0, 9),
    'F=3 "a"': Bounded("U", TRUE, parse_ltl("a"), 3, 3),
    'F[2,5] "a"': Bounded("U", TRUE, parse_ltl("a"), 2, 5),
    'F>=3 "a"': Bounded("U", TRUE, parse_ltl("a"), 3),
    'F>3 "a"': Bounded("U", TRUE, parse_ltl("a"), 4),
    '"a" & "b" U<=7 !"c"': Bounded("U", parse_ltl("a & b"), parse_ltl("!c"), 0, 7),
    'G<=4 "a"': Bounded("R", FALSE, parse_ltl("a"), 0, 4),
    '"a" R<=4 "b"': Bounded("R", parse_ltl("a"), parse_ltl("b"), 0, 4),
    '"a" W<=4 "b"': Bounded("R", parse_ltl("b"), parse_ltl("a | b"), 0, 4),
    'F{"time"}<=5.5 "a"': Bounded("U", TRUE, parse_ltl("a"), reward="time", limit=Fraction(11, 2)),
    '"b" U rew{"x"}<5 "a"': Bounded(
        "U", parse_ltl("b"), parse_ltl("a"), reward="x", limit=Fraction(5), strict=True
    ),
}


@pytest.mark.parametrize("text", BOUNDS)
def test_bounds(text):
    assert path(text) == BOUNDS[text]
    again = str(BOUNDS[text]).translate(str.maketrans("", "", '"'))
    assert again.replace(" ", "").startswith(("F", "G", "(a&b)U", "aR", "bR", "bU"))


@pytest.mark.parametrize(
    "text",
    [
        'F<=2 "a"',
        'F[1,2] "a"',
        'F=2 "a"',
        'F>=2 "a"',
        '"a" U<=2 "b"',
        '"a" U[1,3] "b"',
        'G<=2 "a"',
        'G[1,2] "a"',
        '"a" R<=2 "b"',
        '"a" R[1,2] "b"',
        '"a" W<=2 "b"',
        '"a" W[1,2] "b"',
    ],
)
def test_unfolded_bounds_mean_what_the_steps_say(text):
    """Against the definition, read off the word."""
    bound = path(text)
    formula = unfolded(bound)
    rng = np.random.default_rng(len(text))
    for _ in range(60):
        word = [{x for x in "ab" if rng.random() < 0.6} for _ in range(6)]
        left, right = (
            [holds_on_lasso(f, [], [letter]) for letter in word] for f in (bound.left, bound.right)
        )
        upper = 5 if bound.upper is None else bound.upper
        steps = range(bound.lower, upper + 1)
        if bound.operator == "U":
            wanted = any(right[i] and all(left[:i]) for i in steps)
        else:
            wanted = all(right[i] or any(left[:i]) for i in steps)
        # After the sixth letter nothing new happens: the last one would repeat, so cut it off.
        assert holds_on_lasso(formula, word, [{"c"}]) == wanted or bound.upper is None
        if bound.upper is None and wanted:
            assert holds_on_lasso(formula, word, [{"c"}])


def test_bounds_inside_of_formulas_unfold():
    assert path('G F<=1 "a"') == parse_ltl("G (a | X a)")
    assert path('F<=1 ("a" & X "b")') == parse_ltl("(a & X b) | X (a & X b)")
    with pytest.raises(ValueError, match="at most 100 steps inside"):
        path('G F<=101 "a"')
    with pytest.raises(ValueError, match="reward outermost"):
        path('G F{"x"}<=1 "a"')


def test_operators_thresholds_and_names():
    found = parse_properties("""
      // what is asked
      "p1": Pmax=? [ F "a" ];
      P>=0.9 [ X "a" ]   P > 1/3 [ X "a" ]; P<=1e-3 [ X "a" ]
      Pmax>=0.9 [ X "a" ]; Pmin<0.3 [ X "a" ]
      R{"steps taken"}min=? [ C<=10 ]; Rmax=? [ C ]; R=? [ I=5 ]; Rmax<-2.5 [ S ]; R{"x"}>=3 [ LRA ]
      Tmin=? [ F "a" | "b" ]; LRAmax=? [ "a" ]; S=? [ !"a" ] // the end""")
    assert [p.operator for p in found] == [*"PPPPPPRRRRRT", "LRA", "LRA"]
    assert [p.name for p in found] == ["p1"] + [None] * 13
    assert [p.direction for p in found] == [
        "max",
        "min",
        "min",
        "max",
        "max",
        "min",
        "min",
        "max",
        None,
        "max",
        "min",
        "min",
        "max",
        None,
    ]
    assert [p.relation for p in found[1:6]] == [">=", ">", "<=", ">=", "<"]
    assert [p.threshold for p in found[1:6]] == [
        Fraction(9, 10),
        Fraction(1, 3),
        Fraction(1, 1000),
        Fraction(9, 10),
        Fraction(3, 10),
    ]
    assert found[9].threshold == Fraction(-5, 2)
    assert [p.reward for p in found[6:11]] == ["steps taken", None, None, None, "x"]
    assert [p.path for p in found[6:11]] == [
        Earned("cumulative", 10),
        Earned("total"),
        Earned("instantaneous", 5),
        Earned("average"),
        Earned("average"),
    ]
    assert found[0].text == str(found[0]) == 'Pmax=? [ F "a" ]'
    assert found[11].path == parse_ltl("F (a | b)")


def test_several_objectives():
    found = parse_property('multi(Pmax=? [ F "a" ], R{"x"}<=3 [ C ], P>=0.9 [ G !"b" ])')
    assert found.operator == "multi"
    assert [p.operator for p in found.parts] == ["P", "R", "P"]
    assert found.parts[2].path == parse_ltl("G !b")
    with pytest.raises(ValueError, match="outermost"):
        parse_property('multi(multi(Pmax=? [ F "a" ]))')


@pytest.mark.parametrize(
    "name",
    ["goal", "a b", "x=1 & y", "F", "ä", 'say "hi"', "back\\slash", "// no comment", "P=? ["],
)
def test_labels_hold_any_characters(name):
    quoted = name.replace("\\", "\\\\").replace('"', '\\"')
    assert path(f'F "{quoted}"') == Formula("F", (Formula("ap", proposition=name),))


WRONG = {
    "P=? [ F goal ]": ("'goal'", "a label in double quotes"),
    'P=? [ F "a" ': ("the end", "']'"),
    'P=? F "a"': ("'F'", "'\\['"),
    'P [ F "a" ]': ("'\\['", "=\\? or a threshold"),
    'P=0.5 [ F "a" ]': ("'0.5'", "'\\?'"),
    'P>=2 [ F "a" ]': ("'2'", "between 0 and 1"),
    'P>=1/0 [ F "a" ]': ("'0'", "other than 0"),
    'P=? [ F<=2.5 "a" ]': ("'2.5'", "whole number"),
    'P=? [ F<0 "a" ]': ("'0'", "some number of steps"),
    'P=? [ F[5,2] "a" ]': ("'2'", "from 5 up"),
    'P=? [ X<=3 "a" ]': ("'<='", "X takes no bound"),
    'P=? [ "a" U "b" U "c" ]': ("'U'", "parentheses"),
    'P=? [ "a" => "b" => "c" ]': ("'=>'", "parentheses"),
    'P=? [ F "a" ]]': ("'\\]'", "a property"),
    'P=? [ F{"x"}>=5 "a" ]': ("'>='", "upper bounds"),
    'P=? [ F{"x"}<=5,{"y"}<=2 "a" ]': ("','", "one bound"),
    'P=? [ F{"x"}<0 "a" ]': ("'0'", "some reward"),
    "R{x}=? [ C ]": ("'x'", "double quotes"),
    'R=? [ G "a" ]': ("'G'", "F and a state formula"),
    'R=? [ F G "a" ]': ("'F'", "F and a state formula"),
    "R=? [ I<=5 ]": ("'<='", "'='"),
    "T=? [ C ]": ("'C'", "a label"),
    'P=? [ F P=? [ F "a" ] ]': ("'P'", "threshold, such as P>=0.5"),
    "P=? [ F x ]": ("'x'", "comparison of variables, such as x=1"),
    "P=? [ F (x + ) ]": ("'\\)'", "a variable or a number"),
    "P=? [ F x + 1 ]": ("'\\]'", "a comparison"),
    'filter(mean, P=? [ F "a" ])': ("'mean'", "the kind of the filter: min"),
    'filter(min, P>=1 [ F "a" ])': ("'P'", "a number"),
    'filter(forall, P=? [ F "a" ])': ("'P'", "a threshold or a state formula"),
    'LRA=? [ F "a" ]': ("'F'", "a state formula"),
    "const int k = 3;": ("the end", "a property"),
    "const int k = x; P=? [ F x=k ]": ("'k'", "constants"),
    "const int k; P=? [ F x=k ]": ("'k'", "--const k="),
    'const int k = 3; const int k = 4; P=? [ F "a" ]': ("'k'", "not declared yet"),
    "P=? [ F x < ]": ("'\\]'", "an expression"),
    "P=? [ F mod(x)=1 ]": ("'mod'", "mod takes 2 arguments"),
    'Q=? [ F "a" ]': ("'Q'", "a property"),
    'P=? [ F "a': ("'\"'", "never closed"),
    "P=? [ F # ]": ("'#'", "signs"),
    "": ("the end", "a property"),
    "// nothing": ("the end", "a property"),
    "P=? [ ]": ("'\\]'", "a label"),
    'P=? [ "" ]': ("'\"\"'", "name between"),
}


@pytest.mark.parametrize("text", WRONG)
def test_mistakes_are_shown_where_they_are(text):
    found, wanted = WRONG[text]
    with pytest.raises(ValueError, match=f"found {found}.*expected .*{wanted}") as error:
        parse_property(text)
    _, line, caret = str(error.value).split("\n")
    token = found.strip("'").replace("\\", "")
    if found != "the end":
        assert line[caret.index("^") :].startswith(token)


def test_the_place_is_in_its_line():
    with pytest.raises(ValueError, match="line 3, column 9: found 'b'"):
        parse_properties('P=? [ F "a" ];\n\nP=? [ F b ]')


def test_hostile_text_ends_soon():
    begin = time.process_time()
    for text in (
        "(" * 10_000,
        "!" * 10_000,
        '"' + "\\" * 10_000,
        "P=? [" + "X" * 10_000,
        "P=? [ F<=" + "9" * 10_000,
        "P>=1e999999999 [",
        'P=? [ F<=1e300 X "a" ]',
        "P=? [" + '"a" &' * 5_000 + "]",
        "P=? [" + "(" * 5_000 + '"a"' + ")" * 5_000,
    ):
        with pytest.raises(ValueError):
            parse_properties(text)
    assert time.process_time() - begin < 20


def test_texts_declare_constants_formulas_and_labels():
    text = """const int k = 2*3; const double p = 0.9; formula big = x > k; // a comment
    label "far" = big & y; "first": P>=p [ F<=k "far" ]; R{"r"}<=k/2+1 [ F big ];
    P>=1-p [ F[k-5,k] (x=k) ]"""
    first, second, third = parse_properties(text)
    assert (first.name, str(first.threshold), first.path.upper) == ("first", "9/10", 6)
    ((_, far),) = first.definitions
    assert str(far.expression) == "((x > 6) & y)"
    assert (str(second.threshold), str(second.definitions[0][1].expression)) == ("4", "(x > 6)")
    assert (third.path.lower, third.path.upper) == (1, 6)
    assert float(third.threshold) == pytest.approx(0.1)


def test_names_of_a_program_are_used_in_properties():
    text = """mdp const int N = 4; formula even = mod(x, 2) = 0; module m x : [0..N]; T : bool;
    [] true -> true; endmodule rewards true : 1; endrewards rewards "b" true : 1; endrewards"""
    known = program_definitions(read_program(text), {"k": 3})
    properties = """const int k; Pmax=? [ F even & !T & x<=N-k ]; R=? [ F T ]; R{2}max=? [ F T ];
    Pmin=? [ F^{rew{"b"}<=N} (x = 0) ]; Pmin=? [ F{"b"}<=2 T ]; Pmin=? [ (T) U ((x+1)*2=N) ]"""
    found = parse_properties(properties, known)
    assert [str(d.expression) for _, d in found[0].definitions] == [
        "(mod(x, 2) = 0)",
        "T",
        "(x <= 1)",
    ]
    assert [found[i].reward for i in (1, 2)] == [None, "b"]
    assert (found[3].path.reward, found[3].path.limit) == ("b", 4)
    assert len(found) == 6


def test_conditions_stand_outermost():
    (prop,) = parse_properties('P>=0.5 [ F<=1 "a" || G !"b" ]')
    assert str(prop.path) == "a | X a || G !b"
    assert parse_properties('P=? [ (F "a" || F "b") ]')[0].path.operator == "|"
    assert parse_properties('P=? [ F ("a" || "b") ]')[0].path.operands[0].operator == "|"


def test_coalitions_stand_before_the_operator():
    (prop,) = parse_properties('"p": <<system, environment>> Rmin=? [ F "a" ]')
    assert (prop.coalition, prop.name, prop.direction) == (("system", "environment"), "p", "min")
    sure, rare = parse_properties('<<system>> P>=0.5 [ F "a" ] <<>> P<0.5 [ F "a" ]')
    assert (sure.direction, rare.direction, rare.coalition) == ("max", "min", ())


NEAR_MISSES = {
    'R=? [ F<=3 "a" ]': "column 8: found '<=', .* F without a bound",
    "R=? [ F<=3 a ]": "column 8: found '<=', .* F without a bound",
    'T=? [ F[1,3] "a" ]': r"column 8: found '\[', .* F without a bound",
    'R=? [ F G "a" ]': "column 7: .* a prefix satisfies, .*; G a is none",
    'P=? [ O "a" ]': "column 7: found 'O', .* those of the past",
    "P=? [ O a ]": "column 7: found 'O', .* those of the past",
    "P=? [ WX a ]": "column 7: found 'WX', .* with blanks between",
    'P=? [ F<=3 "a" || F "b" || "c" ]': "column 16: .*one condition",
    'R=? [ F "a" || F "b" ]': "one path; a condition",
    "Pmax=? [ F a ]": 'column 12: found .a., expected a label in double quotes, such as "a"',
}


@pytest.mark.parametrize("text", NEAR_MISSES)
def test_near_misses_name_what_is_meant(text):
    with pytest.raises(ValueError, match=NEAR_MISSES[text]):
        parse_properties(text)


def test_a_remainder_is_written_as_in_programs():
    known = Definitions(variables=("s",))
    for text in ("P=? [ F s%2=1 ]", "P=? [ F s % 2 = 1 ]", "P=? [ F (s%2)=1 ]"):
        (found,) = parse_properties(text, known)
        ((_, comparison),) = found.definitions
        assert comparison.holds({"s": np.arange(4)}).tolist() == [False, True, False, True]
