"""UMB files read by ranges onto a mesh: the model that is read whole and put there."""

import contextlib
import gzip
import io
import json
import lzma
from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxltl.core.models.game import make_game
from jaxltl.core.models.mesh.lanes import on_host
from jaxltl.core.models.mesh.shard import shard, to_mesh
from jaxltl.io.model_files import read_model, write_model
from jaxltl.io.umb import sharded as umb_sharded
from jaxltl.io.umb.sharded import read_sharded
from jaxltl.io.umb.umb import write_umb
from tests.core.models.mesh.test_sharded import mesh_of
from tests.io.archives import classes_example, example, f64, members_of, tar, u32, u64
from tests.io.archives import umb as archive
from tests.io.same import full_interval, full_model
from tests.io.test_umb import (
    changed,
    drop,
    everything,
    header_edit,
    member_edit,
    put,
    system_edit,
    with_member,
)

ARRAYS = ("tables", "place", "available", "sent", "kind", "label_rows", "rewards", "number", "row")


def assert_same_on_mesh(found, expected):
    """Array for array, but for the last bit of initial probabilities."""
    for name in ARRAYS:
        a, b = (jax.tree.flatten(getattr(x, name)) for x in (found, expected))
        assert a[1] == b[1], name
        for x, y in zip(a[0], b[0], strict=True):
            assert x.dtype == y.dtype and x.sharding == y.sharding
            np.testing.assert_array_equal(x, y, err_msg=name)
    np.testing.assert_allclose(found.initial, expected.initial, rtol=1e-15)
    for name in ("propositions", "num_unpadded", "mesh", "axis", "rounds"):
        assert getattr(found, name) == getattr(expected, name), name


def finite(model):
    """Without infinite rewards, whose mean may be none."""
    cut = jax.tree.map(lambda x: np.where(np.isfinite(x), x, 9.0), model.rewards)
    return replace(model, rewards=cut)


@pytest.mark.parametrize("count", [1, 4])
@pytest.mark.parametrize("compression", ["gzip", "xz", None])
def test_models_are_those_that_are_read_whole(count, compression, tmp_path):
    path, mesh = tmp_path / "m.umb", mesh_of(count)
    for seed, make, chain in (
        (0, full_model, False),
        (1, everything, False),
        (2, full_model, True),
    ):
        model = finite(make(np.random.default_rng(seed), 23, chain=chain))
        if seed == 0:  # numbers of actions without names, and runs that start anywhere
            rank = np.arange(model.num_rows) - model.row_start[model.host.state]
            model = replace(
                model,
                initial=np.full(23, 1 / 23),
                action=(2 * rank).astype(np.int32),
                action_names=(),
            )
        write_umb(path, model, compression=compression)
        found, whole = read_sharded(path, mesh), read_model(path)
        expected = shard(whole, mesh)
        assert_same_on_mesh(found, expected)
        of_rows = np.arange(whole.num_rows)
        np.testing.assert_array_equal(
            on_host(to_mesh(found, of_rows)), on_host(to_mesh(expected, of_rows))
        )


def packed(data, compression):
    return {None: bytes, "gzip": gzip.compress, "xz": lzma.compress}[compression](data)


@pytest.mark.parametrize("compression", [None, "gzip"])
def test_members_in_any_order(compression, tmp_path):
    mesh = mesh_of(4)
    rng = np.random.default_rng(0)
    twice = changed(member_edit("branch-to-target.bin", u64(2, 2, 3, 2, 0, 1, 2, 3)))
    for data in (archive(*example()), archive(*classes_example()), twice):
        expected = shard(read_model(put(tmp_path, data)), mesh)
        members = members_of(data)
        for order in (
            members[::-1],
            *([members[i] for i in rng.permutation(len(members))] for _ in range(2)),
        ):
            found = read_sharded(put(tmp_path, packed(tar(order), compression)), mesh)
            assert_same_on_mesh(found, expected)


def test_only_the_ranges_are_held(tmp_path, monkeypatch):
    """Of a plain file no more is read than the ranges of the process, and its headers."""
    model = finite(full_model(np.random.default_rng(0), 4000))
    path, taken = tmp_path / "m.umb", []
    write_umb(path, model, compression=None)

    class Counted(io.FileIO):
        def readinto(self, target):
            taken.append(super().readinto(target))
            return taken[-1]

        def read(self, size=-1):
            data = super().read(size)
            taken.append(len(data))
            return data

    @contextlib.contextmanager
    def opened(path):
        with Counted(path) as file:
            yield file

    monkeypatch.setattr(umb_sharded, "opened", opened)
    monkeypatch.setattr(umb_sharded, "ranges_of", lambda *_: [(1000, 1100)])
    parts = []
    monkeypatch.setattr(
        umb_sharded, "model_from_parts", lambda part, *_, **__: parts.append(part(1000, 1100))
    )
    read_sharded(path, mesh_of(1))
    rows = slice(*model.row_start[[1000, 1100]])
    np.testing.assert_array_equal(parts[0].row, np.arange(model.num_rows)[rows])
    size, members = path.stat().st_size, len(members_of(path.read_bytes()))
    assert sum(taken) < size / 40 * 1.5 + members * 4 * 512 < size / 8


def test_what_no_mesh_takes(tmp_path):
    rng, path = np.random.default_rng(0), tmp_path / "m.umb"
    write_model(path, make_game(full_model(rng), rng.random(9) < 0.5))
    with pytest.raises(
        ValueError, match=r"m\.umb': the model is a game of 2 players; a mesh supports"
    ):
        read_sharded(path, mesh_of(1))
    write_model(path, full_interval(rng))
    with pytest.raises(
        ValueError, match=r"m\.umb': the probabilities are intervals; a mesh supports"
    ):
        read_sharded(path, mesh_of(1))
    write_model(path, finite(full_model(rng, 3)))
    with pytest.raises(ValueError, match="3 states cannot lie on 4 devices"):
        read_sharded(path, mesh_of(4))
    with pytest.raises(ValueError, match=r"cannot read '.*none\.umb': No such file"):
        read_sharded(tmp_path / "none.umb", mesh_of(1))
    with pytest.raises(ValueError, match=r"axis='lanes'; the mesh has"):
        read_sharded(path, mesh_of(1), axis="lanes")


def also(edit, *more):
    return lambda *given: [x(*given) for x in (edit, *more)]


def one_nowhere(index, system, members):
    """As many branches as choices, one choice without."""
    system["#branches"] = 5
    members["choice-to-branches.bin"] = u64(0, 1, 3, 3, 4, 5)
    members["branch-to-target.bin"] = u64(1, 2, 3, 2, 3)
    members["branch-to-probability.bin"] = f64(1, 0.5, 0.5, 1, 1)
    members["annotations/rewards/r/branches/values.bin"] = f64(*range(5))


DAMAGED = [
    *(
        changed(x)
        for x in (
            system_edit("#branches", 10**15),
            also(
                system_edit("#branches", 9),
                member_edit("choice-to-branches.bin", u64(0, 2, 4, 6, 7, 9)),
            ),
            system_edit("#players", 0),
            drop("branch-to-target.bin"),
            drop("branch-to-probability.bin"),
            drop("state-to-choices.bin"),
            drop("choice-to-branches.bin"),
            drop(
                "choice-to-branches.bin",
                "branch-to-target.bin",
                "branch-to-probability.bin",
                "annotations/rewards/r/branches/values.bin",
            ),
            drop("annotations/aps/g/states/values.bin"),
            member_edit("state-to-choices.bin", u64(0, 2, 1, 4, 5)),
            member_edit("state-to-choices.bin", u64(0, 2, 2, 4, 5)),
            member_edit("state-to-choices.bin", u64(0, 2, 3, 5, 5)),
            member_edit("state-to-choices.bin", u64(0, 2**63, 3, 4, 5)),
            member_edit("state-to-choices.bin", u64(0, 7, 8, 9, 5)),
            member_edit("choice-to-branches.bin", u64(0, 2, 4, 6, 7, 9)),
            member_edit("choice-to-branches.bin", u64(0, 2, 4, 6, 6, 8)),
            member_edit("choice-to-branches.bin", u64(0, 2, 4, 9, 9, 8)),
            member_edit("branch-to-target.bin", u64(1, 2, 2, 3, 0, 1, 2, 4)),
            member_edit("branch-to-target.bin", u64(*[2**64 - 1] * 8)),
            member_edit("branch-to-probability.bin", f64(0.5, 0.5, 0.2, 0.8, 0.9, 0.1, 1, 0.5)),
            member_edit("branch-to-probability.bin", f64(0.5, 0.5, 0.2, 0.8, 0.9, 0.1, 0, 1)),
            member_edit("branch-to-probability.bin", f64(0.5, 0.5, 0.2, 0.8, 0.9, np.nan, 1, 1)),
            member_edit("actions/choices/values.bin", u32(0, 2, 0, 0, 0)),
            member_edit("actions/choices/strings.bin", b"a\xff"),
            member_edit("annotations/rewards/r/choices/values.bin", f64(0, 0, 0, np.nan, 0)),
            member_edit("annotations/rewards/r/branches/values.bin", f64(*[0] * 6, np.nan, 0)),
            # As many choices as states, one state without.
            also(
                system_edit("#choices", 4),
                drop("actions/choices/values.bin"),
                member_edit("state-to-choices.bin", u64(0, 1, 3, 3, 4)),
                member_edit("choice-to-branches.bin", u64(0, 2, 4, 6, 8)),
                member_edit("annotations/rewards/r/choices/values.bin", f64(0, 0, 0, 0)),
            ),
        )
    ),
    tar(members_of(changed(one_nowhere))[::-1]),
    gzip.compress(tar(members_of(changed(one_nowhere))[::-1])),
    header_edit(257, b"vstar"),
    with_member("../evil"),
    tar([*members_of(archive(*example())), ("state-to-choices.bin", bytes(40))]),
    tar({"index.json": json.dumps({}).encode()}),
    b"",
    b"nonsense" * 100,
    gzip.compress(b"nonsense" * 100),
    gzip.compress(archive(*example()))[:-9],
]


@pytest.mark.parametrize("i", range(len(DAMAGED)))
def test_errors_are_those_of_the_reader(i, tmp_path):
    path = put(tmp_path, DAMAGED[i])
    with pytest.raises(ValueError) as expected:
        read_model(path)
    for count in (1, 4):
        with pytest.raises(ValueError) as raised:
            read_sharded(path, mesh_of(count))
        assert str(raised.value) == str(expected.value)


def test_archives_cut_off_anywhere(tmp_path):
    plain = archive(*example())
    for data, last in ((plain, len(plain.rstrip(b"\0"))), (gzip.compress(plain), None)):
        for length in range(0, len(data[:last]), 97):
            with pytest.raises(ValueError, match=r"made\.umb'"):
                read_sharded(put(tmp_path, data[:length]), mesh_of(4))


def test_initial_distributions(tmp_path):
    rng, path = np.random.default_rng(0), tmp_path / "m.umb"
    model = finite(full_model(rng, 70))
    drawn = rng.random(70)
    write_umb(path, replace(model, initial=drawn / drawn.sum()))
    found, expected = read_sharded(path, mesh_of(4)), shard(read_model(path), mesh_of(4))
    np.testing.assert_array_equal(found.initial, expected.initial)
    for wrong, message in (
        (drawn, rf"m\.umb': the initial distribution sums to {drawn.sum():.9g}, not 1\."),
        (np.r_[drawn[:-1], -1], r"m\.umb': initial probability of state 69 is -1\.0; it must not"),
    ):
        write_umb(path, replace(model, initial=wrong))
        for read in (read_model, lambda path: read_sharded(path, mesh_of(4))):
            with pytest.raises(ValueError, match=message):
                read(path)
