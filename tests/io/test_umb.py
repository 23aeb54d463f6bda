"""UMB files: models come back bit for bit, and what cannot be is refused by name."""

import gzip
import io
import json
import lzma
import re
import tarfile
from dataclasses import replace
from fractions import Fraction

import jax
import numpy as np
import pytest

from jaxltl.core.models.game import Game, make_game
from jaxltl.core.models.mdp import make_mdp
from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.io import files as _files
from jaxltl.io.umb import umb
from jaxltl.io.umb import values as _umb_values
from jaxltl.io.umb.index import Record, RecordVariable, Type
from jaxltl.io.umb.members import members, tar_pieces, write_gzip
from jaxltl.io.umb.umb import read_umb, write_umb
from jaxltl.io.umb.values import read_numbers, read_variables
from tests.io.archives import (
    classes_example,
    example,
    f64,
    members_of,
    tar,
    u32,
    u64,
)
from tests.io.archives import umb as archive
from tests.io.same import full_model
from tests.storm_oracle import storm_values


def assert_equal(found, model):
    """The same kind of model, and every array the same bits."""
    assert type(found) is type(model)
    a, b = jax.tree_util.tree_flatten(found), jax.tree_util.tree_flatten(model)
    assert a[1] == b[1]
    for x, y in zip(a[0], b[0], strict=True):
        assert x.dtype == y.dtype and x.shape == y.shape
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


def everything(rng, num_states=9, **options):
    """A random model with all that a file can hold, under names of all sorts."""
    model = full_model(rng, num_states, **options)
    initial = rng.random(num_states)
    names = ("a b", "init", "A", "a-", "ap0", "")
    texts = np.array(["", "é", 'end"', "\u4e2d\u6587"])[rng.integers(0, 4, num_states)]
    texts[0] = 'end"'  # the longest one
    return replace(
        model,
        initial=initial / initial.sum(),
        propositions=names,
        label=rng.random((num_states, len(names))) < 0.3,
        rewards={
            **model.rewards,
            "Of all": Rewards(
                rng.random(num_states),
                rng.random(model.num_rows),
                rng.random(model.num_transitions),
            ),
        },
        action_names=("go", "", "go é"),
        valuation={
            "i": rng.integers(-9, 9, num_states).astype(np.int32),
            "far": np.array([-(2**63)] * (num_states - 1) + [2**63 - 1]),
            "u": np.full(num_states, 2**64 - 1, np.uint64),
            "t": texts,
            "b": rng.random(num_states) < 0.5,
            "": np.where(rng.random(num_states) < 0.5, np.nan, -0.0),
            "t2": np.array(["x"] * num_states),
        },
    )


@pytest.mark.parametrize("compression", ["gzip", "xz", None])
@pytest.mark.parametrize("kind", ["chain", "process", "game"])
def test_round_trips(kind, compression, tmp_path):
    path = tmp_path / "model.umb"
    for seed in range(6):
        rng = np.random.default_rng(seed)
        make = everything if seed % 2 else full_model
        size = (1, 9, 64, 65, 200)[seed % 5]
        model = make(rng, max(size, 3), chain=kind == "chain")
        if seed == 2:
            model = replace(model, action_names=())
        if seed == 4:
            model = replace(
                model,
                action=None,
                action_names=(),
                valuation={},
                rewards={},
                label=np.zeros((model.num_states, 0), bool),
                propositions=(),
            )
        if kind == "game":
            model = make_game(model, rng.random(model.num_states) < 0.5)
        write_umb(path, model, compression=compression)
        assert_equal(read_umb(path), model)
        first = path.read_bytes()
        assert _files.compression_of(first) == compression
        write_umb(path, model, compression=compression)
        assert path.read_bytes() == first
    assert [x.name for x in tmp_path.iterdir()] == ["model.umb"]


def test_initial_distributions(tmp_path):
    rng = np.random.default_rng(0)
    for size in (1, 3, 49, 1000):
        model = full_model(rng, size + 3, chain=True)
        some = rng.random(model.num_states) < 0.4
        some[0] = True
        for initial in (None, some / some.sum(), rng.random(model.num_states) + some):
            if initial is not None:
                initial = initial / initial.sum()
            model = make_sparse(
                None, model.entry_start, model.successor, model.probability, initial=initial
            )
            write_umb(tmp_path / "m.umb", model)
            found = read_umb(tmp_path / "m.umb")
            assert found.initial.tobytes() == model.initial.tobytes()


def test_compression_goes_by_the_name(tmp_path):
    model = full_model(np.random.default_rng(0))
    for name, kind in (("a.umb", "gzip"), ("a", "gzip"), ("a.umb.gz", "gzip"), ("a.xz", "xz")):
        write_umb(tmp_path / name, model)
        assert _files.compression_of((tmp_path / name).read_bytes()) == kind
        assert_equal(read_umb(tmp_path / name), model)
    with pytest.raises(ValueError, match="compression is 'zip'; expected 'gzip', 'xz'"):
        write_umb(tmp_path / "a", model, compression="zip")


def test_other_models_are_made_sparse(tmp_path):
    mdp = make_mdp([[[0, 1], [1, 0]], [[1, 0], [0, 0]]], [[[0.5, 0.5], [1, 0]], [[1, 0], [0, 0]]])
    write_umb(tmp_path / "m.umb", mdp)
    assert read_umb(tmp_path / "m.umb").successor.tolist() == [0, 1, 1, 1]
    write_umb(tmp_path / "m.umb", make_game(mdp, [False, True]))
    found = read_umb(tmp_path / "m.umb")
    assert isinstance(found, Game) and found.system.tolist() == [False, True]


def test_large_members_go_through_blocks(tmp_path):
    rng = np.random.default_rng(0)
    contents = [
        ("a", rng.bytes(2**20 + 5)),
        ("b", b"x" * 10),
        ("c", bytes(2**21)),
        ("d", b""),
        ("e", rng.integers(0, 9, 10**6).astype("<u8").view(np.uint8)),
    ]
    plain = b"".join(tar_pieces(contents))
    packed = []
    for threads in (1, 3):
        file = io.BytesIO()
        write_gzip(file, tar_pieces(contents), threads)
        packed.append(file.getvalue())
        assert gzip.decompress(file.getvalue()) == plain
    assert packed[0] == packed[1]
    assert members_of(plain) == [(name, bytes(memoryview(x))) for name, x in contents]


# --- what others write ----------------------------------------------------------------------


def put(tmp_path, data):
    path = tmp_path / "made.umb"
    path.write_bytes(data)
    return path


def test_the_example(tmp_path):
    found = read_umb(put(tmp_path, archive(*example())))
    assert found.row_start.tolist() == [0, 2, 3, 4, 5]
    assert found.entry_start.tolist() == [0, 2, 4, 6, 7, 8]
    assert found.successor.tolist() == [1, 2, 2, 3, 0, 1, 2, 3]
    assert found.probability.tolist() == [0.5, 0.5, 0.2, 0.8, 0.9, 0.1, 1, 1]
    assert found.initial.tolist() == [1, 0, 0, 0]
    assert found.propositions == ("Goal!",) and found.label[:, 0].tolist() == [False] * 3 + [True]
    assert found.rewards["r"].state is None
    assert found.rewards["r"].choice.tolist() == [0, 1, 0, 0, 0]
    assert found.rewards["r"].transition.tolist() == list(range(1, 9))
    assert found.action.tolist() == [0, 1, 0, 0, 0] and found.action_names == ("a", "b")
    assert {k: x.tolist() for k, x in found.valuation.items()} == {
        "x": [-1, 0, 1, 1],
        "b": [False, False, False, True],
    }


def test_archives_of_all_sorts_hold_the_same(tmp_path):
    index, members = example()
    plain = archive(index, members)
    expected = read_umb(put(tmp_path, plain))
    end = -(-len(plain.rstrip(b"\0")) // 512) * 512
    listed = [("index.json", json.dumps(index).encode()), *members.items()]
    long = [("x" * 300 + "/more", b"1" * 600), *listed]
    for data in (
        gzip.compress(plain, mtime=0),
        lzma.compress(plain),
        tar(listed[::-1]),
        gzip.compress(plain[:999], mtime=0) + gzip.compress(plain[999:]),
        archive(index, members, folders=True),
        tar([(f"./{name}", x) for name, x in listed]),
        tar(long, tarfile.GNU_FORMAT),
        tar(long, tarfile.PAX_FORMAT),
        plain[:end] + bytes(512),
        plain + bytes(10**6),
    ):
        assert_equal(read_umb(put(tmp_path, data)), expected)


def test_classes_of_states_and_rationals(tmp_path):
    found = read_umb(put(tmp_path, archive(*classes_example())))
    assert found.probability.tolist() == [0.5, 0.5, 0.2, 0.8, 0.9, 0.1, 1, 1]
    assert list(found.valuation) == ["k", "o", "s", "d", "q"]
    assert found.valuation["k"].tolist() == [-3, -100, 15, 2]
    assert found.valuation["s"].tolist() == ["end", "", "é", "end"]
    np.testing.assert_array_equal(found.valuation["o"], [12, np.nan, np.nan, 7])
    np.testing.assert_array_equal(found.valuation["d"], [np.nan, 0.25, np.nan, np.nan])
    np.testing.assert_array_equal(found.valuation["q"], [np.nan, -1 / 3, np.nan, np.nan])


def changed(edit):
    """The example after a change, as an archive."""
    index, members = example()
    edit(index, index["transition-system"], members)
    return archive(index, members)


def drop(*names):
    return lambda index, system, members: [members.pop(name) for name in names]


def test_long_texts_are_objects(tmp_path, monkeypatch):
    model = replace(
        full_model(np.random.default_rng(0)),
        valuation={"t": np.array(["a" * i for i in range(9)], object)},
    )
    write_umb(tmp_path / "m.umb", model)
    for most, kind in ((2**30, "U"), (100, "O")):
        monkeypatch.setattr(_umb_values, "_MAX_TEXT", most)
        found = read_umb(tmp_path / "m.umb").valuation["t"]
        assert found.dtype.kind == kind and found.tolist() == model.valuation["t"].tolist()


def test_what_may_be_absent(tmp_path):
    def read(edit):
        return read_umb(put(tmp_path, changed(edit)))

    assert read(drop("state-is-initial.bin")).initial.tolist() == [0.25] * 4
    assert read(drop("actions/choices/values.bin")).action.tolist() == [0] * 5
    assert read(drop("actions/choices/string-mapping.bin")).action_names == ()
    assert read(drop("annotations/rewards/r/choices/values.bin")).rewards["r"].choice is None
    assert read(drop("valuations/states/valuations.bin")).valuation == {}
    found = read(
        lambda index, system, members: (
            [index.pop(key) for key in ("annotations", "valuations", "file-data", "model-data")],
            system.update({"#choice-actions": 0}),
        )
    )
    assert found.propositions == () and found.rewards == {} and found.action is None

    def deterministic(index, system, members):
        members.clear()
        del system["branch-probability-type"], index["annotations"], index["valuations"]
        system.update({"#players": 0, "#choices": 4, "#branches": 4, "#choice-actions": 0})
        members["branch-to-target.bin"] = u64(1, 2, 3, 3)

    found = read(deterministic)
    assert found.is_chain and found.successor.tolist() == [1, 2, 3, 3]
    assert found.probability.tolist() == [1] * 4


def test_branches_to_one_target_are_put_together(tmp_path):
    def edit(index, system, members):
        members["branch-to-target.bin"] = u64(2, 2, 3, 2, 0, 1, 2, 3)

    found = read_umb(put(tmp_path, changed(edit)))
    assert found.successor.tolist() == [2, 2, 3, 0, 1, 2, 3]
    assert found.probability.tolist() == [1, 0.8, 0.2, 0.9, 0.1, 1, 1]
    assert found.rewards["r"].transition.tolist() == [1.5, 4, 3, 5, 6, 7, 8]


def test_players(tmp_path):
    def of(count, *players):
        def edit(index, system, members):
            system.update({"#players": count, "player-names": ["max", "min", "sink"][:count]})
            members["state-to-player.bin"] = u32(*players)

        return changed(edit)

    found = read_umb(put(tmp_path, of(2, 1, 0, 0, 1)))
    assert found.system.tolist() == [False, True, True, False]
    # Storm gives states without a player to another one; where there is one choice, it is the same.
    found = read_umb(put(tmp_path, of(3, 1, 0, 2, 2)))
    assert found.system.tolist() == [False, True, True, True]
    message = r"made\.umb': the game has 3 players \('max', 'min', 'sink'\), and player 2 chooses"
    with pytest.raises(ValueError, match=message + " in state 0; games of two are read"):
        read_umb(put(tmp_path, of(3, 2, 0, 1, 1)))
    with pytest.raises(ValueError, match=r"state-to-player\.bin: a state is of player 2; expected"):
        read_umb(put(tmp_path, of(2, 2, 0, 1, 1)))


# --- values ---------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [128, 256])
def test_rationals_are_the_nearest_doubles(size):
    rng, half = np.random.default_rng(0), size // 16
    numbers = []
    for _ in range(400):
        above = int.from_bytes(rng.bytes(int(rng.integers(1, half + 1))), "little", signed=True)
        below = 1 + int.from_bytes(rng.bytes(int(rng.integers(1, half + 1))), "little") // 2
        numbers.append((above, below))
    numbers += [(2**53 + 1, 1), (2**62 + 1, 3), (-(2**63), 2**64 - 1), (0, 7), (1, 2**63 + 2**11)]
    content = b"".join(
        a.to_bytes(half, "little", signed=True) + b.to_bytes(half, "little") for a, b in numbers
    )
    found = read_numbers(np.frombuffer(content, np.uint8), Type("rational", size))
    for (a, b), x in zip(numbers, found.tolist(), strict=True):
        exact = Fraction(a, b)
        error = abs(Fraction(x) - exact)
        for other in (np.nextafter(x, np.inf), np.nextafter(x, -np.inf)):
            assert error <= abs(Fraction(float(other)) - exact)


def test_variables_are_bits_at_any_place():
    """Against numbers of any size, shifted one by one."""
    rng, count = np.random.default_rng(0), 7
    for _ in range(60):
        variables, records, expected, start = [], [0] * count, {}, 0
        for i in range(rng.integers(1, 6)):
            start += int(rng.integers(0, 9))
            kind = ("bool", "int", "uint", "double")[rng.integers(4)]
            size = 64 if kind == "double" else int(rng.integers(1, 65))
            offset = 0 if kind in ("bool", "double") else int(rng.integers(-(2**10), 2**10))
            presence = None
            if kind != "bool" and rng.integers(3) == 0:
                presence, start = start, start + 1
            values = []
            for s in range(count):
                code = int.from_bytes(rng.bytes(8), "little") >> (64 - size)
                code >>= int(rng.integers(0, size))  # small ones too
                if kind == "double":
                    code = int.from_bytes(np.float64(rng.normal()).tobytes(), "little")
                there = presence is None or bool(rng.integers(2))
                records[s] |= (code << start) | (0 if presence is None else there << presence)
                if kind == "int" and code >> (size - 1):
                    code -= 1 << size
                value = {"bool": code > 0, "double": np.uint64(code % 2**64).view(np.float64)}.get(
                    kind, code + offset
                )
                values.append(value if there else np.nan)
            if kind in ("int", "uint") and any(
                x == x and not -(2**63) <= x < 2**63 for x in values
            ):
                offset, values = None, None
            if values is not None:
                expected[f"v{i}"] = values
                variables.append(RecordVariable(f"v{i}", Type(kind, size), offset, start, presence))
            start += size
        width = -(-start // 8)
        content = np.frombuffer(b"".join(x.to_bytes(width, "little") for x in records), np.uint8)
        found = read_variables(content, None, [Record(tuple(variables), width)], count, ())
        assert list(found) == list(expected)
        for name, values in expected.items():
            assert len(found[name]) == count
            for x, y in zip(found[name].tolist(), values, strict=True):
                assert x == (float(y) if found[name].dtype == float else y) or (x != x and y != y)


# --- what is refused ------------------------------------------------------------------------

DOUBLES = "annotations/rewards/r"


def index_edit(key, value):
    return lambda index, system, members: index.update({key: value})


def system_edit(key, value):
    return lambda index, system, members: system.update({key: value})


def member_edit(name, content):
    return lambda index, system, members: members.update({name: content})


def annotation_edit(key, value):
    return lambda index, system, members: index["annotations"]["rewards"]["r"].update({key: value})


def variable_edit(key, value):
    def edit(index, system, members):
        index["valuations"]["states"]["classes"][0]["variables"][0][key] = value

    return edit


INTERVAL = {"type": "double-interval", "size": 128}


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (index_edit("format-version", 2), r"index\.json: format-version is 2; version 1 is read"),
        (
            index_edit("transition-system", 3),
            r"index\.json: transition-system is 3; expected an obj",
        ),
        (
            system_edit("time", "stochastic"),
            r"time is 'stochastic'; expected discrete",
        ),
        (
            lambda index, system, members: system.update({"#observations": 3, "#players": 2}),
            r"the model has observations and 2 players; expected one player",
        ),
        (
            lambda index, system, members: system.update(
                {"#observations": 3, "observations-apply-to": "branches"}
            ),
            r"the observations apply to 'branches', or are random; expected one",
        ),
        (
            system_edit("branch-probability-type", INTERVAL),
            r"branch-to-probability\.bin has 64 bytes; expected 128",
        ),
        (
            system_edit("branch-probability-type", {"type": "int"}),
            r"is int of 64 bits; expected doub",
        ),
        (
            system_edit("branch-probability-type", {"type": "double", "size": 32}),
            r"a double of 32 bit",
        ),
        (
            system_edit("branch-probability-type", {"type": "float"}),
            r"type is 'float'; expected one of bool",
        ),
        (
            system_edit("#states", 10**15),
            r"#states is 1000000000000000; at most 2147483646 are read",
        ),
        (system_edit("#states", 2**31 - 2), r"describes a model of|choices\.bin has 40 bytes"),
        (system_edit("#branches", 10**15), r"index\.json describes a model of .* GB, which"),
        (
            system_edit("#branches", 2**64),
            r"#branches is 18446744073709551616; expected a whole num",
        ),
        (
            system_edit("#branches", 9),
            r"branch-to-target\.bin has 64 bytes; expected 72, by the count",
        ),
        (system_edit("#states", -1), r"#states is -1; expected a whole number"),
        (system_edit("#states", 4.0), r"#states is 4\.0; expected a whole number"),
        (system_edit("#states", True), r"#states is True; expected a whole number"),
        (system_edit("#states", 0), r"#states is 0; a model needs at least one"),
        (system_edit("#players", 0), r"state 0 has 2 choices; expected one, as #players is 0"),
        (system_edit("player-names", 1), r"player-names is 1; expected a list of texts"),
        (drop("branch-to-target.bin"), r"made\.umb': branch-to-target\.bin is missing"),
        (drop("branch-to-probability.bin"), r"choice 0 has 2 branches; without probabilities"),
        (
            drop("state-to-choices.bin"),
            r"state-to-choices\.bin is missing, so that 4 are mapped to 5",
        ),
        (drop("annotations/aps/g/states/values.bin"), r"aps/g/states/values\.bin is missing"),
        (drop("actions/choices/strings.bin"), r"actions/choices/strings\.bin is missing"),
        (
            member_edit("state-to-choices.bin", u64(0, 2, 1, 4, 5)),
            r"bin: it falls from 2 to 1 at 2",
        ),
        (member_edit("state-to-choices.bin", u64(0, 2, 2, 4, 5)), r"umb': state 1 has no choice"),
        (
            member_edit("state-to-choices.bin", u64(0, 2**63, 3, 4, 5)),
            r"it falls from 922337203685477",
        ),
        (
            member_edit("choice-to-branches.bin", u64(0, 2, 4, 6, 7, 9)),
            r"goes from 0 to 9; expected f",
        ),
        (
            member_edit("choice-to-branches.bin", u64(0, 2, 4, 6, 6, 8)),
            r"state 2, choice 0 leads now",
        ),
        (
            member_edit("branch-to-target.bin", u64(1, 2, 2, 3, 0, 1, 2, 4)),
            r"successor 4 is out of ra",
        ),
        (
            member_edit("branch-to-target.bin", u64(*[2**64 - 1] * 8)),
            r"successor 184467440737095516",
        ),
        (
            member_edit("branch-to-probability.bin", f64(0.5, 0.6, *[0.5] * 6)),
            r"sum to 1\.1, not 1",
        ),
        (
            member_edit("branch-to-probability.bin", f64(*[np.nan] * 8)),
            r"choice 0: probability nan",
        ),
        (
            member_edit("state-is-initial.bin", b"\1"),
            r"state-is-initial\.bin has 1 bytes; expected 8",
        ),
        (
            member_edit("actions/choices/values.bin", u32(0, 2, 0, 0, 0)),
            r"choice has the action 2; ex",
        ),
        (
            member_edit("actions/choices/string-mapping.bin", u64(0, 1, 3)),
            r"from 0 to 3; expected fro",
        ),
        (
            member_edit("actions/choices/strings.bin", b"a\xff"),
            r"strings\.bin: a text is not UTF-8",
        ),
        (
            member_edit(f"{DOUBLES}/choices/values.bin", f64(*[np.nan] * 5)),
            r"reward 'r' is NaN at cho",
        ),
        (
            annotation_edit("applies-to", ["players"]),
            r"rewards/r: applies-to is \['players'\]; expect",
        ),
        (
            annotation_edit("applies-to", []),
            r"rewards/r: applies-to is \[\]; expected a list of state",
        ),
        (
            annotation_edit("type", {"type": "double-interval"}),
            r"rewards/r/choices/values\.bin has 40 bytes; expected 80",
        ),
        (
            annotation_edit("type", {"type": "string"}),
            r"rewards/r: its type is string of 64 bits; exp",
        ),
        (
            annotation_edit("probability-type", {"type": "double"}),
            r"random values are not supported",
        ),
        (annotation_edit("alias", 3), r"rewards/r: alias is 3; expected a text"),
        (
            variable_edit("type", {"type": "int-interval", "size": 2}),
            r"'x' is int-interval; expected",
        ),
        (
            variable_edit("type", {"type": "uint", "size": 3}),
            r"take 9 bits; expected a multiple of 8",
        ),
        (variable_edit("offset", 2**63), r"'x': offset is 9223372036854775808; expected a whole"),
        (variable_edit("name", "b"), r"a variable is named 'b'; expected distinct"),
        (
            member_edit("valuations/states/valuation-to-class.bin", u32(0, 0, 0, 1)),
            r"is of class 1; t",
        ),
        (
            index_edit("annotations", {"aps": {"A": {}}}),
            r"'annotations/aps/A': expected an id of 0-9",
        ),
        (
            index_edit(
                "annotations",
                {
                    "aps": {
                        x: {"alias": "y", "applies-to": ["states"], "type": {"type": "bool"}}
                        for x in "ab"
                    }
                },
            ),
            r"two annotations are named 'y'",
        ),
    ],
)
def test_what_cannot_be_is_refused(tmp_path, edit, message):
    with pytest.raises(ValueError, match=message) as raised:
        read_umb(put(tmp_path, changed(edit)))
    assert str(tmp_path / "made.umb") in str(raised.value)


def with_member(name, content=b"x"):
    index, members = example()
    return archive(index, {**members, name: content})


def header_edit(place, value, member=b"state-to-choices.bin"):
    """The header of a member changed, with a right checksum."""
    data = bytearray(archive(*example()))
    at = data.index(member)
    data[at + place : at + place + len(value)] = value
    head = data[at : at + 512]
    checksum = sum(head) - sum(head[148:156]) + 8 * 32
    data[at + 148 : at + 156] = b"%06o\0 " % checksum
    return bytes(data)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", r"a header of the tar archive cannot be read, empty header"),
        (b"nonsense" * 100, r"a header of the tar archive cannot be read, .*: b'nonsense"),
        (gzip.compress(b"nonsense" * 100, mtime=0), r"a header of the tar archive cannot be read"),
        (tar({}), r"the archive has no index\.json; it is no UMB file"),
        (tar({"index.json": b"{"}), r"index\.json: this is not JSON: Expecting"),
        (tar({"index.json": b"\xff"}), r"index\.json: this is not JSON: 'utf-8'"),
        (tar({"index.json": b"[" * 10**5}), r"index\.json: this is not JSON: maximum recursion"),
        (tar({"index.json": b"9" * 10**5}), r"index\.json: this is not JSON: Exceeds"),
        (tar({"index.json": b"{}"}), r"index\.json: 'format-version' is missing"),
        (
            header_edit(124, b"00400000001\0", b"index.json"),
            r"index\.json has 67108865 bytes; at most 67108864",
        ),
        (
            with_member("../evil"),
            r"a member is named '\.\./evil'; expected a path within the archive",
        ),
        (with_member("/etc/passwd"), r"a member is named '/etc/passwd'; expected a path within"),
        (with_member("a/../../b"), r"a member is named 'a/\.\./\.\./b'"),
        (with_member("a\\b"), r"a member is named 'a\\\\b'"),
        (with_member("C:x"), r"a member is named 'C:x'"),
        (with_member("a\nb"), r"a member is named 'a\\nb'"),
        (with_member("./index.json"), r"state-to|two members are named|."),
        (
            tar([*members_of(archive(*example())), ("state-to-choices.bin", bytes(40))]),
            r"two members are named 'state-to-choices\.bin'",
        ),
        (header_edit(0, b"\xff"), r"cannot be read, 'utf-8' codec can't decode byte 0xff"),
        (header_edit(124, b"77777777777\0"), r"state-to-choices\.bin has 8589934591 bytes"),
        (
            header_edit(124, b"\x80" + (2**70).to_bytes(11, "big")),
            r"choices\.bin has 1180591620717",
        ),
        (
            header_edit(124, b"-0000000001\0"),
            r"'state-to-choices\.bin': a size of -1 bytes; expected none",
        ),
        (
            header_edit(124, b"\xff" * 12),
            r"'state-to-choices\.bin': a size of -1 bytes; expected none",
        ),
        (header_edit(156, b"x"), r"choices\.bin is missing|invalid header"),
        (
            header_edit(257, b"vstar"),
            r"cannot be read, 'ustar' is missing at byte 257: b'state-to-ch",
        ),
        (
            archive(*example()).replace(b"state-to-choices.bin", b"state-to-choicez.bin"),
            r"cannot be read, bad checksum: b'state-to-choicez\.bin",
        ),
    ],
)
def test_damaged_archives(tmp_path, data, message):
    path = put(tmp_path, data)
    if message.endswith("|."):  # a second index is passed over
        assert read_umb(path).num_states == 4
        return
    with pytest.raises(ValueError, match=message) as raised:
        read_umb(path)
    assert str(path) in str(raised.value)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(ValueError, match=r"cannot read '.*none\.umb': No such file"):
        read_umb(tmp_path / "none.umb")
    with pytest.raises(ValueError, match=r"cannot write '.*none/a\.umb'"):
        write_umb(tmp_path / "none" / "a.umb", full_model(np.random.default_rng(0)))
    model = replace(full_model(np.random.default_rng(0)), valuation={"z": np.zeros(9, complex)})
    with pytest.raises(ValueError, match=r"a\.umb': the variable 'z' holds complex128"):
        write_umb(tmp_path / "a.umb", model)
    model = replace(model, valuation={}, action_names=("\ud800", "", ""))
    with pytest.raises(ValueError, match=r"actions/choices: a text is no Unicode"):
        write_umb(tmp_path / "a.umb", model)


def test_archives_cut_off_anywhere(tmp_path):
    plain = archive(*example())
    end = len(plain.rstrip(b"\0"))
    for data, last in ((plain, end), (gzip.compress(plain, mtime=0), None)):
        for length in range(0, len(data[:last]), 37):
            with pytest.raises(ValueError, match=r"made\.umb"):
                read_umb(put(tmp_path, data[:length]))
    packed = bytearray(gzip.compress(plain, mtime=0))
    packed[-6] ^= 1  # of the checksum at the end
    with pytest.raises(ValueError, match="has the header of gzip and is damaged"):
        read_umb(put(tmp_path, bytes(packed)))


@pytest.mark.parametrize("pack", [gzip.compress, lambda data: lzma.compress(data, preset=0)])
def test_bombs(tmp_path, pack, monkeypatch):
    monkeypatch.setattr(_files, "ALWAYS_ALLOWED", 2**20)
    index, members = example()
    large = bytes(2**23)
    for data in (
        tar([("zeros", large), *members_of(archive(index, members))]),  # before the index
        with_member("zeros", large),
        archive(index, members) + large,
        with_member("actions/choices/unknown.bin", large),
    ):
        with pytest.raises(ValueError, match=r"holds more than \d+ bytes; decompress it first"):
            read_umb(put(tmp_path, pack(data)))
    taken = []
    monkeypatch.setattr(
        umb.np, "empty", lambda size, dtype: taken.append(size) or np.zeros(size, dtype)
    )
    for name in ("branch-to-target.bin", "actions/choices/strings.bin"):
        with pytest.raises(ValueError, match=rf"{name} has 8388608 bytes; expected (64|0 to)"):
            read_umb(put(tmp_path, pack(archive(index, {**members, name: large}))))
    assert max(taken) < 1000
    assert read_umb(put(tmp_path, pack(archive(index, members)))).num_states == 4


def test_a_model_beyond_the_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(umb.os, "sysconf", lambda name: 16)
    with pytest.raises(
        ValueError, match=r"describes a model of \S+ GB, which takes twice that; th"
    ):
        read_umb(put(tmp_path, archive(*example())))


# --- Storm ----------------------------------------------------------------------------------


def matrix_of(model):
    """Of a model of Storm: where choices start, where entries start, targets, probabilities."""
    matrix = model.transition_matrix
    rows = [[(e.column, e.value) for e in matrix.get_row(r)] for r in range(matrix.nr_rows)]
    starts = [matrix.get_row_group_start(s) for s in range(matrix.nr_columns)]
    return [*starts, matrix.nr_rows], rows


def assert_storm_has(storm, model):
    host, rows = model.host, matrix_of(storm)
    assert rows[0] == host.row_start.tolist()
    for r, row in enumerate(rows[1]):
        span = slice(host.entry_start[r], host.entry_start[r + 1])
        assert [x for x, _ in row] == host.successor[span].tolist()
        assert [float(Fraction(str(x))) for _, x in row] == host.probability[span].tolist()
    labels = storm.labeling
    assert labels.get_labels() - {"init"} == set(model.propositions) - {"init"}
    for name in labels.get_labels():
        expected = model.initial > 0 if name == "init" else model.states_with_label(name)
        assert list(labels.get_states(name)) == np.flatnonzero(expected).tolist()
    assert set(storm.reward_models) == set(model.rewards)


@pytest.mark.parametrize("compression", ["gzip", "xz", None])
def test_storm_reads_what_is_written(tmp_path, compression):
    stormpy = pytest.importorskip("stormpy")
    path = str(tmp_path / "model.umb")
    for seed in range(4):
        rng = np.random.default_rng(seed)
        model = replace(
            everything(rng, 30, chain=seed == 1),
            propositions=("goal", "init", "A b", "a", "b", "c"),
        )
        rewards = {name: x for name, x in model.rewards.items() if name != "cost"}
        variables = {name: x for name, x in model.valuation.items() if name}  # Storm wants a name
        model = replace(model, rewards=rewards, valuation=variables)
        given = make_game(model, rng.random(30) < 0.5) if seed == 2 else model
        write_umb(path, given, compression=compression)
        storm = stormpy.build_model_from_umb(path)
        assert storm.model_type.name == {1: "DTMC", 2: "SMG"}.get(seed, "MDP")
        assert_storm_has(storm, model)
        for name, reward in rewards.items():
            found = storm.reward_models[name]
            if reward.state is not None:
                np.testing.assert_array_equal(found.state_rewards, reward.state)
            if reward.choice is not None:
                np.testing.assert_array_equal(found.state_action_rewards, reward.choice)
        for row in range(0 if seed == 1 else model.num_rows):
            name = model.action_names[model.action[row]]
            assert storm.choice_labeling.get_labels_of_choice(row) == ({name} if name else set())


PROGRAM = """mdp
module M
  x : [-3..7] init 0;
  b : bool init false;
  [up] x < 7 & !b -> 0.3 : (x'=x+1) + 0.7 : (b'=true);
  [down] x > -3 & !b -> 1/3 : (x'=x-1) + 2/3 : (x'=-3);
  [] b -> (b'=false);
  [stop] x = 7 | x = -3 -> true;
endmodule
label "goal" = x = 7;
label "Low" = x < 0;
rewards "steps" true : 1; [up] true : 2.5; endrewards
"""


def test_what_storm_writes_is_read(tmp_path):
    stormpy = pytest.importorskip("stormpy")
    source, path = tmp_path / "program.prism", str(tmp_path / "model.umb")
    source.write_text(PROGRAM)
    options = stormpy.BuilderOptions()
    for what in ("all_labels", "all_reward_models", "choice_labels", "state_valuations"):
        getattr(options, f"set_build_{what}")()
    program = stormpy.parse_prism_program(str(source))
    storm = stormpy.build_model(program, options=options)
    modes = stormpy.io.CompressionMode
    for mode in (modes.GZIP, modes.XZ, modes.NO_COMPRESSION):
        export = stormpy.io.UmbExportOptions()
        export.compression = mode
        stormpy.io.export_to_umb(storm, path, options=export)
        found = read_umb(path)
        assert_storm_has(storm, found)
        reward = storm.reward_models["steps"]
        assert found.rewards["steps"].state.tolist() == list(reward.state_rewards)
        assert found.rewards["steps"].choice.tolist() == list(reward.state_action_rewards)
        for row in range(found.num_rows):
            name = found.action_names[found.action[row]]
            assert storm.choice_labeling.get_labels_of_choice(row) == ({name} if name else set())
        x, goal = found.valuation["x"], found.states_with_label("goal")
        assert np.array_equal(goal, x == 7) and np.array_equal(
            found.states_with_label("Low"), x < 0
        )
        assert found.valuation["b"].dtype == bool


def test_storm_reads_rationals_as_here(tmp_path):
    stormpy = pytest.importorskip("stormpy")
    index, members = classes_example()
    del index["valuations"]
    members = {name: x for name, x in members.items() if not name.startswith("valuations")}
    path = put(tmp_path, archive(index, members))
    assert_storm_has(stormpy.build_model_from_umb(str(path)), read_umb(path))


def test_storm_finds_the_same_values(tmp_path):
    stormpy = pytest.importorskip("stormpy")
    source, path = tmp_path / "program.prism", str(tmp_path / "model.umb")
    source.write_text(PROGRAM)
    options = stormpy.BuilderOptions()
    options.set_build_all_labels()
    options.set_build_all_reward_models()
    storm = stormpy.build_model(stormpy.parse_prism_program(str(source)), options=options)
    stormpy.io.export_to_umb(storm, path)
    write_umb(path, read_umb(path))
    again = stormpy.build_model_from_umb(path)
    for text in ('Pmax=? [F "goal"]', 'Pmin=? [F "goal"]', 'R{"steps"}max=? [F "goal" | "Low"]'):
        assert storm_values(storm, text) == storm_values(again, text)


def test_a_damaged_extended_header_is_no_end_of_an_archive():
    """Python's tarfile ends silently there, without the members that follow."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.PAX_FORMAT) as file:
        for name in ("first.bin", "x" * 120 + ".bin", "last.bin"):
            file.addfile(tarfile.TarInfo(name))
    content = buffer.getvalue()
    found = [name for name, _ in members(io.BytesIO(content))]
    assert len(found) == 3 and found[-1] == "last.bin"
    record = re.search(rb"\d+ path=", content)
    assert record is not None
    zero = b"0" * (len(record[0]) - len(b" path=")) + b" path="
    damaged = content[: record.start()] + zero + content[record.end() :]
    with pytest.raises(ValueError, match="a header is damaged, or data follow"):
        list(members(io.BytesIO(damaged)))
