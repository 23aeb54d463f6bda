"""Programs with parameters, against the models of programs whose constants are given."""

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.programs import explore

pytestmark = pytest.mark.filterwarnings("ignore:.*deadlocks", "ignore:.*several commands")

MDP = """mdp
const double p; const double q; const double r = 1 - p; const int N = 2; const double unused;
formula half = (1 + q) / 2;
module a x : [0..N];
  [go] x<N -> p : (x'=x+1) + r : true;
  [] x=1 -> pow(q, 2) / (p + q) : (x'=0) + 1 - q*q / (p + q) : (x'=2);
  [go] x=N -> true;
endmodule
module b y : [0..2]; [go] y<2 -> 0.1 * q : (y'=y+1) + 1 - q/10 : (y'=0);
  [] y=1 -> half : (y'=2) + 1 - half : true; endmodule
label "end" = x=N & y=2;
rewards "cost" x=1 : 3*p + y; [go] x<N : -(-q) + r; [go] true : 0.25; endrewards"""

CHAIN = """dtmc const double p; module m x : [0..3];
  [] x=0 -> p : (x'=1) + 1 - p : (x'=2); [] x=0 -> p : (x'=3) + 1-p : true; [] x=3 -> true;
endmodule rewards x=0 : 1/p; endrewards"""


@pytest.fixture(autouse=True)
def in_one_order(monkeypatch):
    """Both models are built by levels, and have their states in the same order."""
    monkeypatch.setattr(explore, "LEVEL", 0)


def written(tmp_path, text):
    path = tmp_path / "model.prism"
    path.write_text(text)
    return path


def assert_same_at(path, model, values):
    """At a point, the model is that of the program whose constants have these values."""
    found = model.at(values)
    given = jl.read_model(
        path, constants={**values, **({} if "q" not in values else {"unused": 0})}
    )
    for name in ("row_start", "entry_start", "successor", "action", "initial", "label"):
        assert np.array_equal(getattr(found, name), getattr(given, name)), name
    assert np.allclose(found.probability, given.probability, atol=1e-15)
    assert {k: v.tolist() for k, v in found.valuation.items()} == {
        k: v.tolist() for k, v in given.valuation.items()
    }
    for name, reward in given.rewards.items():
        for part in ("state", "choice"):
            mine, theirs = getattr(found.rewards[name], part), getattr(reward, part)
            if theirs is None or mine is None:
                assert theirs is None or not np.any(theirs)
                assert mine is None or not np.any(mine)
            else:
                assert np.allclose(mine, theirs, atol=1e-15)


def test_a_program_at_points_is_the_program_with_these_constants(tmp_path):
    path = written(tmp_path, MDP)
    model = jl.io.read_parametric(path)
    assert model.parameters == ("p", "q")
    for p, q in ((0.5, 0.25), (0.1, 0.9), (0.75, 0.3)):
        assert_same_at(path, model, {"p": p, "q": q})
    over = model.over(0.05, 0.95)
    probability, rewards = over.numbers(np.array([0.3, 0.6]))
    assert np.allclose(probability, over.at({"p": 0.3, "q": 0.6}).probability, atol=1e-6)
    assert rewards["cost"].shape == (over.model.num_rows,)


def test_overlapping_commands_of_a_chain_and_deadlocks(tmp_path):
    path = written(tmp_path, CHAIN)
    model = jl.io.read_parametric(path)
    for p in (0.25, 0.7):
        assert_same_at(path, model, {"p": p})


def test_numbers_are_exact(tmp_path):
    path = written(tmp_path, MDP)
    functions = jl.io.read_parametric(path).functions
    shares = {str(f.at((1, 1))) for f in functions if len(f.numerator) == 1}
    assert "1/10" in shares  # 0.1 q at q = 1, not the double


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("N = 2", "N", "constant N has no value"),
        ("x<N -> p", "x<N & p>0.5 -> p", "constant p has no value"),
        ("pow(q, 2)", "min(q, 2)", "no rational function, because of min"),
        ("pow(q, 2)", "pow(q, p)", "no power with an integer"),
        ("const int N = 2", "const int N = floor(p)", "constant p has no value"),
        ("half : (y'=2) + 1 - half : true", "[0.5, half] : (y'=2) + [0, 1] : true", "intervals"),
    ],
)
def test_what_is_refused(tmp_path, old, new, message):
    assert old in MDP
    with pytest.raises(ValueError, match=message):
        jl.io.read_parametric(written(tmp_path, MDP.replace(old, new)))


def test_programs_without_parameters_and_constants_of_files_are_refused(tmp_path):
    path = written(tmp_path, MDP)
    with pytest.raises(ValueError, match="no parameter"):
        jl.io.read_parametric(path, constants="p=0.5,q=0.5")
    assert jl.io.read_parametric(path, constants="p=0.5").parameters == ("q",)
    with pytest.raises(ValueError, match="is no program"):
        jl.io.read_parametric(tmp_path / "coin.drn", constants="N=3")
    with pytest.raises(ValueError, match="more than 3 states"):
        jl.io.read_parametric(path, max_states=3)
