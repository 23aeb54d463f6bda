"""The DRN format: what is written is read bit for bit, and what is wrong is named."""

from dataclasses import replace

import numpy as np
import pytest

from jaxltl.core.models.sparse import Rewards, choice_reward, make_sparse
from jaxltl.io.drn.drn import read_drn, write_drn
from tests.io.same import actions, assert_same, full_model, refuses
from tests.sparse_models import storm_values

MDP = """\
// Exported by storm
// Original model type: MDP
@type: MDP
@value_type: double
@parameters

@placeholders
$0 : 1/4
$half : 0.5
$1 : $half
@reward_models
time  steps\x20
@nr_states
4
@nr_choices
5
@model
state 0 [1, 0, 0.5] init "two words"
//[!b\t& x="0"]
\taction go [0, 0, 1/3]
\t\t2 : $half
\t\t1 : $1
\taction stay
\t\t0 : 1e-1
\t\t3 : 9/10

state 1 [0,2,0] "quoted""twice" plain
\taction __NOLABEL__ [-1.5,0,inf]
\t\t1 : 1
state 2
\taction __NOLABEL__
\t\t2 : $0
\t\t3 : 0.75
state 3 plain init
\taction go
\t\t3 : 1.0"""


def read(tmp_path, text):
    path = tmp_path / "m.drn"
    path.write_bytes(text.encode(errors="surrogateescape"))
    return read_drn(path)


def test_a_model_of_storm(tmp_path):
    model = read(tmp_path, MDP)
    assert model.row_start.tolist() == [0, 2, 3, 4, 5]
    assert model.successor.tolist() == [1, 2, 0, 3, 1, 2, 3, 3]
    assert model.probability.tolist() == [0.5, 0.5, 0.1, 0.9, 1, 0.25, 0.75, 1]
    assert model.initial.tolist() == [0.5, 0, 0, 0.5]
    assert set(model.propositions) == {"two words", "plain", "quoted", "twice"}
    assert model.states_with_label("plain").tolist() == [False, True, False, True]
    assert actions(model) == ["go", "stay", "", "", "go"]
    assert list(model.rewards) == ["time", "", "steps"]
    assert model.rewards["time"].state.tolist() == [1, 0, 0, 0]
    assert model.rewards["time"].choice.tolist() == [0, 0, -1.5, 0, 0]
    assert model.rewards[""].state.tolist() == [0, 2, 0, 0] and model.rewards[""].choice is None
    assert model.rewards["steps"].choice.tolist() == [1 / 3, 0, np.inf, 0, 0]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("name", ["m.drn", "m.drn.gz", "m.xz"])
def test_what_is_written_is_read(tmp_path, seed, name):
    names = ("a", "two words", "x]", "[y", "//", "state")
    model = full_model(
        np.random.default_rng(seed), chain=seed % 2 == 1, transition_rewards=False, names=names
    )
    write_drn(tmp_path / name, model)
    assert_same(read_drn(tmp_path / name), model, valuation=False)


def test_actions_with_numbers_and_without(tmp_path):
    for action in (None, [4, 0, 1999999999]):
        model = make_sparse([0, 2, 3], [0, 1, 2, 3], [0, 1, 1], [1.0, 1, 1], action=action)
        write_drn(tmp_path / "m.drn", model)
        assert_same(read_drn(tmp_path / "m.drn"), model)


def test_blocks_do_not_matter(tmp_path, monkeypatch):
    model = full_model(np.random.default_rng(3), 40, transition_rewards=False)
    write_drn(tmp_path / "m.drn", model)
    for size in (1, 30, 200, 1000):
        monkeypatch.setattr("jaxltl.io.tokens._SIZE", size)
        assert_same(read_drn(tmp_path / "m.drn"), model, valuation=False)
    monkeypatch.setattr("jaxltl.io.drn.drn._STEP", 7)
    write_drn(tmp_path / "n.drn", model)
    assert (tmp_path / "n.drn").read_bytes() == (tmp_path / "m.drn").read_bytes()


def test_observations(tmp_path):
    text = MDP.replace("@type: MDP", "@type: POMDP")
    for state, seen in enumerate((1, 0, 2, 3)):
        text = text.replace(f"state {state}", f"state {state} {{{seen}}}")
    for line, message in (
        ("state 1 {0}", "state 1"),
        ("state 1 {0}", "state 1 {x}"),
        ("state 1 {0}", "state 1 0"),
        ("state 1 {0}", "state 1 {4}"),
        ("state 1 {0}", "state 1 {1}"),
    ):
        with pytest.raises(ValueError, match=r"m\.drn'.*(line 27|states 0 and 1 have the obs)"):
            read(tmp_path, text.replace(line, message))
    pomdp = read(tmp_path, text)
    assert pomdp.observation.tolist() == [1, 0, 2, 3]
    assert_same(pomdp.fully_observable, read(tmp_path, MDP))


WRONG = [
    ("@type: MDP", "@type: CTMC", r"m.drn', line 3: a model of type 'CTMC' is not supported"),
    ("@type: MDP", "@type: POMDP", "line 18: 'state 0 .*; expected 'state number {observation}'"),
    ("@type: MDP", "@type: MA", "line 3: a model of type 'MA' is not supported"),
    ("@type: MDP", "", "line 17: expected a line '@type: MDP'"),
    ("@type: MDP", "@kind: MDP", "line 3: '@kind: MDP'; expected @type, @value_type"),
    ("@value_type: double", "@value_type: interval", "line 4: the value type is 'interval'"),
    ("@value_type: double", "@value_type: float", "line 4: the value type is 'float'"),
    ("@value_type: double", "@type: MDP", "line 4: @type is given twice"),
    ("$0 : 1/4", "0 : 1/4", "line 8: '0 : 1/4'; expected '.name : value'"),
    ("$0 : 1/4", "$0 : p", "the placeholder .0 stands for 'p'; expected a number"),
    ("$1 : $half", "$half : 1", "line 10: '.half : 1'; expected .* each name once"),
    ("@nr_states\n4", "", "line 16: expected the number of states"),
    ("@nr_states\n4", "@nr_states\n-4", "line 14: '-4'; expected a number from 1"),
    ("@nr_states\n4", "@nr_states\n1000000000000000", "line 14: .*; expected a number from 1"),
    ("@nr_states\n4", "@nr_states\n5", "5 states are announced and 4 follow"),
    ("@nr_states\n4", "@nr_states\n2", "'2' stands where .* below 2"),
    ("@nr_choices\n5", "@nr_choices\n6", "6 choices are announced and 5 follow"),
    ("@model", "@mode", "it has no line '@model'"),
    ("state 0 [1", "[1", "line 18: .*; expected 'state number' or 'action name' before it"),
    ("state 1 [", "state 2 [", "line 27: '2' stands where state 1 is expected"),
    ("state 1 [0,2,0]", "state 1 [0,2]", "line 27: .* with 3 rewards"),
    ("state 1 [0,2,0]", "state 1 [0,2,0", "line 27: .*; expected 'state number"),
    ("[1, 0, 0.5]", "[1, 0, x]", "line 18: 'x' stands where a reward"),
    ("[1, 0, 0.5]", "[1, , 0.5]", "line 18: .*reward"),
    ("[0,2,0]", "[0,2 1,0]", "line 27: .* with 3 rewards"),
    ("[0,2,0]", "[0,x,0]", "line 27: 'x' stands where a reward"),
    ("state 2\n", "state\n", "line 30: 'state'; expected 'state number"),
    ("action stay", "action", "line 23: 'action'; expected 'action name"),
    ("action stay", "action stay put", "line 23: 'action stay put'; expected 'action name"),
    ("\taction stay\n", "", "4 follow|sum to 2"),
    ("0 : 1e-1", "0 1e-1", "line 24: '0 1e-1'; expected 'successor : probability'"),
    ("0 : 1e-1", "0 : ", "line 24: '0 :'; expected 'successor : probability'"),
    ("0 : 1e-1", "4 : 1e-1", "line 24: '4' stands where a state below 4"),
    ("0 : 1e-1", "0 : p", "line 24: 'p' stands where a probability is expected"),
    ("0 : 1e-1", "0 : $2", "line 24: '.2' stands where a probability is expected"),
    ("0 : 1e-1", "0 : [0, .1]", "line 24: .*expected 'successor : probability'"),
    ("0 : 1e-1", "0 : 0.2", "line 23: the probabilities of this action of state 0 sum to 1.1"),
    ("\t\t1 : 1\n", "", "line 28: this action leads nowhere"),
    ("\taction __NOLABEL__\n", "", "line 31: .*; expected 'state number' or 'action name'"),
    ("\taction go\n\t\t3 : 1.0", "", "4 follow|state 3 has no action"),
    ("plain init", "plain", "."),
    ("init", "\udcff", "."),
]


@pytest.mark.parametrize(("old", "new", "message"), WRONG)
def test_what_is_wrong_is_named(tmp_path, old, new, message):
    assert old in MDP
    text = MDP.replace(old, new, 1)
    if message == ".":
        text = text.replace("init", "other")
        message = "no state has the label 'init'|is not UTF-8"
    with pytest.raises(ValueError, match=message) as caught:
        read(tmp_path, text)
    assert str(tmp_path) in str(caught.value)


def test_a_chain_has_one_action_in_each_state(tmp_path):
    with pytest.raises(ValueError, match="line 23: a second action of state 0; a DTMC has one"):
        read(tmp_path, MDP.replace("@type: MDP", "@type: DTMC"))


def test_what_cannot_be_written_is_named(tmp_path):
    model = full_model(np.random.default_rng(0))
    steps = {"r": Rewards(transition=np.ones(model.num_transitions))}
    refuses(
        write_drn,
        tmp_path / "m.drn",
        replace(model, rewards={}),
        {"has rewards of transitions": {"rewards": steps}},
    )


@pytest.mark.parametrize("chain", [False, True])
def test_storm_reads_what_is_written_and_writes_what_is_read(tmp_path, chain):
    stormpy = pytest.importorskip("stormpy")
    from stormpy import io

    model = full_model(
        np.random.default_rng(5),
        12,
        chain=chain,
        transition_rewards=False,
        names=("goal", "two words"),
    )
    finite = {
        name: Rewards(
            *(
                None if x is None else np.clip(np.nan_to_num(x), -9, 9)
                for x in (r.state, r.choice, None)
            )
        )
        for name, r in model.rewards.items()
    }
    model = replace(model, rewards=finite)
    write_drn(tmp_path / "m.drn", model)
    named = io.DirectEncodingParserOptions()
    named.build_choice_labeling = True
    storm = stormpy.build_model_from_drn(tmp_path / "m.drn", options=named)
    direction = "" if chain else "max"
    values = storm_values(storm, f'P{direction}=? [ F<=4 "goal" ]')
    reached = model.states_with_label("goal").astype(float)
    for _ in range(4):
        best = model.host.over_choices(np.maximum, model.host.expectation(reached))
        reached = np.where(model.states_with_label("goal"), 1, best)
    np.testing.assert_allclose(values, reached, rtol=1e-12)
    exact = io.DirectEncodingExporterOptions()
    exact.output_precision = 17
    io.export_to_drn(storm, tmp_path / "n.drn", options=exact)
    found = read_drn(tmp_path / "n.drn")
    # What Storm wrote is read to the last bit; what Storm reads is off by one in some.
    matrix = storm.transition_matrix
    entries = [e.value for r in range(model.num_rows) for e in matrix.get_row(r)]
    assert found.probability.tolist() == entries
    np.testing.assert_allclose(entries, model.probability, rtol=1e-15)
    assert found.successor.tolist() == model.successor.tolist()
    assert actions(found) == actions(model)
    for name in model.propositions:
        assert found.states_with_label(name).tolist() == model.states_with_label(name).tolist()
    assert set(found.rewards) == set(model.rewards)
    assert found.rewards["cost"].state.tolist() == storm.get_reward_model("cost").state_rewards
    for name, reward in model.rewards.items():
        np.testing.assert_allclose(
            choice_reward(found, name), choice_reward(model, reward), rtol=1e-15
        )
