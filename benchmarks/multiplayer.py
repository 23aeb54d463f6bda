"""``python -m benchmarks.multiplayer [--large] [--json]``: games of several players from the literature.

Two games of the PRISM benchmark suite, written anew from their descriptions: a dice game, and a grid in
which an intruder looks for an item and for the exit while an observer searches for it (Chatterjee, Katoen,
Weininger and Winkler 2020, "Stochastic games with lexicographic reachability-safety objectives"). The
numbers of states and of choices are those that the suite reports. Times are seconds of the first call.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from typing import Any

from jaxltl.core.language.resolve import read_program
from jaxltl.core.models.multiplayer import MultiplayerGame
from jaxltl.core.programs.build import build_model
from jaxltl.core.types import Status
from jaxltl.core.values.properties.solve_property import solve_property

# The first player throws until satisfied, at most N times; the second one has as many throws.
DICE = """smg
const int N;
player one [throw_one], [again_one], [stop_one], [over] endplayer
player two [throw_two], [again_two], [stop_two] endplayer
formula over = first=2 & second=3;
module first_player
  first : [0..2];  // to throw, to decide, stopped
  throws : [0..N];
  shown : [0..6];
  [throw_one] first=0 -> SIX(shown,first,1);
  [again_one] first=1 & throws<N-1 -> (throws'=throws+1) & (first'=0);
  [stop_one] first=1 -> (throws'=throws+1) & (first'=2);
  [over] first=2 -> true;
endmodule
module second_player
  second : [0..3];  // waits, to throw, to decide, stopped
  answer : [0..6];
  used : [0..N];
  [stop_one] second=0 -> (second'=1);
  [throw_two] second=1 -> SIX(answer,second,2);
  [again_two] second=2 & used<throws-1 -> (used'=used+1) & (second'=1);
  [stop_two] second=2 -> (second'=3);
  [over] second=3 -> true;
endmodule
label "one" = over & shown>answer;
label "two" = over & shown<=answer;
"""

# Positions of the intruder and of the observer; the observer moves at random unless it sees the intruder.
AVOID = """smg
const int X; const int Y;
player p1 [look], [go], [seek], [wait] endplayer
player p2 [watch], [follow], [roam] endplayer
global mover : [1..2] init 1;
global caught : bool; global item : bool;
formula together = x=a & y=b;
formula exit = x=X-1 & y=Y-1;
formula seen = (x-a)*(x-a) + (y-b)*(y-b) <= 8;
module intruder
  x : [0..X]; y : [0..Y]; ready : bool;
  [look] mover=1 & !ready & together & !exit -> (caught'=true);
  [look] mover=1 & !ready & !(together & !exit) -> (ready'=true);
  [go] mover=1 & ready & !caught & x<X-1 -> (x'=x+1) & (mover'=2) & (ready'=false);
  [go] mover=1 & ready & !caught & x>0 -> (x'=x-1) & (mover'=2) & (ready'=false);
  [go] mover=1 & ready & !caught & y<Y -> (y'=y+1) & (mover'=2) & (ready'=false);
  [go] mover=1 & ready & !caught & y>0 -> (y'=y-1) & (mover'=2) & (ready'=false);
  [seek] mover=1 & ready & !caught & !exit ->
    9/10 : (mover'=2) & (ready'=false) + 1/10 : (mover'=2) & (ready'=false) & (item'=true);
  [wait] mover=1 & ready & !caught -> (mover'=2) & (ready'=false);
endmodule
module observer
  a : [0..X-1] init X-1; b : [0..Y-1] init Y-1; alert : bool; turned : bool;
  [watch] mover=2 & !turned -> (alert'=seen) & (turned'=true);
  [follow] mover=2 & turned & alert & a<X-1 -> (a'=a+1) & (mover'=1) & (turned'=false);
  [follow] mover=2 & turned & alert & a>0 -> (a'=a-1) & (mover'=1) & (turned'=false);
  [follow] mover=2 & turned & alert & b<Y-1 -> (b'=b+1) & (mover'=1) & (turned'=false);
  [follow] mover=2 & turned & alert & b>0 -> (b'=b-1) & (mover'=1) & (turned'=false);
  [follow] mover=2 & turned & alert -> (mover'=1) & (turned'=false);
  [roam] mover=2 & turned & !alert -> 1/4 : (a'=min(a+1,X-1)) & (mover'=1) & (turned'=false)
    + 1/4 : (a'=max(a-1,0)) & (mover'=1) & (turned'=false)
    + 1/4 : (b'=min(b+1,Y-1)) & (mover'=1) & (turned'=false)
    + 1/4 : (b'=max(b-1,0)) & (mover'=1) & (turned'=false);
endmodule
label "exit" = exit;
label "item" = item;
label "free" = exit & item;
"""


def dice(throws: int) -> MultiplayerGame:
    """The dice game with at most some throws of each player."""
    text = DICE
    for name, place, after in (("shown", "first", 1), ("answer", "second", 2)):
        six = " + ".join(f"1/6 : ({name}'={i}) & ({place}'={after})" for i in range(1, 7))
        text = text.replace(f"SIX({name},{place},{after})", six)
    return _built(text, N=throws)


def avoid(size: int) -> MultiplayerGame:
    """The intruder and the observer on a square grid."""
    return _built(AVOID, X=size, Y=size)


def _built(text: str, **constants: int) -> MultiplayerGame:
    model = build_model(read_program(text, constants))
    assert isinstance(model, MultiplayerGame)
    return model


# Model, parameter, states of the suite, and properties.
CASES = (
    (dice, 10, 5_755, ('<<one>> Pmax=? [ F "one" ]', '<<2>> Pmax=? [ F "two" ]')),
    (dice, 25, 34_645, ('<<one>> Pmax=? [ F "one" ]',)),
    (dice, 50, 136_795, ('<<one>> Pmax=? [ F "one" ]',)),
    (avoid, 10, 106_524, ('<<p1>> Pmax=? [ F "exit" ]', '<<p1>> Pmax=? [ F "item" ]')),
)
LARGE = ((avoid, 15, 480_464, ('<<p1>> Pmax=? [ F "exit" ]', '<<p1>> Pmax=? [ F "item" ]')),)


def run(large: bool = False) -> Iterator[dict[str, Any]]:
    """Yields a row for each property: sizes, value and seconds."""
    for make, parameter, states, properties in CASES + (LARGE if large else ()):
        begin = time.perf_counter()
        model = make(parameter)
        built = time.perf_counter() - begin
        for text in properties:
            begin = time.perf_counter()
            answer = solve_property(model, text)
            yield {
                "model": f"{make.__name__}({parameter})",
                "property": text,
                "states": model.num_states,
                "published_states": states,
                "value": float(answer.value[0]),
                "width": float(answer.upper[0] - answer.lower[0]),
                "status": Status(answer.status).name,
                "build_seconds": built,
                "seconds": time.perf_counter() - begin,
            }


def main() -> None:
    """Prints a line for each property."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.multiplayer", description=__doc__)
    parser.add_argument("--large", action="store_true", help="also half a million states")
    parser.add_argument("--json", action="store_true", help="rows as JSON")
    chosen = parser.parse_args()
    for row in run(chosen.large):
        if chosen.json:
            print(json.dumps(row))
        else:
            print(
                f"{row['model']:<12} {row['property']:<28} {row['states']:>8} of {row['published_states']:>8} "
                f"{row['value']:.7f} {row['status']:<10} {row['build_seconds']:7.2f} s {row['seconds']:7.2f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
