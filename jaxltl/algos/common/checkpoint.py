"""Training checkpoints: atomic, bit for bit, in parts of a mesh, refused for another problem.

A fingerprint of the problem and of the hyperparameters is stored with it: shape, dtype and hash of
every array, and every static field. A checkpoint of another problem is refused even if shapes
agree. Arrays on the devices of several processes are written in parts, one by each process, and
read onto any other mesh by any number of processes.

>>> import os, tempfile
>>> import numpy as np
>>> from jaxltl.algos.common import checkpoint
>>> path = os.path.join(tempfile.mkdtemp(), "state.npz")
>>> state, description = {"step": np.int32(3)}, checkpoint.fingerprint(problem=np.arange(2))
>>> checkpoint.save(path, state, description)
>>> checkpoint.load(path, {"step": np.int32(0)}, description)["step"].item()
3
>>> checkpoint.remove(path)
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import functools
import glob
import hashlib
import inspect
import json
import os
import secrets
import textwrap
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core.array_types import PyTree
from jaxltl.core.files import atomic_write, read_arrays
from jaxltl.core.models.ops.array_namespace import to_jax


_DESCRIPTION = "given"  # the fingerprint's name in the file
_PARTS = "parts"  # name of the index of arrays in other files


def save(
    path: str | os.PathLike[str], state: PyTree, description: Mapping[str, str] | None = None
) -> None:
    """Writes a learner's `state`, a tree of arrays, as an ``.npz`` at `path`, atomically.

    `description` is the :func:`fingerprint` of the problem and hyperparameters. With several processes all
    call it, with a shared directory. Each writes its part of arrays on the devices of several, and the
    first process writes the file last.
    """
    path, named = Path(path), [(name, _data(leaf)) for name, leaf in _named(state)]
    apart = {name: leaf for name, leaf in named if _is_apart(leaf)}
    before = _parts_of(path)
    stored = _write_parts(path, apart) if apart else {}
    if jax.process_index() and any(_is_shared(leaf) for _, leaf in named):
        return
    arrays: dict[str, PyTree] = {_DESCRIPTION: np.array(json.dumps(dict(description or {})))}
    arrays |= {name: np.asarray(leaf) for name, leaf in named if name not in apart}
    if stored:
        arrays[_PARTS] = np.array(json.dumps({name: list(x) for name, x in stored.items()}))
    with atomic_write(path) as file:
        np.savez(file, **arrays)
    current = {file for x in stored.values() for *_, file, _ in x.pieces}
    _unlink([part for part in before if part.name not in current])


def remove(path: str | os.PathLike[str]) -> None:
    """Removes the checkpoint at `path`, its parts and unfinished files; no process may be writing it.

    A missing file is no error.
    """
    path = Path(path)
    _unlink([path, *_parts_of(path), *_unfinished(path)])


def load(
    path: str | os.PathLike[str], like: PyTree, description: Mapping[str, str] | None = None
) -> PyTree:
    """The state saved by :func:`save` at `path`, bit for bit, as a tree like `like`.

    `like` is a state of the same learner and problem, for example from ``init``; a first axis of length
    zero matches any length. Arrays are placed on its devices, and each process reads its parts.
    `description` is as for :func:`save`.

    Raises:
      ValueError: the file is damaged, its arrays do not fit `like`, or it was saved for another problem
        or other hyperparameters.
    """
    with _ArrayParts(path) as others:
        try:
            # An open file of our own is closed even where a damaged archive is given up.
            with open(path, "rb") as file:
                arrays: dict[str, PyTree] = read_arrays(file)
            before = json.loads(str(arrays.pop(_DESCRIPTION)))
            stored = json.loads(str(arrays.pop(_PARTS, "{}")))
            arrays |= {name: _Stored(*x) for name, x in stored.items()}
            leaves = [
                _loaded(str(path), name, leaf, arrays.get(name), others)
                for name, leaf in _named(like)
            ]
        except _Another as error:
            raise ValueError(str(error)) from None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{str(path)!r} is not a saved state: {error}") from error
    _require_same(str(path), before, dict(description or {}))
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


class _Another(Exception):
    """An array of another learner or problem."""


def _loaded(path: str, name: str, leaf: PyTree, array: PyTree, others: _ArrayParts) -> PyTree:
    """An array on its devices, from the file or from the parts."""
    expected = _data(leaf)
    if array is None or not _fits(array, expected):
        is_ = "missing" if array is None else f"{array.dtype}{list(array.shape)}"
        raise _Another(
            f"{path!r} does not belong to this run: {name} is {is_}, expected "
            f"{expected.dtype}{list(expected.shape)}. Delete the file to start afresh."
        )
    if isinstance(expected, jax.Array) and len(expected.sharding.device_set) > 1:

        def block(index: tuple[slice, ...] | None) -> np.ndarray:
            stored = isinstance(array, _Stored)
            return others.read(array, index) if stored else array[index or ()]

        value = jax.make_array_from_callback(tuple(array.shape), expected.sharding, block)
    else:
        value = to_jax(others.read(array) if isinstance(array, _Stored) else array)
    if expected is not leaf:
        value = jax.random.wrap_key_data(value, impl=jax.random.key_impl(leaf))
    return value


def _fits(array: np.ndarray | _Stored, expected: jax.Array) -> bool:
    shape = expected.shape
    if shape[:1] == (0,):
        shape = (*array.shape[:1], *shape[1:])
    return tuple(array.shape) == shape and array.dtype == expected.dtype


def _require_same(path: str, before: dict[str, str], now: dict[str, str]) -> None:
    other = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    if other:
        name = other[0]
        raise ValueError(
            f"{path!r} does not belong to this run: {name} was "
            f"{before.get(name, 'not given')} and is {now.get(name, 'not given')}"
            + (f" ({len(other)} differences)" if len(other) > 1 else "")
            + ". Delete the file to start afresh, or continue with the original arguments."
        )


def _named(tree: PyTree) -> list[tuple[str, PyTree]]:
    """Leaves with distinct file-safe names, numbered to distinguish nested paths."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return [
        (f"{i}{jax.tree_util.keystr(path)}".replace("/", "_"), _array_of(leaf))
        for i, (path, leaf) in enumerate(leaves)
    ]


def _array_of(leaf: PyTree) -> PyTree:
    """As ``jnp.asarray``, but NumPy arrays stay on the host, where nothing is compiled."""
    if not isinstance(leaf, np.ndarray):
        return jnp.asarray(leaf)
    return leaf.astype(jax.dtypes.canonicalize_dtype(leaf.dtype), copy=False)


def _data(leaf: jax.Array) -> jax.Array:
    return jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf


# --- fingerprints ---------------------------------------------------------------------------


def fingerprint(**parts: object) -> dict[str, str]:
    """A description of each of the `parts`: types, static fields, and arrays by a hash of their bytes.

    Functions are described by their text, so that other processes find the same, also of another
    version of Python; where the text is not found, by their bytecode.

    >>> one, two = (fingerprint(x=(np.arange(2), {"b": y})) for y in (0.5, 0.25))
    >>> sorted(one), [name for name in one if one[name] != two[name]]
    (['x[0]', "x[1]['b']"], ["x[1]['b']"])
    """
    return dict(pair for name, value in parts.items() for pair in _described(name, value))


def _described(name: str, value: PyTree) -> Iterator[tuple[str, str]]:
    value = inspect.unwrap(value)  # what jax.jit wraps
    if value is None or isinstance(value, bool | int | float | complex | str | bytes | np.dtype):
        yield name, repr(value)
    elif isinstance(value, jax.Array | np.ndarray | np.generic):
        yield name, _array(value)
    elif isinstance(value, Mapping):
        for key in sorted(value, key=str):
            yield from _described(f"{name}[{key!r}]", value[key])
    elif isinstance(value, list | tuple):
        names = getattr(value, "_fields", None)
        for i, entry in enumerate(value):
            yield from _described(f"{name}.{names[i]}" if names else f"{name}[{i}]", entry)
    elif isinstance(value, functools.partial):  # JAX's are its children
        for part in ("func", "args", "keywords"):
            yield from _described(f"{name}.{part}", getattr(value, part))
    elif isinstance(value, types.FunctionType):
        yield from _function(name, value)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield name, _type(value)
        for field in dataclasses.fields(value):
            if field.name not in ("parent", "name"):  # of a flax module: where it hangs
                yield from _described(f"{name}.{field.name}", getattr(value, field.name))
    else:
        leaves, structure = jax.tree.flatten(value)
        yield name, _type(value) if jax.tree_util.treedef_is_leaf(structure) else str(structure)
        if not jax.tree_util.treedef_is_leaf(structure):
            yield from _described(name, leaves)


def _array(value: object) -> str:
    """Shape, dtype and a hash of the bytes; small arrays also as text."""
    value = _data(value) if isinstance(value, jax.Array) else value
    array = np.asarray(value)
    digest = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16]
    text = f" = {array.tolist()}" if array.size <= 4 else ""
    return f"{array.dtype}{list(array.shape)}{text} #{digest}"


def _function(name: str, value: types.FunctionType) -> Iterator[tuple[str, str]]:
    yield name, f"{value.__module__}.{value.__qualname__} #{_code(value.__code__)}"
    for free, cell in zip(value.__code__.co_freevars, value.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):  # a cell that is empty yet
            held = inspect.unwrap(cell.cell_contents)
            if isinstance(held, types.FunctionType):  # its own cells may lead back here
                yield f"{name}.{free}", _code(held.__code__)
            else:
                yield from _described(f"{name}.{free}", held)


def _code(code: types.CodeType) -> str:
    """A hash of a function's text without comments and docstring, else of its bytecode."""
    if (text := _source(code)) is not None:
        return hashlib.sha256(text.encode()).hexdigest()[:16]
    held = [_code(c) if isinstance(c, types.CodeType) else _constant(c) for c in code.co_consts]
    return hashlib.sha256(code.co_code + repr((held, code.co_names)).encode()).hexdigest()[:16]


def _source(code: types.CodeType) -> str | None:
    """The formatted text of a function; None if it is not found, or one of several in a statement."""
    try:
        statement = ast.parse(textwrap.dedent(inspect.getsource(code))).body[0]
    except (OSError, TypeError, SyntaxError, IndexError):
        return None
    nodes = [
        node
        for node in ast.walk(statement)
        if isinstance(node, ast.Lambda if code.co_name == "<lambda>" else ast.FunctionDef)
        and getattr(node, "name", "<lambda>") == code.co_name
    ]
    if len(nodes) != 1:
        return None
    if isinstance(node := nodes[0], ast.FunctionDef) and ast.get_docstring(node) is not None:
        node.body = node.body[1:] or [ast.Pass()]
    return ast.unparse(node)


def _constant(value: object) -> str:
    """The representation of a constant; sets in an order that is the same in every process."""
    return repr(sorted(map(repr, value)) if isinstance(value, frozenset) else value)


def _type(value: object) -> str:
    kind = value if isinstance(value, type) else type(value)
    return f"{kind.__module__}.{kind.__qualname__}"


# --- arrays over several processes ----------------------------------------------------------

# A part has a new name each time it is written. One process writes the file that names the parts
# last, when all processes have written theirs, and the previous parts stay until then. So whenever a
# process dies, that file and the parts that it names are complete.


def _is_shared(x: object) -> bool:
    """True if an array lies on the devices of several processes."""
    return isinstance(x, jax.Array) and not x.is_fully_addressable


def _is_apart(x: object) -> bool:
    """True if an array lies on the devices of several processes and is not replicated."""
    return isinstance(x, jax.Array) and _is_shared(x) and not x.is_fully_replicated


class _Stored(NamedTuple):
    """An array in parts: bounds, file and name in the file of each of its `pieces`."""

    shape: list[int]
    dtype: str
    pieces: list[tuple[list[int], list[int], str, str]]


def _write_parts(path: Path, arrays: Mapping[str, PyTree]) -> dict[str, _Stored]:
    """Writes this process's part of arrays, and waits until the others have written theirs."""
    from jax.experimental.multihost_utils import process_allgather

    token = np.frombuffer(secrets.token_bytes(8), np.uint32)
    mine = {
        _piece_name(array, shard.index): np.asarray(shard.data)
        for array, x in enumerate(arrays.values())
        for shard in x.addressable_shards
        if shard.replica_id == 0
    }
    if mine:
        with atomic_write(_part(path, jax.process_index(), token)) as file:
            np.savez(file, allow_pickle=False, **mine)
    tokens = np.asarray(process_allgather(token))  # when it is back all have written
    names = [_part(path, process, x).name for process, x in enumerate(tokens)]
    return {
        name: _Stored(
            list(x.shape),
            str(x.dtype),
            [
                (
                    *_ends(shard.index, x.shape),
                    names[shard.device.process_index],
                    _piece_name(array, shard.index),
                )
                for shard in x.global_shards
                if shard.replica_id == 0
            ],
        )
        for array, (name, x) in enumerate(arrays.items())
    }


def _part(path: Path, process: int, token: np.ndarray) -> Path:
    return path.with_name(f"{path.name}.part-{process}-{token.tobytes().hex()}")


def _parts_of(path: Path) -> list[Path]:
    """All parts in the directory of a file, named by it or not."""
    return sorted(path.parent.glob(f"{glob.escape(path.name)}.part-*"))


def _unfinished(path: Path) -> list[Path]:
    """Temporary files that killed processes left of a file and of its parts."""
    return sorted(path.parent.glob(f".{glob.escape(path.name)}.*"))


def _unlink(paths: list[Path]) -> None:
    """Removes files, those that are there."""
    for path in paths:
        path.unlink(missing_ok=True)


class _ArrayParts(contextlib.ExitStack):
    """The parts of a file, read on demand, each piece once, and closed in the end."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__()
        self._beside = Path(path)
        self._files, self._pieces = dict[str, Any](), dict[tuple[str, str], np.ndarray]()

    def read(self, stored: _Stored, index: tuple[slice, ...] | None = None) -> np.ndarray:
        """A block of an array, or all of it, from its pieces; ValueError if a part is missing or damaged."""
        begin, end = _ends(index or (), stored.shape)
        block = np.zeros([b - a for a, b in zip(begin, end, strict=True)], stored.dtype)
        for first, last, file, name in stored.pieces:
            low, high = np.maximum(begin, first), np.minimum(end, last)
            if (low < high).all():
                block[_block(low, high, begin)] = self._piece(file, name)[_block(low, high, first)]
        return block

    def _piece(self, file: str, name: str) -> np.ndarray:
        if (file, name) not in self._pieces:
            try:
                if file not in self._files:
                    opened = self.enter_context(self._beside.with_name(file).open("rb"))
                    self._files[file] = np.load(opened, allow_pickle=False)
                self._pieces[file, name] = self._files[file][name]
            except Exception as error:  # damaged bytes make numpy and zipfile raise almost anything
                fault = "missing" if isinstance(error, FileNotFoundError) else "damaged"
                raise ValueError(f"its part {file!r} is {fault}.") from None
        return self._pieces[file, name]


def _ends(index: tuple[slice, ...], shape: Sequence[int]) -> tuple[list[int], list[int]]:
    """First and last indices of a block; axes that are not named are whole."""
    index = (*index, *(slice(None),) * (len(shape) - len(index)))
    each = [x.indices(int(n)) for x, n in zip(index, shape, strict=True)]
    return [x[0] for x in each], [x[1] for x in each]


def _block(low: Iterable[int], high: Iterable[int], first: Iterable[int]) -> tuple[slice, ...]:
    return tuple(slice(int(a - c), int(b - c)) for a, b, c in zip(low, high, first, strict=True))


def _piece_name(array: int, index: tuple[slice, ...]) -> str:
    return f"{array}-" + "-".join(str(x.start or 0) for x in index)
