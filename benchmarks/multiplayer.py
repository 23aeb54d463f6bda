"""``python -m benchmarks.multiplayer [--large] [--json]``: games of several players from the literature.

Games of the PRISM benchmark suite, written anew from their descriptions: a dice game; a grid in which an
intruder looks for an item and for the exit while an observer searches for it, and a hall in which a robot
with faulty moves looks for a person in panic (Chatterjee, Katoen, Weininger and Winkler 2020, "Stochastic
games with lexicographic reachability-safety objectives"); two investors in a futures market that may bar
them (McIver and Morgan 2007); and the schedule of a task graph on two processors with faults (Bouyer,
Fahrenberg, Larsen and Markey 2011), with clocks in whole time units. The numbers of states and of choices
are those that the suite reports. Times are seconds of the first call.
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

# The robot moves ahead with probability 4/5, or slips; each turn on the spot damages it with 1/100.
HALL = """smg
const int N;
player robot [check], [go], [spin], [settle] endplayer
player person [drift], [flee] endplayer
global phase : [0..4];  // the robot checks itself, acts, has turned; the person drifts, flees
module robot
  x : [0..N-1]; y : [0..N-1]; look : [0..3]; damaged : bool;
  [check] phase=0 & damaged -> 1/2 : (phase'=1) + 1/2 : (phase'=3);
  [check] phase=0 & !damaged -> (phase'=1);
  GO
  SPIN
  [settle] phase=2 -> 1/100 : (damaged'=true) & (phase'=3) + 99/100 : (phase'=3);
endmodule
module person
  a : [0..N-1] init N-1; b : [0..N-1] init N-1;
  [drift] phase=3 -> DRIFT + 1/2 : (phase'=4);
  FLEE
  [flee] phase=4 -> (phase'=0);
endmodule
label "saved" = x=a & y=b;
label "damaged" = damaged;
"""

# An investor reserves a share for the next month and sells unless the market bars it, not twice in a row.
MARKET = """smg
const int V;
player one [reserve_one], [wait_one], [sell_one] endplayer
player two [reserve_two], [wait_two], [sell_two] endplayer
player market calendar, [open], [bar_one], [bar_two], [month], [closed] endplayer
module calendar
  next : [0..3];  // nobody yet, an investor, the market
  over : bool;
  done_one : [0..2]; done_two : [0..2];  // undecided, decided, waits for the month
  [] next=0 & done_one=0 & has_one!=2 & !over -> 99/100 : (next'=1) + 1/100 : (over'=true);
  [] next=0 & done_two=0 & has_two!=2 & !over -> 99/100 : (next'=2) + 1/100 : (over'=true);
  [] next=0 & (done_one>0 | has_one=2) & (done_two>0 | has_two=2) & !over -> (next'=3);
  [wait_one] next=1 & done_one=0 -> (done_one'=1) & (next'=0);
  [reserve_one] next=1 & done_one=0 -> (done_one'=1) & (next'=0);
  [sell_one] next=1 & done_one=0 -> (next'=0);
  [wait_two] next=2 & done_two=0 -> (done_two'=1) & (next'=0);
  [reserve_two] next=2 & done_two=0 -> (done_two'=1) & (next'=0);
  [sell_two] next=2 & done_two=0 -> (next'=0);
  [open] next=3 & (done_one=1 | has_one=2) & (done_two=1 | has_two=2) & has_one+has_two<4
    -> (done_one'=2) & (done_two'=2);
  [bar_one] next=3 & done_one=1 -> (done_one'=2) & (done_two'=2);
  [bar_two] next=3 & done_two=1 -> (done_one'=2) & (done_two'=2);
  [month] done_one=2 & done_two=2 -> (done_one'=0) & (done_two'=0) & (next'=0);
  [closed] next=3 & done_one=0 & done_two=0 | over -> true;
endmodule
module first
  has_one : [0..2];  // nothing, a reservation, sold
  [wait_one] has_one=0 | has_one=1 & barred_one -> (has_one'=0);
  [reserve_one] has_one=0 | has_one=1 & barred_one -> (has_one'=1);
  [sell_one] has_one=1 & !barred_one -> (has_one'=2);
  [closed] has_one=2 | over -> true;
endmodule
module second = first [has_one=has_two, barred_one=barred_two, wait_one=wait_two, reserve_one=reserve_two,
  sell_one=sell_two]
endmodule
module prices
  barred_one : bool init true; barred_two : bool init true;
  v : [0..V] init 5;
  [open] true -> (barred_one'=false) & (barred_two'=false);
  [bar_one] !barred_one -> (barred_one'=true) & (barred_two'=false);
  [bar_two] !barred_two -> (barred_two'=true) & (barred_one'=false);
  [month] true -> up/10 : (v'=min(v+1,cap,V)) + 1-up/10 : (v'=min(max(v-1,0),cap));
endmodule
module trend
  up : [0..10] init 5;
  [month] v<5 -> 2/3 : (up'=min(up+1,10)) + 1/3 : (up'=max(up-1,0));
  [month] v=5 -> 1/2 : (up'=min(up+1,10)) + 1/2 : (up'=max(up-1,0));
  [month] v>5 -> 1/3 : (up'=min(up+1,10)) + 2/3 : (up'=max(up-1,0));
endmodule
module ceiling
  cap : [0..V] init V;
  [month] true -> 1/2 : (cap'=max(cap-1,0)) + 1/2 : true;
endmodule
label "rich" = has_one=2 & v>5;
rewards "profit" [sell_one] true : v; endrewards
"""

# Each processor needs at most so long for a sum and for a product; a fault stops a task with 1/10.
TASKS = {1: ("sum", ()), 2: ("product", ()), 3: ("product", (1,)), 4: ("sum", (1, 2)), 5: ("product", (3,)),
         6: ("sum", (4, 5))}  # fmt: skip
LONGEST = {1: (2, 3), 2: (5, 7)}


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


def hall(size: int) -> MultiplayerGame:
    """The robot and the person on a square grid."""
    steps, moves = _moves("x", "y", size), _moves("a", "b", size)
    go = []
    for look in range(4):
        right, back, left = ((look + i) % 4 for i in (1, 2, 3))
        slips = [("4/5", f"{steps[look]} & "), ("1/20", "")]
        slips += [("1/20", f"{steps[side]} & (look'={side}) & ") for side in (left, right)]
        slips += [("1/40", f"{steps[back]} & "), ("1/40", f"{steps[back]} & (look'={back}) & ")]
        outcomes = " + ".join(f"{p} : {move}(phase'=3)" for p, move in slips)
        go.append(f"[go] phase=1 & look={look} -> {outcomes};")
    spin = [f"[spin] phase=1 -> (look'={look}) & (phase'=2);" for look in range(4)]
    text = HALL.replace("GO", "\n  ".join(go)).replace("SPIN", "\n  ".join(spin))
    text = text.replace("DRIFT", " + ".join(f"1/8 : {move} & (phase'=0)" for move in moves))
    text = text.replace("FLEE", "\n  ".join(f"[flee] phase=4 -> {m} & (phase'=0);" for m in moves))
    return _built(text, N=size)


def _moves(x: str, y: str, size: int) -> list[str]:
    """Assignments of a step to the north, east, south and west."""
    last = size - 1
    return [
        f"({y}'=min({y}+1,{last}))",
        f"({x}'=min({x}+1,{last}))",
        f"({y}'=max({y}-1,0))",
        f"({x}'=max({x}-1,0))",
    ]


def market(highest: int) -> MultiplayerGame:
    """Two investors and a market with shares of at most some value."""
    return _built(MARKET, V=highest)


def task_graph(faults: int) -> MultiplayerGame:
    """The scheduler of six tasks against two processors with at most some faults each."""
    commands, processors = [], []
    for number, (kind, after) in TASKS.items():
        ready = "".join(f" & task{i}=3" for i in after)
        for q in LONGEST:
            commands += [
                f"[{kind}{q}] turn=0 & task{number}=0{ready} -> (task{number}'={q});",
                f"[done{q}] task{number}={q} -> (task{number}'=3) & (y'=0) & (turn'=0);",
                f"[stop{q}] task{number}={q} -> (task{number}'=0) & (turn'=0);",
            ]
    for q, longest in LONGEST.items():
        lines = [f"p{q} : [0..3]; faults{q} : [0..{faults}]; x{q} : [0..{max(longest) + 1}];"]
        for job, (kind, limit) in enumerate(zip(("sum", "product"), longest, strict=True), 1):
            lines += [
                f"[{kind}{q}] p{q}=0 -> (p{q}'={job}) & (x{q}'=0);",
                f"[done{q}] turn=1 & p{q}={job} & x{q}<={limit} -> (p{q}'=0) & (x{q}'=0);",
                f"[] turn=1 & p{q}={job} & x{q}<={limit} & faults{q}<{faults} -> 1/10 : (p{q}'=3) & (x{q}'=0) "
                f"& (faults{q}'=faults{q}+1) + 9/10 : (faults{q}'=faults{q}+1);",
            ]
        lines += [
            f"[stop{q}] turn=1 & p{q}=3 -> (p{q}'=0);",
            f"[time] (p{q}=1 => x{q}<{longest[0]}) & (p{q}=2 => x{q}<{longest[1]}) & p{q}<3 -> "
            f"(x{q}'=min(x{q}+1,{max(longest) + 1}));",
        ]
        processors.append(f"module processor{q} " + "\n  ".join(lines) + " endmodule\n")
    started = ", ".join(f"[{kind}{q}]" for kind in ("sum", "product") for q in LONGEST)
    ended = ", ".join(f"[{name}{q}]" for name in ("done", "stop") for q in LONGEST)
    text = f"""smg
player scheduler scheduler, {started} endplayer
player environment processor1, processor2, {ended} endplayer
module scheduler
  turn : [0..1]; y : [0..1]; {" ".join(f"task{i} : [0..3];" for i in TASKS)}
  [] turn=0 -> (turn'=1);
  {" ".join(commands)}
  [time] turn=1 | task6=3 & p1<2 & p2<2 -> (y'=1);
endmodule
{"".join(processors)}
label "complete" = task6=3;
rewards "time" [time] true : 1; endrewards
"""
    return _built(text)


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
    (
        hall,
        5,
        25_000,
        ('<<robot>> Pmax=? [ F "saved" ]', '<<robot>> Pmax=? [ !"damaged" U "saved" ]'),
    ),
    (market, 10, 172_240, ('<<one>> Pmax=? [ F "rich" ]',)),
)
LARGE = (
    (hall, 10, 400_000, ('<<robot>> Pmax=? [ F "saved" ]',)),
    (market, 20, 568_790, ('<<one>> Pmax=? [ F "rich" ]',)),
    (task_graph, 10, 467_638, ('<<scheduler>> R{"time"}min=? [ F "complete" ]',)),
    (avoid, 15, 480_464, ('<<p1>> Pmax=? [ F "exit" ]', '<<p1>> Pmax=? [ F "item" ]')),
)


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
