"""Constructs of the property language, with values that were worked out by hand.

A fair die of Knuth and Yao: states 0 to 6 toss a coin, in state 7 the face d is known. The second
model is an MDP in which a robot picks a lane.
"""

import contextlib
import random

import numpy as np
import pytest

from jaxltl.core.language.resolve import read_program
from jaxltl.core.logic.comparisons import program_definitions
from jaxltl.core.logic.properties import MalformedProperty, parse_each, parse_properties
from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.programs.build import build_model
from jaxltl.core.values.properties import exact_thresholds
from jaxltl.core.values.properties.solve_property import solve_property

SOURCES = {
    "die": """dtmc const double p = 1/2; const int N = 2; formula done = s=7; const bool yes = true;
    module die s : [0..7]; d : [0..6];
    [] s=0 -> p:(s'=1) + 1-p:(s'=2); [] s=1 -> p:(s'=3) + 1-p:(s'=4);
    [] s=2 -> p:(s'=5) + 1-p:(s'=6); [] s=3 -> p:(s'=1) + 1-p:(s'=7)&(d'=1);
    [] s=4 -> p:(s'=7)&(d'=2) + 1-p:(s'=7)&(d'=3); [] s=5 -> p:(s'=7)&(d'=4) + 1-p:(s'=7)&(d'=5);
    [] s=6 -> p:(s'=2) + 1-p:(s'=7)&(d'=6); [] done -> true; endmodule
    label "one" = done & d=1; label "end" = done;
    rewards "flips" !done : 1; endrewards rewards "face" true : d; endrewards""",
    # In state 0: a leads to 1, b to 2 or 3; in 1: a to 4, b to 0; 2 returns to 0; 3 and 4 stay.
    "lanes": """mdp module m x : [0..4]; [a] x=0 -> (x'=1); [b] x=0 -> 0.25:(x'=2) + 0.75:(x'=3);
    [a] x=1 -> (x'=4); [b] x=1 -> (x'=0); [] x=2 -> (x'=0); [] x>2 -> true; endmodule
    label "goal" = x=3; label "far" = x=4;
    rewards "time" x<3 : 1; endrewards rewards "toll" [a] x<3 : 3; [b] x<3 : 1; endrewards""",
}
SOURCES[
    "tenths"
] = """dtmc const double c = 0.1; const double t = 1/3; module m s : [0..9]; b : bool;
    [] s=0 & t=0.3333333333333333 -> (s'=1); [] s=0 & t!=0.3333333333333333 -> t:(s'=2) + 1-t:(s'=9);
    [] s>0 & s*c<0.3 -> (s'=3) & (b'=true); [] s*0.1>=3*0.1 -> true; endmodule
    label "three" = s/10 = c+0.2; label "third" = s/3 = 1 & 0.1+0.2 = 0.3; label "b" = b = (s*c = 0.3);
    rewards s*c = 0.3 : 1; endrewards"""
inf = float("inf")


@pytest.fixture(scope="module")
def models():
    programs = {name: read_program(text) for name, text in SOURCES.items()}
    return {
        name: (build_model(x), program_definitions(x, {"k": 6})) for name, x in programs.items()
    }


def answer(models, name, text, **options):
    """The answer to the last property of a text that has no name."""
    model, known = models[name]
    prop = [x for x in parse_properties(text, known) if x.name is None][-1]
    return solve_property(model, prop, **options)


def check(models, name, text, expected):
    actual = answer(models, name, text)
    assert actual.status.name == "CONVERGED", text
    if isinstance(expected, bool):
        assert actual.holds == [expected], text
    else:
        assert actual.holds is None, text
        assert actual.value == pytest.approx(np.ravel(expected), rel=1e-6, abs=1e-9), text
        assert (actual.lower <= actual.upper).all()


# --- computation tree logic ---

CTL = {
    "die": {
        "E [ F s=7 & d=6 ]": True,
        "E [ F d=7 ]": False,
        "A [ F s=7 ]": False,
        "A [ G s<=7 ]": True,
        "A [ G s<7 ]": False,
        "E [ G s<7 ]": True,
        "E [ G s=0 ]": False,
        "E [ G s<=3 ]": True,
        "E [ s<4 U d=1 ]": True,
        "E [ s<4 U d=6 ]": False,
        "A [ s<7 U s=7 ]": False,
        "A [ s<7 W s=7 ]": True,
        "A [ s<6 W s=7 ]": False,
        "E [ s<6 W s=7 ]": True,
        "E [ s=7 R s<7 ]": True,
        "A [ s=7 R s<7 ]": False,
        "A [ s=7 R s<=7 ]": True,
        "E [ X s=2 ]": True,
        "A [ X s=2 ]": False,
        "A [ X s>0 ]": True,
        "A [ X X s>2 ]": True,
        "E [ X E [ G s!=0 ] ]": True,
        "A [ X A [ G s!=0 ] ]": True,
        "E [ F A [ G s=7 ] ]": True,
        "A [ F A [ G s=7 ] ]": False,
        "A [ G E [ F s=7 ] ]": True,
        "A [ G E [ X E [ X A [ G s=7 ] ] ] ]": False,
        "A [ G E [ X E [ X E [ X A [ G s=7 ] ] ] ] ]": True,
        "E [ A [ X s=7 ] R s<6 ]": True,
        "E [ F<=2 s=7 ]": False,
        "E [ F<=3 s=7 ]": True,
        "A [ G<=2 s<7 ]": True,
        "E [ G F s=1 ]": True,
        "A [ G F s=7 ]": False,
        "E [ F G s=7 ]": True,
        "A [ (G F s=1) | (G F s=2) | (F G s=7) ]": True,
        "E [ (F s=3) & (F s=4) ]": True,
        "E [ (F s=3) & (F s=5) ]": False,
        "E [ F s=7 ] & !A [ F s=7 ]": True,
        "E [ F s=7 ] => A [ F s=7 ]": False,
        "P>=1 [ F s=7 ] & !A [ F s=7 ]": True,
        "A [ true ]": True,
        "E [ s=1 ]": False,
        "E [ F P>0.4 [ X d=6 ] ]": True,
        "E [ F (s<7 & P>0.5 [ X d=6 ]) ]": False,
        "filter(exists, E [ F d=6 ], s>0)": True,
        "filter(forall, E [ F d=6 ], s<2)": False,
        "filter(count, E [ F d=6 ])": 4,
        "filter(count, A [ F s=7 ])": 8,
        "filter(state, A [ X s=7 ], s=4)": True,
    },
    "lanes": {
        'E [ F "goal" ]': True,
        'A [ F "goal" ]': False,
        "A [ F x>2 ]": False,
        "E [ G F x=0 ]": True,
        "E [ G F x=2 ]": True,
        'A [ G E [ F "goal" | "far" ] ]': True,
        'A [ G E [ F "far" ] ]': False,
        'E [ !("goal" | "far") U E [ G "far" ] ]': True,
        "A [ x=0 W (x=1 | x=2 | x=3) ]": True,
        'A [ X E [ X "far" ] ]': False,
        'E [ X E [ X "far" ] ]': True,
        "filter(count, A [ F x>2 ])": 2,
        'Pmax>=1 [ F "goal" ] & E [ G !"goal" ]': True,
    },
}

# --- rewards until a formula is proven ---

COSAFE = {
    "die": {
        'R{"flips"}=? [ true ]': 0,
        'R{"flips"}=? [ !false ]': 0,
        'R{"flips"}=? [ s=0 ]': 0,
        'R{"flips"}=? [ s>0 | s=0 ]': 0,
        'R{"flips"}=? [ s=1 ]': inf,
        'R{"flips"}=? [ false ]': inf,
        'R{"flips"}=? [ X true ]': 1,
        'R{"flips"}=? [ !(X false) ]': 1,
        'R{"flips"}=? [ !(X true) ]': inf,
        'R{"flips"}=? [ X s>=0 ]': 1,
        'R{"flips"}=? [ X X true ]': 2,
        'R{"flips"}=? [ X X X s<0 ]': inf,
        'R{"flips"}=? [ X X X (true ? true : s<0) ]': 3,
        'R{"flips"}=? [ s=0 | X true ]': 0,
        'R{"flips"}=? [ s=1 | X true ]': 1,
        'R{"flips"}=? [ s=0 & X X true ]': 2,
        'R{"flips"}=? [ X F s=7 ]': 11 / 3,
        'R{"flips"}=? [ X X F s=7 ]': 11 / 3,
        'R{"flips"}=? [ F X s=7 ]': 11 / 3,
        'R{"flips"}=? [ F (s=7 & X true) ]': 11 / 3,
        'R{"face"}=? [ F (s=7 & X true) ]': 3.5,
        'R{"face"}=? [ F (s=7 & X X true) ]': 7,
        'R{"flips"}=? [ s<7 U s=7 ]': 11 / 3,
        'R{"flips"}=? [ s<3 U s>=3 ]': 2,
        'R{"flips"}=? [ s=0 U s=1 ]': inf,
        'R{"flips"}=? [ (F s>0) & (F s>2) ]': 2,
        'R{"flips"}=? [ (F s>0) | (F s>2) ]': 1,
        'R{"flips"}=? [ F (s>0 & X s=7) ]': 11 / 3,
        'R{"flips"}=? [ !(G s<3) ]': 2,
        'R{"flips"}=? [ !(s=7 R s<7) ]': 11 / 3,
        'R{"flips"}=? [ F P>0.4 [ X s=7 ] ]': 2,
        'R{"flips"}=? [ X F R{"flips"}>0 [ C<=1 ] ]': 1,
        'R{"flips"}=? [ F R{"flips"}<2 [ F s=7 ] ]': 3,
        'R{"flips"}<4 [ X F s=7 ]': True,
        'R{"flips"}>=4 [ X F s=7 ]': False,
        "T=? [ X F s=7 ]": 11 / 3,
        'filter(max, R{"flips"}=? [ X F s=7 ], s>2 & s<7)': 7 / 3,
        'filter(sum, R{"flips"}=? [ X true ])': 7,
    },
    "lanes": {
        'R{"time"}min=? [ X true ]': 1,
        'R{"time"}min=? [ F "goal" | "far" ]': 4 / 3 + 1 / 3,
        'R{"time"}max=? [ X X true ]': 2,
        'R{"time"}max=? [ F x>2 ]': inf,
        'R{"toll"}max=? [ X true ]': 3,
        'R{"toll"}min=? [ X X true ]': 1,
        'R{"toll"}max=? [ X X true ]': 6,
        'R{"toll"}min=? [ (F x=1) & (F "goal") ]': 3 + 1 + 4 / 3,
        'R{"time"}min=? [ (F x=1) & (F "goal") ]': 2 + 5 / 3,
        'R{"time"}min=? [ (x<3 U x=1) & (X X X "far") ]': 2,
        'R{"time"}min=? [ F (x=1 & X "far") ]': 2,
        'R{"toll"}min=? [ F (x=1 & X "far") ]': 6,
    },
}

# --- expressions of numbers and results ---

EXPRESSIONS = {
    "die": {
        "42": 42,
        "-1": -1,
        "1/3": 1 / 3,
        "7/2 - 1": 2.5,
        "N": 2,
        "N + 1": 3,
        "2^(N+1)": 8,
        "pow(2, 3) + mod(7, 4)": 11,
        "floor(7/2) + ceil(7/2) + round(7/2)": 11,
        "max(1, N, 5) - min(3, N)": 3,
        "p": 0.5,
        "p*N": 1,
        "true": True,
        "false": False,
        "yes": True,
        "!yes": False,
        "done": False,
        "s": 0,
        "d + 1": 1,
        "s = 0": True,
        "s = 0 & d = 0": True,
        '"init"': True,
        '"init" => s>0': False,
        "s=0 ? 5 : 6": 5,
        "s=1 ? P=? [ F d=6 ] : 2*P=? [ F d=6 ]": 1 / 3,
        "1/3 = 0.3333333333333333": False,
        "0.1 + 0.2 = 0.3": True,
        "0.1 * 3 <= 0.3": True,
        "ceil(0.1 * 30)": 3,
        "floor((0.1 + 0.2) * 10)": 3,
        "ceil(P=? [ F d=6 ]) + 1": 2,
        "ceil(6 * P=? [ F d=6 ])": 1,
        "floor(6 * P=? [ F d=6 ])": 1,
        "round(1 + P=? [ X s=1 ])": 2,
        "round(P=? [ F d=6 ])": 0,
        "P=? [ F d=6 ] + P=? [ F d=5 ]": 1 / 3,
        "P=? [ F d=6 ] * 6 - 1": 0,
        "1 - P=? [ F d=6 ]": 5 / 6,
        "-P=? [ F d=6 ]": -1 / 6,
        "P=? [ F d=6 ] / P=? [ F d>4 ]": 0.5,
        'R{"flips"}=? [ F s=7 ] * 3': 11,
        'R{"flips"}=? [ F s=7 ] / P=? [ X s=1 ]': 22 / 3,
        "max(P=? [ F d=6 ], P=? [ F d<6 ])": 1,
        "min(P=? [ F d=6 ], 0.5)": 1 / 6,
        "pow(P=? [ X s=1 ], 2)": 0.25,
        "log(P=? [ X s=1 ], 2)": -1,
        "P=? [ F d=6 ] = 1/6": True,
        "P=? [ F d=6 ] != 1/6": False,
        "P=? [ F d=6 ] > 0.1 & s=0": True,
        "P=? [ F d=6 ] + 0.1 < 0.2": False,
        "P=? [ F d=6 ] >= P=? [ F d=5 ]": True,
        "P=? [ F d=6 ] > P=? [ F d=5 ]": False,
        "0.2 > P=? [ F d=6 ]": True,
        "!(P=? [ F d=6 ] > 0.1)": False,
        "P>0.1 [ F d=6 ] & !P>0.5 [ F d=6 ]": True,
        "P>0.1 [ F d=6 ] | s=5": True,
        "P>0.1 [ F d=6 ] <=> true": True,
        "P=? [ F P=? [ F d=6 ] > 0.4 ]": 1 / 4,
        "P=? [ F P=? [ F d=6 ] = 1/3 ]": 0.5,
        "P=? [ X (P=? [ F d=6 ] * 3 = 1) ]": 0.5,
        "P=? [ F s/3 = 1 ]": 0.25,
        "P=? [ F s*0.5 > 2.5 & s<7 ]": 0.25,
        "P=? [ F (s=7 ? d : 0) > 3 ]": 0.5,
        "P=? [ F d = s - 1 ]": 2 / 3,
        "P=? [ F true = (d=6) ]": 1 / 6,
        "P=? [ F floor(d/2) = 3 ]": 1 / 6,
        "P=? [ F d > filter(max, d) - 2 ]": 1 / 3,
        "P=? [ F filter(exists, d=7) ]": 0,
        "P=? [ F P=? [ X s=7 ] = filter(max, P=? [ X s=7 ], s<7) ]": 1,
        "yesOr; const bool yesOr = c=0 | pow(2,c-1)>0; const int c = 0;": True,
        "const int c = 0; c!=0 & pow(2,c-1)>0": False,
        "const int c = 0; c!=0 => pow(2,c-1)>0": True,
        "const int c = 0; c>0 ? pow(2,c-1) : 0": 0,
        "filter(forall, s=0 | pow(2,s-1)>0)": True,
        "filter(exists, s!=0 & pow(2,s-1)>64)": False,
        "filter(sum, s>0 ? pow(2,s-1) : 0)": 447,
        "const int y = z; const int z = 3; P=? [ F d=y ]": 1 / 6,
        "P=? [ F d=y ]; const int y = 3;": 1 / 6,
        "const int k; P=? [ F d=k ]": 1 / 6,
        "const int k; const int j = k - 1; P=? [ F d=j ] + k": 6 + 1 / 6,
        "const double q = 1/3; q * 3 = 1": True,
        "const int j = 5; formula big = d > j; P=? [ F big ]": 1 / 6,
        'label "six" = d=6; P=? [ F "six" ]': 1 / 6,
        'label "six" = d=6; P=? [ F ("six" ? true : d=5) ]': 1 / 3,
        'label "z" = P>0.4 [ F d=6 ]; P=? [ F "z" ]': 0.25,
        'label "z" = P>0.4 [ F d=6 ]; filter(count, "z")': 2,
        'label "z" = P>0.4 [ F d=6 ]; filter(count, ("z" ? 1 : 0) = 1)': 2,
    },
}

NAMES = {
    "die": {
        '"p1": P=? [ F d=6 ]; "p1" * 6': 1,
        '"p1": P=? [ F d=6 ]; "p1" * 6 = 1': True,
        '"p1": P=? [ F d=6 ]; "p2": "p1" * 6; "p1" + "p2"': 7 / 6,
        '(2 * "half")^(N+1); "half": P=? [ X s=1 ]': 1,
        '"sure": P>=1 [ F s=7 ]; P=? [ X "sure" ]': 1,
        '"sure": P>0.4 [ F d=6 ]; P=? [ F "sure" ]': 0.25,
        '"sure": P>0.4 [ F d=6 ]; filter(count, "sure")': 2,
        '"rare": P=? [ F d=6 ]; filter(max, "rare", s<7)': 2 / 3,
        '"rare": P=? [ F d=6 ]; filter(argmax, "rare", s<7)': 2 / 3,
        '"rare": P=? [ F d=6 ]; P=? [ F "rare" > 0.6 & s<7 ]': 0.25,
        '"ex": s=7; filter(forall, "ex" <=> "end")': True,
        '"ex": s=7 | s=6; filter(forall, "ex" <=> (s=7 | s=6))': True,
        '"all": filter(forall, s<8); "all" & true': True,
        '"n": filter(count, s<3); "n" / 2': 1.5,
        '"a": 3; "b": "a" + 1; "c": "a" * "b"; "c"': 12,
        '"e": E [ F d=6 ]; A [ G ("e" | s!=0) ]': True,
        '"six": d=6; P=? [ F "six" ]': 1 / 6,
        '"six": d=6; P>0.1 [ F "six" ]': True,
        '"a": s; "a" + 1': 1,
    },
}

# --- filters ---

FILTERS = {
    "die": {
        "filter(min, P=? [ F d=6 ], s<3)": 0,
        "filter(max, P=? [ F d=6 ], s<3)": 1 / 3,
        "filter(sum, P=? [ F d=6 ], s<3)": 0.5,
        "filter(+, P=? [ F d=6 ], s<3)": 0.5,
        "filter(avg, P=? [ F d=6 ], s<3)": 1 / 6,
        "filter(range, P=? [ F d=6 ], s<3)": [0, 1 / 3],
        "filter(first, P=? [ F d=6 ], s>1)": 1 / 3,
        "filter(state, P=? [ F d=6 ], s=6)": 2 / 3,
        "filter(argmax, P=? [ F d=6 ], s<7)": 2 / 3,
        "filter(argmin, P=? [ F d=6 ], s<7)": [0] * 4,
        "filter(print, P=? [ F d=6 ], s<3)": [1 / 6, 0, 1 / 3],
        "filter(printall, P=? [ F d=6 ], s<3)": [1 / 6, 0, 1 / 3],
        "filter(forall, P>0 [ F d=6 ], s<3)": False,
        "filter(&, P>0 [ F d=6 ], s=2)": True,
        "filter(exists, P>0.5 [ F d=6 ])": True,
        "filter(|, P>0.5 [ F d=6 ], s<3)": False,
        "filter(count, P>0 [ F d=6 ])": 4,
        "filter(count, s>3)": 9,
        "filter(count, true)": 13,
        "filter(count, s<3, s>0)": 2,
        "filter(max, d)": 6,
        "filter(min, -d)": -6,
        "filter(sum, d, s=7)": 21,
        "filter(avg, s, s<7)": 3,
        "filter(max, s * d)": 42,
        "filter(argmax, d)": 6,
        "filter(first, s, s>3)": 4,
        "filter(state, s + d, d=6)": 13,
        "filter(forall, s>=0)": True,
        'filter(forall, "end" <=> s=7)': True,
        'filter(forall, "one" => "end")': True,
        'filter(exists, "one" & s<7)': False,
        "filter(max, P=? [ F d=6 ] + 1, s<3)": 4 / 3,
        "filter(sum, ceil(P=? [ F d=6 ]), s<7)": 3,
        "filter(count, P=? [ F d=6 ] > 0.2, s<7)": 2,
        "filter(min, s=0 ? 3 : 4)": 3,
        "0.0 + filter(sum, P=? [ F d=6 ], s<3)": 0.5,
        "filter(sum, filter(count, true, P>0 [ X F s=7 ]), s=2)": 13,
        "filter(max, P=? [ F d=6 ], s<7) - filter(min, P=? [ F d=6 ], s<7)": 2 / 3,
        "filter(count, filter(exists, s=3))": 13,
        'filter(max, R{"flips"}=? [ F s=7 ])': 11 / 3,
        'filter(min, R{"flips"}=? [ F s=7 ], s<7)': 1,
        'filter(count, R{"flips"}>1 [ F s=7 ])': 5,
        "filter(state, S=? [ s=7 ], s=0)": 1,
        "P=? [ F d=6 {s=2} ]": 1 / 3,
        "P=? [ F d=6 {s=6} ]": 2 / 3,
        "P=? [ F d=6 {s<7}{max} ]": 2 / 3,
        "P=? [ F d=6 {s<7}{min} ]": 0,
        "P=? [ F d=6 {s<3}{min}{max} ]": [0, 1 / 3],
        'P=? [ F d=6 {"init"}{max} ]': 1 / 6,
        'P=? [ F d=6 {"init"} ]': 1 / 6,
        'S=? [ s=7 {"init"}{min} ]': 1,
        'R{"flips"}=? [ F s=7 {s=2} ]': 8 / 3,
        'R{"flips"}=? [ F s=7 {s<7}{max} ]': 11 / 3,
        'R{"flips"}=? [ C<=2 {s=3} ]': 1.5,
        'R{"face"}=? [ I=1 {s=4} ]': 2.5,
        "P>0.3 [ F d=6 {s=2} ]": True,
        "P>0.4 [ F d=6 {s=2} ]": False,
        "P=? [ X s=1 {s=3} ] + 1": 1.5,
        "P=? [ s<7 U d=6 {s=6} ]": 2 / 3,
        "P=? [ F<=1 d=6 {s=6} ]": 0.5,
    },
    "lanes": {
        'filter(max, Pmin=? [ F "goal" ], x<3)': 0,
        'filter(min, Pmax=? [ F "goal" ], x<3)': 1,
        'filter(count, Pmax>=1 [ F "goal" ])': 4,
        'Pmax=? [ F "goal" {x=1} ]': 1,
        'Pmin=? [ F "goal" {x=2}{min} ]': 0,
        'filter(sum, Pmax=? [ F "far" ])': 4,
        'ceil(Pmax=? [ F "goal" ]) + 1': 2,
        'Pmax=? [ F "goal" ] - Pmin=? [ F "goal" ]': 1,
        'Pmin=? [ F Pmax=? [ X "goal" ] > 0.7 ]': 1,
        'Pmin=? [ F x>0 & Pmax>=0.75 [ X "goal" ] ]': 0,
        'R{"time"}min=? [ F x>2 ] + x': 5 / 3,
        "filter(argmax, x)": 4,
    },
}

RATIONAL = {
    "tenths": {
        "P=? [ F s=1 ]": 0,
        "P>0 [ F s=1 ]": False,
        "P=? [ F s=2 ]": 1 / 3,
        "P>=1/3 [ F s=2 ]": True,
        "P>1/3 [ F s=2 ]": False,
        "P<1/3 [ F s=2 ]": False,
        "P=? [ F s=2 ] = t": True,
        "P=? [ F s=2 ] = 0.3333333333333333": False,
        'P=? [ F "three" ]': 1 / 3,
        'P=? [ F "third" ]': 1 / 3,
        'filter(forall, "b")': True,
        "R=? [ C<=3 ]": 1 / 3,
        "P=? [ F s*c = 0.9 ]": 2 / 3,
        "P=? [ F s*c*c = 0.09 ]": 2 / 3,
        "filter(count, s/10 = 0.3)": 1,
        "filter(count, s*0.1 > 0.2)": 2,
        "filter(max, s/3) = 3": True,
        "filter(sum, s*0.1) = 1.4": True,
        "c + 0.2 = 0.3": True,
        "floor((c + 0.2) * 10)": 3,
    },
}

SPELLINGS = {
    "lanes": {
        'Pmax=? [ F<=3 "goal" ]': 15 / 16,
        'Pmax =? [ F "goal" ]': 1,
        'Pmax= ? [F("goal")]': 1,
        'P max=? [ F "goal" ]': 1,
        "Pmax=? [ X X x=3 ]": 0.75,
        'Pmax=? [ F[1,2] "goal" ]': 0.75,
        'Pmax=? [ F>=2 "goal" ]': 1,
        'Pmax=? [ F{"time"}<=3 "goal" ]': 15 / 16,
        'Pmax=? [ "goal" ]': 0,
        'Pmax=? [ F "goal" => F x=1 ]': 1,
        'Pmax=? [ F "goal" & F "far" ]': 0,
        "Pmin=? [ true U x>2 ]": 0,
        'Pmin=? [ F "deadlock" ]': 0,
        "P>=0.5 [ F x>2 ]": False,
        'Pmax>=1 [ F "goal" ] & Pmin<=0 [ F "goal" ]': True,
        '"a":Pmax=? [ F "goal" ];"a"': 1,
        'R{"time"}max=? [ C ]': inf,
        'R{"time"}min=? [ C ]': 5 / 3,
        'R{"time"}min=? [ S ]': 0,
        'R{"time"} min =? [ F "goal" | "far" ]': 5 / 3,
        'R{"toll"}max=? [ C<=2 ]': 6,
        "R{1}min=? [ F x>2 ]": 5 / 3,
        "T min=? [ F x>2 ]": 5 / 3,
        'R{"time"}min<=2 [ F x>2 ]': True,
        'R{"time"}<5 [ C<=2 ]': True,
        'filter(avg, R{"time"}min=? [ F x>2 ], x<3)': 16 / 9,
        "LRAmax=? [ x=1 ]": 0.5,
    },
}

MORE_TEXTS = (
    'R{"flips"}=? [ C{discount=0.9} ]',
    'R{"time"}max=? [ F{discount=1/2} s=3 ]',
    'R{"toll"}min=? [ C{discount=0.5}<=3 ]',
    "<<*>> P>=0.5 [ F x=3 ]",
    '[[]] P>0 [ G F "goal" ]',
    'Pmax=? [ HOA: {"a.hoa", "a" <- x=1} ]',
    'multi(R{"time"}max=? [ C<=2 ], P>=0.5 [ F "goal" ])',
    "P=? [ F d=6 || F s=7 ]",
    "const bool c = true; c & s=0",
)
GROUPS = {
    "spellings": SPELLINGS,
    "rational": RATIONAL,
    "ctl": CTL,
    "cosafe": COSAFE,
    "expressions": EXPRESSIONS,
    "names": NAMES,
    "filters": FILTERS,
}


@pytest.mark.parametrize("name", SOURCES)
@pytest.mark.parametrize("group", GROUPS)
def test_values_by_hand(models, group, name):
    for text, expected in GROUPS[group].get(name, {}).items():  # few models, many properties
        check(models, name, text, expected)


# In state 0: stay, or toss a coin to 1 or 2; in 1 stay or go to 0; 2 stays.
FAIR_MODEL = """mdp module m x : [0..2]; [] x=0 -> true; [a] x=0 -> 0.5:(x'=1) + 0.5:(x'=2);
[] x=1 -> true; [] x=1 -> (x'=0); [] x=2 -> true; endmodule rewards true : 1; endrewards"""
FAIR = {
    "Pmin=? [ F x=2 ]": (0, 1),
    "Pmax=? [ F x=2 ]": (1, 1),
    "Pmin=? [ F x=1 ]": (0, 0.5),
    "Pmin=? [ X x=0 ]": (0, 0),
    "Pmax=? [ G x<2 ]": (1, 0),
    "Pmin=? [ G x<2 ]": (0, 0),
    "Pmax=? [ G x=0 ]": (1, 0),
    "Pmin=? [ F (x=0 & X x=1) ]": (0, 0.5),
    "Pmin=? [ F (x=1 & X x=0) ]": (0, 0.5),
    "Pmin=? [ x<2 U x=2 ]": (0, 1),
    "Pmin=? [ x=0 U x=2 ]": (0, 0.5),
    "Pmax=? [ x=0 W x=2 ]": (1, 0.5),
    "Pmin=? [ F<=1 x=2 ]": (0, 0),
    "P>=1 [ F x=2 ]": (False, True),
    "P<=0 [ G x<2 ]": (False, True),
    "filter(count, P>=1 [ F x=2 ])": (1, 3),
    "1 - Pmin=? [ F x=1 ]": (1, 0.5),
    "Pmin=? [ G F x=2 ]": (0, 1),
    "Pmax=? [ G F x=0 ]": (1, 0),
    "Pmax=? [ F G x=0 ]": (1, 0),
    "Pmin=? [ F G x=2 ]": (0, 1),
    "Pmin=? [ (F x=1) & (F G x=2) ]": (0, 0.5),
    "Pmax=? [ (G F x=0) | (G F x=1) ]": (1, 0),
    "P<=0 [ G F x=1 ]": (False, True),
    "Pmin=? [ F[1,2] x=2 ]": (0, 0),
    "Pmin=? [ F>=2 x=2 ]": (0, 1),
}


@pytest.mark.parametrize("fair", [False, True])
def test_fair_strategies_take_all_choices_for_ever(fair):
    program = read_program(FAIR_MODEL)
    model, known = build_model(program), program_definitions(program)
    for text, values in FAIR.items():
        (prop,) = parse_properties(text, known)
        actual = solve_property(model, prop, fair=fair)
        expected = values[fair]
        got = actual.value if actual.holds is None else actual.holds
        assert got == (pytest.approx([expected]) if actual.holds is None else [expected]), text
    for text in (
        "E [ G x=0 ]",
        "Rmin=? [ F x=2 ]",
        "multi(Pmax=? [ F x=2 ])",
        "Pmin=? [ F{1}<=2 x=2 ]",
    ):
        if fair:
            with pytest.raises(ValueError, match="fair=True"):
                solve_property(model, parse_properties(text, known)[0], fair=True)


def test_a_reward_without_a_name_is_the_first_of_a_program(models):
    assert answer(models, "lanes", "R=? [ C<=2 {x=2} ]; Rmax=? [ C<=2 ]").value == [2]


@pytest.mark.parametrize(
    "text",
    [
        'multi(R{"time"}min=? [ "goal" U x>2 ], P>=0 [ F x=3 ])',
        'multi(R{"time"}min=? [ F X x>2 ], P>=0 [ F x=3 ])',
        "multi(E [ F x=3 ], P>=0 [ F x=3 ])",
        "multi(filter(max, Pmax=? [ F x=3 ]), P>=0 [ F x=3 ])",
    ],
)
def test_objectives_are_not_read_as_others(models, text):
    with pytest.raises(ValueError, match=r"until a state formula holds|a property with P or R"):
        answer(models, "lanes", text)


REFUSED = {
    "filter(forall, pow(2,s-1)>0)": "exponent of an integer is negative",
    "const int c = 0; pow(2,c-1)": "exponent of an integer is negative",
    "const int y = y; y": "column 11.*an expression of constants",
    '"a": "b" + 1; "b": "a"; 1': "depends on itself",
    'R{"flips"}=? [ G s=1 ]': "column 16.*a prefix satisfies",
    'R{"flips"}=? [ s=0 W s=1 ]': "column 16.*a prefix satisfies",
    "P=? [ F P=? [ F d=6 ] ]": "a nested property with a threshold",
    "P=? [ F d ]": "d is a number",
    "filter(max, s=0)": "column 13.*a number",
    "filter(argmax, true)": "column 16.*a number",
    "filter(forall, P=? [ X s=1 ])": "column 16.*a threshold or a state formula",
    "filter(min, P=? [ F d=6 ], s>7)": "no state satisfies",
    "filter(state, s)": "13 states satisfy",
    "P=? [ F d=6 {s=2}{sum} ]": "column 19.*min or max",
    "E [ F d=6 ] + 1": "column 1.*a number; .* is applied to a truth value",
    "filter(range, d) + 1": "several results",
    "true + 1": "column 1.*a number; .* is applied to a truth value",
    "1 +": "the end",
    "(s": "the end",
}


@pytest.mark.parametrize("text", REFUSED)
def test_mistakes_are_one_line_with_a_place_or_the_operand(models, text):
    with pytest.raises(ValueError, match=REFUSED[text]):
        model, known = models["die"]
        for prop in parse_properties(text, known):
            solve_property(model, prop)


EXACT = {
    "P=? [ F d=6 ]": "1/6",
    "P=? [ G F d=6 ]": "1/6",
    "P=? [ F<=3 d=6 ]": "1/8",
    'R{"flips"}=? [ F s=7 ]': "11/3",
    'R{"flips"}=? [ X X F s=7 ]': "11/3",
    "S=? [ d=3 ]": "1/6",
    "P=? [ F d=6 ] + 1/3": "1/2",
    "P=? [ F d=6 ] * 0.1": "1/60",
    "filter(sum, P=? [ F d=6 ], s>3)": "5/3",
    "filter(avg, P=? [ F d=6 ], s<3)": "1/6",
    "filter(max, P=? [ F d=6 ], s<7)": "2/3",
    "filter(range, P=? [ F d=6 ], s<3)": "0 1/3",
    "filter(count, P>=1/3 [ F d=6 ])": "3",
    "ceil(P=? [ F d=6 ])": "1",
}


@pytest.mark.parametrize("text", EXACT)
def test_exact_values_are_fractions(models, text):
    found = answer(models, "die", text, exact=True)
    assert " ".join(map(str, found.exact)) == EXACT[text]
    assert found.status.name == "CONVERGED"
    for value, lower, upper in zip(found.exact, found.lower, found.upper, strict=True):
        assert lower <= value <= upper and upper - lower <= 1e-15 * max(1, abs(value))


def test_exact_answers_are_refused_for_large_models(models, monkeypatch):
    monkeypatch.setattr(exact_thresholds, "MAX_TRANSITIONS", 1)
    with pytest.raises(ValueError, match=r"exact=True is for models of moderate size.*13 states"):
        answer(models, "die", "P=? [ F d=6 ]", exact=True)


def test_a_malformed_property_does_not_stop_the_others(models):
    text = """P=? [ F s=1 ];
    P=? [ F x# ];
    P=? [ G s=1
    "q": P=? [ X s=1 ]
    const int k = j;
    filter(min, P=? [ F s=1 ])
    P=? [ F s=1 ]]
    T=? [ F s=1 ]"""
    items = parse_each(text, models["die"][1])
    assert [isinstance(x, MalformedProperty) for x in items] == [
        False,
        True,
        True,
        False,
        True,
        False,
        True,
        False,
    ]
    assert [x.error.split(":")[1] for x in items if isinstance(x, MalformedProperty)] == [
        " line 2, column 13",
        " line 4, column 5",
        " line 5, column 15",
        " line 7, column 18",
    ]
    assert items[3].name == "q" and items[-1].operator == "T"


PIECES = "P=? [ ] ( ) { } F G X U W R & | ! => <=> = < <= s d 1 1/3 filter(max, E A ? : ; const ceil( + - * / ^ << #"


@pytest.mark.parametrize("count", [1000, pytest.param(100_000, marks=pytest.mark.exhaustive)])
def test_mutated_texts_have_an_answer_or_an_error_with_a_place(models, count):
    rng = random.Random(count)
    texts = {
        name: [text for group in GROUPS.values() for text in [*group.get(name, {}), *MORE_TEXTS]]
        for name in models
    }
    for i in range(count):
        name = rng.choice(("die", "die", "lanes"))
        model, known = models[name]
        text = rng.choice(texts[name])
        for _ in range(rng.randint(1, 3)):
            first = rng.randrange(len(text) + 1)
            piece = rng.choice((*PIECES.split(), '"end"', ""))
            text = text[:first] + piece + text[first + rng.randrange(5) :]
        for item in parse_each(text, known):
            if isinstance(item, MalformedProperty):
                assert "column" in item.error, text
            elif i % 20 == 0:
                with contextlib.suppress(ValueError):
                    solve_property(model, item, fair=i % 60 == 0, exact=i % 100 == 0)


def test_quotients_by_zero_are_infinite_or_refused():
    coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1], initial=[1, 0, 0])
    coin = coin.replace(label=np.array([[False], [True], [False]]), propositions=("g",))
    for text, value in (("1/0", np.inf), ("-1/0", -np.inf), ('P=? [ F "g" ] + 1/0', np.inf)):
        found = solve_property(coin, text)
        assert found.value.tolist() == found.lower.tolist() == found.upper.tolist() == [value]
    for text in ("0/0", "1/0 - 1/0"):
        with pytest.raises(ValueError, match="no number"):
            solve_property(coin, text)
