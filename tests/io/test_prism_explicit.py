"""PRISM's explicit files: what is written is read bit for bit, and what is wrong is named."""

import gzip
import lzma
from dataclasses import replace

import numpy as np
import pytest

from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.io.prism.explicit import read_prism, write_prism
from tests.io.same import actions, assert_same, full_model, refuses
from tests.sparse_models import storm_values

MDP = """\
# Transitions (MDP)
4 4 6
0 0 1 1/2 go
0 0 2 0.5 go
0 1 3 1.0
# a comment
1 0 1 1

2 0 3 .75 go
2 0 2 2.5e-1 go
"""
FILES = {
    "m.tra": MDP,
    "m.lab": '0="init" 1="deadlock" 2="my goal"\n0: 0\n1:\n3: 1 2\n',
    "m.sta": "(x,b,y)\n0:(0,true,1)\n1:(-3,true,2.5)\n2:(5,false,1)\n3:(0,false,0)\n",
    "m1.srew": '# Reward structure "time"\n# State rewards\n4 2\n0 1.5\n2 1/3\n',
    "m1.trew": '# Reward structure "time"\n# Transition rewards\n4 4 2\n2 0 2 1.5\n2 0 3 1.5\n',
    "m2.trew": "4 4 2\n0 0 1 1.5\n2 0 3 7\n",
}
STORM = {
    "m.tra": "mdp\n0 0 1 0.5 go\n0 0 2 0.5 go\n0 1 3 1.0 stay\n1 0 1 1\n2 0 2 0.25\n2 0 3 0.75\n"
    "3 0 3 1",
    "m.lab": "#DECLARATION\ninit goal\nunused\n#END\n0 init\n3 goal\n",
    "m.srew": "0 1.5\n2 3\n",
    "m.trew": "0 0 1 4\n2 0 3 5",
}


def put(folder, files):
    for name, text in files.items():
        (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder / "m.tra"


def test_a_model_of_prism(tmp_path):
    model = read_prism(put(tmp_path, FILES))
    assert model.row_start.tolist() == [0, 2, 3, 4, 5]
    assert model.entry_start.tolist() == [0, 2, 3, 4, 6, 7]
    assert model.successor.tolist() == [1, 2, 3, 1, 2, 3, 3]  # the last is the deadlock's loop
    assert model.probability.tolist() == [0.5, 0.5, 1, 1, 0.25, 0.75, 1]
    assert model.initial.tolist() == [1, 0, 0, 0]
    assert model.propositions == ("deadlock", "my goal")
    assert model.states_with_label("my goal").tolist() == [False, False, False, True]
    assert actions(model) == ["go", "", "", "go", ""]
    assert model.valuation["x"].tolist() == [0, -3, 5, 0]
    assert model.valuation["b"].tolist() == [True, True, False, False]
    assert model.valuation["y"].tolist() == [1.0, 2.5, 1.0, 0.0]
    assert list(model.rewards) == ["time", ""]
    time, other = model.rewards.values()
    assert time.state.tolist() == [1.5, 0, 1 / 3, 0] and time.transition is None
    assert time.choice.tolist() == [0, 0, 0, 1.5, 0]
    assert other.state is other.choice is None
    assert other.transition.tolist() == [1.5, 0, 0, 0, 0, 7, 0]


def test_a_model_of_storm(tmp_path):
    model = read_prism(put(tmp_path, STORM))
    assert model.successor.tolist() == [1, 2, 3, 1, 2, 3, 3]
    assert model.propositions == ("goal", "unused")
    assert actions(model) == ["go", "stay", "", "", ""]
    assert model.rewards[""].state.tolist() == [1.5, 0, 3, 0]
    assert model.rewards[""].transition.tolist() == [4, 0, 0, 0, 0, 5, 0]


def test_chains_and_files_that_are_not_there(tmp_path):
    chain = read_prism(
        put(
            tmp_path,
            {
                "m.tra": "3 3\r\n0 2 0.5 a\r\n0 1 0.5 b\r\n2 0 1\r\n",
                "m10.tra": "",
                "m10.srew": "3 1\n0 1\n",
            },
        )
    )
    assert chain.is_chain and chain.successor.tolist() == [1, 2, 1, 0]
    assert chain.initial.tolist() == [1, 0, 0] and not chain.propositions and not chain.rewards
    assert actions(chain) == ["", "", ""]
    assert read_prism(put(tmp_path, {"m.tra": "dtmc\n0 0 1\n"})).num_states == 1


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("name", ["m.tra", "m.pexp", "m.tra.gz", "m.pexp.xz"])
def test_what_is_written_is_read(tmp_path, seed, name):
    rng = np.random.default_rng(seed)
    model = full_model(rng, chain=seed % 2 == 1)
    write_prism(tmp_path / name, model)
    assert_same(read_prism(tmp_path / name), model)
    begin = {".gz": b"\x1f\x8b", ".xz": b"\xfd7zXZ"}.get(name[-3:], b"")
    assert all(p.read_bytes().startswith(begin) for p in tmp_path.iterdir())


@pytest.mark.parametrize("seed", range(4))
def test_what_is_written_for_storm_is_read(tmp_path, seed):
    model = full_model(np.random.default_rng(seed), chain=seed % 2 == 1)
    write_prism(tmp_path / "m.tra", model, dialect="storm")
    numbered = {str(i): x for i, x in enumerate(model.rewards.values(), 1)}
    model = replace(model, rewards=numbered)
    if model.is_chain:
        model = replace(model, action=None, action_names=())
    assert_same(read_prism(tmp_path / "m.tra"), model, valuation=False)


def test_actions_with_numbers_keep_them(tmp_path):
    model = make_sparse([0, 2, 3], [0, 1, 2, 3], [0, 1, 1], [1.0, 1, 1], action=[4, 0, 1999999999])
    write_prism(tmp_path / "m.tra", model)
    assert " _1999999999\n" in (tmp_path / "m.tra").read_text()
    assert_same(read_prism(tmp_path / "m.tra"), model)


def test_sections_as_prism_writes_them(tmp_path):
    (tmp_path / "m.pexp").write_text("""\
# Transitions (DTMC)
2 3
0 0 0.5
0 1 0.5
1 1 1

# States
(s)
0:(3)
1:(4)

# Labels
0="init" 1="deadlock"
0: 0

# Reward structure "r"
# State rewards
2 1
0 Infinity

# Reward structure "r"
# Transition rewards
2 0

# Reward structure
# State rewards
2 0

# Reward structure
# Transition rewards
2 1
0 1 1
""")
    model = read_prism(tmp_path / "m.pexp")
    assert model.valuation["s"].tolist() == [3, 4] and model.propositions == ("deadlock",)
    r, other = model.rewards["r"], model.rewards[""]
    assert r.state.tolist() == [np.inf, 0] and r.choice is r.transition is other.state is None
    assert other.transition.tolist() == [0, 1, 0]
    write_prism(tmp_path / "n.pexp", model)
    assert "\n0 Infinity\n" in (tmp_path / "n.pexp").read_text()
    assert_same(read_prism(tmp_path / "n.pexp"), model)


def test_compressed_files_may_stand_beside_others(tmp_path):
    path = put(tmp_path, FILES)
    model = read_prism(path)
    for name, pack in {"m.lab": lzma.compress, "m1.trew": gzip.compress}.items():
        (tmp_path / name).rename(tmp_path / "moved")
        suffix = ".xz" if pack is lzma.compress else ".gz"
        (tmp_path / f"{name}{suffix}").write_bytes(pack((tmp_path / "moved").read_bytes()))
        (tmp_path / "moved").unlink()
    assert_same(read_prism(path), model)


def test_numbers_are_the_nearest_doubles(tmp_path):
    digits = "3" * 400
    text = f"3 3\n0 1 {digits}/1{'0' * 400}\n0 2 0.6{'6' * 60}7\n1 0 1\n"
    model = read_prism(put(tmp_path, {"m.tra": text}))
    assert model.probability[:2].tolist() == [1 / 3, 2 / 3]


TRA, LAB, STA, SREW, TREW = "m.tra", "m.lab", "m.sta", "m1.srew", "m2.trew"
WRONG = [
    (TRA, "4 4 6", "4 4 7", r"m.tra', line 2: 7 transitions are announced and 6 follow"),
    (TRA, "4 4 6", "4 5 6", "line 2: 5 choices are announced and 4 follow"),
    (TRA, "4 4 6", "3 4 6", "line 5: '3' stands where a state below 3 is expected"),
    (TRA, "4 4 6", "1000000000000000 4 6", "line 2: 1000000000000000 states; expected 1 to"),
    (TRA, "4 4 6", "2000000000 4 6", "2000000000 states are announced, which 6 transitions"),
    (TRA, "4 4 6", "0 4 6", "line 2: 0 states; expected 1 to"),
    (TRA, "4 4 6", "4 4 6 2", "line 2: four sizes are those of a model with observations"),
    (TRA, "4 4 6", "4 6", "line 2: 2 sizes; a MDP has 3"),
    (TRA, "4 4 6", "four", "line 2: 'four'; expected 'states transitions'"),
    (TRA, "(MDP)", "(CTMC)", "line 1: a model of type CTMC is not read"),
    (TRA, MDP, "ma\n0 0 0 1\n", "line 1: a model of type ma is not supported"),
    (TRA, MDP, "", "line 1: ''; expected 'states transitions'"),
    (TRA, MDP, "4 4 6\n", "the file ends without a transition"),
    (TRA, "1 0 1 1\n", "1 0 1\n", "line 7: '1 0 1'; expected 'state choice successor prob"),
    (TRA, "1 0 1 1\n", "1 0 1 1 a b\n", "line 7: '1 0 1 1 a b'; expected 'state choice succ"),
    (TRA, "1 0 1 1\n", "1 1 1 1\n", "line 7: state 1, choice 1 out of order"),
    (TRA, "1 0 1 1\n", "3 0 1 1\n", "line 9: state 2, choice 0 out of order"),
    (TRA, "1 0 1 1\n", "-1 0 1 1\n", "line 7: '-1' stands where a state is expected"),
    (TRA, "1 0 1 1\n", "1 0 1 1.2\n", "line 7: '1.2' stands where a probability from 0 to 1"),
    (TRA, "1 0 1 1\n", "1 0 1 nan\n", "line 7: 'nan' stands where a probability is expected"),
    (TRA, "1 0 1 1\n", "1 0 1 1/0\n", "line 7: '1/0' stands where a probability is expected"),
    (TRA, "1 0 1 1\n", "1 0 1 1e999\n", "line 7: '1e999' stands where a probability"),
    (TRA, "1 0 1 1\n", "1 0 1 .9\n", "line 7: the probabilities of state 1, choice 0 sum to 0.9"),
    (TRA, "1 0 1 1\n", "1 0 1 [0.8,0.9]\n", "line 7: the upper ends"),
    (TRA, "1 0 1 1\n", "1 0 1 [0.9, 0.8] a\n", "line 7: .* stands where"),
    (TRA, "0 0 2 0.5 go", "0 0 2 0.5 stay", "line 4: state 0, choice 0 has two actions"),
    (TRA, "0 0 2 0.5 go", "0 1 2 0.5 go", "line 5: state 0, choice 1|sum to 0.5"),
    (TRA, "3 1.0\n", "3 1.0 \udcff\n", "line 5: the name b'.*' is not UTF-8"),
    (LAB, '0="init"', '1="init"', "m.lab', line 1: '1=\"init\" .*; expected '0="),
    (LAB, '1="deadlock"', '1="init"', 'line 1: \'1="init"'),
    (LAB, "3: 1 2", "3: 1 3", "line 4: '3' stands where the number of a label below 3"),
    (LAB, "3: 1 2", "4: 1 2", "line 4: '4' stands where a state below 4"),
    (LAB, "3: 1 2", "3 1 2", "line 4: '3 1 2'; expected 'state: label label'"),
    (LAB, "0: 0\n", "", "m.lab': no state has the label 'init'"),
    (STA, "(x,b,y)", "(x,x,y)", r"m.sta', line 1: '\(x,x,y\)'; expected the names"),
    (STA, "1:(-3,true,2.5)", "1:(-3,true)", r"line 3: '1:\(-3,true\)'; expected 'state:"),
    (STA, "1:(-3,true,2.5)", "2:(-3,true,2.5)", "line 3: .*; expected state 1"),
    (STA, "1:(-3,true,2.5)", "1:(-3,maybe,2.5)", "expected a value of 'b': true, false"),
    (STA, "3:(0,false,0)\n", "", "it has 3 states; expected 4"),
    (SREW, "4 2", "4 3", "m1.srew': from line 1 on 3 rewards are announced and 2 follow"),
    (SREW, "2 1/3", "2 x", "m1.srew', line 5: 'x' stands where a reward is expected"),
    (SREW, "2 1/3", "2 1 3", "line 5: '2 1 3'; expected 'state reward'"),
    (SREW, "4 2", "5 2", "line 3: '5 2'; expected a number of states, here 4"),
    (TREW, "2 0 3 7", "2 0 1 7", "line 3: '2 0 1 7'; expected .* of a transition that exists"),
    (TREW, "2 0 3 7", "2 1 3 7", "line 3: '2 1 3 7'; expected .* of a transition that exists"),
]


WRONG_OF_STORM = [
    ("m.lab", "#END", "", "the labels after '#DECLARATION' do not end"),
    ("m.lab", "3 goal", "3 gaol", "line 6: 'gaol' stands where a label that is declared"),
    ("m.lab", "goal\nunused", "goal\ngoal", "declared twice"),
]


@pytest.mark.parametrize(
    ("files", "name", "old", "new", "message"),
    [(FILES, *x) for x in WRONG] + [(STORM, *x) for x in WRONG_OF_STORM],
)
def test_what_is_wrong_is_named(tmp_path, files, name, old, new, message):
    assert old in files[name]
    changed = files[name].replace(old, new, 1).encode(errors="surrogateescape")
    path = put(tmp_path, files | {name: changed})
    with pytest.raises(ValueError, match=message):
        read_prism(path)


def test_sections_that_are_wrong_are_named(tmp_path):
    path = tmp_path / "m.pexp"
    for text, message in {
        MDP[2:]: "it must begin with a line '# Transitions",
        MDP + "# Observations\n": "line 11: models with observations",
        MDP + "# Labels\n# Labels\n": "line 12: a second section of Labels",
        MDP + '# Reward structure "a"\n1 2\n': "line 12: expected '# State rewards'",
        MDP + '# Labels\n0="init"\n0: 1\n': "line 13: '1' stands where the number of a label",
    }.items():
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            read_prism(path)
    with pytest.raises(ValueError, match=r"must end in .tra or .pexp"):
        read_prism(tmp_path / "m.txt")
    with pytest.raises(ValueError, match="cannot read"):
        read_prism(tmp_path / "none.tra")


def test_what_cannot_be_written_is_named(tmp_path):
    model = full_model(np.random.default_rng(0))
    refuses(
        write_prism,
        tmp_path / "m.tra",
        model,
        {
            "the reward 'a\"b' cannot": {"rewards": {'a"b': Rewards()}},
            "the variable 'x' has values of dtype": {"valuation": {"x": np.array(["u"] * 9)}},
        },
    )
    (tmp_path / "m2.srew").write_text("")
    write_prism(tmp_path / "m.tra", model)
    (tmp_path / "m7.srew").write_text("")
    with pytest.raises(ValueError, match=r"the companion files m7.srew exist and would be read"):
        write_prism(tmp_path / "m.tra", model)


@pytest.mark.parametrize("chain", [False, True])
def test_storm_reads_what_is_written_for_it(tmp_path, chain):
    stormpy = pytest.importorskip("stormpy")
    model = full_model(np.random.default_rng(7), 12, chain=chain, names=("goal", "b"))
    reward = Rewards(state=np.arange(12.0), transition=model.rewards["steps"].transition)
    finite = np.where(np.isfinite(reward.transition), reward.transition, 2) % 3
    model = replace(model, rewards={"r": replace(reward, transition=abs(finite))})
    path = tmp_path / "m.tra"
    write_prism(path, model, dialect="storm")
    storm = stormpy.build_model_from_explicit(
        path,
        tmp_path / "m.lab",
        state_rewards=tmp_path / "m.srew",
        transition_rewards=tmp_path / "m.trew",
    )
    matrix = storm.transition_matrix
    entries = [(e.column, e.value) for r in range(model.num_rows) for e in matrix.get_row(r)]
    assert entries == list(zip(model.successor.tolist(), model.probability.tolist(), strict=True))
    for label in ("goal", "b", "init"):
        where = model.initial > 0 if label == "init" else model.states_with_label(label)
        assert [label in storm.labeling.get_labels_of_state(s) for s in range(12)] == where.tolist()
    direction = "" if chain else "max"
    mine = read_prism(path)
    values = storm_values(storm, f"R{direction}=? [ C<=5 ]")
    expected = bounded_reward(mine, 5)
    np.testing.assert_allclose(values, expected, rtol=1e-9)


def bounded_reward(model, steps):
    """The most that is earned in some steps, by backward induction."""
    from jaxltl.core.models.sparse import choice_reward

    host, value = model.host, np.zeros(model.num_states)
    for _ in range(steps):
        value = host.over_choices(np.maximum, choice_reward(model) + host.expectation(value))
    return value


def test_mutated_files_are_read_or_refused(tmp_path):
    from tests.io.mutate import mutated

    rng = np.random.default_rng(0)
    for i in range(400):
        files = [FILES, STORM][i % 2]
        name = list(files)[rng.integers(len(files))]
        path = put(tmp_path, files | {name: mutated(rng, files[name].encode())})
        try:
            model = read_prism(path)
        except ValueError as error:
            assert str(tmp_path) in str(error)
        else:
            assert model.num_states < 10**6
        for other in tmp_path.iterdir():
            other.unlink()
