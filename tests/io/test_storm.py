"""Models that go to Storm and come back; values that both find."""

import sys

import numpy as np
import pytest

from jaxltl.core.models.construct.padded import to_padded
from jaxltl.core.models.game import Game, make_game
from jaxltl.core.models.sparse import Rewards, choice_reward, make_sparse
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.io.storm import from_stormpy, to_stormpy
from tests.storm_oracle import storm_values

PRISM = """mdp
const int N = 4;
module walk
  x : [0..N] init 1;
  done : bool init false;
  [left] x>0 & x<N -> 0.3 : (x'=x-1) + 0.7 : (x'=x+1);
  [right] x>0 & x<N -> 1/3 : (x'=x+1) + 2/3 : true;
  [] x=0 | x=N -> (done'=true);
endmodule
label "top" = x=N;
rewards "steps" true : 1; [left] true : 2.5; endrewards
rewards "plain" x=2 : 3; endrewards
"""


def random_model(rng, chain=False, games=False):
    count = 6
    choices = np.ones(count, int) if chain else rng.integers(1, 4, count)
    rows = int(choices.sum())
    width = rng.integers(1, 4, rows)
    successor = np.concatenate([rng.choice(count, w, replace=False) for w in width])
    probability = np.concatenate([rng.dirichlet(np.ones(w)) for w in width])
    model = make_sparse(
        np.append(0, choices.cumsum()), np.append(0, width.cumsum()), successor, probability,
        initial=np.eye(count)[0], label=rng.random((count, 2)) < 0.4, propositions=["a", "b c"],
        action=None if chain else rng.integers(2, size=rows), action_names=() if chain else "xy",
        valuation={"v": rng.integers(-5, 5, count), "on": rng.random(count) < 0.5},
        rewards={
            "all": Rewards(rng.random(count), rng.random(rows), rng.random(successor.size)),
            "some": Rewards(state=rng.random(count)),
        },
    )  # fmt: skip
    return make_game(model, rng.random(count) < 0.5) if games else model


def assert_same(one, other):
    if isinstance(one, Game):
        assert np.asarray(one.system).tolist() == np.asarray(other.system).tolist()
        one, other = one.mdp, other.mdp
    for name in ("row_start", "entry_start", "successor", "probability", "initial"):
        assert getattr(one, name).tolist() == getattr(other, name).tolist(), name
    assert sorted(one.propositions) == sorted(other.propositions)
    for name in one.propositions:
        assert one.states_with_label(name).tolist() == other.states_with_label(name).tolist()
    if one.action is not None:
        names = [[x.action_names[a] for a in x.action] for x in (one, other)]
        assert names[0] == names[1]
    for name, value in one.valuation.items():
        assert value.tolist() == other.valuation[name].tolist()
    assert one.rewards.keys() == other.rewards.keys()
    for name, reward in one.rewards.items():
        for part in ("state", "choice", "transition"):
            found, expected = (getattr(x, part) for x in (other.rewards[name], reward))
            assert (found is None) == (expected is None), (name, part)
            assert expected is None or found.tolist() == expected.tolist()


@pytest.mark.parametrize("kind", ["chain", "process", "game"])
def test_there_and_back(kind):
    pytest.importorskip("stormpy", minversion="2")
    rng = np.random.default_rng(0)
    for _ in range(5):
        model = random_model(rng, kind == "chain", kind == "game")
        assert_same(model, from_stormpy(to_stormpy(model)))


def test_values_agree():
    pytest.importorskip("stormpy", minversion="2")
    rng = np.random.default_rng(1)
    for _ in range(5):
        model = random_model(rng)
        there = to_stormpy(model)
        goal = model.states_with_label("a")
        for name, objective in (("max", "max"), ("min", "min")):
            (expected,) = storm_values(there, f'P{name}=? [ F "a" ]')
            found = reachability_probability(to_padded(model), goal, objective=objective)
            assert abs(float(expected) - float(found.value[0])) < 1e-5


def test_rewards_mean_the_same():
    pytest.importorskip("stormpy", minversion="2")
    rng = np.random.default_rng(2)
    for _ in range(5):
        model = random_model(rng, chain=True)
        matrix, reward = model.host.matrix.toarray(), choice_reward(model, "all")
        expected, at = 0.0, np.eye(6)[0]
        for _ in range(7):
            expected, at = expected + at @ reward, at @ matrix
        (found,) = storm_values(to_stormpy(model), 'R{"all"}=? [ C<=7 ]')
        assert abs(float(found) - expected) < 1e-9


def test_a_model_that_storm_built():
    stormpy = pytest.importorskip("stormpy", minversion="2")
    from stormpy.io import parse_prism_program

    model = build(stormpy, parse_prism_program)
    found = from_stormpy(model)
    assert "top" in found.propositions
    assert found.num_states == model.nr_states
    assert found.num_transitions == model.nr_transitions
    assert {"left", "right"} <= set(found.action_names)
    assert sorted(found.rewards) == ["plain", "steps"]
    assert set(found.valuation) == {"x", "done"}
    assert found.states_with_label("top").tolist() == (found.valuation["x"] == 4).tolist()
    start = int(np.argmax(found.initial))
    assert (found.valuation["x"][start], found.valuation["done"][start]) == (1, False)


def build(stormpy, parse):
    import tempfile

    with tempfile.NamedTemporaryFile("w", suffix=".nm") as file:
        file.write(PRISM)
        file.flush()
        program = parse(file.name)
    options = stormpy.BuilderOptions()
    for wanted in ("all_labels", "all_reward_models", "choice_labels", "state_valuations"):
        getattr(options, f"set_build_{wanted}")(True)
    return stormpy.build_model(program, options=options)


def test_what_is_no_model_is_refused():
    pytest.importorskip("stormpy", minversion="2")
    with pytest.raises(ValueError, match="from_stormpy: Storm does not write this str"):
        from_stormpy("model")


def test_without_the_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "stormpy", None)
    with pytest.raises(ValueError, match="takes the package stormpy, version 2"):
        from_stormpy(None)
