"""Symmetries of programs: what is found, sorted states, and unchanged answers."""

import numpy as np
import pytest

from jaxltl.core.language.resolve import read_program
from jaxltl.core.programs import symmetry
from jaxltl.core.programs.packed_states import make_layout
from jaxltl.core.programs.partial import solve_program
from jaxltl.core.programs.symmetry import find_orbits

MODULES = """mdp global total : [0..6];
  module one x : [0..3]; f : bool;
    [] x=0 -> 0.4 : (x'=1) + 0.6 : (x'=2) & (f'=true);
    [a] x=1 -> (x'=3); [both] x=2 -> 0.5 : (x'=3) + 0.5 : (x'=0);
    [] x=3 & total<6 -> 0.9 : (total'=total+1) & (x'=0) & (f'=false) + 0.1 : true;
  endmodule
  module two = one [x=y, f=g, a=b] endmodule
  module three = one [x=z, f=h, a=c] endmodule
  module bus w : [0..1]; [a] w=0 -> (w'=1); [b] w=0 -> (w'=1); [c] w=0 -> (w'=1);
    [both] w=1 -> (w'=0); endmodule
  label "high" = f & g & h & total>=3; label "any" = max(x, y, z) = 3;"""

COUNTERS = """dtmc const int N = 4; module m turn : [0..4] init 4; left : [0..N] init N; s : [0..1];
  a : [0..N]; b : [0..N]; c : [0..N]; d : [0..N];
  [] s=0 & left>0 -> 0.4 : (turn'=0) & (s'=1) & (left'=left-1)
    + 0.2 : (turn'=1) & (s'=1) & (left'=left-1) + 0.2 : (turn'=2) & (s'=1) & (left'=left-1)
    + 0.2 : (turn'=3) & (s'=1) & (left'=left-1);
  [] s=1 & turn=0 & a<N -> (a'=a+1) & (s'=0) & (turn'=4);
  [] s=1 & turn=1 & b<N -> 0.7 : (b'=b+1) & (s'=0) & (turn'=4) + 0.3 : (s'=0);
  [] s=1 & turn=2 & c<N -> 0.7 : (c'=c+1) & (s'=0) & (turn'=4) + 0.3 : (s'=0);
  [] s=1 & turn=3 & d<N -> 0.7 : (d'=d+1) & (s'=0) & (turn'=4) + 0.3 : (s'=0);
  [] left=0 & s=0 -> true; endmodule"""


def slots(text, *labels):
    program = read_program(text)
    return [o.slots for o in find_orbits(program, [program.labels[n] for n in labels])]


def test_modules_and_variables_that_may_be_exchanged_are_found():
    assert slots(MODULES, "high", "any") == [(("x", "f"), ("y", "g"), ("z", "h"))]
    (orbit,) = find_orbits(read_program(COUNTERS), [])
    assert orbit.slots == (("b",), ("c",), ("d",)) and orbit.selectors == {"turn": (1, 2, 3)}


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("[c] w=0", "[c] w<1"),
        ('label "high" = f & g & h', 'label "high" = f & (g | h)'),
        ("max(x, y, z)", "max(x + 1, y, z)"),
        ("endmodule\n  label", "endmodule module late q : bool; [c] true -> true; endmodule label"),
    ],
)
def test_a_difference_of_a_third_module_leaves_two_or_none(old, new):
    changed = MODULES.replace(old, new)
    assert changed != MODULES
    assert [len(orbit) for orbit in slots(changed, "high", "any")] == [2]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("[] left=0 & s=0 -> true", "[] left=0 & s=0 -> (turn'=min(turn, 3))"),
        ("[] left=0 & s=0 -> true", "[] left=0 & s=0 & turn<3 -> true"),
        ("0.2 : (turn'=1)", "0.1 : (turn'=1) & (a'=0) + 0.1 : (turn'=1)"),
        ("& c<N", "& c<N-1"),
    ],
)
def test_values_that_name_slots_are_only_compared_and_assigned(old, new):
    assert slots(COUNTERS.replace(old, new)) != slots(COUNTERS)
    assert not any(len(o) == 3 for o in slots(COUNTERS.replace(old, new)))


@pytest.mark.parametrize("text", [MODULES, COUNTERS])
def test_sorted_states_do_not_depend_on_the_order_of_slots(text):
    program, rng = read_program(text), np.random.default_rng(0)
    layout, (orbit,) = make_layout(program.variables), find_orbits(program, [])
    columns = {v.name: rng.integers(v.low, v.high + 1, 500) for v in program.variables}
    exchanged = dict(columns)
    first, second = orbit.slots[0], orbit.slots[2]
    for one, other in zip(first, second, strict=True):
        exchanged[one], exchanged[other] = columns[other], columns[one]
    for name, values in orbit.selectors.items():
        swap = {values[0]: values[2], values[2]: values[0]}
        exchanged[name] = np.array([swap.get(x, x) for x in columns[name].tolist()])
    words, others = layout.packed(columns, 500), layout.packed(exchanged, 500)
    before = [w.copy() for w in words]
    orbit.sort(layout, words)
    orbit.sort(layout, others)
    assert all(np.array_equal(a, b) for a, b in zip(words, others, strict=True))
    assert any((a != b).any() for a, b in zip(words, before, strict=True))
    for name in program.types.keys() - {n for slot in orbit.slots for n in slot} - {"turn"}:
        assert np.array_equal(layout.values(words, name), columns[name])


@pytest.mark.parametrize(
    ("text", "prop"),
    [
        (MODULES, 'Pmax=? [ F "high" ]'),
        (MODULES, 'Pmin=? [ F<=9 "any" & total=1 ]'),
        (MODULES, "Pmax=? [ !f U x=3 & w=1 ]"),
        (COUNTERS, "P=? [ F a>1 ]"),
        (COUNTERS, "P=? [ F max(b, c, d) = 3 ]"),
        (COUNTERS, "P=? [ G b<2 ]"),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_answers_do_not_change(monkeypatch, text, prop):
    program, whole = read_program(text), solve_program(read_program(text), prop)
    states = {}
    for work in (symmetry._WORK, 0):
        monkeypatch.setattr(symmetry, "_WORK", work)
        found = solve_program(
            program,
            prop,
            method="partial",
            report=lambda n, *_, work=work: states.update({work: n}),
        )
        assert found.value[0] == pytest.approx(whole.value[0], abs=2e-6)
    reduced, full = states.values()
    assert reduced < full
