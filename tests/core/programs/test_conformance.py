"""Constructs of the PRISM language: programs with values that were worked out by hand.

Storm builds the same models and finds the same values, where it has the construct.
"""

import pytest

from jaxltl.core.language.resolve import read_program
from jaxltl.core.logic.comparisons import program_definitions
from jaxltl.core.logic.properties import parse_property
from jaxltl.core.programs.build import build_model
from jaxltl.core.values.properties.solve_property import solve_property

CASES = {
    "formulas of formulas, in any order, in rewards": (
        """dtmc formula f = g + 1; formula g = x * 2; module m x : [0..3];
        [] f<6 -> (x'=x+1); [] f>=6 -> true; endmodule
        rewards f>0 : g; [] true : f; endrewards""",
        (4, 4, 4),
        {"R=? [ F x=3 ]": 15},
    ),
    "constants of constants": (
        """dtmc const int M = N*2; const int N = 2+1; const double p = 1/N; const bool b = N>2;
        module m x : [0..M] init N-1; [] x<M & b -> p:(x'=x+1) + (1-p):(x'=N); [] x=M -> true;
        endmodule""",
        (5, 5, 8),
        {"P=? [ F<=N x>N ]": 5 / 9, "P>p [ F<=N x>N ]": True, "P=? [ F x=M ]": 1},
    ),
    "labels of labels, in guards, not renamed": (
        """dtmc label "end" = "big" & x=3; label "big" = x>1; module m x : [0..3];
        [] !"big" -> 0.5:(x'=min(3,x+1)) + 0.5:(x'=3); [] "big" -> true; endmodule
        module n = m [x=y] endmodule""",
        (16, 16, 36),
        {'P=? [ F "end" ]': 0.75},
    ),
    "global variables and unlabelled commands": (
        """mdp global g : [0..2] init 1; global h : bool; module m x : [0..1]; [] g=1 -> (g'=2);
        [] g=2 -> (h'=true) & (x'=1); endmodule module n y : [0..1];
        [] g=1 & !h -> (g'=0) & (y'=1); [] h -> true; endmodule""",
        (4, 6, 6),
        {"Pmax=? [ F h ]": 1, "Pmin=? [ F h ]": 0},
    ),
    "synchronisation of three modules": (
        """mdp module a x : [0..2]; [s] x<2 -> 0.5:(x'=x+1) + 0.5:true; [s] x=0 -> (x'=2); endmodule
        module b y : [0..2]; [s] y=0 -> 0.2:(y'=1) + 0.8:(y'=2); [t] y>0 -> (y'=0); endmodule
        module c z : [0..1]; [s] z=0 -> (z'=1); [s] z=1 -> (z'=0); [t] true -> true; endmodule""",
        (18, 20, 34),
        {"Pmax=? [ F x=2 & y=1 ]": 0.2, "Pmin=? [ F x=2 & y=1 ]": 0.2},
    ),
    "joint updates read old values of other modules": (
        """dtmc module a x : [0..2]; [t] true -> (x'=y); endmodule
        module b y : [0..2] init 2; [t] true -> (y'=x); endmodule""",
        (2, 2, 2),
        {"P=? [ F x=2 & y=0 ]": 1, "P=? [ G F x=2 ]": 1},
    ),
    "overlapping commands of a chain, with rewards of actions": (
        """dtmc module a x : [0..3]; [a] x=0 -> (x'=1); [b] x<1 -> (x'=2); [] x>0 -> true; endmodule
        rewards [a] x=0 : 4; [b] true : 2; x=0 : 1; endrewards""",
        (3, 3, 4),
        {"P=? [ F x=1 ]": 0.5, "R=? [ F x>0 ]": 4},
    ),
    "deadlocks": (
        """mdp module a x : [0..3]; [] x=0 -> (x'=1); [] x=0 -> (x'=2); [] x=1 -> true; endmodule
        rewards true : 1; endrewards""",
        (3, 4, 4),
        {'Pmin=? [ F "deadlock" ]': 0, "Pmax=? [ G x<2 ]": 1, "Rmax=? [ C<=5 ]": 5},
    ),
    "nested conditionals": (
        """dtmc module a x : [0..5];
        [] true -> (x' = x=0 ? 3 : x=3 ? (x>2 ? 1 : 2) : x=1 ? 4 : 5); endmodule""",
        (5, 5, 5),
        {"P=? [ F x=5 ]": 1, "P=? [ F x=2 ]": 0},
    ),
    "a conditional as a probability": (
        """dtmc module m x : [0..1];
        [] true -> x=0 ? 0.3 : 1 : (x'=1) + (x=0 ? 0.7 : 0) : (x'=0); endmodule""",
        (2, 2, 3),
        {"P=? [ X x=1 ]": 0.3},
    ),
    "renaming that exchanges variables, formulas first": (
        """mdp formula free = x2=0; module p1 x1 : [0..2]; [a1] x1<2 & free -> (x1'=x1+1);
        [b] x1=2 -> (x1'=0); endmodule module p2 = p1 [x1=x2, x2=x1, a1=a2] endmodule""",
        (5, 6, 6),
        {"Pmax=? [ F x2=2 ]": 1, "Pmax=? [ F x1=1 & x2=1 ]": 0},
    ),
    "renaming of constants, in initial values and probabilities": (
        """dtmc const int A = 1; const int B = 2; const double p = 0.25; const double q = 0.75;
        module n = m [x=y, A=B, p=q] endmodule
        module m x : [0..2] init A; [t] x<2 -> p:(x'=x+1) + 1-p:(x'=0); [t] x=2 -> true; endmodule""",
        (3, 3, 5),
        {"P=? [ F x=2 & y=2 ]": 1, "P=? [ X x=2 ]": 0.25},
    ),
    "copies of copies": (
        """mdp module m x : [0..3]; [a] x<3 -> (x'=x+1); [] x=3 -> true; endmodule
        module n = m [x=y] endmodule module k = n [y=z, a=b] endmodule""",
        (16, 36, 36),
        {"Pmax=? [ F z=3 & x=0 ]": 1},
    ),
    "probabilities that depend on variables": (
        """dtmc module m x : [1..4]; y : bool;
        [] !y -> 1/(x+1):(x'=min(4,x+1)) + x/(x+1):(y'=true); [] y -> true; endmodule""",
        (8, 8, 12),
        {"P=? [ F x=3 ]": 1 / 6},
    ),
    "equal successors of a command": (
        """dtmc module m x : [0..2]; [] x=0 -> 0.25:(x'=1) + 0.25:(x'=1) + 0.5:(x'=2);
        [] x>0 -> true; endmodule""",
        (3, 3, 4),
        {"P=? [ F x=1 ]": 0.5},
    ),
    "Boolean updates and integral division": (
        """dtmc module m x : [0..4] init 4; b : bool init true;
        [] x>0 -> (b' = !b & x=2) & (x' = floor(x/2)); [] x=0 -> (b'=(x=0)); endmodule""",
        (5, 5, 5),
        {"P=? [ F b & x=1 ]": 1, "P=? [ F !b & x=0 ]": 1, "P=? [ F x=3 ]": 0},
    ),
    "synchronised rewards, and rewards that divide": (
        """mdp module a x : [0..1]; [s] x=0 -> (x'=1); [] x=1 -> true; endmodule
        module b y : [0..1]; [s] y=0 -> (y'=1); endmodule
        rewards [s] true : 2; [s] x=0 : 1; [] true : 10/(x+1); x=0 : 0.5; endrewards""",
        (2, 2, 2),
        {"Rmin=? [ F x=1 ]": 3.5, "Rmax=? [ C<=2 ]": 8.5},
    ),
    "remainders, powers and functions of one argument": (
        """dtmc const int N = 3; module m x : [0..N-1];
        [] min(x)=max(x) -> (x' = func(mod, x + 1, N)); endmodule
        rewards "a" true : x % 2; endrewards rewards "b" true : 2^x; endrewards""",
        (3, 3, 3),
        {"P=? [ F x=N-1 ]": 1, 'R{"a"}=? [ C<=3 ]': 1, 'R{2}=? [ C<=3 ]': 7},
    ),
    "keywords of properties as names": (
        """dtmc const int T = 3; module m F : [0..T]; X : bool; [U] F<T -> (F'=F+1); [] F=T -> true;
        endmodule""",
        (4, 4, 4),
        {"P=? [ F (F=T & !X) ]": 1},
    ),
    "old keywords": (
        """probabilistic const k = 3; rate r = 0.25; prob q = 0.5; module m x : [0..3];
        [] x=0 -> r:(x'=1) + q:(x'=2) + r:(x'=k); [] x>0 -> true; endmodule""",
        (4, 4, 6),
        {"P=? [ F x=k ]": 0.25},
    ),
    "several initial states": (
        """dtmc module a x : [0..3]; y : bool; [] x<3 -> 0.5:(x'=x+1) + 0.5:(x'=3); [] x=3 -> true;
        endmodule init x<2 & (y | x=0) endinit""",
        (8, 8, 12),
        {
            'filter(max, P=? [ F x=2 ], "init")': 0.5,
            "filter(state, P=? [ F x=2 ], x=1 & !y)": 0.5,
            'filter(avg, P=? [ F x=2 ], "init")': 1 / 3,
            'filter(count, P>0.3 [ F x=2 ], "init")': 1,
            'filter(forall, P>=0.2 [ F x=2 ], "init")': True,
        },
    ),
    "state formulas as properties": (
        """dtmc module m x : [0..2]; [] x=0 -> 0.5:(x'=1) + 0.5:(x'=2); [] x>0 -> true; endmodule
        label "end" = x>0;""",
        (3, 3, 4),
        {
            'P>0 [ F x=1 ] & P<1 [ F x=1 ] & !"end"': True,
            '"init"': True,
            'x=0 => P>=1 [ X x=1 ]': False,
            "(x=0 | x=2) & true": True,
        },
    ),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore:'model'")
@pytest.mark.parametrize("case", CASES)
def test_constructs_of_the_language(case):
    text, size, values = CASES[case]
    program = read_program(text)
    model = build_model(program)
    assert (model.num_states, model.num_rows, model.num_transitions) == size
    for asked, expected in values.items():
        found = solve_property(model, parse_property(asked, program_definitions(program)))
        if isinstance(expected, bool):
            assert found.holds == [expected], asked
        else:
            assert found.value.tolist() == pytest.approx([expected]), asked


M = "module m x : [0..1]; [] true -> true; endmodule"


@pytest.mark.parametrize(
    ("text", "place", "says"),
    [
        ("mdp " + M.replace("[0..1]", "[0..1] init 1") + " init x=0 endinit", 14, "init block"),
        ('mdp rewards "a" true : 1; endrewards rewards "a" endrewards ' + M, 38, "two reward str"),
        ('mdp label "a" = "b"; label "b" = !"a"; ' + M, 17, 'the label "a" depends on itself'),
        ("mdp " + M.replace("true ->", '"a" ->'), 29, '"a" is not declared'),
        ("dtmc const double p; " + M.replace("-> true", "-> p:true + 1-p:true"), 19, "no value"),
        ("dtmc " + M.replace("-> true", "-> [0.5,1.5]:true"), 27, "must be at least 0"),
        ("mdp " + M + " " + M.replace("x", "y"), 60, "two modules m"),
    ],
)
def test_refused_programs(text, place, says):
    with pytest.raises(ValueError, match=rf"^'model', line 1, column {place}: .*{says}"):
        build_model(read_program(text))
