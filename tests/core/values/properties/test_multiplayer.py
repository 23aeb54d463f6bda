"""Properties of stochastic multi-player games, with values worked out by hand."""

from __future__ import annotations

from fractions import Fraction
from functools import cache

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.language.resolve import read_program
from jaxltl.core.programs.build import build_model
from jaxltl.core.types import Status

# Bob may try a door (1/3) or call Carol with Alice; Carol opens or sends back to Alice.
VAULT = """smg
player alice [quiet], [loud], [lost] endplayer
player bob guard, [goal] endplayer
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
"""
VAULT = VAULT.replace("player bob guard, [goal]", "player bob guard, [goal], [try], [call]")


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
