"""Interval models in files: round trips bit for bit, other tools, and what is wrong named."""

import gzip
import json
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from jaxltl.core.models.interval import IntervalMDP, interval_rows
from jaxltl.io.drn.drn import read_drn
from jaxltl.io.model_files import read_model, write_model
from jaxltl.io.padded_models import read_padded
from jaxltl.io.prism.explicit import read_prism, write_prism
from jaxltl.io.storm import from_stormpy, to_stormpy
from jaxltl.io.umb.umb import read_umb
from tests.io.archives import example, f64, members_of, u64, umb
from tests.io.same import assert_same_interval, full_interval

DRN = """// Exported by storm
@type: MDP
@value_type: double-interval
@parameters

@reward_models
time cost
@nr_states
3
@nr_choices
4
@model
state 0 [[1, 1], [0.5, 0.5]] init
\taction 0 [0, [2, 2]]
\t\t1 : [0.1, 0.7]
\t\t2 : [0.4, 0.8]
\taction 1 [0, 0]
\t\t0 : [0, 0.2]
\t\t2 : [0.9, 1]
state 1 [[1, 1], [0, 0]] "a [1, 2] b"
\taction 0 [0, 0]
\t\t1 : [1, 1]
state 2 [0, 0]
\taction 0 [0, 0]
\t\t2 : [1, 1]
"""

TRA = """# Transitions (IMDP)
3 4 6
0 0 1 [0.1,0.7] go
0 0 2 [0.4,0.8] go
0 1 0 [0,0.2]
0 1 2 [0.9,1]
1 0 1 1
2 0 2 [1,1]
"""


def the_model():
    return interval_rows(
        [0, 2, 3, 4],
        [0, 2, 4, 5, 6],
        [1, 2, 0, 2, 1, 2],
        [0.1, 0.4, 0, 0.9, 1, 1],
        [0.7, 0.8, 0.2, 1, 1, 1],
        initial=[1, 0, 0],
    )


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    "name", ["m.umb", "m.umb.xz", "m.npz", "m.drn", "m.drn.gz", "m.tra", "m.tra.xz", "m.pexp"]
)
def test_what_is_written_is_read(name, seed, tmp_path):
    rng = np.random.default_rng(seed)
    whole = name.startswith(("m.umb", "m.npz"))
    model = full_interval(rng, 5 + seed, chain=bool(seed % 2), transition_rewards=whole)
    assert (model.lower < model.upper).any()
    write_model(tmp_path / name, model)
    found = read_model(tmp_path / name)
    assert_same_interval(found, model, valuation=not name.startswith("m.drn"))
    write_model(tmp_path / f"again_{name}", found)
    again = read_model(tmp_path / f"again_{name}")
    assert_same_interval(again, found)


def test_text_formats_say_the_same(tmp_path):
    model = the_model()
    (tmp_path / "m.drn").write_text(DRN)
    (tmp_path / "m.tra").write_text(TRA)
    first, second = read_drn(tmp_path / "m.drn"), read_prism(tmp_path / "m.tra")
    for found in (first, second):
        assert found.nominal.successor.tolist() == model.nominal.successor.tolist()
        assert found.lower.tolist() == model.lower.tolist()
        assert found.upper.tolist() == model.upper.tolist()
    assert first.rewards["time"].state.tolist() == [1, 1, 0]
    assert first.rewards["cost"].state.tolist() == [0.5, 0, 0]
    assert first.rewards["cost"].choice.tolist() == [2, 0, 0, 0]
    assert first.propositions == ("a [1, 2] b",)
    assert second.nominal.action_names == ("go", "")
    # Storm's dialect, blanks, and intervals that come late.
    (tmp_path / "m.tra").write_text(
        "mdp\n0 0 1 [ 0.1 , 0.7 ] go\n0 0 2 [.4, 4/5] go\n0 1 0 [0,0.2]\n0 1 2 [0.9,1]\n"
        "1 0 1 1\n2 0 2 1\n"
    )
    assert read_prism(tmp_path / "m.tra").upper.tolist() == model.upper.tolist()
    (tmp_path / "m.tra").write_text("3 4\n0 1 1/3\n0 2 2/3\n1 1 1\n2 2 [1,1]\n")
    found = read_prism(tmp_path / "m.tra")
    assert found.is_chain and found.lower.tolist() == found.upper.tolist() == [1 / 3, 2 / 3, 1, 1]


def test_sums_that_miss_one_by_rounding_stay():
    p = np.random.default_rng(0).dirichlet(np.ones(7), 40)
    assert (p.sum(1) != 1).any()
    target = np.tile(np.arange(7), 40)
    model = interval_rows(None, np.arange(0, 281, 7), target, p.ravel(), p.ravel())
    assert model.lower.tobytes() == p.tobytes() == model.upper.tobytes()


WRONG = [
    ("[0.1, 0.7]", "[0.7, 0.1]", "line 15: '.0.7, 0.1.' stands where .* interval .l, u. with 0"),
    ("[0.1, 0.7]", "[0.7]", "line 15: '.0.7.' stands where"),
    ("[0.1, 0.7]", "[0.1, 0.7", "line 15: .*expected 'successor : probability'"),
    ("[0.1, 0.7]", "[nan, 0.7]", "line 15: 'nan' stands where"),
    ("[0.1, 0.7]", "[0.1, inf]", "line 15: '.0.1, inf.' stands where"),
    ("[0.1, 0.7]", "[-0.1, 0.7]", "line 15: '.-0.1, 0.7.' stands where"),
    ("[0.1, 0.7]", "[0.1, 0.7, 0.8]", "line 15: .* stands where"),
    ("[0.1, 0.7]", "[0.1, 1.7]", "line 15: .* stands where"),
    ("[0.1, 0.7]", "[]", "line 15: .* stands where"),
    ("[0.1, 0.7]", "[[0.1, 0.7]]", "line 15: .* stands where"),
    ("[0.1, 0.7]", "[0.1, 0.7] 3", "line 15: .*; expected 'successor : probability'"),
    ("[0.4, 0.8]", "[0.95, 1]", "line 14: the lower ends of this action of state 0 sum to 1.05"),
    ("[0.4, 0.8]", "[0, 0.2]", "line 14: the upper ends of this action of state 0 sum to 0.9"),
    ("[[1, 1], [0.5", "[[1, 2], [0.5", "line 13: the reward .1, 2. is an interval"),
    ("[[1, 1], [0.5", "[[1], [0.5", "line 13: "),
    ("double-interval", "interval", "line 3: the value type is 'interval'"),
    ("double-interval", "double", "line 13: 'state 0 .*; expected 'state number .reward"),
]


WRONG_EXPLICIT = [
    ("[0.1,0.7]", "[0.7,0.1]", "line 3: '.0.7,0.1.' stands where .* interval .l, u. with 0 <="),
    ("[0.1,0.7]", "[0.7]", "line 3: '.0.7.' stands where"),
    ("[0.1,0.7]", "[0.1,0.7", "line 3: '.0.1,0.7' stands where"),
    ("[0.1,0.7]", "[0.1,nan]", "line 3: 'nan' stands where"),
    ("[0.1,0.7]", "[-1e-9,0.7]", "line 3: '.-1e-9,0.7.' stands where"),
    ("[0.4,0.8]", "[0.95,1]", "line 3: the lower ends of state 0, choice 0 sum to 1.05"),
    ("[0.4,0.8]", "[0,0.2]", "line 3: the upper ends of state 0, choice 0 sum to 0.9"),
    ("(IMDP)", "(IPOMDP)", "line 1: a model of type IPOMDP is not read"),
    ("(IMDP)", "(IDTMC)", "line 2: 3 sizes; a IDTMC has 2"),
]


@pytest.mark.parametrize(
    ("text", "name", "old", "new", "message"),
    [(DRN, "m.drn", *x) for x in WRONG] + [(TRA, "m.tra", *x) for x in WRONG_EXPLICIT],
)
def test_what_is_wrong_is_named(text, name, old, new, message, tmp_path):
    assert old in text
    path = tmp_path / name
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=message) as caught:
        read_model(path)
    assert str(path) in str(caught.value)


def interval_archive(kind="double-interval", size=128, ends=None, reward=None, players=1):
    """The hand-made example with intervals."""
    index, members = example()
    index["transition-system"]["branch-probability-type"] = {"type": kind, "size": size}
    index["transition-system"]["#players"] = players
    members["branch-to-probability.bin"] = ends
    if reward is not None:
        index["annotations"]["rewards"] = {
            "r": {"applies-to": ["choices"], "type": {"type": "double-interval", "size": 128}}
        }
        members["annotations/rewards/r/choices/values.bin"] = f64(*reward)
    return umb(index, members)


LOWER = [0.4, 0.3, 0.2, 0.8, 0.9, 0, 1, 1]
UPPER = [0.6, 0.7, 0.2, 0.8, 1, 0.1, 1, 1]


THIRDS = u64(1, 3, 2, 3, 1, 3, 2, 3, 1, 5, 1, 5, 4, 5, 4, 5, 9, 10, 1, 1, 1, 100, 1, 10, *[1] * 8)


def pairs(lower=LOWER, upper=UPPER):
    return f64(*np.stack([lower, upper], 1).ravel())


def test_umb_as_others_write_it(tmp_path):
    path = tmp_path / "m.umb"
    path.write_bytes(interval_archive(ends=pairs(), reward=[1, 1, 0, 0, 2.5, 2.5, 0, 0, 0, 0]))
    model = read_umb(path)
    assert isinstance(model, IntervalMDP)
    assert model.lower.tolist() == LOWER and model.upper.tolist() == UPPER
    assert model.rewards["r"].choice.tolist() == [1, 0, 2.5, 0, 0]
    assert model.propositions == ("Goal!",)
    path.write_bytes(interval_archive("rational-interval", 256, THIRDS))
    model = read_umb(path)
    assert model.lower.tolist() == [1 / 3, 1 / 3, 1 / 5, 4 / 5, 9 / 10, 1 / 100, 1, 1]
    assert model.upper.tolist() == [2 / 3, 2 / 3, 1 / 5, 4 / 5, 1, 1 / 10, 1, 1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"ends": pairs([0.7, *LOWER[1:]])},
            "state 0, choice 0: the interval of successor 1 is .0.7, 0",
        ),
        (
            {"ends": pairs([-0.1, *LOWER[1:]])},
            "state 0, choice 0: the interval of successor 1 is .-0.1",
        ),
        (
            {"ends": pairs([np.nan, *LOWER[1:]])},
            "state 0, choice 0: the interval of successor 1 is .nan",
        ),
        ({"ends": pairs([0.6, 0.5, *LOWER[2:]])}, "choice 0: the lower ends sum to 1.1"),
        ({"ends": pairs(LOWER, [0.4, 0.5, *UPPER[2:]])}, "choice 0: the upper ends sum to 0.9"),
        ({"ends": f64(*LOWER)}, "branch-to-probability.bin has 64 bytes; expected 128"),
        ({"ends": pairs(), "players": 2}, "the probabilities of this game are intervals"),
        (
            {"ends": pairs(), "reward": [1, 2] * 5},
            "rewards/r/choices/values.bin: number 0 is the interval .1, 2.; single",
        ),
        (
            {"ends": pairs(), "kind": "rational-interval", "size": 128},
            "branch-probability-type: its type is rational-interval of 128 bits",
        ),
        ({"ends": pairs(), "kind": "double-interval", "size": 64}, "double-interval of 64 bits"),
    ],
)
def test_what_is_wrong_in_umb_is_named(options, message, tmp_path):
    path = tmp_path / "m.umb"
    path.write_bytes(interval_archive(**options))
    with pytest.raises(ValueError, match=message) as caught:
        read_model(path)
    assert str(path) in str(caught.value)


def test_padded_arrays(tmp_path):
    path = tmp_path / "m.npz"
    arrays = {
        "successor": [[[1, 2], [0, 2]], [[1, 0], [0, 0]], [[2, 0], [0, 0]]],
        "lower": [[[0.1, 0.4], [0, 0.9]], [[1, 0], [0, 0]], [[1, 0], [0, 0]]],
        "upper": [[[0.7, 0.8], [0.2, 1]], [[1, 0], [0, 0]], [[1, 0], [0, 0]]],
        "initial": [1.0, 0, 0],
        "actions": ["x", "y"],
    }
    np.savez(path, **arrays)
    found = read_model(path)
    assert_same_interval(
        found,
        replace(
            the_model(),
            nominal=replace(
                the_model().nominal,
                action=np.array([0, 1, 0, 0], np.int32),
                action_names=("x", "y"),
            ),
        ),
    )
    with pytest.raises(ValueError, match="its probabilities are intervals"):
        read_padded(path)
    for change, message in [
        ({"upper": None}, "needs the array upper"),
        ({"lower": [[[0.1]]]}, "lower .1, 1, 1."),
        ({"system": [True] * 3}, "the probabilities of this game are intervals"),
        ({"available": [True]}, "available has shape"),
    ]:
        np.savez(path, **{k: v for k, v in (arrays | change).items() if v is not None})
        with pytest.raises(ValueError, match=message) as caught:
            read_model(path)
        assert str(path) in str(caught.value)


def test_what_cannot_be_written_is_named(tmp_path):
    with pytest.raises(ValueError, match="Storm reads no intervals in explicit files"):
        write_prism(tmp_path / "m.tra", the_model(), dialect="storm")
    assert not list(tmp_path.iterdir())


def test_learners_files_refuse_intervals(tmp_path):
    for name in ("m.umb", "m.npz"):
        write_model(tmp_path / name, the_model())
        with pytest.raises(ValueError, match="intervals") as caught:
            read_padded(tmp_path / name)
        assert name in str(caught.value)


def test_storm_reads_what_is_written(tmp_path):
    storm = pytest.importorskip("stormpy")
    rng = np.random.default_rng(5)
    for chain in (False, True):
        model = full_interval(rng, chain=chain, transition_rewards=False, names=("a", "goal"))
        finite = {
            k: replace(
                v,
                state=None if v.state is None else np.minimum(v.state, 9),
                choice=None if v.choice is None else np.minimum(v.choice, 9),
            )
            for k, v in model.rewards.items()
        }
        model = replace(model, nominal=replace(model.nominal, rewards=finite))
        write_model(tmp_path / "m.umb", model)
        write_model(tmp_path / "m.drn", model)
        there = [
            storm.build_model_from_umb(str(tmp_path / "m.umb")),
            storm.build_model_from_drn[storm.Interval](str(tmp_path / "m.drn")),
        ]
        for one in there:
            matrix = one.transition_matrix
            ends = [
                (e.column, e.value.lower(), e.value.upper())
                for r in range(matrix.nr_rows)
                for e in matrix.get_row(r)
            ]
            assert ends == list(
                zip(
                    model.nominal.successor.tolist(),
                    model.lower.tolist(),
                    model.upper.tolist(),
                    strict=True,
                )
            )
            assert set(one.reward_models) == set(model.rewards)
            states = [
                s for s in range(model.num_states) if "goal" in one.labeling.get_labels_of_state(s)
            ]
            assert states == np.flatnonzero(model.states_with_label("goal")).tolist()
        back = from_stormpy(to_stormpy(model))
        assert back.lower.tobytes() == model.lower.tobytes()
        assert back.upper.tobytes() == model.upper.tobytes()


def test_storm_reads_fractions_in_the_same_order(tmp_path):
    storm = pytest.importorskip("stormpy")
    path = tmp_path / "m.umb"
    path.write_bytes(interval_archive("rational-interval", 256, THIRDS))
    there = storm.build_model_from_umb(str(path))  # its matrix does not outlive it
    ends = [
        tuple(float(Fraction(str(x))) for x in (e.value.lower(), e.value.upper()))
        for r in range(there.transition_matrix.nr_rows)
        for e in there.transition_matrix.get_row(r)
    ]
    model = read_umb(path)
    assert ends == list(zip(model.lower.tolist(), model.upper.tolist(), strict=True))


def test_what_storm_writes_is_read(tmp_path):
    io = pytest.importorskip("stormpy.io")
    model = full_interval(np.random.default_rng(3), transition_rewards=False)
    finite = {"cost": replace(model.rewards["cost"], state=np.arange(9.0))}
    model = replace(model, nominal=replace(model.nominal, rewards=finite, valuation={}))
    there = to_stormpy(model)
    io.export_to_umb(there, str(tmp_path / "m.umb"))
    io.export_to_drn(there, str(tmp_path / "m.drn"))
    found = read_model(tmp_path / "m.umb")
    assert found.lower.tobytes() == model.lower.tobytes()
    assert found.rewards["cost"].state.tolist() == list(range(9))
    index = json.loads(
        dict(members_of(gzip.decompress((tmp_path / "m.umb").read_bytes())))["index.json"]
    )
    assert index["annotations"]["rewards"]["cost"]["type"]["type"] == "double-interval"
    text = (tmp_path / "m.drn").read_text()
    assert "[[1, 1]" in text
    found = read_model(tmp_path / "m.drn")  # Storm writes six digits
    np.testing.assert_allclose(found.lower, model.lower, atol=1e-5)
    assert found.rewards["cost"].state.tolist() == list(range(9))
