"""Models by their files' names: every format that can hold one, and what none can."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxltl.core.models.game import Game, make_game
from jaxltl.core.models.mdp import from_dense, make_mdp
from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.io.model_files import read_model, write_model
from jaxltl.io.npz import read_npz, write_npz
from tests.io.same import assert_same, assert_same_pomdp, full_model, random_pomdp

WHOLE = (".umb", ".umb.xz", ".npz", ".tra", ".tra.gz", ".pexp", ".pexp.xz")


def held_by_all(seed, **options):
    """A random model that every format of models holds, but for variables and labels' order."""
    model = full_model(np.random.default_rng(seed), transition_rewards=False, **options)
    return replace(model, action_names=("go", "wait", "x"))


@pytest.mark.parametrize("suffix", [*WHOLE, ".drn", ".drn.gz"])
@pytest.mark.parametrize("chain", [False, True])
def test_every_format_keeps_a_model(tmp_path, suffix, chain):
    for seed in range(3):
        model = held_by_all(seed, chain=chain)
        write_model(tmp_path / f"m{seed}{suffix}", model)
        found = read_model(tmp_path / f"m{seed}{suffix}")
        assert_same(found, model, valuation=suffix in WHOLE)


@pytest.mark.parametrize("suffix", [".umb", ".npz"])
def test_games_and_other_models(tmp_path, suffix):
    path = tmp_path / f"model{suffix}"
    model = held_by_all(0)
    game = make_game(model, np.arange(model.num_states) % 2 == 0)
    write_model(path, game)
    found = read_model(path)
    assert isinstance(found, Game) and found.system.tolist() == game.system.tolist()
    assert_same(found.mdp, model)
    transition = [[[0.25, 0.75], [1, 0]], [[0, 1], [0, 0]]]
    write_model(path, from_dense(transition, label={"a": [1]}))
    found = read_model(path)
    assert found.row_start.tolist() == [0, 2, 3] and found.action.tolist() == [0, 1, 0]
    assert found.successor.tolist() == [0, 1, 0, 1] and found.propositions == ("a",)


@pytest.mark.parametrize("suffix", [".umb", ".umb.xz", ".npz", ".drn", ".drn.gz"])
def test_formats_with_observations_keep_a_pomdp(tmp_path, suffix):
    for seed in range(4):
        pomdp = random_pomdp(np.random.default_rng(seed))
        if "drn" in suffix:
            world = pomdp.fully_observable
            world = replace(world, rewards={"cost": world.rewards["cost"]})
            pomdp = replace(pomdp, fully_observable=world)
        write_model(tmp_path / f"m{suffix}", pomdp)
        assert_same_pomdp(read_model(tmp_path / f"m{suffix}"), pomdp, whole="drn" not in suffix)
    with pytest.raises(ValueError, match=r"holds no POMDPs; write UMB \(\.umb\) or DRN"):
        write_model(tmp_path / "m.tra", pomdp)


def test_observations_in_npz_files(tmp_path):
    path, table = tmp_path / "m.npz", [[[0, 0.5, 0.5]], [[1.0, 0, 0]], [[1.0, 0, 0]]]
    np.savez(path, transition=table, observation=[0, 1, 1], **{"observable:x": [3, 4]})
    pomdp = read_npz(path)
    assert pomdp.observation.tolist() == [0, 1, 1]
    assert pomdp.observation_names == ("x=3", "x=4")
    wrong = {
        "observation": {"observable:x": [3, 4]},
        "system": {"observation": [0, 1, 1], "system": [True] * 3},
        r"observation is int64\[2\]": {"observation": [0, 1]},
        "observation holds float64": {"observation": [0.0, 1.0, 1.0]},
        "observables": {"observation": [0, 1, 1], "observable:x": [3]},
    }
    for words, arrays in wrong.items():
        np.savez(path, transition=table, **arrays)
        with pytest.raises(ValueError, match=words):
            read_npz(path)


def test_a_file_is_known_by_how_it_begins(tmp_path):
    model = held_by_all(1)
    for suffix in (".umb", ".umb.xz", ".npz", ".drn", ".drn.xz"):
        write_model(tmp_path / f"m{suffix}", model)
        other = tmp_path / "model"
        other.write_bytes((tmp_path / f"m{suffix}").read_bytes())
        assert_same(read_model(other), model, valuation="drn" not in suffix)
    for content in (b"", b"nonsense", b"1 1\n0 0 1\n"):
        other.write_bytes(content)
        with pytest.raises(
            ValueError,
            match=(
                r"model': neither the suffix nor the contents name a known format; .*UMB \(\.umb\), PRISM's explicit "
                r"files \(\.tra, \.pexp\), DRN \(\.drn\), numpy \(\.npz\), Cassandra's"
            ),
        ):
            read_model(other)


def test_what_a_format_cannot_hold(tmp_path):
    model = held_by_all(0)
    game = make_game(model, np.ones(model.num_states, bool))
    for suffix, given, message in (
        (".drn", game, r"DRN holds no games; write UMB \(\.umb\) or numpy"),
        (".tra", game, r"PRISM's explicit files holds no games"),
        (".xyz", model, r"the suffix names no format; known are UMB"),
        ("", model, r"the suffix names no format"),
        (".umb", 3, r"int has no transitions"),
        (".drn", full_model(np.random.default_rng(0)), r"reward"),
        (".drn", replace(model, initial=np.arange(9) / 36), r"initial"),
        (".tra", replace(model, initial=np.arange(9) / 36), r"initial"),
    ):
        with pytest.raises(ValueError, match=message):
            write_model(tmp_path / f"m{suffix}", given)
    assert not list(tmp_path.iterdir())
    for name in ("a.umb", "a.tra", "a.pexp", "a.drn", "a.npz", "a"):
        with pytest.raises(ValueError, match=r"none.a"):
            read_model(tmp_path / "none" / name)


# --- the library's own arrays ---------------------------------------------------------------


def equal(found, model):
    a, b = jax.tree_util.tree_flatten(found), jax.tree_util.tree_flatten(model)
    return a[1] == b[1] and all(
        x.dtype == y.dtype and np.asarray(x).tobytes() == np.asarray(y).tobytes()
        for x, y in zip(a[0], b[0], strict=True)
    )


def test_arrays_keep_everything(tmp_path):
    path = tmp_path / "m.npz"
    for seed in range(4):
        rng = np.random.default_rng(seed)
        model = full_model(rng)
        initial = rng.random(model.num_states)
        model = replace(
            model,
            initial=initial / initial.sum(),
            rewards={**model.rewards, "a:b/c": Rewards(None, np.ones(model.num_rows), None)},
            valuation={**model.valuation, "file": np.array(["é"] * model.num_states)},
        )
        write_npz(path, model)
        assert equal(read_npz(path), model)
        first = path.read_bytes()
        write_npz(path, model)
        assert path.read_bytes() == first


def test_padded_arrays_are_read_in_full_precision(tmp_path):
    path = tmp_path / "m.npz"
    successor, probability = [[[0, 1]], [[1, 0]]], [[[0.1, 0.9]], [[1, 0]]]
    with jax.enable_x64(False):
        np.savez(
            path,
            successor=successor,
            probability=probability,
            actions=["x"],
            initial=[0.3, 0.7],
            label=[[True], [False]],
            propositions=["p"],
        )
        found = read_model(path)
        assert found.probability.tolist() == [0.1, 0.9, 1] and found.initial.tolist() == [0.3, 0.7]
        assert found.action_names == ("x",) and found.states_with_label("p").tolist() == [
            True,
            False,
        ]
        np.savez(path, transition=[[[0.1, 0.9]], [[0, 1]]], system=[0, 1])
        found = read_model(path)
        assert found.mdp.probability.tolist() == [0.1, 0.9, 1]
        assert found.system.tolist() == [False, True]
        write_npz(path, make_mdp(successor, probability))
        assert read_model(path).successor.tolist() == [0, 1, 1]


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"row_start": [0, 1]}, r"m\.npz': it needs the array entry_start"),
        ({"probability": np.array([[["a"]]])}, r"probability holds <U1; expected numbers"),
        (
            {"transition": [[[1.0]]], "more": [1]},
            r"an array 'more'; it may hold transition, available",
        ),
        ({"transition": [[[1j]]]}, r"transition holds complex128; expected numbers"),
        ({"transition": [[[1.0]]], "system": [True, False]}, r"m\.npz': system has shape \(2,\)"),
        (
            {
                "row_start": [0, 1],
                "entry_start": [0, 1],
                "successor": [0],
                "probability": [1.0],
                "reward:a:b": [1.0],
            },
            r"the array 'reward:a:b' is unknown; expected a reward's name and",
        ),
        (
            {"row_start": [0, 1], "entry_start": [0, 1], "successor": [0], "probability": [0.9]},
            r"m\.npz': state 0, choice 0: the probabilities sum to 0\.9",
        ),
        (
            {
                "row_start": np.array([0, 2**62, 1], np.uint64),
                "entry_start": [0, 1],
                "successor": [0],
                "probability": [1.0],
            },
            r"m\.npz': row_start falls from 4611686018427387904 to 1 at 2",
        ),
    ],
)
def test_arrays_that_are_no_model(tmp_path, arrays, message):
    np.savez(tmp_path / "m.npz", **arrays)
    with pytest.raises(ValueError, match=message):
        read_model(tmp_path / "m.npz")


def test_arrays_that_would_grow(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxltl.io.npz.ALWAYS_ALLOWED", 2**20)
    path = tmp_path / "m.npz"
    np.savez_compressed(path, transition=np.zeros((2, 1, 2)), label=np.zeros(2**23, np.int8))
    with pytest.raises(ValueError, match=r"m\.npz', \d+ bytes, would grow to 8\d+ bytes; write it"):
        read_model(path)
    model = replace(make_sparse(None, [0, 1], [0], [1.0]), valuation={"z": np.zeros(1, object)})
    with pytest.raises(ValueError, match=r"the variable 'z' holds object; a file holds truth val"):
        write_npz(path, model)
