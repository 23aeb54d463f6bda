"""Programs with ``system`` blocks, and copies of modules with other functions, with values by hand."""

import pytest

from jaxltl.core.language.resolve import read_program
from jaxltl.core.logic.comparisons import program_definitions
from jaxltl.core.logic.properties import parse_property
from jaxltl.core.programs.build import build_model
from jaxltl.core.values.properties.solve_property import solve_property

# A and B move once by x; C counts two moves by x. Commands without an action are worth 10.
MODULES = {
    "A": "module A a : [0..1]; [x] a=0 -> (a'=1); [] a=1 -> true; endmodule",
    "B": "module B b : [0..1]; [x] b=0 -> (b'=1); [] b=1 -> true; endmodule",
    "C": "module C c : [0..2]; [x] c<2 -> (c'=c+1); [] c=2 -> true; endmodule",
}
REWARDS = 'rewards "r" [x] true : 1; [] true : 10; endrewards'
SYSTEMS = {  # the probability that a moves first, that both move at once, and the rewards of a step
    "A || B": (0, 1, 1, 1),
    "A ||| B": (1, 0, 1, 1),
    "A |[x]| B": (0, 1, 1, 1),
    "A |[y]| B": (1, 0, 1, 1),
    "A / {x} || B": (1, 0, 1, 10),
    "(A || B) / {x}": (0, 1, 10, 10),
    "A {x <- y} || B": (1, 0, 0, 1),
    "A {x<-y} |[y]| B": (0, 0, 1, 1),
    "A {x<-y} || B {x<-y}": (0, 1, 0, 0),
    "((A) ||| (B))": (1, 0, 1, 1),
}


def values(program, *texts):
    model, known = build_model(program), program_definitions(program)
    return [solve_property(model, parse_property(text, known)).value[0] for text in texts]


@pytest.mark.parametrize("system", SYSTEMS)
def test_compositions_of_two_modules(system):
    source = f"mdp {MODULES['A']} {MODULES['B']} {REWARDS} system {system} endsystem"
    actual = values(
        read_program(source),
        "Pmax=? [ F a=1 & b=0 ]",
        "Pmax=? [ F<=1 a=1 & b=1 ]",
        "Rmin=? [ C<=1 ]",
        "Rmax=? [ C<=1 ]",
    )
    assert actual == pytest.approx(SYSTEMS[system])


def test_one_module_synchronises_with_either_of_two():
    source = f"mdp {' '.join(MODULES.values())} {REWARDS} system (A ||| B) || C endsystem"
    texts = (
        "F a=1 & b=0 & c=1",
        "F a=1 & b=1 & c=2",
        "F<=1 b=1",
        "F a=1 & c=0",
        "F a=1 & b=1 & c=1",
    )
    actual = values(read_program(source), *(f"Pmax=? [ {text} ]" for text in texts))
    assert actual == [1, 1, 1, 0, 0]


@pytest.mark.parametrize(
    ("system", "message"),
    {
        "A": "module B must occur exactly once",
        "A || A": "module A must occur exactly once",
        "A || B || D": "no module D",
        "A || ": "found 'endsystem', expected the name of a module",
        "A |[x| B": "expected ']'",
        "A {x-y} || B": "as in a <- b",
        "A || B endsystem system A || B": "two system blocks",
    }.items(),
)
def test_mistakes_have_a_place(system, message):
    source = f"mdp {MODULES['A']} {MODULES['B']} system {system} endsystem"
    with pytest.raises(ValueError, match=f"line 1, column [0-9]+: .*{message}"):
        read_program(source)


def test_a_copy_of_a_module_with_another_function():
    program = read_program(
        "mdp module M a : [0..2]; [t] a<2 -> (a'=min(a+1,2)); [] a=2 -> true; endmodule "
        "module N = M [a=b, t=u, min=max] endmodule"
    )
    texts = ("F<=1 a=1", "F<=1 a=2", "F<=1 b=1", "F<=1 b=2")
    assert values(program, *(f"Pmax=? [ {text} ]" for text in texts)) == [1, 0, 0, 1]
