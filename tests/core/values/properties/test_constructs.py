"""Coalitions of one player, discounts, automata of files, and operands of wrong types, with values by hand.

In `trap`, action a is certain and dear, b is cheap and ends in a state with rewards for ever. `rough` is the same
with an interval. `duel` is a game in which p1 decides in state 0 and p2 in state 1.
"""

import itertools
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.app.solve import load
from jaxltl.core.language.resolve import read_program
from jaxltl.core.logic.comparisons import Definitions, program_definitions
from jaxltl.core.logic.properties import parse_properties
from jaxltl.core.programs.build import build_model
from jaxltl.core.values.properties.solve_property import solve_property
from jaxltl.io.hoa.hoa import read_hoa, write_hoa
from jaxltl.io.prism.properties import parse_queries, read_queries

SOURCES = {
    "trap": """mdp module m s : [0..2]; [a] s=0 -> (s'=1); [b] s=0 -> 0.5:(s'=1) + 0.5:(s'=2);
    [] s=1 -> true; [] s=2 -> true; endmodule label "goal" = s=1;
    rewards "r" [a] true : 10; [b] true : 1; s=2 : 5; endrewards rewards "act" [a] true : 2; endrewards""",
    "rough": """mdp module m s : [0..2]; [a] s=0 -> (s'=1); [b] s=0 -> [0.3,0.7]:(s'=1) + [0.3,0.7]:(s'=2);
    [] s=1 -> true; [] s=2 -> true; endmodule label "goal" = s=1;
    rewards "r" [a] true : 10; [b] true : 1; s=2 : 5; endrewards""",
    "drift": """dtmc module m s : [0..3]; [] s=0 -> [0.3,0.7]:(s'=1) + [0.3,0.7]:(s'=2); [] s=1|s=2 -> (s'=3);
    [] s=3 -> true; endmodule rewards "r" s=1 : 2; s=2 : 10; endrewards""",
    "walk": """dtmc module m s : [0..3]; [] s<2 -> 0.5:(s'=s+1) + 0.5:(s'=3); [] s>1 -> true; endmodule
    rewards "r" s<2 : 3; s=2 : 1; endrewards rewards "act" [] s<2 : 4; endrewards label "two" = s=2;""",
    "duel": """smg player p1 [a], [b] endplayer player p2 [c], [d] endplayer
    module m s : [0..3]; [a] s=0 -> (s'=1); [b] s=0 -> 0.5:(s'=1) + 0.5:(s'=2);
    [c] s=1 -> (s'=2); [d] s=1 -> (s'=3); [a] s>1 -> true; endmodule
    rewards "r" [a] s=0 : 2; [c] true : 6; [d] true : 1; s=2 : 1; endrewards""",
}
inf = float("inf")

TABLES = {
    "coalition": {
        "trap": {
            '<<*>> Pmax=? [ F "goal" ]': 1,
            '<<*>> Pmin=? [ F "goal" ]': 0.5,
            '<<>> Pmax=? [ F "goal" ]': 1,
            "[[*]] Pmin=? [ F s=2 ]": 0,
            "[[]] Pmax=? [ F s=2 ]": 0.5,
            "<<*>> P>0 [ F s=2 ]": True,
            "[[]] P>0 [ F s=2 ]": True,
            "<<1>> P>0 [ F s=2 ]": True,
            "[[*]] P>0 [ F s=2 ]": False,
            "<<>> P>0 [ F s=2 ]": False,
            "P>0 [ F s=2 ]": False,
            "<<*>> P<=0 [ F s=2 ]": True,
            "[[*]] P<=0 [ F s=2 ]": False,
            "<<>> P<0.6 [ F s=2 ]": True,
            "<<*>> P>=1 [ G F s=1 ]": True,
            "[[*]] P>=1 [ G F s=1 ]": False,
            "[[*]] P>=0.5 [ G F s=1 ]": True,
            '<<*>> R{"r"}<=10 [ F "goal" ]': True,
            '[[*]] R{"r"}<=10 [ F "goal" ]': False,
            '<<*>> R{"r"}min=? [ C ]': 10,
            "filter(count, <<*>> P>0 [ F s=2 ])": 2,
            "P>=1 [ F <<*>> P>=1 [ X s=1 ] ]": True,
            "E [ F [[*]] P>=1 [ X s=2 ] ]": True,
        },
        "duel": {
            "<<p1>> Pmax=? [ F s=2 ]": 0.5,
            "[[p1]] P>=1 [ F s=3 ]": False,
            "[[p2]] P>=0.5 [ F s=2 ]": True,
            "[[p2]] P>0.5 [ F s=2 ]": False,
            "[[p1,p2]] P>=0.1 [ F s=3 ]": False,
            "[[]] P>=1 [ F s=3 ]": True,
        },
    },
    "forever": {
        "rough": {
            'R{"r"}minmin=? [ C ]': 10,
            'R{"r"}minmax=? [ C ]': 10,
            'R{"r"}maxmin=? [ C ]': inf,
            'R{"r"}minmin=? [ Fc s=2 ]': 1,
            'R{"r"}maxmax=? [ Fc s=2 ]': 10,
            'R{"r"}maxmin=? [ Fc "goal" ]': inf,
            'filter(state, R{"r"}minmin=? [ C ], s=2)': inf,
            'filter(state, R{"r"}maxmax=? [ C ], s=1)': 0,
        },
        "drift": {
            'R{"r"}min=? [ C ]': 0.7 * 2 + 0.3 * 10,
            'R{"r"}max=? [ C ]': 0.3 * 2 + 0.7 * 10,
            'R{"r"}max=? [ Fc s=2 ]': 1.4,
            'R{"r"}min=? [ Fc s=1 ]': 3,
            'R{"r"}max=? [ C<=1 ]': 0,
        },
    },
    "discount": {
        "walk": {
            'R{"r"}=? [ C{discount=0.5} ]': 3 + 0.25 * (3 + 0.25 * 2),
            'R{"r"}=? [ F{discount=0.5} "two" ]': 3 + 0.75,
            'R{"r"}=? [ F{discount=0.5} s>0 ]': 3,
            'R{"r"}=? [ C{discount=0.5}<=0 ]': 0,
            'R{"r"}=? [ C{discount=0.5}<=1 ]': 3,
            'R{"r"}=? [ C{discount=0.5}<=2 ]': 3.75,
            'R{"r"}=? [ C{discount=0.5}<4 ]': 3.75 + 0.25 * 0.25,
            'R{"r"}=? [ C{discount=0} ]': 3,
            'R{"r"}=? [ F{discount=0} s=2 ]': 3,
            'R{"r"}=? [ C{discount=1}<=2 ]': 4.5,
            'R{"r"}=? [ C{discount=1} ]': inf,
            'R{"r"}=? [ F{discount=1} s>1 ]': 4.5,
            'R{"act"}=? [ C{discount=0.1*5} ]': 5,
            'R{"act"}=? [ I=0 ]': 0,
            'R{"act"}=? [ I=3 {s=1} ]': 0,
            'filter(state, R{"r"}=? [ C{discount=0.9} ], s=2)': 10,
            'R{"r"}=? [ C{discount=1/3} {s=2} ]': 1.5,
            'filter(sum, R{"act"}=? [ C{discount=0.5} ])': 9,
            'R{"r"}=? [ C{discount=0.5} ] * 8': 31,
            'R{"act"}<=5 [ C{discount=0.5} ]': True,
            'R{"act"}<5 [ C{discount=0.5} ]': False,
            'R{"act"}>5 [ C{discount=0.5} ]': False,
            'P=? [ F R{"r"}>=2 [ C{discount=0.5} ] ]': 1,
        },
        "trap": {
            'R{"r"}max=? [ C{discount=0.9} ]': 23.5,
            'R{"r"}min=? [ C{discount=0.9} ]': 10,
            'R{"r"}min=? [ C{discount=0.5} ]': 1 + 0.25 * 10,
            'R{"r"}min=? [ F{discount=0.9} "goal" ]': 10,
            'R{"r"}max=? [ F{discount=0.9} s=2 ]': 10,
            'R{"r"}min=? [ F{discount=0.9} s=2 ]': 1,
            'R{"r"}max=? [ C{discount=0.9}<=2 ]': 10,
            'R{"r"}min=? [ C{discount=0.9}<=2 ]': 1 + 0.45 * 5,
            'R{"r"}max=? [ C{discount=1} ]': inf,
            'R{"r"}max<=23.5 [ C{discount=0.9} ]': True,
            'R{"r"}<=23.5 [ C{discount=0.9} ]': True,
            'R{"r"}<23.5 [ C{discount=0.9} ]': False,
            '<<*>> R{"r"}<=10 [ C{discount=0.9} ]': True,
        },
        "rough": {
            'R{"r"}minmin=? [ C{discount=0.9} ]': 10,
            'R{"r"}maxmin=? [ C{discount=0.9} ]': 1 + 0.3 * 45,
            'R{"r"}maxmax=? [ C{discount=0.9} ]': 1 + 0.7 * 45,
            'R{"r"}minmax=? [ C{discount=0.5} ]': 1 + 0.35 * 10,
            'R{"r"}minmin=? [ C{discount=0.5} ]': 1 + 0.15 * 10,
            'R{"r"}minmin=? [ F{discount=0.9} s=2 ]': 1,
            'R{"r"}minmax=? [ C{discount=0.9}<=2 ]': 1 + 0.63 * 5,
            'R{"r"}minmin=? [ C{discount=0} ]': 1,
        },
        "duel": {
            '<<p1>> R{"r"}max=? [ C{discount=0.5} ]': 2.5,
            '<<p2>> R{"r"}max=? [ C{discount=0.5} ]': 1 / 2 + 7 / 4,
            '<<p1,p2>> R{"r"}max=? [ C{discount=0.5} ]': 2 + 3.5,
            '<<p1>> R{"r"}max=? [ F{discount=0.5} s>1 ]': 2.5,
            '<<p1>> R{"r"}min=? [ C{discount=0.5}<=2 ]': 0.25 * 6 + 0.25,
            '<<p1>> R{"r"}>=2.5 [ C{discount=0.5} ]': True,
            '[[p2]] R{"r"}>2.5 [ C{discount=0.5} ]': False,
            '<<p1>> R{"r"}max=? [ C{discount=0} ]': 2,
        },
    },
}


@pytest.fixture(scope="module")
def models():
    programs = {name: read_program(text) for name, text in SOURCES.items()}
    return {name: (build_model(x), program_definitions(x)) for name, x in programs.items()}


@pytest.mark.parametrize("construct", TABLES)
def test_values_by_hand(models, construct):
    for name, table in TABLES[construct].items():
        model, known = models[name]
        for text, expected in table.items():
            (prop,) = parse_properties(text, known)
            answer = solve_property(model, prop)
            assert answer.status.name == "CONVERGED", text
            if isinstance(expected, bool):
                assert answer.holds == [expected], text
            else:
                assert answer.holds is None, text
                assert answer.value == pytest.approx(np.ravel(expected), rel=1e-6, abs=1e-9), text
                assert (answer.lower <= np.asarray(expected) + 1e-12).all(), text
                assert (answer.upper >= np.asarray(expected) - 1e-12).all(), text


def test_discounted_rewards_as_fractions(models):
    exact = {
        "walk": {
            'R{"r"}=? [ C{discount=1/3} ]': "85/24",
            'R{"r"}=? [ C{discount=0.1}<=2 ]': "63/20",
        },
        "trap": {'R{"r"}max=? [ C{discount=0.9} ]': "47/2", 'R{"r"}min=? [ C{discount=2/3} ]': "6"},
        "duel": {'<<p1>> R{"r"}max=? [ C{discount=1/3} ]': "7/3"},
    }
    for name, table in exact.items():
        model, known = models[name]
        for text, expected in table.items():
            (prop,) = parse_properties(text, known)
            assert solve_property(model, prop, exact=True).exact == (Fraction(expected),), text


def test_discounted_rewards_agree_with_the_solvers_of_discounted_rewards():
    """On random MDPs, and games and interval models on them; rewards of states, choices and transitions."""
    rng = np.random.default_rng(5)
    for trial in range(6):
        rows = np.sort(rng.integers(0, 5, 12))
        start = np.searchsorted(rows, np.arange(6))
        if (np.diff(start) == 0).any():
            continue
        successor = np.concatenate([rng.choice(5, 2, replace=False) for _ in rows])
        chance = np.tile([0.25, 0.75], rows.size)
        reward = jl.models.Rewards(
            rng.integers(0, 4, 5), rng.integers(0, 4, rows.size), rng.integers(0, 4, 2 * rows.size)
        )
        model = jl.make_sparse(
            start, np.arange(rows.size + 1) * 2, successor, chance, rewards={"r": reward}
        )
        factor = [0.5, 0.9][trial % 2]
        for objective in ("max", "min"):
            text = f'R{{"r"}}{objective}=? [ C{{discount={factor}}} ]'
            expected = jl.optimal_value(model, "r", factor, objective=objective).value
            actual = solve_property(model, text, states=range(5))
            assert actual.value == pytest.approx(np.asarray(expected), rel=1e-6)
            assert actual.strategy.row.shape == (5,)
        game = jl.make_game(model, np.arange(5) % 2 == 0)
        expected = jl.optimal_value(game, "r", factor).value
        text = f'<<system>> R{{"r"}}max=? [ C{{discount={factor}}} ]'
        assert solve_property(game, text, states=range(5)).value == pytest.approx(
            np.asarray(expected), rel=1e-6
        )
        plain = jl.make_sparse(
            start,
            model.entry_start,
            successor,
            chance,
            rewards={"r": jl.models.Rewards(reward.state, reward.choice)},
        )
        rough = jl.make_interval(plain, chance - 0.1, chance + 0.1)
        expected = jl.optimal_value(rough, "r", factor, nature="adversarial").value
        text = f'R{{"r"}}maxmin=? [ C{{discount={factor}}} ]'
        assert solve_property(rough, text, states=range(5)).value == pytest.approx(
            np.asarray(expected), rel=1e-6
        )


MULTI = {  # action a earns 3 of x, then 1 of y; b earns 2 of y, then 0.2 of x and 1 of y with probability 0.5
    'multi(R{"x"}max=? [ C<=2 ], R{"y"}>=1 [ C<=1 ])': 1.55,
    'multi(R{"x"}max=? [ C<=1 ], R{"y"}>=1 [ C<=1 ])': 1.5,
    'multi(R{"x"}max=? [ C<3 ], P>=1 [ F s=2 ])': 3,
    'multi(R{"x"}max=? [ C<=3 ], P>=1 [ F s=2 ])': 6,
    'multi(R{"x"}max=? [ C<=3 ], R{"y"}>=2.5 [ C<=3 ])': 3.75,
    'multi(R{"x"}max=? [ C<=0 ], P>=1 [ F s=2 ])': 0,
    'multi(R{"x"}min=? [ C<=3 ], P>=1 [ F s=2 ])': 0.1,
    'multi(Pmax=? [ F s=3 ], R{"x"}>=3 [ C<=1 ])': 0.5,
    'multi(R{"y"}min=? [ C ], R{"x"}>=3 [ C<=1 ], P>=1 [ F s=2 ])': 1 + 2.5,
    'multi(Pmax=? [ F<=2 s=2 ], R{"x"}>=1 [ C<=1 ])': 2 / 3,
    'multi(R{"x"}>=1.5 [ C<=1 ], R{"y"}>=1 [ C<=1 ])': True,
    'multi(R{"x"}>=1.501 [ C<=1 ], R{"y"}>=1 [ C<=1 ])': False,
    'multi(R{"x"}>=3.3 [ C<=3 ], R{"y"}>=2 [ C<=3 ])': True,
    'multi(R{"x"}<=0 [ C<=1 ], R{"y"}>=2 [ C<=1 ])': True,
    'multi(R{"x"}>=1.55 [ C<=2 ], R{"y"}>=1 [ C<=1 ])': True,
}


def test_rewards_of_some_steps_among_several_objectives():
    """Thresholds on the boundary are met, since the numbers of the program are exact."""
    program = read_program(
        """mdp module m s : [0..3]; [a] s=0 -> (s'=1); [b] s=0 -> 0.5:(s'=2) + 0.5:(s'=3); [] s=1 -> (s'=0);
        [] s=2 -> true; [] s=3 -> (s'=2); endmodule
        rewards "x" [a] true : 3; s=3 : 0.2; endrewards rewards "y" [b] true : 2; s=1 : 1; s=3 : 1; endrewards"""
    )
    model, known = build_model(program), program_definitions(program)
    for text, expected in MULTI.items():
        (prop,) = parse_properties(text, known)
        answer = solve_property(model, prop)
        assert answer.status == jl.Status.CONVERGED, text
        if isinstance(expected, bool):
            assert answer.holds == expected, text
        else:
            assert answer.value == pytest.approx(expected, rel=1e-6), text
    (prop,) = parse_properties('multi(R{"x"}max=? [ C<=3 ], R{"y"}max=? [ C<=3 ])', known)
    front = solve_property(model, prop)
    assert np.sort(front.points, 0) == pytest.approx(np.array([[3, 1], [6, 3]]))
    (prop,) = parse_properties('multi(R{"x"}max=? [ C<=9999999 ], P>=1 [ F s=2 ])', known)
    with pytest.raises(ValueError, match="ask for fewer steps"):
        solve_property(model, prop)


HOA = {
    "gf.hoa": """HOA: v1 States: 1 Start: 0 AP: 2 "a" "b" acc-name: Rabin 1 Acceptance: 2 Fin(0) & Inf(1)
    --BODY-- State: 0 [0&1] 0 {1} [!0&1] 0 [!1] 0 {0} --END--""",
    "next.hoa": """HOA: v1 States: 4 Start: 0 AP: 1 "a" acc-name: Buchi Acceptance: 1 Inf(0)
    --BODY-- State: 0 [t] 1 State: 1 [0] 2 [!0] 3 State: 2 {0} [t] 2 State: 3 [t] 3 --END--""",
}
RECOGNIZED = {
    'P=? [ HOA: {"gf.hoa", "a" <- s=3, "b" <- s>1} ]': 0.75,
    "P=? [ (G F s=3) & (F G s>1) ]": 0.75,
    'P=? [ ! HOA: {"$PROPERTY_DIR/gf.hoa", "a" <- s=3, "b" <- s>1} ]': 0.25,
    'P=? [ !!HOA:{"$MODEL_DIR/next.hoa","a"<-s=1|s=2} ]': 0.5,
    'P>=0.5 [ HOA: {"next.hoa", "a" <- s=3} ]': True,
    '1 - P=? [ HOA: {"next.hoa", "a" <- "two"} ]': 1,
    'E [ HOA: {"next.hoa", "a" <- s=3} ]': True,
    'A [ HOA: {"next.hoa", "a" <- s=3} ]': False,
    'label "a" = s=3; P=? [ HOA: {"next.hoa"} ]': 0.5,
    'filter(count, P>0.4 [ HOA: {"next.hoa", "a" <- s=3} ])': 3,
    'P=? [ HOA: {"none.hoa"} ]': "column 13.*cannot read",
    'P=? [ HOA: {"next.hoa", "c" <- s=1} ]': "column 25.*: a",
    'P=? [ HOA: {"next.hoa", "a" = s=1} ]': "column 29.*'<-'",
    'P=? [ HOA: {"next.hoa", "a" <- X s=1} ]': "column 32",
    'P=? [ HOA: {"next.hoa"} ]': "proposition 'a'",
}


def test_automata_of_files(tmp_path):
    """Paths that a deterministic automaton in the HOA format accepts, beside the file of properties."""
    for name, text in HOA.items():
        (tmp_path / name).write_text(text)
    source = tmp_path / "walk.prism"
    source.write_text(SOURCES["walk"])
    model = load(source, read_queries(source, None, ["true"])[0])
    for i, (text, expected) in enumerate(RECOGNIZED.items()):
        file = tmp_path / f"{i}.props"
        file.write_text(text)
        if isinstance(expected, str):
            with pytest.raises(ValueError, match=expected):
                (query,) = read_queries(source, None, [str(file)])[1]
                solve_property(model, query.parsed)
            continue
        (query,) = read_queries(source, None, [str(file)])[1]
        for exact in (False, True):
            answer = solve_property(model, query.parsed, exact=exact)
            assert answer.status.name == "CONVERGED", text
            actual = answer.holds[0] if isinstance(expected, bool) else answer.value[0]
            assert actual == pytest.approx(expected), text


def test_automata_of_definitions(models):
    """Without the command, Definitions(automaton=...) reads them."""
    model, known = models["trap"]
    (query,) = parse_queries(['Pmax=? [ HOA: {"next.hoa", "a" <- s=2} ]'], known)
    assert "cannot read" in query.error
    with pytest.raises(ValueError, match=r"column 16.*automaton=\.\.\."):
        parse_properties('Pmax=? [ HOA: {"next.hoa"} ]', known)
    known = replace(known, automaton=lambda name: read_hoa(HOA[name]))
    for text, expected in {
        'Pmax=? [ HOA: {"next.hoa", "a" <- s=2} ]': 0.5,
        'Pmin=? [ HOA: {"next.hoa", "a" <- s=2} ]': 0,
        'Pmin=? [ !HOA: {"next.hoa", "a" <- s=2} ]': 0.5,
        'Pmax=? [ HOA: {"gf.hoa", "a" <- "goal", "b" <- s!=2} ]': 1,
        'Pmin=? [ HOA: {"gf.hoa", "a" <- "goal", "b" <- s!=2} ]': 0.5,
    }.items():
        (prop,) = parse_properties(text, known)
        assert solve_property(model, prop).value == pytest.approx([expected], abs=1e-9), text


REFUSED = {
    "trap": {
        'P=? [ F "goal" ] & true': "column 1: .*a truth value; & is applied to a number",
        'true & Pmax=? [ F "goal" ]': "column 8: .*a nested property with a threshold",
        "s & true": "column 1.*a truth value",
        "s=0 | s": "column 7.*a truth value",
        "-(s=0)": "column 3.*a number; - is",
        "(s=0) * 2": "column 2.*a number",
        "s=true": "column 1.*not one of each",
        "max(true, 1)": "column 5.*a number",
        "s=0 ? 1 : true": "column 1.*not one of each",
        "P>0 [ F s=1 ] + 1": "column 1.*a number",
        '"goal" + 1': "column 1.*a number",
        '"goal" = 1': "not one of each",
        "mod(true, 2)": "column 5",
        "filter(max, s & true)": "column 13.*a truth value",
        "P=? [ F s=true ]": "column 9.*not one of each",
        "formula q = s; q & true": "column 16.*a truth value",
        '"p": Pmin=? [ F s=1 ]; "p" & true': "column 24",
        "const bool c = 1; c": "column 16.*true or false",
        "const int c = true; c": "column 15.*an integer",
        "const int c = 3/2; c": "column 15.*an integer",
        "const double c = false; c": "column 18.*a number",
        'R{"r"}max=? [ C{discount=2} ]': "column 26.*a discount",
        'R{"r"}max=? [ C{discount=-0.5}<=0 ]': "column 26",
        'R{"r"}max=? [ C{discount=0/0} ]': "column 28.*other than 0",
        'R{"r"}max=? [ C{discount=1/0.0} ]': "column 28",
        'R{"r"}min=? [ F{discount=0.9} X s=1 ]': "column 31.*a state formula",
        'R{"r"}min=? [ C{discount=0.9 ]': "'}'",
        'R{"r"}min=? [ F{discount 0.9} s=1 ]': "'='",
        "[[*] P>0 [ F s=1 ]": "column 6.*twice",
        "<<*]] P>0 [ F s=1 ]": "column 4",
        'multi(R{"r"}max=? [ C{discount=0.9} ], P>=1 [ F s=1 ])': "inside multi",
        "[[*]] multi(Pmax=? [ F s=1 ])": "after a coalition",
        "<<*>> Pmaxmin=? [ F s=1 ]": "no intervals",
    },
    "duel": {
        "[[p1]] Pmax=? [ F s=2 ]": "for thresholds",
        "[[p3]] P>=1 [ F s=2 ]": "no player 'p3'",
    },
}


@pytest.mark.parametrize("name", REFUSED)
def test_mistakes_are_named_with_their_place(models, name):
    model, known = models[name]
    for text, message in REFUSED[name].items():
        with pytest.raises(ValueError, match=message):
            for prop in parse_properties(text, known):
                solve_property(model, prop)


FORMULAS = (
    'G F "a"',
    'F G "a"',
    '(G F "a") & (F G "b")',
    '(G F "a") => (G F "b")',
    '"a" U ("b" & X "a")',
    'G ("a" | X "b")',
    'F ("a" & X G "b")',
)


def random_model(rng):
    """Five states with one to three choices of two successors, and random labels."""
    count = rng.integers(1, 4, 5)
    start = np.append(0, np.cumsum(count))
    successor = np.concatenate([rng.choice(5, 2, replace=False) for _ in range(start[-1])])
    chance = np.tile([1 / 4, 3 / 4], start[-1])
    label = rng.random((5, 2)) < 0.5
    return jl.make_sparse(
        start, np.arange(start[-1] + 1) * 2, successor, chance, label=label, propositions=["a", "b"]
    )


def with_all_choices(model, share):
    """The model in which each choice takes every other one with a small probability."""
    start, rows = np.asarray(model.row_start), []
    matrix = np.zeros((model.num_rows, 5))
    row = np.repeat(np.arange(model.num_rows), 2)
    np.add.at(matrix, (row, np.asarray(model.successor)), np.asarray(model.probability))
    for first, last in itertools.pairwise(start):
        mean = matrix[first:last].mean(0)
        rows += [(1 - share) * matrix[r] + share * mean for r in range(first, last)]
    r, t = np.nonzero(np.array(rows))
    entry_start = np.searchsorted(r, np.arange(model.num_rows + 1))
    return jl.make_sparse(
        start,
        entry_start,
        t,
        np.array(rows)[r, t],
        label=np.asarray(model.label),
        propositions=["a", "b"],
    )


def test_fair_strategies_are_limits_of_those_that_take_all_choices():
    """An optimum over fair strategies is that over strategies which take each choice, now and then."""
    rng = np.random.default_rng(8)
    differs = 0
    for trial in range(len(FORMULAS)):
        model, formula = random_model(rng), FORMULAS[trial % len(FORMULAS)]
        limit = with_all_choices(model, 1e-6)
        for objective in ("max", "min"):
            text = f"P{objective}=? [ {formula} ]"
            fair = solve_property(model, text, states=range(5), fair=True)
            assert fair.status.name == "CONVERGED"
            expected = solve_property(limit, text, states=range(5)).value
            assert fair.value == pytest.approx(expected, abs=1e-3), text
            differs += (
                np.abs(solve_property(model, text, states=range(5)).value - expected).max() > 0.1
            )
    assert differs > 1


def test_formulas_and_their_automata_have_the_same_probability():
    rng = np.random.default_rng(6)
    for formula in FORMULAS:
        automaton = jl.to_automaton(formula.replace('"', ""))
        known = Definitions(automaton=lambda _, x=automaton: read_hoa(write_hoa(x)))
        model = random_model(rng)
        for operator in ("Pmax=?", "Pmin=?"):
            for sign in ("", "!"):
                (prop,) = parse_properties(f'{operator} [ {sign}HOA: {{"x.hoa"}} ]', known)
                actual = solve_property(model, prop, states=range(5))
                expected = solve_property(
                    model, f"{operator} [ {sign}({formula}) ]", states=range(5)
                )
                assert actual.value == pytest.approx(expected.value, abs=1e-6), prop.text
