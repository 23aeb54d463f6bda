"""Readers tried with damaged files: nothing but errors of ours comes out, in bounded time.

`READERS` is the table of what is tried. To add a format, give its reader, the end of its files'
names, valid files as bytes, and what damages them.
"""

import gzip
import io
import json
import lzma
import re
import resource
import tarfile
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.models.game import make_game
from jaxltl.core.models.sparse import make_sparse
from jaxltl.io.cassandra import read_cassandra
from jaxltl.io.drn.drn import read_drn, write_drn
from jaxltl.io.drn.parametric import read_parametric
from jaxltl.io.log import read_log
from jaxltl.io.model_files import read_model
from jaxltl.io.npz import read_npz, write_npz
from jaxltl.io.prism.explicit import read_prism, write_prism
from jaxltl.io.reward_machine import read_reward_machine
from jaxltl.io.umb.umb import read_umb, write_umb
from tests.io.archives import classes_example, example, members_of, tar, umb
from tests.io.mutate import mutated
from tests.io.same import full_interval, full_model, random_pomdp
from tests.io.test_cassandra import TIGER
from tests.io.test_drn import MDP as DRN
from tests.io.test_parametric import CHAIN as PARAMETRIC
from tests.io.test_program import PROGRAMS
from tests.io.test_reward_machine import OFFICE

MAX_SECONDS = 5.0  # of processor time, for one small file
MAX_MEMORY = 2**30  # bytes that trying them may add

Damage = Callable[[np.random.Generator, bytes], bytes]


class Reader(NamedTuple):
    """What is tried.

    Attributes:
      read: takes a path.
      suffix: the end of the files' names.
      samples: valid files, made in a folder.
      damage: what is done to one of them.
    """

    read: Callable[[Path], Any]
    suffix: str
    samples: Callable[[Path], list[bytes]]
    damage: Damage = mutated


def try_damaged(name: str, count: int, seed: int, folder: Path) -> int:
    """Reads damaged files; how many were still valid.

    Raises:
      AssertionError: another error than ours came out, or it took too long, with the file left.
    """
    reader = READERS[name]
    samples = reader.samples(folder)
    path = folder / f"damaged{reader.suffix}"
    for sample in samples:
        path.write_bytes(sample)
        reader.read(path)
    rng, before, valid = np.random.default_rng(seed), _memory(), 0
    for i in range(count):
        data = reader.damage(rng, samples[rng.integers(len(samples))])
        path.write_bytes(data)
        start = time.process_time()
        try:
            reader.read(path)
            valid += 1
        except Exception as error:
            ours = type(error) is ValueError and str(path) in str(error)
            assert ours, f"{name}, seed {seed}, file {i} in {path}: {error!r}"
        spent = time.process_time() - start
        assert spent < MAX_SECONDS, f"{name}, seed {seed}, file {i} in {path}: {spent:.1f} s"
    assert _memory() - before < MAX_MEMORY, f"{name}, seed {seed}"
    return valid


def _memory() -> int:
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


# --- archives -------------------------------------------------------------------------------

_NUMBERS = (0, 1, 2, 3, 5, 2**31 - 1, 2**31, 2**32, 2**53, 2**63 - 1, 2**63, 2**64 - 1)
_VALUES = (
    None,
    True,
    False,
    0,
    -1,
    1,
    2,
    3,
    64,
    128,
    256,
    2**31,
    10**15,
    2**63,
    2**64,
    10**40,
    1.5,
    float("nan"),
    float("inf"),
    "",
    "x",
    "states",
    "double",
    "rational",
    "int",
    "bool",
    "string",
    "double-interval",
    "rational-interval",
    "\ud800",
    [],
    {},
    [1],
    ["states", "states"],
    [[[]]],
)
_NAMES = (
    "../index.json",
    "/index.json",
    "./index.json",
    "a\\b",
    "",
    "x" * 300,
    "A",
    "é",
    "annotations//x",
    "state-to-player.bin",
    "index.json",
    "branch-to-target.bin",
    "..",
    ".",
)


def damaged_archive(rng: np.random.Generator, data: bytes) -> bytes:
    """A UMB file with its bytes changed, or its members, or its index; compressed or not."""
    kind = rng.integers(8)
    if kind == 0:
        return mutated(rng, data)
    if kind < 6:
        members = members_of(data)
        for _ in range(rng.integers(1, 4)):
            members = _changed(rng, members)
        data = tar(members, (tarfile.GNU_FORMAT, tarfile.PAX_FORMAT)[rng.integers(2)])
    else:
        data = _flipped(rng, data)
    pack = rng.integers(6)
    if pack > 1:
        return data
    packed = gzip.compress(data, 1) if pack else lzma.compress(data, preset=0)
    return mutated(rng, packed) if rng.integers(2) else packed


def _changed(rng: np.random.Generator, members: list) -> list:
    """One member lost, repeated, moved, renamed or changed; the index half of the time."""
    if not members:
        return members
    members, i = list(members), int(rng.integers(len(members)))
    name, content = members[i]
    kind = rng.integers(12)
    if kind == 0:
        del members[i]
    elif kind == 1:
        members.insert(int(rng.integers(len(members) + 1)), members[i])
    elif kind == 2:
        members.insert(int(rng.integers(len(members))), members.pop(i))
    elif kind == 3:
        members[i] = _NAMES[rng.integers(len(_NAMES))], content
    elif kind == 4:
        members[i] = name, content[: rng.integers(len(content) + 1)]
    elif kind == 5:
        members[i] = name, content + bytes(int(rng.integers(1, 20)))
    elif kind == 6 and len(content) >= 8:
        at = 8 * int(rng.integers(len(content) // 8))
        number = _NUMBERS[rng.integers(len(_NUMBERS))].to_bytes(8, "little")
        members[i] = name, content[:at] + number + content[at + 8 :]
    elif kind == 7:
        members[i] = name, _flipped(rng, content)
    else:
        members = [(n, _edited(rng, c) if n == "index.json" else c) for n, c in members]
    return members


def _flipped(rng: np.random.Generator, data: bytes) -> bytes:
    """A few bits changed."""
    array = np.frombuffer(data, np.uint8).copy()
    if array.size:
        for at in rng.integers(array.size, size=rng.integers(1, 4)):
            array[at] ^= 1 << rng.integers(8)
    return array.tobytes()


def _edited(rng: np.random.Generator, content: bytes) -> bytes:
    """JSON with a value changed somewhere; at times its text."""
    try:
        data = json.loads(content)
    except (ValueError, RecursionError):
        return content
    if rng.integers(8) == 0 or not isinstance(data, dict | list):
        return mutated(rng, content)
    places = list(_places(data))
    if not places:
        return b"[" * 100_000
    table, key = places[rng.integers(len(places))]
    value, kind = table[key], rng.integers(6)
    if kind == 0:
        del table[key]
    elif kind == 1 and type(value) is int:
        table[key] = value + int(rng.integers(-2, 3))
    elif kind == 2 and isinstance(table, dict):
        table[f"{key}x"] = value
    elif kind == 3 and isinstance(table, dict):
        table[key] = list(table.values())[rng.integers(len(table))]
    else:
        table[key] = _VALUES[rng.integers(len(_VALUES))]
    try:
        return json.dumps(data).encode()
    except (ValueError, RecursionError):  # a circle
        return content


def _places(data: Any) -> Any:
    """Everywhere in JSON: the object or list, and the key."""
    for key, value in data.items() if isinstance(data, dict) else enumerate(data):
        yield data, key
        if isinstance(value, dict | list):
            yield from _places(value)


def umb_samples(folder: Path) -> list[bytes]:
    """Plain archives of a chain, a decision process and a game, and of what only others write."""
    rng, path, samples = np.random.default_rng(0), folder / "sample.umb", []
    process = full_model(rng)
    models = (
        full_model(rng, 5, chain=True),
        process,
        make_game(process, rng.random(process.num_states) < 0.5),
    )
    for model in models:
        write_umb(path, model, compression=None)
        samples.append(path.read_bytes())
    write_umb(path, full_interval(rng), compression=None)
    samples.append(path.read_bytes())
    write_umb(path, random_pomdp(rng), compression=None)
    samples.append(path.read_bytes())
    return [*samples, umb(*example()), umb(*classes_example(), folders=True)]


# --- texts, and arrays ----------------------------------------------------------------------


def _written(write: Callable[[Path, Any], None], name: str) -> Callable[[Path], list[bytes]]:
    """Samples of a writer for models."""

    def samples(folder: Path) -> list[bytes]:
        rng, path, found = np.random.default_rng(0), folder / name, []
        for model in (
            full_model(rng, 5, chain=True, transition_rewards=False),
            full_model(rng, transition_rewards=False),
            make_sparse(None, [0, 1], [0], [1.0]),
            full_interval(rng, transition_rewards=False),
        ):
            write(path, model)
            found.append(path.read_bytes())
            path.unlink()
        return found

    return samples


_DTYPES = (
    bool,
    np.int8,
    np.int64,
    np.uint64,
    np.float16,
    np.float64,
    np.complex128,
    "U3",
    "S2",
    "datetime64[s]",
)


def damaged_arrays(rng: np.random.Generator, data: bytes) -> bytes:
    """An ``.npz`` with its bytes changed, or its arrays."""
    if rng.integers(4) == 0:
        return mutated(rng, data)
    arrays: dict[str, Any] = dict(np.load(io.BytesIO(data)))
    for _ in range(rng.integers(1, 4)):
        names = list(arrays) or ["label"]
        name, other = (names[i] for i in rng.integers(len(names), size=2))
        array = np.array(arrays.get(name, [True]))
        array = array.real if array.dtype.kind == "c" else array
        kind = rng.integers(8)
        if kind == 0:
            arrays.pop(name, None)
        elif kind == 1:
            arrays[
                (
                    "system",
                    "transition",
                    "row_start",
                    "reward:x",
                    "reward:x:state",
                    "variable:x",
                    "unknown",
                    "lower",
                    "upper",
                )[rng.integers(9)]
            ] = array
        elif kind == 2:
            arrays[name] = arrays.get(other, array)
        elif kind == 3:
            try:
                with np.errstate(all="ignore"):
                    arrays[name] = array.astype(_DTYPES[rng.integers(len(_DTYPES))])
            except (ValueError, TypeError, RuntimeError):
                arrays[name] = np.zeros(array.shape, _DTYPES[rng.integers(len(_DTYPES))])
        elif kind == 4:
            arrays[name] = array[: rng.integers(len(array) + 1)] if array.ndim else array
        elif kind == 5:
            arrays[name] = array.reshape((-1, 1) if rng.integers(2) else (1, *array.shape))
        elif array.size and array.dtype.kind in "iuf":
            array = np.atleast_1d(array)
            value = (0, 1, -1, 2**31, 2**62, 100, np.nan, np.inf)[
                rng.integers(6 if array.dtype.kind in "iu" else 8)
            ]
            with np.errstate(all="ignore"):
                array.flat[rng.integers(array.size)] = np.array(value).astype(array.dtype)
            arrays[name] = array
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def npz_samples(folder: Path) -> list[bytes]:
    """Sparse and padded models, and a game."""
    file, found = io.BytesIO(), _written(write_npz, "sample.npz")(folder)
    probability = np.array([[[0.5, 0.5], [1, 0]], [[1, 0], [0, 0]]])
    successor = np.array([[[0, 1], [1, 0]], [[1, 0], [0, 0]]])
    np.savez(
        file,
        successor=successor,
        probability=probability,
        system=[True, False],
        label=[[True], [False]],
        propositions=["a"],
        actions=["x", "y"],
        initial=[1.0, 0],
    )
    found.append(file.getvalue())
    file = io.BytesIO()
    np.savez(file, transition=np.array([[[0.5, 0.5]], [[0, 1]]]))
    found.append(file.getvalue())
    file = io.BytesIO()
    np.savez(file, successor=successor, lower=probability / 2, upper=probability)
    return [*found, file.getvalue()]


_LOG = b"""time,state,action,next,count
1,hall,left,"kitchen, lower",3
2,"kitchen, lower", right ,hall,1
3,0,left,hall,0
"""


def _texts(*samples: str) -> Callable[[Path], list[bytes]]:
    """Samples by hand."""
    return lambda folder: [text.encode() for text in samples]


_drn = _written(write_drn, "sample.drn")


def _pomdp(folder: Path) -> list[bytes]:
    pomdp = random_pomdp(np.random.default_rng(0))
    world = pomdp.fully_observable
    world = replace(world, rewards={"cost": world.rewards["cost"]})
    write_drn(folder / "sample.drn", replace(pomdp, fully_observable=world))
    return [(folder / "sample.drn").read_bytes()]


_WORDS = (
    b"module endmodule init endinit rewards endrewards player endplayer label formula const int "
    b"double bool global true false x y -> => <=> ? : [ ] .. ' ( ) = != & | ! + - * / ^ , ; min( "
    b"pow( mod( log( floor( 0.5 0 -1 1e400 10000000000 99999999999999999999 " + b"(" * 70
).split()


def damaged_program(rng: np.random.Generator, data: bytes) -> bytes:
    """A program with its bytes changed, or some of its words and signs."""
    if rng.integers(2):
        return mutated(rng, data)
    words = re.split(rb"(\W)", data)
    for i in rng.integers(len(words), size=rng.integers(1, 4)):
        words[i] = _WORDS[rng.integers(len(_WORDS))]
    return b"".join(words)


def _read_program(path: Path) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return read_model(path, constants="N=4", max_states=10_000)
        except ValueError as error:
            assert "\n" not in str(error), error
            placed = ", line " in str(error) and ", column " in str(error)
            assert placed or "UTF-8" in str(error), error
            raise


READERS = {
    "program": Reader(_read_program, ".prism", _texts(*PROGRAMS), damaged_program),
    "umb": Reader(read_umb, ".umb", umb_samples, damaged_archive),
    "npz": Reader(read_npz, ".npz", npz_samples, damaged_arrays),
    "drn": Reader(read_drn, ".drn", lambda folder: [DRN.encode(), *_drn(folder)]),
    "pomdp": Reader(read_model, ".drn", _pomdp),
    "cassandra": Reader(read_cassandra, ".pomdp", _texts(TIGER)),
    "parametric": Reader(read_parametric, ".drn", _texts(PARAMETRIC)),
    "pexp": Reader(read_prism, ".pexp", _written(write_prism, "sample.pexp")),
    "reward_machine": Reader(read_reward_machine, ".txt", _texts(OFFICE)),
    "log": Reader(read_log, ".csv", lambda folder: [_LOG, gzip.compress(_LOG)]),
}
