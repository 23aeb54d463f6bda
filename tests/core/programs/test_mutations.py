"""Mutated programs: each is a model, or an error of one line with a place, in little time."""

import random
import re
import warnings

import pytest

from jaxltl.core.language.resolve import read_program
from jaxltl.core.programs.build import build_model

PROGRAM = """mdp // two stations and a channel
const int N = 3; const double p = 1/4; const bool fair = true;
formula idle = s1=0 & s2=0; formula next = mod(s1 + 1, N);
label "done" = s1=2 | "both"; label "both" = s1=s2 & !idle;
global busy : bool init false;
module one
  s1 : [0..N-1] init 0; c : [-1..4];
  [go] s1=0 & c<max(2, N) -> p : (s1'=next) & (c'=c+1) + 1-p : (c'=min(c+1, 4));
  [] s1>0 & !busy -> [0.25,0.75] : (s1'=0) & (busy'=true) + [0.25,0.75] : true;
  [end] (s1=2 => fair) -> (c'= c>0 ? floor(c/2) : -1);
endmodule
module two = one [s1=s2, c=d, go=go, end=stop] endmodule
module timer t : [0..2]; [go] t<2 -> (t'=t+1); [stop] t=2 -> 0.5:(t'=0) + 0.5:true; endmodule
rewards "time" true : 1; [go] t>0 : pow(2, t)/3; endrewards
"""
MARKS = (
    *"()[]{};:,.?+-*/^%=<>!&|'\"# \n0123456789xstcd",
    *(" mod ", " init ", " endmodule ", " true ", "->", "=>", "..", "1e9", "9999999999", "smg "),
    *("module m ", "label ", " : bool;", "s1'", "max(", "endinit ", "player x ", "dtmc ", "1/0"),
)
PLACE = re.compile(r"'model', line \d+, column \d+: ")


def mutated(rng):
    """A program with some characters deleted, replaced, inserted, copied or exchanged."""
    text = PROGRAM
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        i, j = sorted(rng.sample(range(len(text)), 2))
        j = min(j, i + rng.choice((1, 1, 3, 20)))
        k = rng.randrange(len(text))
        kind = rng.randrange(6)
        if kind == 0:
            text = text[:i] + text[j:]
        elif kind == 1:
            text = text[:i] + rng.choice(MARKS) + text[i + 1 :]
        elif kind == 2:
            text = text[:i] + rng.choice(MARKS) + text[i:]
        elif kind == 3:
            text = text[:k] + text[i:j] + text[k:]
        elif kind == 4:
            words = re.findall(r"\w+|[^\w\s]", text)
            old, new = rng.choice(words), rng.choice(words)
            text = re.sub(
                r"(?<!\w)" + re.escape(old) + r"(?!\w)", lambda _, new=new: new, text, count=1
            )
        else:
            text = re.sub(r"\d+", lambda m: rng.choice((m[0], "7", "100000")), text)
    return text


def outcome(text):
    """What is wrong with a text, or None."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            build_model(read_program(text), max_states=1000)
    except ValueError as error:
        return str(error)
    return None


@pytest.mark.parametrize(
    "seeds", [range(150), pytest.param(range(150, 100_000), marks=pytest.mark.exhaustive)]
)
def test_mutated_programs_are_models_or_errors_of_one_line(seeds):
    found = {seed: outcome(mutated(random.Random(seed))) for seed in seeds}
    for seed, error in found.items():
        assert error is None or ("\n" not in error and PLACE.match(error)), (seed, error)
    assert sum(e is None for e in found.values()) > len(found) // 20
    assert sum(e is not None for e in found.values()) > len(found) // 4
