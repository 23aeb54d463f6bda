"""Properties of stochastic multi-player games, with values worked out by hand."""

from __future__ import annotations

from fractions import Fraction
from functools import cache

import numpy as np
import pytest

import jaxltl as jl
from benchmarks.multiplayer import avoid, dice, hall, market, task_graph
from jaxltl.core.language.resolve import read_program
from jaxltl.core.programs.build import build_model
from jaxltl.core.types import Status

# Bob may try a door (1/3) or call Carol with Alice; Carol opens or sends back to Alice.
VAULT = """smg
player alice [quiet], [loud], [lost] endplayer
player bob guard, [goal], [try], [call] endplayer
player carol [open], [shut] endplayer
module vault
  s : [0..4];
  [quiet] s=0 -> (s'=1);
  [loud] s=0 -> 1/2 : (s'=2) + 1/2 : (s'=3);
  [open] s=2 -> (s'=4);
  [shut] s=2 -> (s'=0);
  [lost] s=3 -> true;
  [goal] s=4 -> true;
  [try] s=1 -> 1/3 : (s'=4) + 2/3 : (s'=3);
  [call] s=1 -> 1/2 : (s'=2) + 1/2 : (s'=0);
endmodule
module guard n : [0..0]; endmodule
label "goal" = s=4;
label "lost" = s=3;
label "alice" = s=0;
rewards "steps" s<3 : 1; endrewards
rewards "cost" [quiet] true : 2; [try] true : 5; [call] true : 1; endrewards
"""


@cache
def game(text, **constants):
    return build_model(read_program(text, constants))


def check(model, text, value):
    """The answer from the initial state: exact truth, or a converged enclosure of the value."""
    answer = jl.solve_property(model, text)
    assert answer.status == Status.CONVERGED, text
    if isinstance(value, bool):
        assert answer.holds == [value], text
        return
    number = np.inf if value == "inf" else float(Fraction(value))
    assert answer.lower[0] - 1e-12 <= number <= answer.upper[0] + 1e-12, (text, answer.value)
    assert answer.value[0] == pytest.approx(number, abs=2e-6), text


# The members of the coalition maximise, and the others minimise.
REACH = {
    "": 0, "alice": 0, "bob": 0, "carol": "1/3", "alice,bob": "1/3", "alice,carol": "1/2",
    "bob,carol": "1/2", "alice,bob,carol": 1, "*": 1, "1": 0, "3": "1/3", "1,2": "1/3", "3,alice": "1/2",
    '2,"carol"': "1/2",
}  # fmt: skip


@pytest.mark.parametrize("coalition", REACH)
def test_reachability_of_every_coalition(coalition):
    check(game(VAULT), f'<<{coalition}>> Pmax=? [ F "goal" ]', REACH[coalition])


@pytest.mark.parametrize(
    ("text", "value"),
    [
        # A coalition minimises what the others maximise.
        ('<<alice,bob,carol>> Pmin=? [ F "goal" ]', 0), ('<<*>> Pmin=? [ F "goal" ]', 0),
        ('<<bob,carol>> Pmin=? [ F "goal" ]', 0), ('<<1,3>> Pmin=? [ F "goal" ]', 0),
        ('<<1,2>> Pmin=? [ F "goal" ]', "1/3"), ('<<carol>> Pmin=? [ F "goal" ]', "1/3"),
        ('<<bob>> Pmin=? [ F "goal" ]', "1/2"), ('<<alice>> Pmin=? [ F "goal" ]', "1/2"),
        ('<<>> Pmin=? [ F "goal" ]', 1),
        # Without a coalition all players are one.
        ('Pmax=? [ F "goal" ]', 1), ('Pmin=? [ F "goal" ]', 0), ('P>=0 [ F "goal" ]', True),
        ('P<1 [ F "goal" ]', False),
        # One step, and some steps.
        ('<<alice>> Pmax=? [ X "lost" ]', "1/2"), ('<<bob>> Pmax=? [ X "lost" ]', 0),
        ('<<>> Pmin=? [ X s=1 ]', 1), ('<<carol>> Pmin=? [ X s=1 ]', 1),
        ('<<1,2,3>> Pmax=? [ F<=1 "goal" ]', 0), ('<<1,2,3>> Pmax=? [ F<=2 "goal" ]', "1/2"),
        ('<<1,2,3>> Pmax=? [ F<=3 "goal" ]', "1/2"), ('<<1,2,3>> Pmax=? [ F<=4 "goal" ]', "3/4"),
        ('<<1,3>> Pmax=? [ F<=2 "goal" ]', "1/2"), ('<<1,2>> Pmax=? [ F<=2 "goal" ]', "1/3"),
        ('<<1,2>> Pmax=? [ F<2 "goal" ]', 0), ('<<2,3>> Pmin=? [ F<=7 "lost" ]', "1/2"),
        ('<<2>> Pmax=? [ F[2,3] "goal" ]', 0), ('<<1,2>> Pmax=? [ F=2 "goal" ]', "1/3"),
        ('<<1,2,3>> Pmax=? [ G<=2 !"lost" ]', 1), ('<<>> Pmax=? [ G<=1 !"lost" ]', "1/2"),
        # Until, and the operators that it defines.
        ('<<1,3>> Pmax=? [ !"lost" U "goal" ]', "1/2"), ('<<1,2>> Pmax=? [ s<2 U "goal" ]', "1/3"),
        ('<<1,2,3>> Pmax=? [ (s=0|s=2) U "goal" ]', "1/2"), ('<<bob>> Pmax=? [ G !"lost" ]', 0),
        ('<<alice>> Pmax=? [ G !"lost" ]', "1/3"), ('<<alice,carol>> Pmax=? [ G !"goal" ]', 1),
        ('<<alice>> Pmax=? [ "alice" W "lost" ]', "1/2"), ('<<1,2>> Pmin=? [ "goal" R !"lost" ]', "1/3"),
    ],
)  # fmt: skip
def test_paths_of_coalitions(text, value):
    check(game(VAULT), text, value)


# Total rewards by the members that maximise them: the steps, and the cost, before goal or lost.
STEPS = {
    "": "3/2", "1": 2, "2": "3/2", "3": 2, "1,2": 5, "1,3": 3, "2,3": 3, "1,2,3": "inf",
}  # fmt: skip
COST = {"": 0, "1": 6, "2": 0, "3": 0, "1,2": 7, "1,3": 7, "2,3": 0, "1,2,3": "inf"}
# The steps count only if the goal is reached.
REACHED = {"": 0, "1": 0, "2": 0, "3": "2/3", "1,2": 5, "1,3": 1, "2,3": 1, "1,2,3": "inf"}
OTHERS = {
    "": "1,2,3", "1": "2,3", "2": "1,3", "3": "1,2", "1,2": "3", "1,3": "2", "2,3": "1", "1,2,3": "",
}  # fmt: skip


@pytest.mark.parametrize("members", STEPS)
def test_total_rewards_of_every_coalition(members):
    for objective, coalition in (("max", members), ("min", OTHERS[members])):
        for path in ('Fc "goal"', "Fc s>2", "C", "F s>2"):
            check(
                game(VAULT), f'<<{coalition}>> R{{"steps"}}{objective}=? [ {path} ]', STEPS[members]
            )
        path = 'F0 "goal"'
        check(
            game(VAULT), f'<<{coalition}>> R{{"steps"}}{objective}=? [ {path} ]', REACHED[members]
        )
        # Only all players together can be sure of the goal.
        reached = "inf" if members else 5
        check(game(VAULT), f'<<{coalition}>> R{{"steps"}}{objective}=? [ F "goal" ]', reached)
        check(game(VAULT), f'<<{coalition}>> R{{"cost"}}{objective}=? [ C ]', COST[members])
        check(game(VAULT), f'<<{coalition}>> R{{"cost"}}{objective}=? [ Fc s>2 ]', COST[members])


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ('<<>> R{"steps"}max=? [ C<=0 ]', 0), ('<<>> R{"steps"}max=? [ C<=1 ]', 1),
        ('<<1>> R{"steps"}max=? [ C<=2 ]', 2), ('<<2,3>> R{"steps"}max=? [ C<=2 ]', "3/2"),
        ('<<1,2>> R{"steps"}max=? [ C<=3 ]', 3), ('<<1,3>> R{"steps"}max=? [ C<=3 ]', 2),
        ('<<3>> R{"steps"}max=? [ C<=3 ]', 2), ('<<2>> R{"steps"}max=? [ C<=3 ]', "3/2"),
        ('<<1>> R{"steps"}min=? [ C<=3 ]', 2), ('<<1,3>> R{"steps"}min=? [ C<=3 ]', "3/2"),
        ('<<>> R{"steps"}max=? [ I=0 ]', 1), ('<<>> R{"steps"}max=? [ I=1 ]', "1/2"),
        ('<<1>> R{"steps"}max=? [ I=1 ]', 1), ('<<1,3>> R{"steps"}min=? [ I=1 ]', "1/2"),
        ('<<1>> R{"cost"}max=? [ C<=1 ]', 2), ('<<1,2>> R{"cost"}max=? [ C<=2 ]', 7),
        ('<<1>> R{"cost"}max=? [ C<=2 ]', 3), ('<<2,3>> R{"cost"}max=? [ C<=9 ]', 0),
        ('<<1,2,3>> R{"steps"}max=? [ S ]', 1), ('<<1,2>> R{"steps"}max=? [ S ]', 0),
        ('<<>> R{"steps"}min=? [ S ]', 1), ('<<1,3>> R{"steps"}max=? [ LRA ]', 0),
        ('<<1,2>> R{"steps"}>=4.99 [ F0 "goal" ]', True), ('<<1,2>> R{"steps"}>5.01 [ F0 "goal" ]', False),
        ('<<1,2,3>> R{"steps"}>=1000000 [ F0 "goal" ]', True), ('<<3>> R{"steps"}>0.7 [ F0 "goal" ]', False),
        ('<<2>> R{"cost"}max=? [ F0 "lost" ]', 0), ('<<2>> R{"steps"}<=0.1 [ F0 "goal" ]', False),
        ('<<2>> R{"steps"}min=? [ F0 "lost" ]', 3), ("<<1>> R{\"cost\"}max=? [ F0 s=1 ]", 2),
        # Thresholds: some strategy of the coalition meets them.
        ('<<1,2>> R{"steps"}>=5 [ C ]', True), ('<<1,2>> R{"steps"}>5 [ C ]', False),
        ('<<3>> R{"steps"}<=5 [ C ]', True), ('<<3>> R{"steps"}<5 [ C ]', False),
        ('<<1,3>> R{"steps"}>=3 [ Fc "goal" ]', True), ('<<1,2,3>> R{"steps"}>=1000000 [ C ]', True),
        ('<<1>> R{"cost"}>=6 [ Fc s>2 ]', True), ('<<1>> R{"cost"}>6 [ Fc s>2 ]', False),
        ('<<1,2,3>> R{"steps"}<=5 [ F "goal" ]', True), ('<<1,2>> R{"steps"}<=1000 [ F "goal" ]', False),
        ('<<1,2>> P>=1/3 [ F "goal" ]', True), ('<<1,2>> P>1/3 [ F "goal" ]', False),
        ('<<bob,carol>> P>=1/2 [ F "goal" ]', True), ('<<bob,carol>> P>1/2 [ F "goal" ]', False),
        ('<<alice>> P<=1/2 [ F "goal" ]', True), ('<<alice>> P<1/2 [ F "goal" ]', False),
        ('<<>> P>0 [ F "goal" ]', False), ('<<>> P<=0 [ F "goal" ]', False), ('<<>> P<=1 [ F "goal" ]', True),
        ('<<1,2,3>> P>=3/4 [ F<=4 "goal" ]', True), ('<<1,2,3>> P>3/4 [ F<=4 "goal" ]', False),
        ('<<1,2,3>> P>=1 [ F "goal" ]', True), ('<<1>> P>=1/2 [ X "lost" ]', True),
    ],
)  # fmt: skip
def test_rewards_and_thresholds(text, value):
    check(game(VAULT), text, value)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("<<1,2,3>> Pmax=? [ G F s=0 ]", 1), ("<<1,3>> Pmax=? [ G F s=0 ]", 0),
        ("<<2,3>> Pmax=? [ G F s=0 ]", 0), ("<<>> Pmin=? [ G F s=0 ]", 1),
        ('<<1,3>> Pmax=? [ F G "goal" ]', "1/2"), ('<<2>> Pmin=? [ F G "goal" ]', "1/2"),
        ("<<1,3>> Pmax=? [ F (s=2 & F s=0) ]", "1/2"), ("<<2,3>> Pmax=? [ F (s=2 & F s=0) ]", "1/2"),
        ("<<3>> Pmax=? [ F (s=2 & F s=0) ]", 0), ("<<1,2>> Pmax=? [ F (s=2 & F s=0) ]", 0),
        ("<<*>> Pmax=? [ F (s=2 & F s=0) ]", 1), ("<<1>> Pmin=? [ F (s=2 & X s=0) ]", "1/2"),
        ('<<1,2>> Pmax=? [ (F "goal") & (G s!=2) ]', "1/3"), ('<<2>> Pmax=? [ (F "goal") & (G s!=2) ]', 0),
        ('<<1>> Pmax=? [ (F "goal") & (G s!=2) ]', 0), ('<<1,3>> Pmax=? [ (F "goal") | (F "lost") ]', 1),
        ('<<1,2>> Pmax=? [ X X "lost" ]', "2/3"), ('<<1>> Pmax=? [ X X ("lost" | "goal") ]', "1/2"),
        ('<<1,2>> P>=0.33 [ (F "goal") & (G s!=2) ]', True), ('<<1,2>> P>=0.34 [ (F "goal") & (G s!=2) ]', False),
        ("<<1,2,3>> P>=1 [ G F s=0 ]", True), ("<<1,2>> P>0 [ G F s=0 ]", False),
    ],
)  # fmt: skip
def test_formulas_of_linear_temporal_logic(text, value):
    check(game(VAULT), text, value)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ('filter(forall, <<1,3>> P>=0.5 [ F "goal" ] <=> (s=0|s=2|s=4))', True),
        ('filter(forall, (<<1,3>> P>=0.5 [ F "goal" ]) => s!=3)', True),
        ('filter(exists, <<1,3>> P>0.5 [ F "goal" ], s<2)', False),
        ('filter(count, <<2>> P>=1/3 [ F "goal" ])', 2), ('filter(sum, <<1,2>> Pmax=? [ F "goal" ])', 2),
        ('filter(max, <<carol>> Pmax=? [ F "goal" ], s<2)', "1/3"),
        ('filter(min, <<carol>> Pmax=? [ F "goal" ], s<3)', "1/3"),
        ('filter(avg, <<2,3>> Pmax=? [ F "goal" ], s<3)', "3/4"),
        ('filter(state, <<1,2>> R{"steps"}max=? [ C ], s=1)', 4),
        ('filter(forall, <<1,2>> R{"steps"}>=4 [ C ] <=> (s=0|s=1))', True),
        ('filter(forall, !"lost" => <<*>> P>=1 [ F "goal" ])', True),
        ('<<1>> Pmax=? [ F (<<2,3>> P>=3/4 [ F "goal" ]) ]', 1),
        ('<<1>> Pmin=? [ F (<<2,3>> P>=3/4 [ F "goal" ]) ]', "1/2"),
        ('<<1>> Pmin=? [ F <<2,3>> P>=3/4 [ F "goal" ] ]', "1/2"),
        ('<<1,2>> P>=1 [ F <<3>> P>=1 [ X "goal" ] ]', True),
        ('<<1,2>> Pmax=? [ F <<1,2>> P>=1 [ X "goal" ] ]', "1/3"),
        ('<<2>> Pmax=? [ X <<2>> P>=1/3 [ F "goal" ] ]', 0), ('<<1>> Pmax=? [ X <<2>> P>=1/3 [ F "goal" ] ]', 1),
        ('<<1,2>> R{"steps"}max=? [ Fc <<3>> P>=1 [ X "goal" ] ]', 4),
        ('!(<<3>> P>=1/2 [ F "goal" ]) & <<1,3>> P>=1/2 [ F "goal" ]', True),
        ('<<1,3>> P>=1/2 [ F "goal" ] & <<3>> P>=1/2 [ F "goal" ]', False),
    ],
)  # fmt: skip
def test_nested_coalitions_and_filters(text, value):
    check(game(VAULT), text, value)


# The chances of player 1 end with player 2, who may linger, or with player 3.
RELAY = """smg
player p1 first endplayer player p2 second endplayer player p3 third endplayer
global s : [0..3];
module first [] s=0 -> 0.3 : true + 0.7 : (s'=1); [] s=0 -> 0.5 : (s'=1) + 0.5 : (s'=2); [] s=3 -> true; endmodule
module second [] s=1 -> true; [] s=1 -> (s'=2); endmodule
module third [] s=2 -> (s'=1); [] s=2 -> (s'=3); endmodule
label "end" = s=3;
rewards "r" true : s; endrewards
"""


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ('<<1,3>> Pmax=? [ F "end" ]', "1/2"), ('<<1,2>> Pmax=? [ F "end" ]', 0),
        ('<<2,3>> Pmax=? [ F "end" ]', 1), ('<<2,3>> P>=1 [ F "end" ]', True),
        ('<<1,3>> R{"r"}max=? [ F "end" ]', "inf"), ('<<2,3>> R{"r"}min=? [ F "end" ]', 3),
        ('<<1,3>> R{"r"}max=? [ F0 "end" ]', 1), ('<<3>> R{"r"}max=? [ F0 "end" ]', 0),
        ('<<1,2>> R{"r"}max=? [ F0 "end" ]', 0), ('<<*>> R{"r"}max=? [ F0 "end" ]', "inf"),
        ('<<1>> R{"r"}max=? [ Fc "end" ]', 3), ('<<2,3>> R{"r"}min=? [ Fc "end" ]', 3),
        ('<<1,2,3>> R{"r"}min=? [ Fc "end" ]', "5/2"), ('<<3>> R{"r"}max=? [ Fc "end" ]', "inf"),
        ('filter(forall, <<1,3>> P>=0.5 [ F "end" ] <=> s!=1)', True),
        ('filter(forall, <<1,3>> R{"r"}<=2 [ F "end" ] <=> s>1)', True),
        ('filter(forall, <<3>> R{"r"}>=2 [ Fc "end" ] <=> s<3)', True),
        ('filter(forall, <<3>> R{"r"}>=2 [ F0 "end" ] <=> s=2)', True),
        ('filter(forall, <<1,3>> R{"r"}>=1 [ F0 "end" ] <=> (s=0|s=2))', True),
        ('<<1,3>> R{"r"}>1 [ F0 "end" ]', False), ('<<2>> R{"r"}<=1 [ F0 "end" ]', True),
        ('<<2>> R{"r"}<1 [ F0 "end" ]', False), ('<<*>> R{"r"}>=1000 [ F0 "end" ]', True),
        # Rewards until a co-safe formula is satisfied.
        ('<<1>> R{"r"}max=? [ (F s=1) & (F s=2) ]', "3/2"), ('<<2,3>> R{"r"}min=? [ (F s=1) & (F s=2) ]', "3/2"),
        ('<<2,3>> R{"r"}min=? [ X X s=2 ]', "inf"), ('<<1,2,3>> R{"r"}min=? [ X F s>0 ]', 0),
        ('<<1,3>> R{"r"}min=? [ s=0 | X true ]', 0), ('<<2>> R{"r"}max=? [ F X s=2 ]', "inf"),
        ('<<1>> R{"r"}max=? [ S ]', 1), ('<<1,2>> R{"r"}min=? [ S ]', 1), ('<<1,2>> R{"r"}max=? [ S ]', "3/2"),
        ('<<3>> LRAmax=? [ s=1 ]', "1/2"), ('<<2>> LRAmax=? [ s=1 ]', "1/2"), ('<<1>> Tmin=? [ F s>0 ]', 1),
        ('<<>> Tmin=? [ F s>0 ]', "10/7"), ('<<1>> Tmax=? [ F s>0 ]', "10/7"),
    ],
)  # fmt: skip
def test_a_game_of_modules(text, value):
    check(game(RELAY), text, value)


@pytest.mark.few(6, 6)
@pytest.mark.parametrize(
    ("text", "value"),
    [
        ('<<1,2>> P>=1/3 [ F G "goal" ]', True), ('<<1,2>> P>1/3 [ F G "goal" ]', False),
        ('<<3>> P>=1/3 [ G F "goal" ]', True), ('<<3>> P>1/3 [ G F "goal" ]', False),
        ('<<1,2>> P<1/3 [ G F "goal" ]', False), ('<<bob>> P<=1/2 [ G F "goal" ]', True),
        ('<<bob>> P<1/2 [ F G "goal" ]', False), ('<<1,2>> P>=1/3 [ X F ("goal" & X "goal") ]', True),
        ('<<1,2>> P>1/3 [ X F ("goal" & X "goal") ]', False), ('<<1,2>> P>=2/3 [ F G "lost" ]', True),
        ('<<1,2>> P>2/3 [ F G "lost" ]', False), ('<<1,2>> P>1/3 [ !(F G "lost") & F[0,9] "goal" ]', False),
    ],
)  # fmt: skip
def test_thresholds_of_formulas_at_the_value_are_decided(text, value):
    check(game(VAULT), text, value)


# Ann may rest or pass to Ben, who sends back or stays; discounted values solve x = 1 + d max(x, ...).
LOOP = """stpg
player ann [rest], [pass] endplayer
player ben [back], [stay] endplayer
module m
  s : [0..2];
  [rest] s=0 -> true;
  [pass] s=0 -> 1/2 : (s'=1) + 1/2 : (s'=2);
  [back] s=1 -> (s'=0);
  [stay] s=1 -> (s'=1);
  [] s=2 -> true;
endmodule
label "end" = s=2;
rewards "r" [rest] true : 1; [pass] true : 3; [stay] true : 2; endrewards
"""


@pytest.mark.parametrize(
    ("text", "value"),
    [
        # At 1/2: rest for ever 2; pass 3 + V(1)/4, where back is V(0)/2 and stay 4.
        ('<<ann>> R{"r"}max=? [ C{discount=1/2} ]', "24/7"), ('<<*>> R{"r"}max=? [ C{discount=0.5} ]', 4),
        ('<<ann>> R{"r"}min=? [ C{discount=1/2} ]', 2), ('<<ben>> R{"r"}max=? [ C{discount=1/2} ]', 2),
        ('<<ann>> R{"r"}>=24/7 [ C{discount=1/2} ]', True), ('<<ann>> R{"r"}>24/7 [ C{discount=1/2} ]', False),
        # A run without a target earns its discounted sum.
        ('<<ann>> R{"r"}max=? [ F{discount=1/2} "end" ]', "24/7"), ('<<ann>> R{"r"}max=? [ F{discount=0.5} s>0 ]', 3),
        ('<<ann>> R{"r"}min=? [ F{discount=1/2} s>0 ]', 2), ('<<ann>> R{"r"}max=? [ F s>0 ]', "inf"),
        ('<<ann>> R{"r"}max=? [ C{discount=1/2}<=3 ]', "27/8"), ('<<ann>> R{"r"}min=? [ C{discount=1/2}<=3 ]', "7/4"),
        ('<<*>> R{"r"}max=? [ C{discount=1/2}<3 ]', "7/2"), ('<<ann>> R{"r"}max=? [ C{discount=0} ]', 3),
        ('<<ann>> R{"r"}max=? [ C{discount=1}<=2 ]', 4), ('<<ann>> R{"r"}max=? [ C{discount=1} ]', "inf"),
        ('<<ann>> R{"r"}max=? [ C{discount=1/2}<=0 ]', 0), ('R{"r"}max=? [ C{discount=1/2} ] - 1', 3),
        # Two directions are those of the first and of the second player.
        ('R{"r"}maxmin=? [ C{discount=1/2} ]', "24/7"), ('R{"r"}maxmax=? [ C{discount=1/2} ]', 4),
        ('Pmaxmin=? [ F "end" ]', "1/2"), ('Pminmax=? [ F "end" ]', 0), ('Pmaxmin=? [ F s=1 & X s=1 ]', 0),
        ('<<ann>> R{"r"}max=? [ I=2 ]', 0), ('<<ann>> P>0.4 [ X s=1 {s=0} ]', True),
        ('<<1>> Pmax=? [ F "end" {s=1}{min} ]', 0),
    ],
)  # fmt: skip
def test_discounted_rewards_and_two_directions(text, value):
    check(game(LOOP), text, value)


def test_discounted_rewards_of_chains_and_strategies():
    reward = {"r": jl.models.Rewards(transition=[1, 3, 0])}
    chain = jl.make_sparse(
        None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1], initial=[1, 0], rewards=reward
    )
    # x = 2 + 0.9 x / 2.
    check(chain, "R=? [ C{discount=0.9} ]", "40/11")
    check(chain, "R>=40/11 [ C{discount=0.9} ]", True)
    check(chain, "R>40/11 [ C{discount=0.9} ]", False)
    found = jl.solve_property(game(LOOP), '<<ann>> R{"r"}max=? [ C{discount=1/2} ]')
    assert found.strategy.row.tolist() == [0, 2, 4]  # pass, back
    exact = jl.solve_property(game(LOOP), 'R{"r"}max=? [ C{discount=0.3} ]', exact=True)
    assert exact.exact == (Fraction(24, 7),)


def test_games_of_the_literature():
    """With one throw x > y in 15 of 36; with two, the first player keeps an x with (x-1)/6 > 55/216."""
    assert jl.solve_property(dice(10), '<<one>> P>=0.5 [ F "one" ]').holds == [True]
    check(dice(1), '<<one>> Pmax=? [ F "one" ]', "15/36")
    check(dice(1), '<<two>> Pmax=? [ F "two" ]', "21/36")
    check(dice(2), '<<one>> Pmax=? [ F "one" ]', "614/1296")
    check(dice(2), '<<1>> P>=614/1296 [ F "one" ]', True)
    check(dice(2), '<<1>> P>614/1296 [ F "one" ]', False)
    check(dice(2), '<<two>> Pmin=? [ F "one" ]', "614/1296")
    # One pursuer does not catch an intruder on a grid, whose cop number is two.
    world = avoid(4)
    assert world.num_states == 3636
    check(world, "<<p2>> Pmax=? [ F caught ]", 0)
    leaves = jl.solve_property(world, '<<p1>> Pmax=? [ F "exit" ]')
    kept = jl.solve_property(world, '<<p2>> Pmax=? [ G !"exit" ]')
    assert leaves.value[0] + kept.value[0] == pytest.approx(1, abs=1e-6)
    assert 0.85 < leaves.value[0] < 0.87
    # Without faults the six tasks take 12 time units; the person in the hall is saved almost surely.
    check(task_graph(0), '<<scheduler>> R{"time"}min=? [ F "complete" ]', 12)
    check(hall(2), '<<robot>> P>=1 [ F "saved" ]', True)


@pytest.mark.slow
def test_sizes_and_values_of_the_literature():
    """Those that PRISM-games reports for its models."""
    sizes = {
        hall: (10, 400_000, 1_040_000, 1_820_800),
        market: (10, 172_240, 230_767, 373_669),
        task_graph: (10, 467_638, 1_043_539, 1_267_156),
    }
    for make, (parameter, *counts) in sizes.items():
        mdp = make(parameter).mdp
        assert [mdp.num_states, mdp.num_rows, mdp.num_transitions] == counts, make
    check(market(10), '<<one>> Pmax=? [ F "rich" ]', "0.480298005")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('<<dave>> Pmax=? [ F "goal" ]', r"no player 'dave'.*alice \(1\), bob \(2\), carol \(3\)"),
        ('<<4>> Pmax=? [ F "goal" ]', "no player '4'"), ('<<1,>> Pmax=? [ F "goal" ]', "expected a player"),
        ('<<*,1>> Pmax=? [ F "goal" ]', "expected '>>'"), ('<<1,*>> Pmax=? [ F "goal" ]', "no other players"),
        ('<<1>> P=? [ F "goal" ]', "say what the coalition wants"),
        ('<<1>> <<2>> Pmax=? [ F "goal" ]', "after a coalition"), ("<<1 Pmax=? [ X true ]", "expected '>>'"),
        ('multi(R{"steps"}max=? [ Fc "goal" ], P>=0.5 [ F "goal" ])', r"only probabilities, R \[ F"),
        ('multi(R{"steps"}max=? [ F0 "goal" ], P>=0.5 [ F "goal" ])', r"only probabilities, R \[ F"),
        ('<<1>> (P>=1/2 [ F "goal" ] & R{"cost"}>=1 [ C ])', "several objectives of a game"),
        ('<<1>> R{"cost"}/{"steps"}max=? [ S ]', "ratio"), ("<<1:2>> max=? (P[X true]+P[X true])", "equilibria"),
        ('<<1>> filter(max, Pmax=? [ F "goal" ])', "after a coalition"), ('Pmaxmin=? [ F "goal" ]', "no intervals"),
        ('R{"cost"}max=? [ C{discount=1.5} ]', "range from 0 to 1"), ('R{"cost"}max=? [ C{discount=-1} ]', "range"),
        ('R{"cost"}max=? [ F{discount=0.5} X "goal" ]', "a state formula"),
        ('multi(R{"cost"}min=? [ C{discount=0.5} ], P>=0.5 [ F "goal" ])', r"only probabilities, R \[ F"),
        ('<<1>> R{"time"}max=? [ C ]', "time"), ('<<1>> P>=1/2 [ Fc "goal" ]', "Fc"),
    ],
)  # fmt: skip
def test_mistakes_in_coalitions_are_named(text, message):
    with pytest.raises(ValueError, match=message):
        jl.solve_property(game(VAULT), text)


@pytest.mark.parametrize("path", ["Fc", "F0"])
def test_certificates_are_not_written_for_other_variants_of_rewards(tmp_path, path):
    model, text = game(RELAY), f'<<1>> R{{"r"}}min=? [ {path} "end" ]'
    found = jl.total_reward(model.game([1]), "r", "end", objective="min", unreached="sum")
    with pytest.raises(ValueError, match="certificates are written for"):
        jl.io.write_certificate(tmp_path / "c.json", model, found, text)


def test_players_of_models_from_arrays():
    world = jl.from_dense(
        [[[0.5, 0.5], [1.0, 0]], [[0, 1.0], [0, 1.0]]], label={"b": [1]}, initial=[1, 0]
    )
    smg = jl.models.make_multiplayer_game(world, [1, 0], ["x", "y"])
    assert jl.solve_property(smg, '<<y>> Pmax=? [ F "b" ]').value.tolist() == [1]
    assert jl.solve_property(smg, '<<x>> Pmax=? [ F "b" ]').value.tolist() == [0]
    assert smg.game([2]).system.tolist() == [True, False]
    for owner, players, message in (
        ([0, 2], ["x", "y"], "owner is 2 in state 1"), ([0], ["x"], "shape"), ([0, 0], ["x", "x"], "distinct"),
        ([0.0, 1.0], ["x", "y"], "integers"), ([0, 0], "xy", "distinct"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            jl.models.make_multiplayer_game(world, owner, players)
    with pytest.raises(ValueError, match=r"several players.*model\.game"):
        jl.reachability_probability(smg, "b")
    with pytest.raises(ValueError, match="give a list"):
        smg.game("x")
