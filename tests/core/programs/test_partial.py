"""Partial exploration of programs, against the answers of their whole models."""

import warnings

import numpy as np
import pytest

from jaxltl.core.language.resolve import read_program
from jaxltl.core.programs import partial
from jaxltl.core.programs.partial import solve_program
from jaxltl.core.types import Status

PATHS = (
    "F x=9",
    "x<8 U x=9",
    '!"odd" U ("odd" & y)',
    "G x<9",
    "F<=12 x=9",
    "G<=9 !(x=9 & y)",
    "x!=3 W x=9",
    'y R "odd"',
)

WALK = """dtmc const int N; module m x : [0..N] init 1;
  [] x>0 & x<N -> 0.25 : (x'=x+1) + 0.75 : (x'=x-1); [] x=0 | x=N -> true; endmodule"""


def random_program(seed, kind):
    """Two modules with loops, deadlocks, end components, and joint commands."""
    rng = np.random.default_rng(seed)
    commands = []
    for x in range(10):
        for _ in range(1 if kind == "dtmc" else rng.integers(0, 4)):
            p = rng.integers(1, 10) / 10
            one, two = rng.integers(0, 10, 2)
            action = rng.choice(["", "go"])
            commands.append(
                f"[{action}] x={x} -> {p} : (x'={one}) + {1 - p} : (x'={two}) & (y'=!y);"
            )
    return read_program(
        f"{kind} module m x : [0..9]; y : bool; {' '.join(commands)} endmodule "
        "module n z : [0..4]; [go] true -> 0.5 : (z'=mod(z+1, 5)) + 0.5 : true; "
        "[] z=3 -> 0.9 : (z'=0) + 0.1 : true; endmodule "
        'init x=0 & z<2 & !y endinit label "odd" = mod(x + z, 2) = 1;'
    )


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Models are solved from three states on."""
    monkeypatch.setattr(partial, "_FIRST", 3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@pytest.mark.few(2)
@pytest.mark.parametrize("kind", ["dtmc", "mdp"])
@pytest.mark.parametrize("seed", range(3))
def test_bounds_enclose_the_answer_of_the_whole_model_and_only_narrow(seed, kind):
    program = random_program(seed, kind)
    for path in PATHS:
        for objective in ("max", "min"):
            text = f"P{objective}=? [ {path} ]"
            whole = solve_program(program, text)
            reports = []
            found = solve_program(
                program,
                text,
                method="partial",
                tolerance=1e-6,
                report=lambda *x, reports=reports: reports.append(x),
            )
            lower, upper = np.zeros(found.states.size), np.ones(found.states.size)
            for _, _, answer in reports:
                assert (answer.lower >= lower).all() and (answer.upper <= upper).all()
                lower, upper = answer.lower, answer.upper
                assert (lower <= whole.upper).all() and (whole.lower <= upper).all(), text
            assert found.status == Status.CONVERGED
            assert np.allclose(found.value, whole.value, atol=2e-6)
            assert reports[-1][0] <= 100 and found.lower.tolist() == lower.tolist()


@pytest.mark.parametrize("objective", ["max", "min"])
def test_an_exploration_that_ends_early_has_valid_bounds_and_says_so(objective):
    program, text = random_program(3, "mdp"), f"P{objective}=? [ F x=9 ]"
    whole = solve_program(program, text)
    for most in range(3, 40, 6):
        found = solve_program(program, text, method="partial", max_states=most)
        assert (found.lower <= whole.value + 1e-6).all()
        assert (whole.value <= found.upper + 1e-6).all()
        narrow = (found.upper - found.lower <= 1e-6).all()
        assert found.status == (Status.CONVERGED if narrow else Status.MAX_STEPS)
        again = solve_program(program, text, method="partial", max_states=most)
        assert again.lower.tolist() == found.lower.tolist() and again.method == found.method


def test_few_states_of_a_large_program_suffice():
    program = read_program(WALK, {"N": 2**31 - 2})
    found = solve_program(program, "P=? [ F x=20 ]", method="partial")
    assert found.lower[0] <= 2 / (3**20 - 1) <= found.upper[0] <= found.lower[0] + 1e-6
    assert int(found.method.split()[3]) < 30
    assert solve_program(program, "P<0.01 [ F x=20 ]", method="partial").holds == [True]
    assert solve_program(program, "P>=0.99 [ F<=1000 x=0 ]", method="partial").holds == [True]
    assert solve_program(program, "P=? [ G x<20 ]", method="partial").lower[0] > 0.99999


def test_end_components_do_not_keep_the_upper_bound_high():
    """States 1 and 2 form an end component, from which the target has probability one half."""
    program = read_program("""mdp module m x : [0..4] init 0; [] x=0 -> (x'=1); [] x=1 -> (x'=2);
      [] x=2 -> (x'=1); [] x=2 -> 0.5 : (x'=3) + 0.5 : (x'=4); [] x>2 -> true; endmodule""")
    found = solve_program(program, "Pmax=? [ F x=3 ]", method="partial")
    assert found.lower[0] == pytest.approx(0.5) and found.upper[0] == pytest.approx(0.5)
    assert solve_program(program, "Pmin=? [ F x=3 ]", method="partial").upper[0] == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('P=? [ F "deadlock" ]', "known of expanded states"),
        ("P=? [ G F x=1 ]", "partial exploration is for"),
        ("R=? [ F x=1 ]", "partial exploration is for"),
        ("P=? [ F[2,3] x=1 ]", "partial exploration is for"),
        ("P=? [ F P>0.5 [ F x=1 ] ]", "partial exploration is for"),
        ('P=? [ F "missing" ]', "missing"),
    ],
)
def test_other_properties_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        solve_program(read_program(WALK, {"N": 5}), text, method="partial")


def test_other_programs_and_methods_are_refused():
    intervals = "dtmc module m x : [0..1]; [] x=0 -> [0.1, 0.3] : (x'=1) + [0.7, 0.9] : true; [] x=1 -> true; endmodule"
    with pytest.raises(ValueError, match="not explored in part"):
        solve_program(read_program(intervals), "Pmax=? [ F x=1 ]", method="partial")
    with pytest.raises(ValueError, match="choose one of build, partial"):
        solve_program(read_program(WALK, {"N": 5}), "P=? [ F x=5 ]", method="guess")
    mdp = WALK.replace("dtmc", "mdp")
    with pytest.raises(ValueError, match="Pmax"):
        solve_program(read_program(mdp, {"N": 5}), "P=? [ F x=5 ]", method="partial")
